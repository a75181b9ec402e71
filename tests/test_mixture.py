"""sejax.agents.mixture: candidates that are divided among agents, and how their scores combine."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import assert_equal, outcome_of, paper_se, refused

import sejax
from sejax import envs
from sejax.agents.mixture import Mixture, MixtureConfig
from sejax.bilevel import make_bilevel
from sejax.es.nes import NESConfig
from sejax.evaluation import make_evaluator
from sejax.options import registry
from sejax.training import TrainingConfig

NAN, INF = np.nan, np.inf
KEY = jax.random.key(0)
TASK = envs.make("gridworld_2x2")
SARSA = sejax.SARSAConfig(learning_rate=0.3, epsilon_init=0.7, epsilon_min=0.7)
AGENTS = tuple(sejax.make_agent(x, TASK) for x in (sejax.QLearningConfig(learning_rate=0.5), SARSA))


def mixture(num=2, weights=(), **config):
    """A mixture of which nobody looks at the agents."""
    return Mixture(agents=AGENTS[:1] * num, weights=weights, **config)


# --- which agent trains where --------------------------------------------------------------------


@pytest.mark.parametrize(("weights", "num_candidates", "candidates"), [
    # Shares 1/2, 1/3 and 1/6; after each candidate, share times candidates less those had:
    # 1: 3/6 2/6 1/6 -> 0.  2: 0 4/6 2/6 -> 1.  3: 3/6 0 3/6 -> 0 (a tie goes to the first).
    # 4: 0 2/6 4/6 -> 2.  5: 3/6 4/6 -1/6 -> 1.  6: 6/6 0 0 -> 0.  Then all over again.
    ((3.0, 2.0, 1.0), 12, ([0, 2, 5, 6, 8, 11], [1, 4, 7, 10], [3, 9])),
    ((1.0, 1.0), 5, ([0, 2, 4], [1, 3])),
    ((1.0,), 3, ([0, 1, 2],)),
    # An agent of weight 0 trains on incumbents alone, and needs no candidate.
    ((0.0, 3.0), 3, ([], [0, 1, 2])),
    ((0.0, 3.0), 1, ([], [0])),
])  # fmt: skip
def test_candidates_go_to_the_agent_that_is_furthest_behind(weights, num_candidates, candidates):
    agents = mixture(len(weights), weights=weights)
    assert tuple(x.tolist() for x in agents.deal(num_candidates)) == candidates
    pairs = agents.deal(2 * num_candidates, mirrored=True)
    mirrored = tuple(x + [num_candidates + i for i in x] for x in candidates)
    assert tuple(x.tolist() for x in pairs) == mirrored


@pytest.mark.parametrize(("asked", "num", "evals"), [(16, 2, 16), (5, 2, 6), (1, 3, 3), (4, 1, 4)])
def test_the_incumbent_is_evaluated_equally_often_with_each_agent(asked, num, evals):
    bilevel = make_bilevel(task=TASK, agent=mixture(num), es=NESConfig(num_incumbent_evals=asked))
    assert bilevel.layout.num_on_incumbent == evals


@pytest.mark.parametrize(("make", "field"), [
    (lambda: Mixture(agents=()), "agents"),
    (lambda: Mixture(agents=AGENTS, weights=(1.0, 2.0, 3.0)), "agents"),
    (lambda: mixture(2, weights=(0.0, 0.0)), "agents"),
    (lambda: mixture(2, weights=(1.0, -1.0)), "agents"),
    (lambda: mixture(2, weights=(1.0, NAN)), "agents"),
    (lambda: Mixture(agents=(AGENTS[0], "sarsa")), "agent"),
    (lambda: mixture(3).deal(4, mirrored=True), "es.population_size"),
    (lambda: mixture(2, weights=(10.0, 1.0)).deal(4), "es.population_size"),
    (lambda: MixtureConfig(aggregate="max"), "mixture.aggregate"),
])  # fmt: skip
def test_a_mixture_that_cannot_be_is_refused(make, field):
    assert refused(make) == field


# --- how scores combine --------------------------------------------------------------------------

SCORES = np.array([200, -500, 150, NAN, 190, -80, NAN, -500, 10, -90, 180, -100], np.float32)
AGENT = np.array([0, 1] * 6)


def plain_comparable(scores, agent, incumbents):
    """The same in plain Python, one candidate at a time."""
    out = []
    for score, index in zip(scores.tolist(), agent, strict=True):
        of_agent = scores[agent == index].tolist()
        alive = [x for x in of_agent if np.isfinite(x)]
        mean = incumbents[index] if np.isfinite(incumbents[index]) else sum(alive) / len(alive)
        out.append(score - mean if np.isfinite(score) else NAN)
    return out


def compare(scores, agent, incumbents):
    """`comparable` of as many agents as there are incumbents' means, in NumPy."""
    comparable = mixture(len(incumbents)).comparable
    candidates = [np.flatnonzero(np.array(agent) == i) for i in range(len(incumbents))]
    jitted = jax.jit(lambda scores, means: comparable(scores, candidates, means))
    return jax.device_get(jitted(np.float32(scores), np.float32(incumbents)))


@pytest.mark.parametrize("incumbents", [(160.0, -95.0), (190.0, NAN), (NAN, NAN)])
def test_scores_are_compared_within_their_agent(incumbents):
    got, incumbent = compare(SCORES, AGENT, incumbents)
    expected = plain_comparable(SCORES, AGENT, incumbents)
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)
    assert incumbent == 0.0


def test_what_ties_with_the_incumbent_but_for_rounding_moves_nothing():
    mean = np.float32(-93.3) - np.float32(2e-5)  # as a mean of equal scores may be off
    got, _ = compare([-93.3, 0.0, -93.3, 1.0], [0, 1, 0, 1], [mean, 0.5])
    assert got[0] == got[2] == 0 and got[1] < 0 < got[3]


# --- Algorithm 1 ---------------------------------------------------------------------------------

PROXY = registry.make("proxy", paper_se(hidden_size=4, done="threshold"), TASK)
TRAINING = TrainingConfig(max_episodes=5, max_steps=30, stop_rule="never", test_episodes=2)
ES = NESConfig(population_size=3, noise_std=1.0, num_evals=2, num_incumbent_evals=3)


def bilevel_of(agent, **fields):
    return make_bilevel(
        **{"task": TASK, "agent": agent, "proxy": PROXY, "es": ES, "training": TRAINING,
           "num_parallel": 1, "devices": 2, **fields}
    )  # fmt: skip


@pytest.fixture(scope="module")
def two():
    """A generation of a mixture of two agents, and the outcome of its evaluations by hand.

    The outcome is that of one training after another, each with a single agent's evaluator.
    """
    bilevel = bilevel_of(Mixture(agents=AGENTS, names=("q", "sarsa"), weights=(2.0, 1.0)))
    state = jax.jit(bilevel.init)(KEY)

    @jax.jit
    def generation(state):
        candidates = bilevel.ask(state)
        outcome = bilevel.evaluate(candidates)
        return candidates, outcome, *bilevel.tell(state, candidates, outcome)

    candidates, outcome, after, info = generation(state)
    # Candidates 0 1 0 of each sign, two evaluations each; four of the incumbent, 3 rounded up.
    agent = np.array([0, 0, 1, 1, 0, 0] * 2 + [0, 1, 0, 1])
    keys = jnp.concatenate([group.ravel() for group in candidates.keys])
    vectors = np.repeat(candidates.population, 2, axis=0), [candidates.incumbent] * 4
    params = jax.jit(jax.vmap(lambda x: PROXY.params(bilevel.unravel(x))))(np.concatenate(vectors))
    evaluators = [make_evaluator(agent, PROXY, TASK, TRAINING) for agent in AGENTS]
    run_all = jax.jit(lambda *x: [jax.lax.map(lambda y, run=run: run(*y), x) for run in evaluators])
    by_agent = jax.device_get(run_all(keys, params))
    assert np.mean(by_agent[0].auc != by_agent[1].auc) > 0.5  # the agents differ on most
    expected = jax.tree.map(lambda *x: np.stack([x[a][i] for i, a in enumerate(agent)]), *by_agent)
    return SimpleNamespace(
        bilevel=bilevel, before=state, candidates=candidates, outcome=outcome, after=after,
        info=info, agent=agent, expected=expected,
    )  # fmt: skip


@pytest.mark.slow
def test_keys_may_be_of_the_old_kind(two):
    generation = jax.jit(lambda key: two.bilevel.generations(two.bilevel.init(key), 1)[1])
    old, new = (generation(key) for key in (jax.random.PRNGKey(3), jax.random.key(3)))
    assert_equal(old, new)


def test_each_candidate_is_trained_by_its_agent_and_no_other(two):
    assert_equal(two.outcome, two.expected)


def test_a_generation_tells_the_advantages_over_each_agents_incumbent(two):
    scores, agent = two.expected.test_return, two.agent
    candidates, after = two.candidates, two.after
    assert np.isfinite(scores).all()
    assert (np.asarray(after.es_state.mean) != two.before.es_state.mean).any()
    means = [scores[12:][agent[12:] == i].mean() for i in range(2)]
    advantage = scores[:12].reshape(6, 2).mean(axis=1) - np.array(means)[[0, 1, 0, 0, 1, 0]]
    told = two.bilevel.layout.strategy.tell(
        candidates.key_tell, candidates.population, jnp.float32(advantage), jnp.float32(0),
        candidates.es_state,
    )  # fmt: skip
    np.testing.assert_allclose(after.es_state.mean, told.mean, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(two.info.incumbent_mean, np.mean(means), rtol=1e-6)
    np.testing.assert_allclose(after.best.by_agent, means, rtol=1e-6)
    np.testing.assert_allclose(after.last.by_agent, means, rtol=1e-6)


def test_the_columns_of_each_agent_are_means_over_its_trainings(two):
    info, outcome, agent = two.info, two.expected, two.agent
    scores, is_candidate = outcome.test_return, np.arange(16) < 12
    for i in range(2):
        own = agent == i
        expected = {
            "incumbent_mean": scores[own & ~is_candidate].mean(),
            "population_mean": scores[own & is_candidate].mean(),
            "train_steps_mean": outcome.train_steps[own].mean(),
            "num_nonfinite": 0,
        }
        found = {name: getattr(info.by_agent, name)[i] for name in expected}
        assert found == pytest.approx(expected, rel=1e-5)
    np.testing.assert_allclose(info.population_mean, scores[:12].mean(), rtol=1e-6)
    np.testing.assert_allclose(info.population_max, scores[:12].max(), rtol=1e-6)
    np.testing.assert_allclose(info.incumbent_std, scores[12:].std(), rtol=1e-5)
    np.testing.assert_array_equal(info.train_steps, outcome.train_steps)
    np.testing.assert_array_equal(info.real_steps, outcome.real_steps)


def told(incumbents, state=None, stop_when_solved=True, candidates=(0, 0), **config):
    """State and info after a generation whose candidates and incumbent returned these."""
    bilevel = bilevel_of(
        Mixture(agents=AGENTS, **config), stop_when_solved=stop_when_solved,
        es=NESConfig(population_size=2, mirrored=False, num_incumbent_evals=len(incumbents)),
    )  # fmt: skip
    outcome = outcome_of([*candidates, *incumbents])
    state = bilevel.init(KEY) if state is None else state
    return jax.jit(lambda s: bilevel.tell(s, bilevel.ask(s), outcome))(state)


@pytest.mark.parametrize(("aggregate", "score"), [("mean", 0.25), ("min", -0.25)])
def test_a_run_stops_when_the_incumbents_score_solves_the_task(aggregate, score):
    # The mean of both agents is above the threshold, the second agent's is below it.
    incumbents = TASK.solved_reward + np.array([0.75, -0.25])
    after, info = told(incumbents, aggregate=aggregate)
    assert bool(after.solved) == (aggregate == "mean")
    np.testing.assert_allclose(after.best.score, TASK.solved_reward + score, rtol=1e-6)
    np.testing.assert_allclose(info.by_agent.incumbent_mean, incumbents, rtol=1e-6)
    after, _ = told(incumbents + 1, stop_when_solved=False)
    assert not after.solved and after.best.score > TASK.solved_reward


def test_the_incumbents_agents_that_diverged_rank_last_within_their_agent():
    # Both agents' candidates returned 0. The lowest of the first agent is -3, of the second 0.
    _, info = told([4, 5, NAN, NAN, -3, 7])
    np.testing.assert_allclose(info.by_agent.incumbent_mean, [(4 - 3 - 3) / 3, (5 + 0 + 7) / 3])
    np.testing.assert_array_equal(info.by_agent.num_nonfinite, [1, 1])


def test_a_candidate_of_infinite_score_is_counted_and_no_maximum():
    _, info = told([4, 5], candidates=[INF, 3])
    assert (info.population_max, info.population_mean, info.num_nonfinite) == (3, 3, 1)


@pytest.mark.parametrize("aggregate", ["mean", "min"])
def test_an_incumbent_that_one_agent_never_survived_is_never_the_best(aggregate):
    after, info = told([1e6, NAN], aggregate=aggregate)
    assert (after.best.generation, after.best.score, after.solved) == (-1, -INF, False)
    np.testing.assert_array_equal(after.last.by_agent, [1e6, -INF])
    np.testing.assert_array_equal(info.by_agent.num_nonfinite, [0, 1])
