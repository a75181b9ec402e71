"""What the outer loop maximises.

An `Objective` turns an `Outcome` (one agent trained on a proxy, tested on the real task) into a
number. `sejax.scoring` applies it to a generation.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PyTree

from sejax.envs.base import Task
from sejax.envs.environment import Environment
from sejax.envs.wrappers import PartlyScored, PartParams
from sejax.options import MOST, Count, NonNegative, Options, require


class Outcome(struct.PyTreeNode):
    """The result of one agent. Leaves are `[]`, returns `[episode]`; `[training, ...]` for many.

    Attributes:
      test_returns: return of each test episode on the real task, in reward units.
      scored_returns: returns of the same episodes, as `Objective.test_env` scores them.
      train_steps: steps in the training world.
      train_episodes: episodes in the training world.
      auc: sum over training episodes of return times length. If there are tests after each episode,
        their mean return replaces the episode's return. An episode that the step limit cut off
        counts with the final test return.
      nonfinite: whether training met a number that is not finite; the score is then nan.
      real_steps: steps on the real task: tests, and training where its dynamics are real.
    """

    test_returns: Float[Array, "*training episode"]
    scored_returns: Float[Array, "*training episode"]
    train_steps: Int[Array, "*training"]
    train_episodes: Int[Array, "*training"]
    auc: Float[Array, "*training"]
    nonfinite: Bool[Array, "*training"]
    real_steps: Int[Array, "*training"]

    @property
    def test_return(self) -> Float[Array, "*training"]:
        """Mean over the test episodes."""
        return self.test_returns.mean(axis=-1)


@dataclass(frozen=True, kw_only=True)
class Objective:
    """What the outer loop maximises.

    Attributes:
      score: `outcome -> [training]` float32, leaves of the outcome `[training, ...]`. A training
        that diverged gets nan, whatever this function returns.
      needs_tests: whether it uses tests between training episodes. Then agents are tested after
        each episode, and solving the task ends no training.
      scores_are_returns: whether scores are mean returns, comparable with the task's solved reward.
      shown: the score that people see and that selects the best proxy, a function like `score`.
        With None it is `score`; else `score` only compares candidates within a generation.
      test_env: maps the real task's environment to that of test episodes; by default the same. The
        `info["scored_reward"]` of its steps adds up to `Outcome.scored_returns`.
      test_params: `generation -> EnvParams` of `test_env`; None for the task's.
      meaning: what a score means, for people.
    """

    score: Callable[[Outcome], Float[Array, "*training"]]
    needs_tests: bool = False
    scores_are_returns: bool = False
    shown: Callable[[Outcome], Float[Array, "*training"]] | None = None
    test_env: Callable[[Environment], Environment] = lambda env: env
    test_params: Callable[[Array], PyTree] = lambda generation: None
    meaning: str = ""

    def search_scores(self, outcome: Outcome) -> Float[Array, "*training"]:
        """The scores that compare candidates; nan for diverged agents.

        A score beyond `MOST` counts as diverged: the statistics of such scores would overflow.

        Raises:
          ConfigError: unless there is a score for each agent.
        """
        scores = jnp.asarray(self.score(outcome))
        shape = outcome.nonfinite.shape
        rule = f"must give one score for each agent, {shape}"
        require(scores.shape == shape, "objective", rule, got=scores.shape)
        return jnp.where(outcome.nonfinite | ~(jnp.abs(scores) <= MOST), jnp.nan, scores)

    def shown_scores(self, outcome: Outcome) -> Float[Array, "*training"]:
        """The scores that people see: those of `shown`, as `search_scores` gives those of `score`.

        Raises:
          ConfigError: as `search_scores`.
        """
        return replace(self, score=self.shown or self.score).search_scores(outcome)


@dataclass(frozen=True, kw_only=True)
class ObjectiveConfig(Options, ABC):
    """What the configurations of sejax's objectives share."""

    group: ClassVar[str] = "objective"

    @abstractmethod
    def make(self, task: Task) -> Objective:
        """The objective on a task."""


@dataclass(frozen=True, kw_only=True)
class MaxReward(ObjectiveConfig):
    """The mean test return (SEs); in early generations, optionally, over another number of steps.

    Other lengths can tell proxies apart that the task's own length does not. Short episodes show
    where a Pendulum goes at once; long ones show whether a car reaches the hill at all.

    Attributes:
      first_eval_steps: Steps of a test episode that are scored in the first generation; null: the
        task's limit.
      curriculum_generations: Generation from which the task's limit counts; until then the steps
        change linearly.

    Source: paper, Algorithm 1, EvaluateAgent; the curriculum: Liesen et al., "Discovering Minimal
    Reinforcement Learning Environments" (2024).
    """

    first_eval_steps: Count | None = None
    curriculum_generations: Count = 50

    def make(self, task: Task) -> Objective:
        objective = Objective(score=lambda outcome: outcome.test_return, scores_are_returns=True)
        if self.first_eval_steps is None:
            return objective
        first, last = self.first_eval_steps, task.max_steps

        def test_params(generation: Array) -> PartParams:
            done = jnp.minimum(generation / self.curriculum_generations, 1.0)
            steps = jnp.round(first + done * (last - first)).astype(jnp.int32)
            return PartParams(scored_steps=steps)

        return replace(
            objective,
            score=lambda outcome: outcome.scored_returns.mean(axis=-1),
            shown=objective.score,
            test_env=lambda env: PartlyScored(env, task.params),
            test_params=test_params,
        )


@dataclass(frozen=True, kw_only=True)
class RewardThreshold(ObjectiveConfig):
    r"""How soon an agent solves the task (RNs).

    .. math:: -(n_{tr} + w_{sol} \max(0, C_{sol} - C_{fin}))

    Attributes:
      unsolved_weight: w_sol: training steps that a unit of missing return is worth

    Source: paper, section "Learning Reward Networks".
    """

    unsolved_weight: NonNegative = 100.0

    def make(self, task: Task) -> Objective:
        """The objective on a task that says when it is solved.

        Raises:
          ConfigError: if nobody says when the task is solved.
        """
        fix = "Give your Task or env=gymnax/ID a solved_reward, or set objective=max_reward."
        require(task.is_solvable, "objective", f"needs {task.name}'s solved reward", fix=fix)

        def score(outcome: Outcome) -> Array:
            shortfall = jnp.maximum(0.0, task.solved_reward - outcome.test_return)
            return -(outcome.train_steps + self.unsolved_weight * shortfall)

        lacking = f"{self.unsolved_weight:g} for each unit of return below {task.solved_reward:g}"
        meaning = f"minus the training steps of its agents, and {lacking}"
        return Objective(score=score, meaning=meaning)


@dataclass(frozen=True, kw_only=True)
class AUC(ObjectiveConfig):
    """The area under the curve of test returns over training steps, divided by the steps (RNs).

    Source: paper, appendix "Studying the Influence of Different Reward Network Optimization
    Objectives".
    """

    def make(self, task: Task) -> Objective:
        return Objective(
            score=lambda outcome: outcome.auc / jnp.maximum(outcome.train_steps, 1),
            needs_tests=True,
            meaning="the mean of its agents' test returns over their training",
        )


@dataclass(frozen=True, kw_only=True)
class AUCSum(ObjectiveConfig):
    """The area under the same curve, not divided, as in the authors' code.

    Agents train for a number of episodes. So the area rewards short episodes if returns are
    negative, and long episodes if returns are positive.

    Source: `docs/reference.md` 5.5.
    """

    def make(self, task: Task) -> Objective:
        return Objective(
            score=lambda outcome: outcome.auc,
            needs_tests=True,
            meaning="the sum of its agents' test returns times the steps between them",
        )
