"""Training agents with drawn hyperparameters on SEs and on the real task.

What the experiments with SEs share. Every group of agents, on one SE or on the real task, is a
piece that is computed once.
"""

import argparse
import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from sejax.configs import TrainingConfig
from sejax.experiments import common
from sejax.validation import each_of

AGENTS = ("ddqn", "dueling_ddqn", "td3_discrete")
NUM_SES = 40
GROUPS_AT_ONCE = 5  # groups of agents in one program, but for one CPU device

# Hidden sizes up to 6: one network has room for all of them, and little is compiled.
QUICK_AGENT: dict[str, Any] = {
    "hidden_size": 2,
    "batch_size": 16,
    "num_layers": 1,
    "init_episodes": 1,
}
QUICK = {"num_agents": 4, "num_ses": 3, "real_episodes": 100, "max_steps": 4000}


@dataclass(frozen=True, kw_only=True)
class World:
    """What agents are trained in: the SEs of a set, or the real task a number of times.

    Attributes:
      env: gymnax environment; `params` are what its SEs differ in.
      task: the real task that agents are tested on.
      params: `EnvParams`, one for each group of agents.
      names: of the groups, in the files' names.
      training: how long an agent of a configuration trains.
      settings: what else the agents' results depend on; plain values.
    """

    env: Any
    task: Any
    params: tuple[Any, ...]
    names: tuple[str, ...]
    training: Callable[[Any], TrainingConfig]
    settings: dict[str, Any]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options on the agents."""
    parser.add_argument("--agents", nargs="+", default=list(AGENTS), metavar="AGENT",
                        help=", ".join(AGENTS))  # fmt: skip
    parser.add_argument("--num-agents", type=int, help="agents for each SE; 10, quick 4")
    parser.add_argument("--num-ses", type=int, help="SEs of a set at most; 40, quick 3")
    parser.add_argument("--test-episodes", type=int, default=10, help="of each agent; 10")
    parser.add_argument("--max-steps", type=int, help="training steps at most; no other limit "
                        "than that of the SEs' own configuration")  # fmt: skip


def fill_in(args: argparse.Namespace) -> None:
    """Sets the options whose default depends on `--quick`, and checks the numbers.

    Raises:
      ConfigError: for an unknown agent or a number out of range.
    """
    defaults: dict[str, Any] = {"num_agents": 10, "num_ses": NUM_SES}
    for name, value in (QUICK if args.quick else defaults).items():
        if getattr(args, name, 0) is None:
            setattr(args, name, value)
    check_agents(args)
    common.require_counts(args, "num_agents", "num_ses", "test_episodes", "max_steps",
                          "real_episodes", "real_groups")  # fmt: skip


def check_agents(args: argparse.Namespace) -> None:
    """Checks `--agents`, which the experiments with SEs share.

    Raises:
      ConfigError: for an agent that is not one of `AGENTS`.
    """
    each_of("--agents", args.agents, AGENTS)


def real_world(args: argparse.Namespace, task: Any, count: int) -> World:
    """The real task for `count` groups of agents; training ends by the solved rule."""

    def training(agent: Any) -> TrainingConfig:
        # reference_details.md 7.1: discrete TD3 trains 500 episodes on Acrobot, all others 1000.
        short = task.name == "acrobot" and agent.name == "td3_discrete"
        return TrainingConfig(
            max_episodes=args.real_episodes or (500 if short else 1000),
            max_steps=args.max_steps,
            stop_rule="solved",
            solved_by=args.solved_by,
            test_episodes=args.test_episodes,
            time_limit_is_terminal=True,
        )

    names = tuple(f"real-{index:02d}" for index in range(count))
    return World(env=task.env, task=task, params=(task.params,) * count, names=names,
                 training=training, settings={"world": task.name})  # fmt: skip


def se_world(args: argparse.Namespace, ses: Any) -> World:
    """The SEs of a set; agents train as long as those that the SEs were learned with."""
    from sejax.evaluation import training_as_learned

    def training(agent: Any) -> TrainingConfig:
        learned = training_as_learned(ses, agent)
        limits = [x for x in (learned.max_steps, args.max_steps) if x is not None]
        return dataclasses.replace(learned, max_steps=min(limits, default=None),
                                   test_episodes=args.test_episodes)  # fmt: skip

    # The name has the weights' hash, so that sets can share a folder: se_models then finds these.
    names = tuple(f"se-{seed:02d}-{ses.fingerprint(i)}" for i, seed in enumerate(ses.seeds))
    proxy = {f"proxy.{name}": value for name, value in vars(ses.config.proxy).items()}
    params = tuple(ses.one(i) for i in range(ses.size))
    return World(env=ses.env, task=ses.task, params=params, names=names, training=training,
                 settings={"world": f"SE of {ses.task.name}", **proxy})  # fmt: skip


def train_all(
    args: argparse.Namespace, kind: str, world: World, pieces: common.Pieces
) -> pd.DataFrame:
    """Agents of one kind in a world, a row each; every group is a piece.

    Raises:
      ConfigError: for stored pieces of other settings.
    """
    from sejax.agents.configs import AGENT_CONFIGS

    config = AGENT_CONFIGS[kind](**(QUICK_AGENT if args.quick else {}))
    training = world.training(config)
    settings = {
        **world.settings,
        **{f"agent.{name}": value for name, value in vars(config).items()},
        **{f"training.{name}": value for name, value in vars(training).items()},
        "num_agents": args.num_agents,
        "seed": args.seed,
    }
    tables = []
    at_once = groups_at_once(args.devices)
    for first in range(0, len(world.names), at_once):
        indices = {f"{kind}-{name}": index for index, name in enumerate(world.names)
                   if first <= index < first + at_once}  # fmt: skip

        def compute(missing: list[str], indices: dict[str, int] = indices) -> list[pd.DataFrame]:
            chosen = [indices[piece] for piece in missing]
            return train_groups(args, config, world, training, chosen)

        named = {piece: settings | {"group": world.names[i]} for piece, i in indices.items()}
        computed = pieces.compute_all(named, compute)
        for index, table in zip(indices.values(), computed, strict=True):
            name = world.names[index]
            print(f"{kind} {name}: mean return {table['test_return'].mean():.1f} after "
                  f"{table['train_steps'].mean():,.0f} steps", flush=True)  # fmt: skip
            tables.append(table.assign(kind=kind, group=name))
    return pd.concat(tables, ignore_index=True)


def groups_at_once(devices: int | None) -> int:
    """Groups in one program: some agents train a hundred times as long as others.

    Several groups keep all devices, or an accelerator's lanes, busy; with one CPU device, a group
    is saved as soon as it is done.
    """
    import jax

    alone = (devices or jax.device_count()) == 1 and jax.default_backend() == "cpu"
    return 1 if alone else GROUPS_AT_ONCE


def train_groups(
    args: argparse.Namespace,
    config: Any,
    world: World,
    training: TrainingConfig,
    indices: list[int],
) -> list[pd.DataFrame]:
    """Trains and tests the agents of some SEs, or groups on the real task; a row for each agent.

    There are always as many as `groups_at_once`, so that the program is compiled once. Agents of
    the same numbers draw the same hyperparameters in every setting, so that settings are compared
    on equal draws.
    """
    import jax

    program = make_program(config, world.env, world.task, training, args.devices)
    num_agents = args.num_agents
    padded = [*indices, *[indices[-1]] * (groups_at_once(args.devices) - len(indices))]
    groups = np.repeat(padded, num_agents)
    numbers = np.tile(np.arange(num_agents), len(padded))
    key = jax.random.key(args.seed)
    keys = jax.vmap(lambda g, n: jax.random.fold_in(jax.random.fold_in(key, g), n))(groups, numbers)
    params = jax.tree.map(
        lambda *each: np.repeat(np.stack(each), num_agents, axis=0),
        *[world.params[index] for index in padded],
    )
    active = np.arange(len(groups)) < len(indices) * num_agents
    outcome, drawn = jax.device_get(program(keys, params, active))
    tables = []
    for place in range(len(indices)):
        mine = slice(place * num_agents, (place + 1) * num_agents)
        table = to_table(jax.tree.map(lambda x, mine=mine: x[mine], outcome))
        tables.append(table.assign(**{name: x[mine].astype(float) for name, x in drawn.items()}))
    return tables


def to_table(outcome: Any) -> pd.DataFrame:
    """The outcomes of some agents, a row each, with a column for each test episode's return."""
    returns = outcome.test_returns.astype(float)
    columns = {
        "agent": range(len(returns)),
        "test_return": returns.mean(axis=1),
        "nonfinite": outcome.nonfinite,
        "train_episodes": outcome.train_episodes.astype(float),
        "train_steps": outcome.train_steps.astype(float),
    }
    return pd.DataFrame(columns | {f"return_{i}": x for i, x in enumerate(returns.T)})


@functools.cache
def make_program(
    config: Any, env: Any, task: Any, training: TrainingConfig, devices: int | None
) -> Callable[..., Any]:
    """Builds `program(keys, env_params, active) -> (Outcome, hparams)`, compiled once for all SEs.

    All leaves are `[agent, ...]`. Nothing is computed for an agent that is not active.
    """
    import jax

    from sejax.agents.configs import ExplorationConfig
    from sejax.agents.hparams import drawing_key, make_varied_agents
    from sejax.evaluation import make_varied_evaluator
    from sejax.parallel import spread_over_devices

    varied = make_varied_agents(config, task, ExplorationConfig())
    evaluate = make_varied_evaluator(varied, env, task, training)

    def train_one(key: Any, env_params: Any, active: Any) -> Any:
        return evaluate(key, env_params, active), varied.draw(drawing_key(key))

    spread = spread_over_devices(train_one, devices, cpu_lanes=varied.agents[0].cpu_lanes)
    return jax.jit(spread)


def return_columns(agents: pd.DataFrame) -> list[str]:
    """Names of the columns that hold the return of one test episode."""
    return [name for name in agents if name.startswith("return_")]
