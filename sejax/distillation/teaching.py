"""What SEs of policies teach: students on each, and which of the SEs teaches best.

A policy that earns much may be a poor teacher: agents learn it roughly, and a fragile gait then
falls. So an SE is chosen by agents that train on it and are tested on the real task, and others
say what it teaches.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, PyTree

from sejax.agents.base import Agent
from sejax.envs.base import Task
from sejax.evaluation import make_evaluator, num_parallel_on_cpu
from sejax.objectives import Outcome
from sejax.ops.parallel import compiler_options, spread_over_devices
from sejax.options import FailedError
from sejax.proxies.base import ProxyEnv
from sejax.proxies.exact import Layer, make_exact
from sejax.training import TrainingConfig


class Lesson(NamedTuple):
    """A policy that is to be taught.

    Attributes:
      generation: of the search that it is of; 0 for a copy.
      layers: as of `sejax.proxies.exact`.
      states: observations that it visited, `[state, obs_dim]`.
      policy_return: its mean return on the real task.
    """

    generation: int
    layers: Sequence[Layer]
    states: np.ndarray
    policy_return: float


def make_ses(
    task: Task, lessons: Sequence[Lesson], **options: Any
) -> tuple[ProxyEnv, list[dict[str, Any]]]:
    """An SE of each lesson: the environment that they share, and the weights of each.

    `options` are those of `sejax.proxies.exact.make_exact`.
    """
    made = [make_exact(task, each.layers, each.states, **options) for each in lessons]
    return made[0][0], [weights for _, weights in made]


def teach(
    env: ProxyEnv,
    weights: Sequence[PyTree],
    agent: Agent,
    training: TrainingConfig,
    keys: Array,
    devices: int | None = None,
) -> Outcome:
    """Trains fresh agents on each SE and tests them on the real task; leaves `[se, agent]`.

    Args:
      env: of the SEs.
      weights: of each.
      agent: the kind of students.
      training: of a student; `test_episodes` are those on the real task.
      keys: of the students, `[agent]`, the same on all SEs.
      devices: that they are spread over; None for all.
    """
    evaluate = make_evaluator(agent, env, env.task, training)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *weights)
    shape = len(weights), len(keys)
    se, student = (x.reshape(-1) for x in np.indices(shape))
    spread = spread_over_devices(
        lambda key, one: evaluate(key, env.params(one)),
        devices,
        cpu_num_parallel=num_parallel_on_cpu(agent, training),
    )

    def all_of(keys: Array, stacked: PyTree) -> Outcome:
        outcome = spread(keys[student], jax.tree.map(lambda x: x[se], stacked))
        return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), outcome)

    taught: Outcome = jax.device_get(
        jax.jit(all_of, compiler_options=compiler_options())(keys, stacked)
    )
    return taught


def as_rows(taught: Outcome, lessons: Sequence[Lesson], kind: str, use: str) -> pd.DataFrame:
    """A row for each student: its SE's generation, its kind and number, its mean test return.

    The return of one that diverged is nan.
    """
    means = np.asarray(taught.test_returns, float).mean(axis=-1)
    means = np.where(taught.nonfinite, np.nan, means)
    lesson, student = (x.ravel().tolist() for x in np.indices(means.shape))
    return pd.DataFrame(
        {
            "use": use,
            "generation": [lessons[i].generation for i in lesson],
            "policy_return": [lessons[i].policy_return for i in lesson],
            "agent": kind,
            "student": student,
            "test_return": means.ravel(),
            "train_steps": np.asarray(taught.train_steps).ravel(),
            "real_steps": np.asarray(taught.real_steps).ravel(),
        }
    )


def counted(returns: pd.Series) -> pd.Series:
    """Returns in which a student that diverged is as bad as the worst of all.

    Raises:
      FailedError: if all diverged.
    """
    if returns.isna().all():
        raise FailedError("No student learned: all met numbers that are not finite.")
    return returns.fillna(returns.min())


def grades(rows: pd.DataFrame) -> pd.Series:
    """How well each SE teaches, by generation: the mean over kinds of (mean + worst student) / 2.

    A student that diverged is as bad as the worst of all.
    """
    returns = counted(rows["test_return"])
    by_kind = returns.groupby([rows["generation"], rows["agent"]]).agg(["mean", "min"])
    return by_kind.mean(axis=1).groupby("generation").mean()
