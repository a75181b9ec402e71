"""What SEs of policies teach: students on each, and which of the SEs teaches best.

A policy that earns much may be a poor teacher: agents learn it roughly, and a fragile gait then
falls. So an SE is chosen by agents that train on it and are tested on the real task, and others
say what it teaches.
"""

import functools
import time
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, PyTree

from sejax.agents import make_agent
from sejax.agents.base import Agent
from sejax.distillation.policy_search import Lesson
from sejax.evaluation import evaluate_agents
from sejax.options import FailedError
from sejax.proxies.base import ProxyEnv
from sejax.proxies.io import fingerprint
from sejax.runs.config import LearnConfig
from sejax.runs.store import Store
from sejax.training import TrainingConfig

COLUMNS = ("test_return", "train_steps", "real_steps", "cpu_s")  # of a student


def students(
    env: ProxyEnv,
    weights: Sequence[PyTree],
    lessons: Sequence[Lesson],
    config: LearnConfig,
    keys: Array,
    store: Store,
) -> pd.DataFrame:
    """A row for each student on each SE.

    The students of an agent are kept in the store before those of the next one train.

    Args:
      env: of the SEs.
      weights: of each SE.
      lessons: that the SEs were made of.
      config: agents and their trainings.
      keys: of the students, `[student]`, the same on all SEs.
      store: where students are kept.
    """
    # By the weights, as what `policy` names may have changed.
    taught_by = fingerprint({str(i): se_weights for i, se_weights in enumerate(weights)})
    policies = [(lesson.generation, lesson.policy_return) for lesson in lessons]
    rows = pd.DataFrame(policies, columns=["generation", "policy_return"]).assign(agent="")
    rows = rows.merge(pd.DataFrame({"student": range(len(keys))}), how="cross")
    tables = []
    for key, agent_config in config.agents.items():
        agent = make_agent(agent_config, env.task, config.exploration)
        train = functools.partial(teach, env, weights, agent, config.training, keys, config.devices)
        taught = store.once(f"students/{key}-{taught_by}", train)
        table = rows.assign(agent=key, **{column: taught[column] for column in COLUMNS})
        returns = counted(table["test_return"])
        mean, worst = returns.mean(), returns.min()
        print(f"{len(table)} {key} students reach {mean:.1f}, the worst {worst:.1f}", flush=True)
        tables.append(table)
    return pd.concat(tables, ignore_index=True)


def teach(
    env: ProxyEnv,
    weights: Sequence[PyTree],
    agent: Agent,
    training: TrainingConfig,
    keys: Array,
    devices: int | None = None,
) -> dict[str, np.ndarray]:
    """Trains fresh agents on each SE and tests them on the real task.

    Args:
      env: of the SEs.
      weights: of each SE.
      agent: of the students.
      training: of a student; `test_episodes` are those on the real task.
      keys: of the students, `[student]`, the same on all SEs.
      devices: number of devices that they are spread over; None for all.

    Returns:
      By name, `[se * student]` each: `test_return`, the mean over test episodes, nan for a student
      that diverged; `train_steps`; `real_steps`; `cpu_s`, the mean CPU seconds of a student.
    """
    started = time.process_time()
    print(f"training {len(weights) * len(keys)} students ...", flush=True)
    evaluate = functools.partial(evaluate_agents, agent, env, devices=devices)
    outcomes = [evaluate(env.params(x), env.task, training, keys) for x in weights]
    outcome = jax.device_get(jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *outcomes))
    returns = np.asarray(outcome.test_returns, float).mean(axis=-1)
    returns = np.where(outcome.nonfinite, np.nan, returns)
    cpu_s = np.full(len(returns), (time.process_time() - started) / len(returns))
    values = returns, outcome.train_steps, outcome.real_steps, cpu_s
    return dict(zip(COLUMNS, map(np.asarray, values), strict=True))


def counted(returns: pd.Series) -> pd.Series:
    """Returns in which a student that diverged is as bad as the worst of all.

    Raises:
      FailedError: if all diverged.
    """
    if returns.isna().all():
        raise FailedError("No student learned: all met numbers that are not finite.")
    return returns.fillna(returns.min())


def grades(rows: pd.DataFrame) -> pd.Series:
    """How well each SE teaches, by generation: the mean over agents of (mean + worst student) / 2.

    A student that diverged is as bad as the worst of all.
    """
    returns = counted(rows["test_return"])
    by_agent = returns.groupby([rows["generation"], rows["agent"]]).agg(["mean", "min"])
    return by_agent.mean(axis=1).groupby("generation").mean()
