"""The contract of an outer optimiser: ask for a population, tell its scores; higher is better."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree
from pydantic import Field

from sejax.ops.scores import finite_mean
from sejax.options import LEAST, Count, Options

# Perturbations (NES) or candidates (evosax's) of a generation.
NumMembers = Annotated[int, Field(ge=2, le=100_000)]
# Larger steps or noise lead to weights whose products are not finite.
Scale = Annotated[float, Field(ge=LEAST, le=1e6)]

StrategyState: TypeAlias = PyTree  # only the strategy reads it


@dataclass(frozen=True, kw_only=True)
class Evaluations(Options):
    """How often the candidates of a generation are evaluated, each time with a fresh agent.

    Attributes:
      num_evals: evaluations for each candidate of the population.
      aggregate: how the scores of a candidate's evaluations become one score: mean or min.
      num_incumbent_evals: trainings on the incumbent.
      common_random_numbers: whether the r-th evaluation of every candidate has the same seed, the
        incumbent's with each agent too.
    """

    num_evals: Count = 1
    aggregate: Literal["mean", "min"] = "mean"
    num_incumbent_evals: Count = 16
    common_random_numbers: bool = False

    def keys(self, key: Array, population_size: int, num_agents: int = 1) -> Array:
        """A key for each training of a generation, `[training]`, in the order of `Scoring`.

        Args:
          key: of the generation.
          population_size: candidates in the population.
          num_agents: agents that take turns on the incumbent; a divisor of `num_incumbent_evals`.
        """
        of_population = np.arange(population_size * self.num_evals)
        of_incumbent = np.arange(self.num_incumbent_evals)
        if self.common_random_numbers:
            of_population = of_population % self.num_evals
            of_incumbent = of_incumbent // num_agents
        else:
            of_incumbent = of_incumbent + of_population.size
        numbers = np.concatenate([of_population, of_incumbent])
        return jax.vmap(jax.random.fold_in, (None, 0))(key, numbers)

    def candidate_scores(self, scores: Float[Array, "pop evaluation"]) -> Float[Array, " pop"]:
        """A score for each candidate; nan if the agent of one evaluation diverged."""
        return scores.mean(axis=1) if self.aggregate == "mean" else scores.min(axis=1)

    def with_diverged_last(
        self, scores: Float[Array, " turn"], population: Float[Array, " evaluation"]
    ) -> tuple[Float[Array, " turn"], Float[Array, ""]]:
        """The incumbent's scores, with agents that diverged ranked last, and their mean.

        Agents that diverged have the score nan. They get the lowest score of their algorithm in the
        generation: a mean without them would rank an incumbent by its other agents alone. If all
        diverged, the mean is nan.
        """
        lowest, diverged = jnp.nanmin(jnp.concatenate([population, scores])), jnp.isnan(scores)
        repaired = jnp.where(diverged & ~diverged.all(), lowest, scores)
        return repaired, finite_mean(repaired)


@dataclass(frozen=True, kw_only=True)
class Strategy:
    """An outer optimiser over flat parameter vectors `[dims]`; pure functions.

    Attributes:
      init: `(key, mean [dims]) -> state`.
      ask: `(key, state) -> (population [pop, dims], state)`.
      tell: `(key, population, scores [pop], incumbent_score [], state) -> state`; higher scores are
        better, and scores that are not finite rank worst.
      incumbent: `(state) -> [dims]`, the proxy at the centre of the population.
      population_size: vectors that `ask` returns.
      antithetic: whether the second half of the population mirrors the first at the incumbent.
      evaluations: how often each candidate is evaluated.
    """

    init: Callable[[Array, Float[Array, " dims"]], StrategyState]
    ask: Callable[[Array, StrategyState], tuple[Float[Array, "pop dims"], StrategyState]]
    tell: Callable[[Array, Array, Array, Array, StrategyState], StrategyState]
    incumbent: Callable[[StrategyState], Float[Array, " dims"]]
    population_size: int
    antithetic: bool = False
    evaluations: Evaluations = Evaluations()


@dataclass(frozen=True, kw_only=True)
class StrategyOptions(Options):
    """What the configurations of sejax's strategies share.

    Attributes:
      population_size: n_p: perturbations in a generation; of evosax's, candidates
      num_evals: agents on each candidate
      eval_aggregate: how the scores of a candidate's agents become one
      common_random_numbers: the same inner seeds for all candidates of a generation
    """

    group: ClassVar[str] = "es"

    population_size: NumMembers = 16
    num_evals: Count = 1
    eval_aggregate: Literal["mean", "min"] = "mean"
    common_random_numbers: bool = False

    def evaluations(self, num_incumbent_evals: int) -> Evaluations:
        """How often each candidate is evaluated."""
        return Evaluations(
            num_evals=self.num_evals,
            aggregate=self.eval_aggregate,
            num_incumbent_evals=num_incumbent_evals,
            common_random_numbers=self.common_random_numbers,
        )
