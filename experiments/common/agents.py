"""Groups of fresh agents that train under a condition, and what is measured of them.

A condition is an agent with an environment: the real task, or a set of SEs or RNs, of which each
group of agents has one. Every group is a cached shard.
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
from experiments.common.experiment import Settings
from sejax import Proxy, ProxySet, Task, TrainingConfig, envs
from sejax.agents import Agent, AgentConfig, ExplorationConfig, NoExploration
from sejax.agents.varied import for_keys
from sejax.envs.environment import Environment
from sejax.ops.parallel import spread_over_devices
from sejax.options.plain import configure, to_plain
from sejax.training import cpu_num_parallel_of

# Kinds of students, where actions are discrete and where they are continuous.
DISCRETE = ("ddqn", "dueling_ddqn", "ppo", "sac", "td3_discrete")
CONTINUOUS = ("td3", "sac", "ppo")
KINDS = tuple(dict.fromkeys(DISCRETE + CONTINUOUS))
GROUPS_AT_ONCE = 5  # groups of agents in one program, but for one CPU device


class Group(NamedTuple):
    """The environment of a group of agents."""

    name: str  # in the names of files, and in the rows' column `group`
    params: Any  # `EnvParams`
    fingerprint: str = ""  # of the proxy's weights

    @classmethod
    def of(cls, name: str, proxy: Proxy) -> Self:
        """A stored proxy."""
        return cls(name, proxy.params, proxy.fingerprint)


@dataclass(frozen=True, kw_only=True)
class Condition:
    """Which agents are trained, in which environment, and how long."""

    name: str  # in the names of files
    env: Environment  # its groups differ in the `params`
    task: Task  # the real one, that agents are tested on
    groups: tuple[Group, ...]
    agent: AgentConfig  # of all
    training: TrainingConfig
    exploration: ExplorationConfig = field(default_factory=NoExploration)
    hparams: str = "default"  # or "varied": drawn for each agent
    settings: dict[str, Any] = field(default_factory=dict)  # what else results depend on; plain
    is_single: bool = False  # whether its one group takes its keys from the seed itself

    @classmethod
    def real(cls, task: Task, names: Iterable[str], **rest: Any) -> Self:
        """The real task for groups of these names."""
        groups = tuple(Group(name, task.params) for name in names)
        return cls(env=task.env, task=task, groups=groups, **rest)

    @classmethod
    def of_set(cls, proxies: ProxySet, names: Iterable[str], **rest: Any) -> Self:
        """The proxies of a `ProxySet`, one for each group."""
        groups = tuple(Group.of(name, proxies[i]) for i, name in enumerate(names))
        settings = {"proxy": proxies.config["proxy"], **rest.pop("settings", {})}
        return cls(env=proxies.env, task=proxies.task, groups=groups, settings=settings, **rest)

    def plain(self) -> dict[str, Any]:
        """What the results of all groups depend on, beside seeds and weights."""
        return {
            "task": self.task.origin or self.task.name,
            "agent": to_plain(self.agent, "agent"),
            "exploration": to_plain(self.exploration, "exploration"),
            "training": to_plain(self.training),
            "hparams": self.hparams,
            **self.settings,
        }


@dataclass(frozen=True, kw_only=True)
class Measure:
    """What is kept of an agent's training."""

    # (agent, env, task, training) -> run(key, env_params, active), with leaves `[]` and `[episode]`
    make_run: Callable[[Agent, Environment, Task, TrainingConfig], Callable[..., Any]]
    # (results [agent, ...], drawn hyperparameters [agent]) -> rows, with a column `agent`
    to_table: Callable[[Any, dict[str, np.ndarray]], pd.DataFrame]
    is_timed: bool = False  # whether rows have a column `cpu_s`, the cost of an agent


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


OUTCOMES = Measure(make_run=sejax.make_evaluator, to_table=outcome_rows)


def train_groups(
    condition: Condition, settings: Settings, num_agents: int, measure: Measure = OUTCOMES
) -> pd.DataFrame:
    """Rows of all agents of a condition, with a column `group`; trains the missing groups.

    The agents of the i-th group have the same seeds under every condition: where hyperparameters
    are drawn, conditions are compared on equal draws.

    Args:
      condition: what is trained.
      settings: of the experiment.
      num_agents: of each group.
      measure: what is kept of an agent.
    """
    shared = condition.plain() | {"num_agents": num_agents, "seed": settings.seed}
    groups = {f"{condition.name}-{group.name}": group for group in condition.groups}
    names = list(groups)
    at_once = 1 if measure.is_timed else min(len(groups), groups_at_once(settings.devices))
    tables = []
    print(f"training {len(groups) * num_agents:,} agents: {condition.name} ...", flush=True)
    for first in range(0, len(groups), at_once):
        chosen = names[first : first + at_once]
        made_with = {
            name: {
                **shared,
                "group": groups[name].name,
                "weights": groups[name].fingerprint,
                "place": names.index(name),  # which its keys depend on
            }
            for name in chosen
        }

        def compute(missing: list[str]) -> list[pd.DataFrame]:
            places = [names.index(name) for name in missing]
            return train(condition, settings, num_agents, measure, places, at_once)

        made = settings.shards.compute_all(made_with, compute)
        for name, table in zip(chosen, made, strict=True):
            print(f"{name}: done", flush=True)
            tables.append(table.assign(group=groups[name].name))
    return worst_for_diverged(pd.concat(tables, ignore_index=True), condition.name)


def train(
    condition: Condition,
    settings: Settings,
    num_agents: int,
    measure: Measure,
    places: list[int],
    at_once: int,
) -> list[pd.DataFrame]:
    """The rows of the groups at these places; a program is compiled once for `at_once` of them."""
    task, varied = condition.task, condition.hparams == "varied"
    agent = sejax.make_agent(condition.agent, task, condition.exploration, varied)
    padded = [*places, *[places[-1]] * (at_once - len(places))]
    key = jax.random.key(settings.seed)

    def keys_of(places: Iterable[int]) -> jax.Array:
        keys = [key if condition.is_single else jax.random.fold_in(key, i) for i in places]
        # Of a group's agents, the first ones have the same keys for any number of them.
        return jax.numpy.concatenate([jax.random.split(key, num_agents) for key in keys])

    agent = for_keys(agent, keys_of(range(len(condition.groups))))  # one program for all groups
    env, training, keys = condition.env, condition.training, keys_of(padded)
    program = make_program(measure, agent, env, task, training, settings.devices)
    each = [condition.groups[i].params for i in padded]
    params = jax.tree.map(lambda *leaves: np.stack(leaves), *each)
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


# A compiled program takes hundreds of the 65,530 memory mappings that Linux grants a process.
@functools.lru_cache(maxsize=80)
def make_program(
    measure: Measure,
    agent: Agent,
    env: Environment,
    task: Task,
    training: TrainingConfig,
    devices: int | None,
) -> Callable[..., Any]:
    """Builds `program(keys [agent], params, active [agent]) -> (results, drawn)`, `[agent, ...]`.

    The leaves of `params` are `[group, ...]`; the agents of a group follow one another. Nothing is
    computed for an agent that is not active.
    """
    run = measure.make_run(agent, env, task, training)

    def program(keys: Any, params: Any, active: Any) -> Any:
        num_groups = jax.tree.leaves(params)[0].shape[0]

        def one(key: Any, group: Any, active: Any) -> Any:
            place = 0 if num_groups == 1 else group  # else each agent has a copy of the weights
            mine = jax.tree.map(lambda x: x[place], params)
            return run(key, mine, active), agent.drawn_values(key)

        groups = np.repeat(np.arange(num_groups), keys.shape[0] // num_groups)
        num_parallel = cpu_num_parallel_of(agent, training)
        spread = spread_over_devices(one, num_devices=devices, cpu_num_parallel=num_parallel)
        return spread(keys, jax.numpy.asarray(groups), active)

    return jax.jit(program)


def groups_at_once(devices: int | None) -> int:
    """Groups in one program: some agents train a hundred times as long as others.

    Several groups keep all devices, or an accelerator, busy; with one CPU device, a group is saved
    as soon as it is done.
    """
    alone = (devices or jax.device_count()) == 1 and jax.default_backend() == "cpu"
    return 1 if alone else GROUPS_AT_ONCE


def worst_for_diverged(rows: pd.DataFrame, name: str) -> pd.DataFrame:
    """Rows in which tests of agents that diverged return the worst that others did.

    A mean would leave them out, and so be better for each of them.
    """
    if "test_return" not in rows:
        return rows
    lost = rows["test_return"].isna() | (rows.get("nonfinite", 0) > 0)
    if not lost.any():
        return rows
    returns = ["test_return", *return_columns(rows)]
    rows = rows.assign(**{column: rows[column].mask(lost) for column in returns})
    worst = float(rows[returns].min(axis=None))
    count = len(rows[lost].groupby(["group", "agent"]))
    print(f"{name}: {count} agents diverged; their tests count as {worst:.1f}, the worst return.")
    return rows.fillna(dict.fromkeys(returns, worst))


def return_columns(agents: pd.DataFrame) -> list[str]:
    """Names of the columns that hold the return of one test episode."""
    return [name for name in agents if name.startswith("return_")]


# Overrides where the preset's agent is made for one-step SEs, and explores as in a bandit.
ON_REAL_TASKS = {
    ("mountain_car_continuous", "td3"): ("proxy=rn",),
    ("mountain_car_continuous", "ppo"): ("proxy=rn",),
    ("halfcheetah", "td3"): ("proxy=rn",),
    ("pendulum", "td3"): ("proxy=rn",),
    ("pendulum", "sac"): ("agent.warmup_episodes=1",),
}


def tuned_agent(env: str, kind: str) -> AgentConfig:
    """The agent of that kind with what was found on real tasks for few steps (docs/agents.md)."""
    words = ON_REAL_TASKS.get((env, kind), ())
    return sejax.config([f"env={env}", f"agent={kind}", *words]).agent


def shipped(name: str) -> Any:
    """The card of the proxy that ships with sejax under this name; None where there is none."""
    return next((card for card in sejax.pretrained() if card.name == name), None)


def usual_kind(task: Task) -> str:
    """The kind of agents that SEs of a task are learned with, and tested by."""
    return CONTINUOUS[0] if task.num_actions is None else DISCRETE[0]


def kinds_of_students(settings: Any) -> tuple[str, ...]:
    """The kinds in `settings.students`, or all that fit the actions of the task `settings.env`."""
    is_discrete = envs.make(settings.env).num_actions is not None
    return settings.students or (DISCRETE if is_discrete else CONTINUOUS)


# --- agents on SEs -------------------------------------------------------------------------------

SE_AGENTS = ("ddqn", "dueling_ddqn", "td3_discrete")
SOFT_SE = "results/soft_ses/cartpole.safetensors"  # with dynamics to look into, as the paper's


def agent_config(kind: str) -> AgentConfig:
    """The default configuration of a kind of agent."""
    return configure("agent", {"name": kind})


def paper_agent(kind: str) -> AgentConfig:
    """An agent of the paper's performance figures, around which hyperparameters are drawn.

    Source: paper, table of the hyperparameter ranges of SEs; the authors' performance files.
    """
    return sejax.config(["env=cartpole", "preset=paper_performance", f"agent={kind}"]).agent


def training_as_learned(
    proxies: Proxy | ProxySet, agent: Any, test_episodes: int, max_steps: int | None = None
) -> TrainingConfig:
    """How long an agent trains on SEs: as those that these were learned with, or `max_steps`."""
    learned = sejax.training_of(proxies, agent)
    limits = [x for x in (learned.max_steps, max_steps) if x is not None]
    most = min(limits, default=None)
    return dataclasses.replace(learned, max_steps=most, test_episodes=test_episodes)
