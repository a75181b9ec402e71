"""experiments.common.statistics: against scipy, and what is worked out by hand."""

import numpy as np
import pytest
import scipy.stats

from experiments.common.statistics import difference_interval, mean_interval, worst_tenth


@pytest.mark.parametrize("size", [5, 6, 10, 33])
def test_intervals_are_those_of_scipys_t_tests(size):
    values = np.random.default_rng(size).exponential(size=size)
    expected = scipy.stats.ttest_1samp(values, 0).confidence_interval()
    assert mean_interval(values) == pytest.approx(tuple(expected))
    others = np.random.default_rng(0).normal(size=7)
    welch = scipy.stats.ttest_ind(values, others, equal_var=False).confidence_interval()
    assert difference_interval(values, others) == pytest.approx(tuple(welch))


def test_fewer_than_five_values_have_no_interval():
    assert np.isnan([mean_interval(range(4)), difference_interval(range(4), [1.0] * 9)]).all()


def test_the_worst_tenth_is_the_mean_of_the_lowest_values():
    assert worst_tenth(np.random.default_rng(0).permutation(20)) == 0.5
    assert worst_tenth([3.0, 1.0, 2.0]) == 1.0 and worst_tenth(range(11)) == 0.5
    assert np.isnan(worst_tenth([np.nan, 1.0]))
