"""sejax.scoring: how often candidates are evaluated, and how their scores combine."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import outcome_of

import sejax
from sejax import envs
from sejax.agents.mixture import Mixture
from sejax.es.evosax import EvosaxConfig
from sejax.es.nes import NESConfig
from sejax.generation import Layout
from sejax.ops.scores import finite_mean
from sejax.scoring import Scoring, with_diverged_last

NAN, INF = np.nan, np.inf


def scoring_of(config, num_agents=1):
    """The scoring of a strategy, with agents that are never run."""
    task = envs.make("gridworld_2x2")
    agents = (sejax.make_agent(sejax.QLearningConfig(), task),) * num_agents
    layout = Layout(strategy=config.make(6), mixture=Mixture(agents=agents))
    return Scoring(objective=sejax.MaxReward().make(task), layout=layout)


@pytest.mark.parametrize("cls", [NESConfig, EvosaxConfig])
def test_every_training_has_a_seed_of_its_own_unless_asked_otherwise(cls):
    config = cls(population_size=4, num_evals=2, num_incumbent_evals=3)
    for shared in (False, True):
        layout = scoring_of(dataclasses.replace(config, common_random_numbers=shared)).layout
        size, keys = layout.strategy.num_candidates, layout.keys(jax.random.key(0))
        seeds = np.asarray(jax.random.key_data(keys))
        assert len(seeds) == 2 * size + 3
        assert len(np.unique(seeds, axis=0)) == (3 if shared else len(seeds))
        if shared:  # two for each candidate, which are the first two of the incumbent
            np.testing.assert_array_equal(seeds[:-3], np.tile(seeds[-3:-1], (size, 1)))


def test_with_common_random_numbers_all_agents_of_a_mixture_have_the_populations():
    fields = {"num_evals": 2, "num_incumbent_evals": 6, "common_random_numbers": True}
    keys = scoring_of(NESConfig(population_size=2, **fields), 2).layout.keys(jax.random.key(0))
    assert (keys[8:12] == keys[jnp.array([6, 6, 7, 7])]).all()  # the population's are 0 to 7


# --- what is evaluated, and its scores -----------------------------------------------------------


@pytest.mark.parametrize(("aggregate", "first"), [("mean", 2.0), ("min", 1.0)])
def test_a_member_has_no_score_if_the_agent_of_one_evaluation_diverged(aggregate, first):
    es = NESConfig(population_size=2, num_evals=2, eval_aggregate=aggregate, num_incumbent_evals=1)
    scores = jnp.array([1.0, 3.0, 2.0, NAN, NAN, 0.0, -4.0, -4.0, 5.0])
    told, incumbent = scoring_of(es).candidate_scores(outcome_of(scores))
    np.testing.assert_array_equal(told, [first, NAN, NAN, -4.0])
    assert incumbent == 5


@pytest.mark.parametrize(("scores", "members", "repaired", "mean"), [
    ([1, 2, 6], [0, 9], [1, 2, 6], 3),  # nothing diverged
    # The lowest score of the generation is a member's, -5: (1 - 5 + 10) / 3 = 2.
    ([1, NAN, 10], [-5, 9], [1, -5, 10], 2),
    # It is the incumbent's own, 1, where members diverged or were better: (1 + 1 + 7) / 3 = 3.
    ([1, NAN, 7], [NAN, NAN, 9], [1, 1, 7], 3),
    # One that no agent survived has no score, whatever the members did.
    ([NAN, NAN, NAN], [1, 2], [NAN, NAN, NAN], NAN),
])  # fmt: skip
def test_the_incumbents_agents_that_diverged_get_the_lowest_score(scores, members, repaired, mean):
    result = with_diverged_last(jnp.float32(scores), jnp.float32(members))
    np.testing.assert_array_equal(result[0], repaired)
    np.testing.assert_array_equal(result[1], mean)


def test_the_finite_mean_leaves_out_what_diverged():
    assert finite_mean(jnp.array([1.0, NAN, 5.0, -INF])) == 3.0
    assert np.isnan(finite_mean(jnp.array([NAN, INF])))
