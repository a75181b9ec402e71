"""Statistics of scores over runs and tasks, as the field reports them.

Scores come in *strata*: an array of runs, `[run]`, for each task, or for each proxy that agents
were trained on; strata may differ in length. A single array is a single stratum. Where strata are
themselves samples (learned proxies that stand for others), give their means as a single one.

Source: Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice"
(2021), sections 4.1 to 4.3; their library rliable, which takes matrices `[run, task]`.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

LEVEL, NUM_RESAMPLES = 0.95, 2000


def mean(scores: Any) -> Any:
    """Mean over the last axis: `[..., run] -> [...]`."""
    return np.mean(scores, axis=-1)


def interquartile_mean(scores: Any) -> Any:
    """Mean over the last axis without its lowest and highest quarter: `[..., run] -> [...]`.

    Of n runs, floor(n / 4) are left out on each side; nan where one is nan.
    """
    ordered = np.sort(np.asarray(scores, float), axis=-1)  # with nan last
    cut = ordered.shape[-1] // 4
    middle = ordered[..., cut : ordered.shape[-1] - cut].mean(axis=-1)
    return np.where(np.isnan(ordered[..., -1]), np.nan, middle)[()]


def bootstrap_interval(
    *strata: Any,
    statistic: Callable[[Any], Any] = mean,
    level: float = LEVEL,
    num_resamples: int = NUM_RESAMPLES,
    seed: int = 0,
) -> tuple[float, float]:
    """Percentile confidence interval of a statistic of all runs: the stratified bootstrap.

    Runs are drawn again, with replacement, within each stratum. They must be independent: average
    what belongs together before.

    Args:
      *strata: runs of each, `[run]`.
      statistic: `[resample, run] -> [resample]`, of the runs of all strata.
      level: of confidence.
      num_resamples: how often all runs are drawn.
      seed: of the draws.
    """
    rng = np.random.default_rng(seed)
    low, high = _ends(statistic(_resamples(rng, strata, num_resamples)), level)
    return float(low), float(high)


def performance_profile(
    *strata: Any,
    thresholds: Any,
    level: float = LEVEL,
    num_resamples: int = NUM_RESAMPLES,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fraction of runs with a score above each threshold, and its interval at each.

    Args:
      *strata: runs of each, `[run]`.
      thresholds: `[threshold]`.
      level, num_resamples, seed: as of `bootstrap_interval`.

    Returns:
      Fractions, lower and upper ends, `[threshold]` each.
    """

    def fractions(runs: np.ndarray) -> np.ndarray:
        return (runs > np.reshape(thresholds, (-1, 1))).mean(axis=-1)

    resamples = _resamples(np.random.default_rng(seed), strata, num_resamples)
    low, high = _ends(np.array([fractions(runs) for runs in resamples]), level)
    return fractions(np.concatenate(strata)), low, high


def _resamples(rng: np.random.Generator, strata: Sequence[Any], count: int) -> np.ndarray:
    """All runs, drawn again within their strata: `[resample, run]`."""
    arrays = [np.asarray(runs, float) for runs in strata]
    return np.concatenate(
        [runs[rng.integers(0, runs.size, (count, runs.size))] for runs in arrays], axis=1
    )


def _ends(values: np.ndarray, level: float) -> np.ndarray:
    """Percentiles `[2, ...]` of values `[resample, ...]` between which a share `level` lies."""
    return np.quantile(values, [(1 - level) / 2, (1 + level) / 2], axis=0)
