"""sejax.es.base: how often candidates are evaluated, and how their scores combine."""

import jax.numpy as jnp
import numpy as np
import pytest

from sejax.es.base import Evaluations, finite_mean
from sejax.es.evosax import EvosaxConfig
from sejax.es.nes import NESConfig

NAN, INF = np.nan, np.inf


def numbers(*values):
    return np.array(values, np.float32)


# --- seeds ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("config", [NESConfig(population_size=3, num_evals=2),
                                    EvosaxConfig(population_size=4, num_evals=2)])  # fmt: skip
def test_every_candidate_trains_with_its_own_seed_unless_asked_otherwise(config):
    strategy = config.make(6)
    seed_ids = strategy.evaluations.seed_ids(strategy.population_size)
    assert len(set(seed_ids.tolist())) == len(seed_ids) == strategy.num_evaluations


def test_common_random_numbers_give_each_evaluation_of_a_member_the_same_seeds():
    # 3 members, 2 signs, 2 evaluations: seeds 0 and 1 for each; the incumbents 0, 1, 2.
    shared = {"num_evals": 2, "common_random_numbers": True}
    config = NESConfig(population_size=3, num_incumbent_evals=3, **shared)
    strategy = config.make(6)
    seed_ids = strategy.evaluations.seed_ids(strategy.population_size)
    np.testing.assert_array_equal(seed_ids, [0, 1] * 6 + [0, 1, 2])
    config = EvosaxConfig(population_size=4, num_incumbent_evals=3, common_random_numbers=True)
    strategy = config.make(6)
    seed_ids = strategy.evaluations.seed_ids(strategy.population_size)
    np.testing.assert_array_equal(seed_ids, [0] * 4 + [0, 1, 2])


@pytest.mark.parametrize("config", [
    NESConfig(population_size=4, num_evals=3, num_incumbent_evals=5, eval_aggregate="min",
              common_random_numbers=True),
    EvosaxConfig(population_size=4, num_evals=3, num_incumbent_evals=5, eval_aggregate="min",
                 common_random_numbers=True),
])  # fmt: skip
def test_a_strategy_has_the_configured_evaluations(config):
    assert config.make(6).evaluations == Evaluations(
        num_evals=3, aggregate="min", num_incumbent_evals=5, common_random_numbers=True
    )


# --- what is evaluated, and its scores -----------------------------------------------------------

EVALUATIONS = Evaluations(num_evals=2, num_incumbent_evals=3)


def test_a_candidates_evaluations_follow_one_another_and_the_incumbents_come_last():
    members, incumbent = numbers([1, 2], [3, 4]), numbers(5, 6)
    np.testing.assert_array_equal(
        EVALUATIONS.params(members, incumbent),
        [[1, 2], [1, 2], [3, 4], [3, 4], [5, 6], [5, 6], [5, 6]],
    )
    np.testing.assert_array_equal(EVALUATIONS.seed_ids(2), range(7))  # as many


def test_scores_come_apart_as_candidates_were_put_together():
    tried, incumbent = EVALUATIONS.split(jnp.arange(7.0))
    np.testing.assert_array_equal(tried, [0, 1, 2, 3])
    np.testing.assert_array_equal(incumbent, [4, 5, 6])


@pytest.mark.parametrize(
    ("aggregate", "expected"), [("mean", [2.0, NAN, NAN, -4.0]), ("min", [1.0, NAN, NAN, -4.0])]
)
def test_a_members_score_is_not_finite_if_one_evaluation_is_not(aggregate, expected):
    evaluations = Evaluations(num_evals=2, aggregate=aggregate)
    scores = jnp.array([1.0, 3.0, 2.0, NAN, INF, 0.0, -4.0, -4.0])
    np.testing.assert_array_equal(evaluations.population_scores(scores), expected)


@pytest.mark.parametrize(
    ("scores", "members", "repaired", "mean"),
    [
        # Nothing diverged.
        ([1, 2, 6], [0, 9], [1, 2, 6], 3),
        # The lowest score of the generation is a member's, -5: (1 - 5 + 10) / 3 = 2.
        ([1, NAN, 10], [-5, 9], [1, -5, 10], 2),
        # It is the incumbent's own, 1, where members diverged or were better: (1 + 1 + 7) / 3 = 3.
        ([1, -INF, 7], [NAN, INF], [1, 1, 7], 3),
        # One that no agent survived has no score, whatever the members did.
        ([NAN, INF, -INF], [1, 2], [NAN, INF, -INF], NAN),
        ([NAN, NAN, NAN], [NAN, NAN], [NAN, NAN, NAN], NAN),
    ],
)
def test_the_incumbents_agents_that_diverged_get_the_lowest_score(scores, members, repaired, mean):
    got = EVALUATIONS.incumbent_scores(numbers(*scores), numbers(*members))
    np.testing.assert_array_equal(got[0], repaired)
    np.testing.assert_array_equal(got[1], mean)


def test_the_finite_mean_leaves_out_what_diverged():
    assert finite_mean(jnp.array([1.0, NAN, 5.0, -INF])) == 3.0
    assert np.isnan(finite_mean(jnp.array([NAN, INF])))
