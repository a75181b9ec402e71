"""Statistics of scores over runs, and their 95% intervals.

Intervals of means are Student's, of what was sampled: of the means of SEs or RNs where agents
belong to them, as agents of one have much in common, else of agents. Percentile bootstraps of 5 to
10 values cover the truth in 80 to 90% of the cases in place of 95%. Of fewer than `ENOUGH` values
there is no interval.

Where returns have a ceiling, a mean beside the mean of the worst tenth tells agents apart that an
interquartile mean does not.
"""

from typing import Any

import numpy as np
from scipy.stats import t as student

from sejax.myopia import ENOUGH, LEVEL, UNKNOWN
from sejax.myopia import mean_interval as mean_interval


def difference_interval(first: Any, second: Any) -> tuple[float, float]:
    """Welch's confidence interval of the difference of two means, of independent values `[n], [m]`.

    `UNKNOWN` if either has fewer than `ENOUGH` values.
    """
    first, second = np.asarray(first, float), np.asarray(second, float)
    if min(first.size, second.size) < ENOUGH:
        return UNKNOWN
    errors = np.array([x.var(ddof=1) / x.size for x in (first, second)])
    middle, error = first.mean() - second.mean(), errors.sum()
    if error == 0:
        return float(middle), float(middle)
    freedom = error**2 / (errors**2 / [first.size - 1, second.size - 1]).sum()
    half = student.ppf((1 + LEVEL) / 2, freedom) * error**0.5
    return float(middle - half), float(middle + half)


def worst_tenth(values: Any) -> float:
    """Mean of the lowest tenth of values `[n]`, of one at least; nan where one is nan."""
    values = np.asarray(values, float)
    lowest = np.sort(values)[: -(-values.size // 10)]
    return float("nan") if np.isnan(values).any() else float(lowest.mean())
