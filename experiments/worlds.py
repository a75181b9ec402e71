"""Groups of fresh agents that train in a world, and what is measured of them.

A world is the real task, an SE or an RN, or a set of these: each group of agents has its own. Every
group is a piece that is computed once.
"""

import dataclasses
import functools
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

import jax
import numpy as np
import pandas as pd

import sejax
from experiments import return_curves
from experiments.settings import Settings
from sejax import registry, serialize
from sejax.agents import NoExploration
from sejax.cli.progress import Tally
from sejax.ops.parallel import spread_over_devices
from sejax.training import TrainingConfig

HPARAMS = ("varied", "default")
GROUPS_AT_ONCE = 5  # groups of agents in one program, but for one CPU device


class Group(NamedTuple):
    """Where a group of agents trains."""

    name: str  # in the names of files, and in the rows' column `group`
    params: Any  # `EnvParams`
    fingerprint: str = ""  # what tells its world from those of other groups


@dataclass(frozen=True, kw_only=True)
class World:
    """What agents are trained in, which, and how long."""

    name: str  # in the names of files
    env: Any  # gymnax environment; `params` are what its groups differ in
    task: Any  # the real one, that agents are tested on
    groups: tuple[Group, ...]
    agent: Any  # configuration of all
    training: TrainingConfig
    exploration: Any = field(default_factory=NoExploration)
    hparams: str = "default"  # or "varied": drawn for each agent
    settings: dict[str, Any] = field(default_factory=dict)  # what else results depend on; plain
    is_single: bool = False  # whether its one group takes its keys from the seed itself

    @classmethod
    def real(cls, task: Any, names: Iterable[str], **rest: Any) -> Self:
        """The real task for groups of these names."""
        groups = tuple(Group(name, task.params) for name in names)
        return cls(env=task.env, task=task, groups=groups, **rest)

    @classmethod
    def of_set(cls, proxies: Any, names: Iterable[str], **rest: Any) -> Self:
        """The proxies of a `ProxySet`, one for each group; the first ones again for more groups."""
        places = [(name, i % proxies.size) for i, name in enumerate(names)]
        groups = tuple(Group(name, proxies.one(i), proxies.fingerprint(i)) for name, i in places)
        settings = {"proxy": proxies.config["proxy"], **rest.pop("settings", {})}
        return cls(env=proxies.env, task=proxies.task, groups=groups, settings=settings, **rest)

    def settings_of(self, group: Group) -> dict[str, Any]:
        """What a group's results depend on, beside the random numbers."""
        return {
            "task": self.task.origin,
            "agent": registry.describe("agent", self.agent),
            "exploration": registry.describe("exploration", self.exploration),
            "training": serialize.to_plain(self.training),
            "hparams": self.hparams,
            "group": group.name,
            "weights": group.fingerprint,
            **self.settings,
        }


@dataclass(frozen=True, kw_only=True)
class Measure:
    """What is kept of an agent's training."""

    # (agent, env, task, training) -> run(key, env_params, active), with leaves `[]` and `[episode]`
    make_run: Callable[[Any, Any, Any, TrainingConfig], Callable[..., Any]]
    # (results [agent, ...], drawn hyperparameters [agent]) -> rows, with a column `agent`
    to_table: Callable[[Any, dict[str, np.ndarray]], pd.DataFrame]
    say: Callable[[pd.DataFrame], str]  # of the rows of a group, for people
    is_timed: bool = False  # whether rows have a column `cpu_s`, what an agent has cost


def train_groups(
    world: World,
    settings: Settings,
    num_agents: int,
    measure: Measure | None = None,
    at_once: int = 1,
) -> pd.DataFrame:
    """Rows of all agents of a world, with a column `group`; trains the groups that are missing.

    The agents of the i-th group have the same seeds in every world: where hyperparameters are
    drawn, the worlds are compared on equal draws. `at_once` groups are one program and finished
    together; see `groups_at_once`. What is kept of an agent are its `OUTCOMES` by default.
    """
    measure = measure or OUTCOMES  # which are defined below
    shared = {"num_agents": num_agents, "seed": settings.seed}
    tables = []
    every = [(f"{world.name}-{group.name}", i) for i, group in enumerate(world.groups)]
    with Tally(len(every) * num_agents, f"agents: {world.name}") as tally:
        for first in range(0, len(every), at_once):
            places = dict(every[first : first + at_once])
            named = {n: world.settings_of(world.groups[i]) | shared for n, i in places.items()}

            def compute(missing: list[str], places: dict[str, int] = places) -> list[pd.DataFrame]:
                chosen = [places[name] for name in missing]
                return train(world, settings, num_agents, measure, chosen, at_once)

            made = settings.pieces.compute_all(named, compute)
            for name, table in zip(places, made, strict=True):
                print(f"{name}: {measure.say(table)}", flush=True)
                tables.append(table.assign(group=world.groups[places[name]].name))
                tally.add(num_agents)
    return worst_for_diverged(pd.concat(tables, ignore_index=True), world.name)


def train(
    world: World,
    settings: Settings,
    num_agents: int,
    measure: Measure,
    places: list[int],
    at_once: int,
) -> list[pd.DataFrame]:
    """The rows of the groups at these places; a program is compiled once for `at_once` of them."""
    program = make_program(
        measure,
        world.agent,
        world.exploration,
        world.hparams,
        world.env,
        world.task,
        world.training,
        settings.devices,
    )
    padded = [*places, *[places[-1]] * (at_once - len(places))]
    key = jax.random.key(settings.seed)
    own_keys = [key if world.is_single else jax.random.fold_in(key, i) for i in padded]
    # Of a group's agents, the first ones have the same keys for any number of them.
    keys = jax.numpy.concatenate([jax.random.split(key, num_agents) for key in own_keys])
    params = jax.tree.map(lambda *each: np.stack(each), *[world.groups[i].params for i in padded])
    active = np.repeat(np.arange(at_once) < len(places), num_agents)
    if measure.is_timed:  # without compilation
        jax.block_until_ready(program(keys, params, np.zeros_like(active)))
    started = time.process_time()
    result = jax.device_get(program(keys, params, active))
    cost = {"cpu_s": (time.process_time() - started) / active.sum()} if measure.is_timed else {}
    return [
        measure.to_table(*jax.tree.map(lambda x, i=i: x[i : i + num_agents], result)).assign(**cost)
        for i in range(0, len(places) * num_agents, num_agents)
    ]


@functools.cache
def make_program(
    measure: Measure,
    agent: Any,
    exploration: Any,
    hparams: str,
    env: Any,
    task: Any,
    training: TrainingConfig,
    devices: int | None,
) -> Callable[..., Any]:
    """Builds `program(keys [agent], params, active [agent]) -> (results, drawn)`, `[agent, ...]`.

    The leaves of `params` are `[group, ...]`; the agents of a group follow one another. Nothing is
    computed for an agent that is not active.
    """
    from sejax.evaluation import num_parallel_on_cpu

    made = sejax.make_agent(agent, task, exploration, hparams == "varied")
    run = measure.make_run(made, env, task, training)

    def program(keys: Any, params: Any, active: Any) -> Any:
        num_groups = jax.tree.leaves(params)[0].shape[0]

        def one(key: Any, group: Any, active: Any) -> Any:
            place = 0 if num_groups == 1 else group  # else lanes would have copies of the weights
            mine = jax.tree.map(lambda x: x[place], params)
            return run(key, mine, active), made.drawn_values(key)

        groups = np.repeat(np.arange(num_groups), keys.shape[0] // num_groups)
        spread = spread_over_devices(
            one, devices, cpu_num_parallel=num_parallel_on_cpu(made, training)
        )
        return spread(keys, jax.numpy.asarray(groups), active)

    return jax.jit(program)


def groups_at_once(devices: int | None) -> int:
    """Groups in one program: some agents train a hundred times as long as others.

    Several groups keep all devices, or an accelerator's lanes, busy; with one CPU device, a group
    is saved as soon as it is done.
    """
    alone = (devices or jax.device_count()) == 1 and jax.default_backend() == "cpu"
    return 1 if alone else GROUPS_AT_ONCE


def tuned_agent(env: str, kind: str) -> Any:
    """The agent of that kind with what was found on real tasks for few steps (docs/agents.md)."""
    return sejax.config([f"env={env}", f"agent={kind}"]).agent


def training_as_learned(proxies: Any, agent: Any) -> TrainingConfig:
    """How long an agent trains on a set of SEs: as those that they were learned with."""
    return proxies.proxy(0).training_for(agent)


def outcome_rows(outcome: Any, drawn: dict[str, np.ndarray]) -> pd.DataFrame:
    """A row for each agent, with a column for each test episode and each drawn hyperparameter."""
    returns = outcome.test_returns.astype(float)
    return pd.DataFrame(
        {
            "agent": range(len(returns)),
            "test_return": returns.mean(axis=1),
            "nonfinite": outcome.nonfinite | ~np.isfinite(returns).all(axis=1),
            "train_episodes": outcome.train_episodes.astype(float),
            "train_steps": outcome.train_steps.astype(float),
            **{f"return_{i}": x for i, x in enumerate(returns.T)},
            **{name: x.astype(float) for name, x in drawn.items()},
        }
    )


def worst_for_diverged(rows: pd.DataFrame, name: str) -> pd.DataFrame:
    """Rows in which tests of agents that diverged return the worst that others did, and says so.

    A mean would leave them out, and so be better for each of them.
    """
    if "test_return" not in rows or not (lost := rows["test_return"].isna()).any():
        return rows
    returns = ["test_return", *return_columns(rows)]
    worst = float(rows[returns].min(axis=None))
    count = len(rows[lost].groupby([key for key in ("group", "agent") if key in rows]))
    print(
        f"{name}: {count} agents diverged; their tests count as the worst return seen there, "
        f"{worst:.1f}.",
        flush=True,
    )
    return rows.fillna(dict.fromkeys(returns, worst))


def return_columns(agents: pd.DataFrame) -> list[str]:
    """Names of the columns that hold the return of one test episode."""
    return [name for name in agents if name.startswith("return_")]


def make_curves(agent: Any, env: Any, task: Any, training: TrainingConfig) -> Callable[..., Any]:
    """Builds `run(key, env_params, active) -> (test returns, training steps)`, `[episode]` each.

    What comes after an agent's last episode is nan and 0. Only the limits of `training` end it.
    """
    from sejax.evaluation import make_tested_trainer

    between = max(1, training.tests_between)
    training = dataclasses.replace(training, stop_rule="never", tests_between=between)

    def make_run(agent: Any) -> Callable[..., Any]:
        train = make_tested_trainer(agent, env, task, training)

        def run(key: Any, env_params: Any, active: Any, hparams: Any) -> Any:
            result = train(key, env_params, hparams, active)
            return result.test_returns, result.episode_ends

        return run

    return agent.fresh(make_run)


def curve_rows(curves: tuple[np.ndarray, np.ndarray], drawn: Any = None) -> pd.DataFrame:
    """A row for each training episode: agent, training steps at its end, mean return of its tests.

    The curves are test returns and training steps, `[agent, episode]`.
    """
    tables = []
    for agent, (returns, ends) in enumerate(zip(*curves, strict=True)):
        count = int((ends > 0).sum())
        columns = {"steps": ends[:count], "test_return": returns[:count].astype(float)}
        tables.append(pd.DataFrame({"agent": agent} | columns))
    return pd.concat(tables, ignore_index=True)


OUTCOMES = Measure(
    make_run=lambda *args: sejax.make_evaluator(*args),
    to_table=outcome_rows,
    say=lambda rows: (
        f"mean return {rows['test_return'].mean():.1f} after "
        f"{rows['train_steps'].mean():,.0f} steps"
    ),
)
CURVES = Measure(
    make_run=make_curves,
    to_table=curve_rows,
    say=lambda rows: f"last test returns {return_curves.last_returns(rows).mean():.1f}",
)
