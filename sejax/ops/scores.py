"""Statistics of scores that may not be finite, or equal but for rounding; moments of numbers.

What an agent that diverged counts as, step by step:

================================== ================================================================
step                               its score
================================== ================================================================
`Objective.search_scores`,         nan
`Objective.shown_scores`
`Scoring.candidate_scores`         nan for its candidate
`scoring.with_diverged_last`       on the incumbent: the lowest one of its algorithm in the
                                   generation; nan if all trainings with the algorithm diverged
`Mixture.comparable`               stays nan
`es.nes`, `es.score_transforms`    the worst: minus infinity where scores are ranked, the lowest
                                   finite one where they are added
`Bilevel.tell`                     an incumbent with nan is never the best
`fresh_agents.summarise`,          in tables: the worst return of all agents
`distill.teaching.diverged_last`
================================== ================================================================
"""

from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

# Count of numbers, their mean, and the sum of squared differences from it.
Moments: TypeAlias = tuple[Array, Array, Array]

_TIE = 1e-6  # of the other score, or of 1 if that score is smaller


def is_tie(scores: Float[Array, "*n"], other: Float[Array, ""]) -> Bool[Array, "*n"]:
    """Whether scores equal another score, but for rounding.

    In single precision the mean of equal scores may differ from them in its last digits. Divided by
    each other, such differences would give large weights. The authors' code has 1e-6 as well.
    """
    return jnp.abs(scores - other) <= _TIE * jnp.maximum(1.0, jnp.abs(other))


def reaches(score: Array | np.ndarray | float, goal: float) -> Any:
    """Whether scores, `[*n]` of any library, reach a goal, but for rounding.

    None reaches infinity, which stands for a task without a solved score.
    """
    return score >= goal - _TIE * (1 + abs(goal))


def finite_mean(scores: Float[Array, " n"]) -> Float[Array, ""]:
    """Mean of the finite scores; nan if there is none."""
    return jnp.mean(scores, where=jnp.isfinite(scores))


def or_minus_inf(scores: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The scores, with minus infinity in place of those that are not finite."""
    return jnp.where(jnp.isfinite(scores), scores, -jnp.inf)


def or_lowest_finite(scores: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The scores, with the worst finite one (or 0) in place of those that are not finite."""
    finite = jnp.isfinite(scores)
    worst = jnp.min(jnp.where(finite, scores, jnp.inf))
    return jnp.where(finite, scores, jnp.where(jnp.isfinite(worst), worst, 0.0))


def below_all(scores: Float[Array, "*n"]) -> Float[Array, ""]:
    """A score below the finite ones, by their range and at least by what 32 bits can tell."""
    scores = or_lowest_finite(scores)
    lowest = scores.min()
    gap = scores.max() - scores.min()
    return lowest - jnp.maximum(gap, _TIE * jnp.maximum(1e6, jnp.abs(lowest)))


def merged_moments(moments: Moments, others: Moments) -> Moments:
    """The moments of two groups of numbers together.

    Source: Chan et al., "Updating formulae and a pairwise algorithm for computing sample variances"
    (1979).
    """
    count, mean, square = moments
    count_others, mean_others, square_others = others
    total = count + count_others
    difference = mean_others - mean
    share = count_others / jnp.maximum(total, 1)
    square = square + square_others + difference**2 * count * share
    return total, mean + difference * share, square
