"""experiments.common.statistics: against scipy, by simulation, and what is worked out by hand."""

import numpy as np
import pandas as pd
import pytest
import scipy.stats

from experiments.common.statistics import (
    difference_interval,
    mean_interval,
    worst_tenth,
)
from experiments.common.tables import mean_columns


@pytest.mark.parametrize("size", [5, 6, 10, 33])
def test_intervals_are_those_of_scipys_t_tests(size):
    values = np.random.default_rng(size).exponential(size=size)
    expected = scipy.stats.ttest_1samp(values, 0).confidence_interval()
    assert mean_interval(values) == pytest.approx(tuple(expected))
    others = np.random.default_rng(0).normal(size=7)
    welch = scipy.stats.ttest_ind(values, others, equal_var=False).confidence_interval()
    assert difference_interval(values, others) == pytest.approx(tuple(welch))


def draws(size, num_agents, seed=0):
    """Returns of agents `[study, SE, agent]`: SEs differ as agents of one do; mean 0."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(2000, size, 1)) + rng.normal(size=(2000, size, num_agents))


@pytest.mark.parametrize("size", [5, 8, 10])
def test_intervals_cover_the_truth_as_often_as_they_say(size):
    """Those over the agents of few SEs, as if these were independent, cover it far less often."""

    def covered(interval, *values):
        ends = np.array([interval(*each) for each in zip(*values, strict=True)])
        return np.mean((ends[:, 0] <= 0) & (ends[:, 1] >= 0))

    returns = draws(size, num_agents=6)
    means = returns.mean(axis=2)
    for share in (
        covered(mean_interval, means),
        covered(difference_interval, means, 3 * draws(10, 6, seed=1).mean(axis=2)),
    ):
        assert abs(share - 0.95) < 0.02  # its standard error: 0.005
    assert covered(mean_interval, returns.reshape(2000, -1)) < 0.8
    columns = [
        mean_columns(pd.Series(each.ravel()), "x", pd.Series(np.repeat(range(size), 6)))
        for each in returns[:200]
    ]
    lows = [mean_interval(each)[0] for each in means[:200]]
    np.testing.assert_allclose([column["x_low"] for column in columns], lows)


def test_fewer_than_five_values_have_no_interval():
    four = [1.0, 2.0, 3.0, 4.0]
    for ends in (mean_interval(four), difference_interval(four, [1.0] * 9)):
        assert np.isnan(ends).all()


def test_the_worst_tenth_is_the_mean_of_the_lowest_values():
    assert worst_tenth(np.random.default_rng(0).permutation(20)) == 0.5
    assert worst_tenth([3.0, 1.0, 2.0]) == 1.0 and worst_tenth(range(11)) == 0.5
    assert np.isnan(worst_tenth([np.nan, 1.0]))


def test_equal_runs_have_no_uncertainty():
    assert mean_interval([3.0] * 5) == (3.0, 3.0)
    assert difference_interval([3.0] * 5, [1.0] * 6) == (2.0, 2.0)
