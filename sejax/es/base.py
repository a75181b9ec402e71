"""The contract of an outer optimiser: ask for members, tell their scores, which are maximised."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

AGGREGATES = ("mean", "min")
LARGEST = 1e6  # larger steps or noise lead to weights whose products are not finite
_TIE = 1e-6  # of the incumbent's score, or of 1 where that is smaller


@dataclass(frozen=True, kw_only=True)
class Trials:
    """How often the proxies of a generation are tried, each time by a fresh agent.

    Attributes:
      num_evals: agents on each member.
      aggregate: what their scores make: mean or min.
      num_incumbent_evals: agents on the incumbent.
      common_random_numbers: the r-th agent of every member has the same seed.
    """

    num_evals: int = 1
    aggregate: str = "mean"
    num_incumbent_evals: int = 16
    common_random_numbers: bool = False

    def seed_ids(self, num_members: int) -> np.ndarray:
        """Numbers of the trials of members and incumbent, `[num_trials]`; equal ones share a seed.

        The trials of a member follow one another; those of the incumbent come last.
        """
        num_tried = num_members * self.num_evals
        if not self.common_random_numbers:
            return np.arange(num_tried + self.num_incumbent_evals)
        return np.concatenate(
            [np.arange(num_tried) % self.num_evals, np.arange(self.num_incumbent_evals)]
        )

    def families(self, of_members: np.ndarray, num_families: int) -> np.ndarray:
        """The family of agents of each trial, `[num_trials]`; the incumbent's take turns."""
        of_incumbent = np.arange(self.num_incumbent_evals) % num_families
        return np.concatenate([np.repeat(of_members, self.num_evals), of_incumbent])

    def candidates(
        self, members: Float[Array, "members dims"], incumbent: Float[Array, " dims"]
    ) -> Float[Array, "trials dims"]:
        """What is tried, in the order of `seed_ids`."""
        tried = jnp.repeat(members, self.num_evals, axis=0)
        shape = (self.num_incumbent_evals, incumbent.shape[0])
        return jnp.concatenate([tried, jnp.broadcast_to(incumbent, shape)])

    def split(
        self, scores: Float[Array, " trials"]
    ) -> tuple[Float[Array, " tried"], Float[Array, " incumbent"]]:
        """Scores of the members' trials, and of the incumbent's."""
        num_tried = scores.shape[0] - self.num_incumbent_evals
        return scores[:num_tried], scores[num_tried:]

    def of_members(self, scores: Float[Array, " tried"]) -> Float[Array, " members"]:
        """A score for each member; not finite if one of its trials is not."""
        scores = scores.reshape(-1, self.num_evals)
        scores = jnp.where(jnp.isfinite(scores), scores, jnp.nan)
        return scores.mean(axis=1) if self.aggregate == "mean" else scores.min(axis=1)

    def of_incumbent(
        self, scores: Float[Array, " incumbent"], members: Float[Array, " tried"]
    ) -> tuple[Float[Array, " incumbent"], Float[Array, ""]]:
        """The incumbent's scores, with agents that diverged ranked last, and their mean.

        Agents that diverged get the lowest finite score of the generation: a mean without them
        would rank an incumbent by the agents that survived it. One that none survived has no score:
        nan.
        """
        everyone = jnp.concatenate([members, scores])
        lowest = jnp.nanmin(jnp.where(jnp.isfinite(everyone), everyone, jnp.nan))
        finite = jnp.isfinite(scores)
        repaired = jnp.where(~finite & finite.any(), lowest, scores)
        return repaired, finite_mean(repaired)


def trials_of(config: Any, num_incumbent_evals: int) -> Trials:
    """How often the proxies of a generation are tried, as a strategy's configuration says."""
    return Trials(
        num_evals=config.num_evals,
        aggregate=config.eval_aggregate,
        num_incumbent_evals=num_incumbent_evals,
        common_random_numbers=config.common_random_numbers,
    )


@dataclass(frozen=True, kw_only=True)
class Strategy:
    """An outer optimiser over flat parameter vectors `[dims]`; pure functions.

    Attributes:
      init: `(key, mean [dims]) -> state`.
      ask: `(key, state) -> (members [num_members, dims], state)`.
      tell: `(key, members, scores [num_members], incumbent_score [], state) -> state`; higher
        scores are better, and scores that are not finite rank worst.
      incumbent: `(state) -> [dims]`, the proxy that the strategy stands for.
      num_members: proxies in a generation beside the incumbent.
      num_signs: blocks of members, at the same place of which stand the signs of one perturbation.
      remembers_scores: whether scores are held against those of earlier generations, so that they
        must be in one unit.
      trials: how often each is tried.
    """

    init: Callable[..., Any]
    ask: Callable[..., tuple[Array, Any]]
    tell: Callable[..., Any]
    incumbent: Callable[[Any], Array]
    num_members: int
    num_signs: int = 1
    remembers_scores: bool = False
    trials: Trials = Trials()

    @property
    def num_candidates(self) -> int:
        """Trainings in a generation."""
        return self.num_members * self.trials.num_evals + self.trials.num_incumbent_evals


def is_tie(scores: Float[Array, "*n"], incumbent: Float[Array, ""]) -> Bool[Array, "*n"]:
    """Whether scores are the incumbent's but for rounding.

    In single precision the mean of equal scores may be a few last digits off, whose share of each
    other would be weights as large as any. The authors' code asks for a difference of 1e-6.
    """
    return jnp.abs(scores - incumbent) <= _TIE * jnp.maximum(1.0, jnp.abs(incumbent))


def finite_mean(scores: Float[Array, " n"]) -> Float[Array, ""]:
    """Mean of the finite scores; nan if there is none."""
    finite = jnp.isfinite(scores)
    return jnp.where(finite, scores, 0.0).sum() / finite.sum()
