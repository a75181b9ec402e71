"""The contract of an outer optimiser: ask for a population, tell its scores; higher is better."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from sejax.options import MOST_MEMBERS, Options, counts, one_of, option

AGGREGATES = ("mean", "min")
MAX_SCALE = 1e6  # larger steps or noise lead to weights whose products are not finite
_TIE = 1e-6  # of the incumbent's score, or of 1 where that is smaller

StrategyState: TypeAlias = PyTree  # only the strategy reads it


@dataclass(frozen=True, kw_only=True)
class Evaluations:
    """How often the candidates of a generation are evaluated, each time with a fresh agent.

    Attributes:
      num_evals: evaluations for each candidate of the population.
      aggregate: what a candidate's score is, given those of its evaluations: mean or min.
      num_incumbent_evals: evaluations of the incumbent.
      common_random_numbers: whether the r-th evaluation of every candidate has the same seed.
    """

    num_evals: int = 1
    aggregate: str = "mean"
    num_incumbent_evals: int = 16
    common_random_numbers: bool = False

    def seed_ids(self, population_size: int) -> np.ndarray:
        """Numbers of the evaluations, `[evaluation]`; those with equal numbers share a seed.

        The evaluations of a candidate follow one another; those of the incumbent come last.
        """
        num_evaluations = population_size * self.num_evals
        if not self.common_random_numbers:
            return np.arange(num_evaluations + self.num_incumbent_evals)
        of_population = np.arange(num_evaluations) % self.num_evals
        return np.concatenate([of_population, np.arange(self.num_incumbent_evals)])

    def agents(self, agent_of_candidate: np.ndarray, num_agents: int) -> np.ndarray:
        """Index of the agent in each evaluation, `[evaluation]`; the incumbent's take turns."""
        of_incumbent = np.arange(self.num_incumbent_evals) % num_agents
        return np.concatenate([np.repeat(agent_of_candidate, self.num_evals), of_incumbent])

    def params(
        self, population: Float[Array, "pop dims"], incumbent: Float[Array, " dims"]
    ) -> Float[Array, "evaluation dims"]:
        """The vector of each evaluation, in the order of `seed_ids`."""
        repeated = jnp.repeat(population, self.num_evals, axis=0)
        shape = (self.num_incumbent_evals, incumbent.shape[0])
        return jnp.concatenate([repeated, jnp.broadcast_to(incumbent, shape)])

    def split(
        self, scores: Float[Array, " evaluation"]
    ) -> tuple[Float[Array, " of_population"], Float[Array, " of_incumbent"]]:
        """Scores of the population's evaluations, and of the incumbent's."""
        num_evaluations = scores.shape[0] - self.num_incumbent_evals
        return scores[:num_evaluations], scores[num_evaluations:]

    def population_scores(self, scores: Float[Array, " of_population"]) -> Float[Array, " pop"]:
        """A score for each candidate; not finite if that of an evaluation is not."""
        scores = scores.reshape(-1, self.num_evals)
        scores = jnp.where(jnp.isfinite(scores), scores, jnp.nan)
        return scores.mean(axis=1) if self.aggregate == "mean" else scores.min(axis=1)

    def incumbent_scores(
        self, scores: Float[Array, " of_incumbent"], population: Float[Array, " of_population"]
    ) -> tuple[Float[Array, " of_incumbent"], Float[Array, ""]]:
        """The incumbent's scores, with agents that diverged ranked last, and their mean.

        Agents that diverged get the lowest finite score of the generation: a mean without them
        would rank an incumbent by the agents that survived it. If none survived, the mean is nan.
        """
        all_scores = jnp.concatenate([population, scores])
        lowest = jnp.nanmin(jnp.where(jnp.isfinite(all_scores), all_scores, jnp.nan))
        finite = jnp.isfinite(scores)
        repaired = jnp.where(~finite & finite.any(), lowest, scores)
        return repaired, finite_mean(repaired)


@dataclass(frozen=True, kw_only=True)
class Strategy:
    """An outer optimiser over flat parameter vectors `[dims]`; pure functions.

    Attributes:
      init: `(key, mean [dims]) -> state`.
      ask: `(key, state) -> (population [pop, dims], state)`.
      tell: `(key, population, scores [pop], incumbent_score [], state) -> state`; higher scores are
        better, and those that are not finite rank worst.
      incumbent: `(state) -> [dims]`, the proxy at the centre of the population.
      population_size: vectors that `ask` returns.
      antithetic: whether the second half of the population is the first mirrored at the incumbent.
      remembers_scores: whether scores are compared with those of earlier generations, so that they
        must be in one unit.
      evaluations: how often each candidate is evaluated.
    """

    init: Callable[[Array, Float[Array, " dims"]], StrategyState]
    ask: Callable[[Array, StrategyState], tuple[Float[Array, "pop dims"], StrategyState]]
    tell: Callable[[Array, Array, Array, Array, StrategyState], StrategyState]
    incumbent: Callable[[StrategyState], Float[Array, " dims"]]
    population_size: int
    antithetic: bool = False
    remembers_scores: bool = False
    evaluations: Evaluations = Evaluations()

    @property
    def num_evaluations(self) -> int:
        """Trainings in a generation."""
        evaluations = self.evaluations
        return self.population_size * evaluations.num_evals + evaluations.num_incumbent_evals


@dataclass(frozen=True, kw_only=True)
class StrategyOptions(Options):
    """What the configurations of sejax's strategies share."""

    group: ClassVar[str] = "es"

    population_size: int = option(
        16,
        counts("scores are compared within a generation", 2, MOST_MEMBERS),
        help="n_p: perturbations in a generation",
    )
    num_evals: int = option(1, counts("a candidate needs a score"), help="agents on each candidate")
    eval_aggregate: str = option("mean", one_of(AGGREGATES), help="how their scores become one")
    common_random_numbers: bool = option(
        False, help="the same inner seeds for all candidates of a generation"
    )

    def evaluations(self, num_incumbent_evals: int) -> Evaluations:
        """How often each candidate is evaluated."""
        return Evaluations(
            num_evals=self.num_evals,
            aggregate=self.eval_aggregate,
            num_incumbent_evals=num_incumbent_evals,
            common_random_numbers=self.common_random_numbers,
        )


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
