"""sejax.objectives: what an outcome is worth, by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from sejax.configs import OBJECTIVES, ObjectiveConfig
from sejax.objectives import Outcome, make_objective


def outcome(test_return, train_steps, nonfinite):
    count = len(test_return)
    return Outcome(
        # The mean over three episodes of each agent.
        test_returns=jnp.array([[x - 1, x, x + 1] for x in test_return], jnp.float32),
        train_steps=jnp.array(train_steps, jnp.int32),
        train_episodes=jnp.ones(count, jnp.int32),
        return_area=jnp.arange(count, dtype=jnp.float32),
        nonfinite=jnp.array(nonfinite),
        real_steps=jnp.ones(count, jnp.int32),
    )


def test_max_reward_is_the_test_return():
    objective = make_objective(ObjectiveConfig(name="max_reward"), solved_reward=195.0)
    got = objective(outcome([10.0, 200.0, -3.0], [1, 2, 3], [False] * 3))
    np.testing.assert_array_equal(got, [10.0, 200.0, -3.0])


def test_reward_threshold_charges_steps_and_the_shortfall():
    config = ObjectiveConfig(name="reward_threshold", unsolved_weight=100.0)
    objective = make_objective(config, solved_reward=195.0)
    # -(500 + 100 * (195 - 190)) = -1000; -(500 + 0) for 195 and for 200.
    got = objective(outcome([190.0, 195.0, 200.0], [500, 500, 500], [False] * 3))
    np.testing.assert_array_equal(got, [-1000.0, -500.0, -500.0])


def test_reward_threshold_prefers_fewer_steps_among_the_solved():
    config = ObjectiveConfig(name="reward_threshold", unsolved_weight=100.0)
    objective = make_objective(config, solved_reward=-20.0)
    got = objective(outcome([-12.0, -12.0, -50.0], [300, 200, 100], [False] * 3))
    # -300, -200, and -(100 + 100 * 30) = -3100.
    np.testing.assert_array_equal(got, [-300.0, -200.0, -3100.0])


@pytest.mark.parametrize(("name", "scores"), [("auc", [0, 0.5, 0.5]), ("auc_sum", [0, 1, 2])])
def test_auc_is_the_mean_under_the_curve_or_the_area(name, scores):
    objective = make_objective(ObjectiveConfig(name=name), solved_reward=195.0)
    got = objective(outcome([1.0, 1.0, 1.0], [1, 2, 4], [False] * 3))  # areas 0, 1, 2
    np.testing.assert_array_equal(got, scores)


@pytest.mark.parametrize("name", OBJECTIVES)
def test_a_training_that_diverged_has_no_score(name):
    objective = make_objective(ObjectiveConfig(name=name), solved_reward=195.0)
    got = objective(outcome([200.0, 200.0], [10, 10], [True, False]))
    assert np.isnan(got[0]) and np.isfinite(got[1])
