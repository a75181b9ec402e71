"""sejax.objectives: what an outcome is worth, by hand."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from support import outcome_of, refused

from sejax import envs
from sejax.objectives import AUC, AUCSum, MaxReward, Objective, RewardThreshold
from sejax.options import registry
from sejax.options.plain import configure


def outcome(test_return, train_steps, nonfinite):
    returns, steps = jnp.float32(test_return)[:, None], jnp.array(train_steps, jnp.int32)
    return outcome_of(test_return).replace(
        test_returns=returns + jnp.float32([-1, 0, 1]),  # the mean over three episodes
        scored_returns=2 * returns + jnp.float32([-1, 1]), train_steps=steps,
        auc=jnp.arange(len(test_return), dtype=jnp.float32), nonfinite=jnp.array(nonfinite),
    )  # fmt: skip


def task(solved_reward=195.0):
    return dataclasses.replace(envs.make("cartpole"), solved_reward=solved_reward)


def test_a_curriculum_scores_other_lengths_until_it_is_over():
    # From 20 steps in generation 0 to the task's 200 in generation 40: 4.5 more in each.
    objective = MaxReward(first_eval_steps=20, curriculum_generations=40).make(task())
    generations = jnp.array([0, 1, 2, 20, 39, 40, 1000])
    steps = objective.test_params(generations).scored_steps
    np.testing.assert_array_equal(steps, [20, 24, 29, 110, 196, 200, 200])  # halves to even
    assert steps.dtype == jnp.int32
    long = MaxReward(first_eval_steps=1000, curriculum_generations=8).make(task())
    np.testing.assert_array_equal(long.test_params(generations[:3]).scored_steps, [1000, 900, 800])
    # Members are worth the part that is scored, incumbents whole episodes.
    ended = outcome([10.0, 200.0, -3.0], [1, 2, 3], [False, False, True])
    np.testing.assert_array_equal(objective.search_scores(ended), [20.0, 400.0, np.nan])
    np.testing.assert_array_equal(objective.shown_scores(ended), [10.0, 200.0, np.nan])
    assert MaxReward().make(task()).test_params(0) is None


@pytest.mark.parametrize(("config", "scores"), [
    (MaxReward(), [190.0, 195.0, 200.0]),
    # -(500 + 100 * (195 - 190)), -(500 + 0), -(400 + 0)
    (RewardThreshold(unsolved_weight=100.0), [-1000.0, -500.0, -400.0]),
    (AUC(), np.float32([0, 1 / 500, 2 / 400])),  # of areas 0, 1, 2
    (AUCSum(), [0, 1, 2]),
])  # fmt: skip
def test_scores_are_worked_by_hand(config, scores):
    objective = config.make(task(195.0))
    got = objective.search_scores(outcome([190.0, 195.0, 200.0], [500, 500, 400], [False] * 3))
    np.testing.assert_array_equal(got, scores)


OWN = Objective(score=lambda outcome: -outcome.train_episodes.astype(jnp.float32))
NAMES = registry.names("objective")
CONFIGS = [configure("objective", {"name": name}) for name in NAMES]


@pytest.mark.parametrize(
    "objective", [OWN, *(config.make(task()) for config in CONFIGS)], ids=["own", *NAMES]
)
def test_a_training_that_diverged_has_no_score(objective):
    scores = objective.search_scores(outcome([200.0, 200.0], [10, 10], [True, False]))
    assert np.isnan(scores[0]) and np.isfinite(scores[1])


def test_a_score_that_statistics_cannot_hold_counts_as_diverged():
    ended = outcome([np.inf, -np.inf, -3e38, 9e29], [1] * 4, [False] * 4)
    scores = MaxReward().make(task()).search_scores(ended)
    assert np.isnan(scores).tolist() == [True, True, True, False]


def test_an_objective_must_score_each_agent():
    mean = Objective(score=lambda outcome: outcome.test_returns.mean())  # of all agents
    assert refused(mean.search_scores, outcome([1.0, 2.0], [10] * 2, [False] * 2)) == "objective"
