r"""Score transforms: from the candidates' scores K_i to their weights F_i.

Scores are maximised. A score that is not finite ranks below every finite one, or counts as the
worst of them. Some transforms need a difference between candidates, or between a candidate and the
incumbent. Without a difference their weights are all 0 and the proxy stays.

Source: paper, appendix "NES Score Transformation". `K_psi` is the incumbent's mean score.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sejax.ops.scores import below_all, is_tie, or_lowest_finite, or_minus_inf
from sejax.options import foreign_code, registry, require

FIELD = "es.score_transform"
PerCandidate = Float[Array, " pop"]
# Those of this file take the scores, and the incumbent's; a user's take the scores alone.
ScoreTransform = Callable[[PerCandidate, Float[Array, ""]], PerCandidate]
OwnTransform = Callable[[PerCandidate], PerCandidate]


def linear(scores: PerCandidate, incumbent: Float[Array, ""]) -> PerCandidate:
    r"""Maps scores linearly to [0, 1]: :math:`F_i = (K_i - \min K) / (\max K - \min K)`.

    Args:
      scores: `[pop]`, of each candidate, in the objective's unit.
      incumbent: the incumbent's score; not used.

    Returns:
      `[pop]` weights; all 0 if all scores are equal.
    """
    scores = or_lowest_finite(scores)
    return _safe_divide(scores - scores.min(), scores.max() - scores.min())


def rank(scores: PerCandidate, incumbent: Float[Array, ""]) -> PerCandidate:
    r"""Maps ranks linearly to [0, 1]: :math:`F_i = (R_i - \min R) / (\max R - \min R)`.

    :math:`R_i` counts the candidates with a lower score, so that ties share a rank.
    """
    scores = or_minus_inf(scores)
    ranks = (scores[None, :] < scores[:, None]).sum(axis=1).astype(jnp.float32)
    return _safe_divide(ranks, ranks.max())  # the lowest is 0


def nes(scores: PerCandidate, incumbent: Float[Array, ""]) -> PerCandidate:
    r"""Utilities of Wierstra et al. (2008), scaled to a largest magnitude of 1.

    .. math::
        \hat F_i = \frac{\max(0, \log(n_p/2 + 1) - \log R_i)}{\sum_j \max(0, \ldots)} - 1/n_p,
        \quad F_i = \hat F_i / \max_i |\hat F_i|

    Here :math:`R_i` is 1 for the best, as in the source. In the paper's text it is 0 for the worst,
    for which the logarithm is not defined. Ties share the better rank.
    """
    return _scaled_utilities(scores, 1 / scores.shape[0])


def nes_unnormalized(scores: PerCandidate, incumbent: Float[Array, ""]) -> PerCandidate:
    """As `nes` without the subtraction of 1/n_p: the worse half weighs nothing, the best 1."""
    return _scaled_utilities(scores, 0.0)


def single_best(scores: PerCandidate, incumbent: Float[Array, ""]) -> PerCandidate:
    """1 for the candidate of the best rank (for each, if several share it), 0 for the others."""
    scores = or_minus_inf(scores)
    return jnp.where((scores == scores.max()) & jnp.isfinite(scores), 1.0, 0.0)


def single_better(scores: PerCandidate, incumbent: Float[Array, ""]) -> PerCandidate:
    """As `single_best`, but only if that candidate is better than the incumbent."""
    return jnp.where(_advantage(scores, incumbent) > 0, single_best(scores, incumbent), 0.0)


def all_better_1(scores: PerCandidate, incumbent: Float[Array, ""]) -> PerCandidate:
    r"""Weighs the candidates by how far they beat the incumbent. The best has weight 1.

    .. math:: F_i = \max(0, K_i - K_\psi) / (\max K - K_\psi)
    """
    advantage = _advantage(scores, incumbent)
    return _safe_divide(advantage, advantage.max())


def all_better_2(scores: PerCandidate, incumbent: Float[Array, ""]) -> PerCandidate:
    """As `all_better_1`, with weights that sum to 1."""
    advantage = _advantage(scores, incumbent)
    return _safe_divide(advantage, advantage.sum())


_ALL = (linear, rank, nes, nes_unnormalized, single_best, single_better, all_better_1, all_better_2)
TRANSFORMS: dict[str, ScoreTransform] = {transform.__name__: transform for transform in _ALL}


def transform_of(choice: str | OwnTransform, pop: int) -> ScoreTransform:
    """The transform that a configuration chooses.

    Args:
      choice: a name of `TRANSFORMS`; or your own function, as an object or as `module:attribute`.
        It maps scores `[pop]` to weights `[pop]`. It gets the worst finite score in place of scores
        that are not finite. Its weights that are not finite become 0.
      pop: the number of scores.

    Raises:
      ConfigError: if a function cannot be imported or traced; or if its weights for the scores 0,
        1, 2, ... or for equal scores have another shape or are not finite.
    """
    if isinstance(choice, str) and choice in TRANSFORMS:
        return TRANSFORMS[choice]
    function = registry.imported(FIELD, choice) if isinstance(choice, str) else choice
    for scores in (np.arange(pop, dtype=np.float32), np.zeros(pop, np.float32)):
        guarded = foreign_code(FIELD, f"must take scores in jax; {choice}")
        with guarded, jax.ensure_compile_time_eval():
            weights = np.asarray(jax.jit(function)(scores), float)
        is_fit = weights.shape == (pop,) and np.isfinite(weights).all()
        rule = f"must give {pop} finite weights for {pop} scores"
        fix = f"Mend {choice}, or set {FIELD}=rank."
        require(is_fit, FIELD, rule, got=weights.tolist(), fix=fix)

    def transform(scores: PerCandidate, incumbent: Float[Array, ""]) -> PerCandidate:
        weights = jnp.asarray(function(or_lowest_finite(scores)), jnp.float32)
        return jnp.where(jnp.isfinite(weights) & jnp.isfinite(scores).any(), weights, 0.0)

    return transform


def _advantage(scores: PerCandidate, incumbent: Float[Array, ""]) -> PerCandidate:
    """Advantage over the incumbent; 0 for candidates that are worse, or better by rounding alone.

    Every candidate with a finite score is better than an incumbent without one.
    """
    floor = jnp.where(jnp.isfinite(incumbent), incumbent, below_all(scores))
    is_better = jnp.isfinite(scores) & ~(jnp.isfinite(incumbent) & is_tie(scores, incumbent))
    return jnp.where(is_better, jnp.maximum(scores - floor, 0.0), 0.0)


def _scaled_utilities(scores: PerCandidate, subtracted: float) -> PerCandidate:
    """Log utilities less a constant, with a largest magnitude of 1; 0 if all scores are equal.

    Before the subtraction they sum to 1, and a score that is not finite has 0, whatever its rank.
    """
    sortable = or_minus_inf(scores)
    ranks = 1 + (sortable[None, :] > sortable[:, None]).sum(axis=1)
    utilities = jnp.maximum(0.0, jnp.log(scores.shape[0] / 2 + 1) - jnp.log(ranks))
    utilities = jnp.where(jnp.isfinite(scores), utilities, 0.0)
    utilities = _safe_divide(utilities, utilities.sum()) - subtracted
    utilities = jnp.where(sortable.max() > sortable.min(), utilities, 0.0)
    return _safe_divide(utilities, jnp.abs(utilities).max())


def _safe_divide(numerator: Array, denominator: Array) -> Array:
    return jnp.where(denominator > 0, numerator / jnp.where(denominator > 0, denominator, 1.0), 0.0)
