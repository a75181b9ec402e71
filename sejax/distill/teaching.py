"""What SEs of policies teach: students train on each SE, and their returns grade the SEs.

A policy with a high return may be a poor teacher: agents learn it roughly, and a fragile gait then
falls. So agents that train on an SE and are tested on the real task choose the SE. Other agents
measure what it teaches.
"""

import functools
import time
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, PyTree

from sejax.agents.base import Agent
from sejax.distill.policy_search import Arrays, Lesson
from sejax.evaluation import evaluate_agents
from sejax.options import FailedError
from sejax.proxies.base import ProxyEnv
from sejax.proxies.io import fingerprint
from sejax.runs.command_config import CommandConfig
from sejax.runs.store import Store

SE = tuple[ProxyEnv, PyTree]  # environment and weights
COLUMNS = ("test_return", "train_steps", "real_steps", "cpu_s")  # of a student


def students(
    ses: Sequence[SE], lessons: Sequence[Lesson], config: CommandConfig, keys: Array, store: Store
) -> pd.DataFrame:
    """A row for each student on each SE.

    The students of an agent are kept in the store before the next agent's students train.

    Args:
      ses: environment and weights of each SE; all have one configuration.
      lessons: the lessons that the SEs were made of.
      config: agents and their trainings.
      keys: the students' keys, `[student]`, the same on all SEs.
      store: where students are kept.
    """
    # The weights name the entry: the policy behind the name in `policy` may have changed.
    taught_by = fingerprint({str(i): weights for i, (_, weights) in enumerate(ses)})
    lines = [(x.generation, x.policy_return, "", i) for x in lessons for i in range(len(keys))]
    rows = pd.DataFrame(lines, columns=["generation", "policy_return", "agent", "student"])
    tables = []
    for key in config.agents:
        agent = config.agent_for(key, ses[0][0].task, is_varied=False)
        train = functools.partial(teach, ses, agent, config, keys)
        taught = store.once(f"students/{key}-{taught_by}", train)
        table = rows.assign(agent=key, **{column: taught[column] for column in COLUMNS})
        mean, worst = table["test_return"].mean(), table["test_return"].min()
        print(f"{len(table)} {key} students reach {mean:.1f}, the worst {worst:.1f}", flush=True)
        tables.append(table)
    return pd.concat(tables, ignore_index=True)


def teach(ses: Sequence[SE], agent: Agent, config: CommandConfig, keys: Array) -> Arrays:
    """Trains fresh agents on each SE and tests them on the real task.

    Args:
      ses: environment and weights of each SE; all have one configuration.
      agent: the students' agent.
      config: its `training` is a student's training; students use its `devices` and `num_parallel`.
      keys: the students' keys, `[student]`, the same on all SEs.

    Returns:
      By name, `[se * student]` each: `test_return`, the mean over test episodes, nan for a student
      that diverged; `train_steps`; `real_steps`; `cpu_s`, the mean CPU seconds of a student.
    """
    started = time.process_time()
    env, _ = ses[0]
    print(f"training {len(ses) * len(keys)} students ...", flush=True)
    counts = {"devices": config.devices, "num_parallel": config.num_parallel}
    outcomes = [
        evaluate_agents(agent, env, env.params(weights), env.task, config.training, keys, **counts)
        for _, weights in ses
    ]
    outcome = jax.device_get(jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *outcomes))
    returns = np.asarray(outcome.test_returns, float).mean(axis=-1)
    returns = np.where(outcome.nonfinite, np.nan, returns)
    cpu_s = np.full(len(returns), (time.process_time() - started) / len(returns))
    values = returns, outcome.train_steps, outcome.real_steps, cpu_s
    return dict(zip(COLUMNS, map(np.asarray, values), strict=True))


def diverged_last(returns: pd.Series) -> pd.Series:
    """Returns in which a student that diverged counts as the worst student.

    Raises:
      FailedError: if all diverged.
    """
    if returns.isna().all():
        raise FailedError("No student learned: all met numbers that are not finite.")
    return returns.fillna(returns.min())


def grades(rows: pd.DataFrame) -> pd.Series:
    """How well each SE teaches, by generation: the mean over agents of (mean + worst student) / 2.

    A student that diverged counts as the worst student.
    """
    returns = diverged_last(rows["test_return"])
    by_agent = returns.groupby([rows["generation"], rows["agent"]]).agg(["mean", "min"])
    return by_agent.mean(axis=1).groupby("generation").mean()
