"""What the training of one agent on a proxy, and its test on the real task, are worth."""

from collections.abc import Callable

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from sejax.configs import ObjectiveConfig


@struct.dataclass
class Outcome:
    """What came of one agent. Leaves are `[]` but for the first, and `[agent, ...]` for many.

    Attributes:
      test_returns: return of each test episode on the real task, in reward units.
      train_steps: steps in the training world.
      train_episodes: episodes there.
      return_area: sum over those episodes of their return times their length; the returns are those
        of the tests after each, where there are such tests. An episode that the step limit cut off
        counts with the test return.
      nonfinite: whether a number that is not finite was met in training; the score is then nan.
      real_steps: steps on the real task: tests, and training where its dynamics are real.
    """

    test_returns: Float[Array, "*agent episode"]
    train_steps: Int[Array, "*agent"]
    train_episodes: Int[Array, "*agent"]
    return_area: Float[Array, "*agent"]
    nonfinite: Bool[Array, "*agent"]
    real_steps: Int[Array, "*agent"]

    @property
    def test_return(self) -> Float[Array, "*agent"]:
        """Mean over the test episodes."""
        return self.test_returns.mean(axis=-1)


def make_objective(
    config: ObjectiveConfig, solved_reward: float
) -> Callable[[Outcome], Float[Array, "*agent"]]:
    r"""Builds `objective(outcome) -> score`, to be maximised; nan for a training that diverged.

    - `max_reward`: the mean test return (SEs).
    - `reward_threshold`: :math:`-(n_{tr} + w_{sol} \max(0, C_{sol} - C_{fin}))` (RNs).
    - `auc`: the area under the curve of test returns over training steps, by the number of these
      steps (RNs).
    - `auc_sum`: the area itself, as in the authors' code. Agents train a number of episodes, so
      that it rewards short ones where returns are negative, and long ones where they are positive.

    Source: paper, Algorithm 1, EvaluateAgent, section "Learning Reward Networks", and appendix
    "Studying the Influence of Different Reward Network Optimization Objectives".
    """

    def objective(outcome: Outcome) -> Array:
        score = outcome.test_return
        if config.name == "reward_threshold":
            shortfall = jnp.maximum(0.0, solved_reward - outcome.test_return)
            score = -(outcome.train_steps + config.unsolved_weight * shortfall)
        elif config.name == "auc":
            score = outcome.return_area / jnp.maximum(outcome.train_steps, 1)
        elif config.name == "auc_sum":
            score = outcome.return_area
        return jnp.where(outcome.nonfinite, jnp.nan, score)

    return objective
