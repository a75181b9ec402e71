"""The contract of an outer optimiser: ask for a population, tell its scores; higher is better."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from jaxtyping import Array, Float, PyTree
from pydantic import Field

from sejax.options import LEAST, Count, Options

# Perturbations (NES) or candidates (evosax's) of a generation.
NumMembers = Annotated[int, Field(ge=2, le=100_000)]
# Larger steps or noise lead to weights whose products are not finite.
Scale = Annotated[float, Field(ge=LEAST, le=1e6)]

StrategyState: TypeAlias = PyTree  # only the strategy reads it


@dataclass(frozen=True, kw_only=True)
class Strategy:
    """An outer optimiser over flat parameter vectors `[dims]`; pure functions.

    Attributes:
      init: `(key, mean [dims]) -> state`.
      ask: `(key, state) -> (population [pop, dims], state)`.
      tell: `(key, population, scores [pop], incumbent_score [], state) -> state`; higher scores are
        better, and scores that are not finite rank worst.
      incumbent: `(state) -> [dims]`, the proxy at the centre of the population.
      num_candidates: vectors that `ask` returns; NES with mirrored perturbations asks for 2 n_p.
      mirrored: whether the second half of the population mirrors the first at the incumbent.
      num_evals: evaluations of each candidate, each with a fresh agent.
      eval_aggregate: how the scores of a candidate's evaluations become one score.
      num_incumbent_evals: trainings on the incumbent.
      common_random_numbers: whether the r-th evaluation of every candidate has the same seed, the
        incumbent's with each agent too.
    """

    init: Callable[[Array, Float[Array, " dims"]], StrategyState]
    ask: Callable[[Array, StrategyState], tuple[Float[Array, "pop dims"], StrategyState]]
    tell: Callable[[Array, Array, Array, Array, StrategyState], StrategyState]
    incumbent: Callable[[StrategyState], Float[Array, " dims"]]
    num_candidates: int
    mirrored: bool = False
    num_evals: int = 1
    eval_aggregate: Literal["mean", "min"] = "mean"
    num_incumbent_evals: int = 16
    common_random_numbers: bool = False


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

    population_size: NumMembers
    num_evals: Count = 1
    eval_aggregate: Literal["mean", "min"] = "mean"
    common_random_numbers: bool = False

    def shared(self) -> dict[str, Any]:
        """The fields of `Strategy` that have the same names here."""
        names = ("num_evals", "eval_aggregate", "common_random_numbers")
        return {name: getattr(self, name) for name in names}
