"""The statistics of `se_tuners`, by hand."""

import numpy as np
import pandas as pd
import pytest
from scipy.stats import spearmanr

from experiments import se_tuners


def test_quality_is_scipys_rho_and_the_loss_of_the_choice():
    target = np.array([10.0, 50, 30, 20, 40, 0])
    chooser = np.array([1.0, 4, 6, 2, 5, 0])
    found = se_tuners.quality(chooser, target)
    assert found["rho"] == pytest.approx(spearmanr(chooser, target).statistic)
    assert found["regret"] == 50 - 30  # the third configuration is chosen
    assert found["regret_top"] == 50 - np.mean([30, 40, 50, 20, 10])


def test_rank_correlations_are_scipys():
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 5, (6, 9)), rng.normal(size=(6, 9))
    found = se_tuners.rank_correlations(x, y)
    expected = [spearmanr(*each).statistic for each in zip(x, y, strict=True)]
    np.testing.assert_allclose(found, expected)
    assert se_tuners.rank_correlations(np.ones((1, 3)), y[:1, :3]) == 0


def test_of_equally_good_choices_the_mean_counts():
    target = np.array([10.0, 50, 30])
    found = se_tuners.quality(np.array([1.0, 1, 0]), target)
    assert found["regret"] == 50 - 30  # the first two, 10 and 50
    constant = se_tuners.quality(np.ones(3), target)
    assert constant["rho"] == 0 and constant["regret"] == pytest.approx(50 - 30)


def test_successive_halving_by_hand():
    # Nine configurations; short trainings rank them as they are, longer ones the other way round.
    first, second = np.arange(9.0)[:, None], -np.arange(9.0)[:, None]
    judges = np.stack([np.arange(9.0), 10 * np.arange(9.0)], axis=1)
    found = se_tuners.halved({5: first, 7: second}, judges)
    # 8, 7, 6 go on; of these 6 does; the best of all is worth 44 to both judges on average.
    # What one seed has chosen, the other judges: 60 and 6.
    assert found["regret"] == pytest.approx(44 - (60 + 6) / 2)
    assert (found["trained_5"], found["trained_7"]) == (1, pytest.approx(3 / 9))
    assert found["trained_last"] == pytest.approx(1 / 9)


def test_a_tuner_averages_the_ranks_of_its_ses():
    reached = pd.DataFrame(
        [(0, 0, 1.0), (0, 1, 2.0), (0, 2, 3.0), (1, 0, 300.0), (1, 1, 100.0), (1, 2, 200.0),
         (2, 0, 5.0), (2, 1, 6.0), (2, 2, 4.0)], columns=["se", "config", "greedy"],
    )  # fmt: skip
    np.testing.assert_allclose(se_tuners.mean_ranks(reached, [0, 1]), [2, 1.5, 2.5])
    target = np.array([2.0, 1, 3])
    each = [se_tuners.mean_ranks(reached, [se]) for se in range(3)]
    found = se_tuners.over_tuners(each, target)
    rhos = [0.5, 0.5, -1.0]  # of 1 2 3, 3 1 2 and 2 3 1 with 2 1 3
    assert found["rho"] == pytest.approx(np.mean(rhos)) and found["rho_worst"] == -1
    assert np.isnan(found["rho_low"])  # of three


def test_features_are_ranks_of_what_both_agents_have():
    rows = pd.DataFrame({
        "kind": ["ddqn", "ddqn", "ppo", "ppo", "ddqn"], "use": ["learn"] * 2 + ["held"] * 3,
        "config": [0, 1, 0, 1, 0], "steps": 10,
        "agent.learning_rate": [1e-4, 1e-1, 1e-3, 1e-2, 5e-2],
        "agent.tau": [0.1, 0.2, np.nan, np.nan, 0.3],
    })  # fmt: skip
    learn, held = se_tuners.features_of(rows, "learn", "ppo", 10)
    np.testing.assert_allclose(learn, [[0.25], [1.0]])
    np.testing.assert_allclose(held, [[0.5], [0.75]])
    assert se_tuners.features_of(rows, "learn", "ddqn", 10)[1].shape == (1, 2)
    own = rows.assign(use=["learn", "regressed", "held", "held", "held"])
    # Of what was measured for regressors alone.
    learn, _ = se_tuners.features_of(own, "regressed", "ppo", 10)
    np.testing.assert_allclose(learn, [[1.0]])


@pytest.mark.parametrize("kind", ["forest", "gaussian_process"])
def test_regressors_find_a_smooth_function(kind):
    rng = np.random.default_rng(0)
    x, asked = rng.random((60, 2)), rng.random((40, 2))
    of = lambda x: np.sin(3 * x[:, 0]) - x[:, 1]  # noqa: E731
    found = se_tuners.regressed(kind, x, of(x), asked)
    assert spearmanr(found, of(asked)).statistic > 0.9


def test_tuners_are_compared_with_others_on_the_same_configurations():
    rng = np.random.default_rng(0)
    target = rng.normal(size=12)
    tuners = [target + rng.normal(size=12) for _ in range(3)]
    other = target + 2 * rng.normal(size=12)
    found = se_tuners.ahead(tuners, [other], target)
    ours = np.mean([spearmanr(x, target).statistic for x in tuners])
    assert found["rho"] == pytest.approx(ours - spearmanr(other, target).statistic)
    assert found["rho_low"] < found["rho"] < found["rho_high"]
    same = se_tuners.ahead([other, other], [other], target)
    assert same == {"rho": 0, "rho_low": 0, "rho_high": 0}


def test_trainings_on_the_task_count_for_all_choices_of_their_seeds():
    short = pd.DataFrame([[1.0, 2.0, 6.0], [4.0, 4.0, 1.0]])
    found = se_tuners.choices(short, 2)
    np.testing.assert_allclose(found, [[1.5, 4.0], [3.5, 2.5], [4.0, 2.5]])
    target = np.array([0.0, 1.0])  # the first choice is right, the two others are wrong
    assert se_tuners.with_interval(found, target)["rho"] == pytest.approx(-1 / 3)
    np.testing.assert_allclose(se_tuners.mean_rho(found, target, np.array([[0, 1]])), [-1 / 3])


def test_a_tuner_is_compared_with_as_many_steps_of_the_task():
    tested = [500, 2000, 6000, 8000]
    assert se_tuners.equal_steps(tested, 5999) == 6000
    assert se_tuners.equal_steps(tested, 4000) == 2000 and se_tuners.equal_steps(tested, 9) == 500
