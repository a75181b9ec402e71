"""experiments.common.statistics: against rliable, scipy, and what can be worked out by hand."""

import itertools

import numpy as np
import pytest
import scipy.stats

from experiments.common.statistics import (
    bootstrap_interval,
    interquartile_mean,
    iqm_interval,
    mean_interval,
    performance_profile,
    worst_tenth,
)


def mean(scores):
    return np.mean(scores, axis=-1)


# `[task, run]`.
SCORES = np.array([
    [0.1, 0.4, 0.7, 0.2, 1.6, 0.9, 0.3],
    [2.0, 2.5, 0.5, 3.5, 2.2, 1.1, 2.9],
    [-3.0, -1.0, -2.5, 0.5, -0.5, 4.0, -1.5],
])  # fmt: skip
THRESHOLDS = [-3, -1, 0, 0.5, 1, 2.5]
# What rliable 1.2.0 (numpy 2.4, arch 8.0) gives for their transposes, with
# `np.random.seed(0)` before each: `get_interval_estimates` with `metrics.aggregate_iqm`,
# `aggregate_mean` and `create_performance_profile` (20,000 resamples each). Another seed moves the
# ends by up to 0.01.
RLIABLE = {
    "iqm": (0.75454545, 0.28181818, 1.33636364),
    "mean": (0.70952381, 0.15714286, 1.33821429),
    "profile": (
        [0.95238095, 0.80952381, 0.76190476, 0.47619048, 0.38095238, 0.14285714],
        [0.85714286, 0.71428571, 0.66666667, 0.28571429, 0.23809524, 0.0],
        [1.0, 0.95238095, 0.85714286, 0.66666667, 0.52380952, 0.28571429],
    ),
}  # fmt: skip


@pytest.mark.parametrize(("name", "statistic"), [("iqm", interquartile_mean), ("mean", mean)])
def test_intervals_are_those_of_rliable(name, statistic):
    estimate, *ends = RLIABLE[name]
    assert statistic(SCORES.ravel()) == pytest.approx(estimate)
    ours = bootstrap_interval(*SCORES, statistic=statistic, num_resamples=20_000)
    assert ours == pytest.approx(ends, abs=0.02)


def test_performance_profiles_are_those_of_rliable():
    ours = performance_profile(*SCORES, thresholds=THRESHOLDS, num_resamples=20_000)
    for got, expected in zip(ours, RLIABLE["profile"], strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-8)


@pytest.mark.parametrize(
    ("last", "expected"), [(0, 0.0), (1, 0.5), (2, 1.0), (3, 1.5), (7, 3.5), (8, 4.0)]
)
def test_the_interquartile_mean_of_numbers_in_a_row_is_their_middle(last, expected):
    assert interquartile_mean(np.random.default_rng(0).permutation(last + 1)) == expected


def test_the_interquartile_mean_forgets_outliers_and_takes_the_last_axis():
    assert interquartile_mean([-1e9, 1.0, 3.0, 1e9]) == 2.0
    assert interquartile_mean([0, 10, 20, 30, 40, 50, 60, 1e9]) == 35.0
    rows = np.random.default_rng(1).exponential(size=(4, 3, 11))
    expected = scipy.stats.trim_mean(rows, 0.25, axis=-1)
    np.testing.assert_allclose(interquartile_mean(rows), expected, rtol=1e-12)
    assert np.isnan(interquartile_mean([[0, np.nan, 1, 2, 3], [1, 1, 1, 1, 1]])).tolist() == [1, 0]


def test_runs_are_drawn_within_their_strata():
    """Two strata of three runs: the 27 * 27 equally likely means, worked out."""
    strata = [0.0, 1.0, 3.0], [100.0, 141.0, 110.0]
    means = [np.mean(a + b) for a in itertools.product(strata[0], repeat=3)
             for b in itertools.product(strata[1], repeat=3)]  # fmt: skip
    for level in (0.5, 0.8, 0.95):
        ends = np.quantile(means, [(1 - level) / 2, (1 + level) / 2], method="inverted_cdf")
        got = bootstrap_interval(*strata, statistic=mean, level=level, num_resamples=9999)
        assert got == pytest.approx(ends)
    # As one stratum, where runs of one task could stand for those of the other, it is far wider.
    low, high = bootstrap_interval(np.concatenate(strata), statistic=mean)
    assert low < 40 and high > 80


@pytest.mark.parametrize("size", [5, 6, 10, 33])
def test_intervals_are_those_of_scipys_t_tests(size):
    values = np.random.default_rng(size).exponential(size=size)
    expected = scipy.stats.ttest_1samp(values, 0).confidence_interval()
    assert mean_interval(values) == pytest.approx(tuple(expected))
    against_zero = scipy.stats.ttest_ind(values, np.zeros(8), trim=0.25, equal_var=False)
    assert iqm_interval(values) == pytest.approx(tuple(against_zero.confidence_interval()))


@pytest.mark.parametrize("interval", [mean_interval, iqm_interval])
@pytest.mark.parametrize("size", [5, 8, 10])
def test_intervals_of_few_values_cover_the_truth_as_often_as_they_say(interval, size):
    """Percentile bootstraps of as few cover the mean of normal values in 82 to 90% of the cases."""
    values = np.random.default_rng(0).normal(size=(2000, size))
    ends = np.array([interval(each) for each in values])
    covered = np.mean((ends[:, 0] <= 0) & (ends[:, 1] >= 0))
    assert abs(covered - 0.95) < 0.02  # its standard error: 0.005


def test_fewer_than_five_values_have_no_interval():
    four = [1.0, 2.0, 3.0, 4.0]
    for ends in (mean_interval(four), iqm_interval(four), bootstrap_interval(four[:2], four[2:])):
        assert np.isnan(ends).all()


def test_the_worst_tenth_is_the_mean_of_the_lowest_values():
    assert worst_tenth(np.random.default_rng(0).permutation(20)) == 0.5
    assert worst_tenth([3.0, 1.0, 2.0]) == 1.0 and worst_tenth(range(11)) == 0.5
    assert np.isnan(worst_tenth([np.nan, 1.0]))


def test_equal_runs_have_no_uncertainty():
    assert mean_interval([3.0] * 5) == iqm_interval([3.0] * 5) == (3.0, 3.0)
    assert bootstrap_interval([3.0] * 5, [3.0]) == (3.0, 3.0)
    profile = performance_profile([3.0] * 5, thresholds=[2.9, 3.0])
    np.testing.assert_array_equal(profile, [[1, 0]] * 3)  # above is more than
