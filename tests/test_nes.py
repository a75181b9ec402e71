"""sejax.es: the paper's NES against NumPy, and the contract of every outer optimiser."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import refused

from sejax.es.evosax import ALGORITHMS, EvosaxConfig, from_evosax
from sejax.es.nes import NESConfig
from sejax.scoring import with_diverged_last

NAN, INF = np.nan, np.inf
DIMS = 6
MEAN = np.array([0.3, -0.2, 0.1, 0.5, -0.4, 0.2], np.float32)


def num_trainings(strategy):
    """Trainings in a generation."""
    return strategy.num_candidates * strategy.num_evals + strategy.num_incumbent_evals


def whole_generations(strategy):
    """`ask` and `tell` of all that a generation tries, the incumbent included, as bilevel.py does.

    `ask(key, state) -> (candidates, state)`, `tell(key, candidates, scores, state) -> state`. The
    evaluations of a candidate follow one another; those of the incumbent come last.
    """
    num_evals, size = strategy.num_evals, strategy.num_candidates

    def ask(key, state):
        population, state = strategy.ask(key, state)
        incumbent = jnp.tile(strategy.incumbent(state), (strategy.num_incumbent_evals, 1))
        return jnp.concatenate([jnp.repeat(population, num_evals, axis=0), incumbent]), state

    def tell(key, candidates, scores, state):
        of_population, of_incumbent = jnp.split(scores, [size * num_evals])
        _, incumbent = with_diverged_last(of_incumbent, of_population)
        scores = getattr(of_population.reshape(size, num_evals), strategy.eval_aggregate)(axis=1)
        population = candidates[: size * num_evals : num_evals]
        return strategy.tell(key, population, scores, incumbent, state)

    return ask, tell


@functools.cache
def nes(**fields):
    """Strategy with jitted `ask` and `tell`, by config fields; population 3 unless told."""
    paper = {"num_incumbent_evals": None, "noise_std": 0.05, "noise_std_decay": 1.0}
    strategy = NESConfig(**{"population_size": 3, **paper, **fields}).make(DIMS)
    return strategy, *map(jax.jit, whole_generations(strategy))


def asked(seed=1, **fields):
    strategy, ask, tell = nes(**fields)
    state = strategy.init(jax.random.key(0), jnp.array(MEAN))
    candidates, state = ask(jax.random.key(seed), state)
    return np.asarray(candidates), jax.tree.map(np.asarray, state), tell


def told(scores, seed=1, **fields):
    """State after one generation with these scores, and the candidates that had them."""
    candidates, state, tell = asked(seed, **fields)
    return tell(jax.random.key(2), candidates, np.array(scores, np.float32), state), candidates


# --- candidates ----------------------------------------------------------------------------------


def test_candidates_are_plus_then_minus_then_the_incumbents():
    candidates, _, _ = asked(num_evals=2)
    strategy, _, _ = nes(num_evals=2)
    # 3 members, each sign evaluated twice in a row, then one incumbent for each member.
    assert candidates.shape == (3 * 2 + 3 * 2 + 3, DIMS)
    assert (strategy.num_candidates, num_trainings(strategy)) == (6, 15)
    np.testing.assert_array_equal(candidates[:12:2], candidates[1:12:2])
    np.testing.assert_allclose(candidates[:6] - MEAN, MEAN - candidates[6:12], atol=1e-7)
    assert np.abs(candidates[:6] - MEAN).min() > 0
    np.testing.assert_array_equal(candidates[12:], np.tile(MEAN, (3, 1)))
    assert len(np.unique(candidates[:6:2], axis=0)) == 3


def test_the_noise_is_normal_with_the_configured_std():
    strategy = NESConfig(population_size=50, noise_std=0.05).make(400)
    state = strategy.init(jax.random.key(0), jnp.zeros(400))
    members, _ = jax.jit(strategy.ask)(jax.random.key(1), state)
    noise = np.asarray(members)[:50] / 0.05
    n = noise.size
    assert abs(noise.mean()) < 5 / np.sqrt(n)
    assert abs(noise.var() - 1) < 5 * np.sqrt(2 / n)
    assert abs((noise**4).mean() - 3) < 5 * np.sqrt(96 / n)  # kurtosis of a normal


# --- the sign ------------------------------------------------------------------------------------


@pytest.mark.parametrize("diverged", [NAN, INF, -INF])
def test_a_sign_that_diverged_loses_to_one_that_did_not(diverged):
    state, candidates = told([diverged, 1, 2, -9, diverged, 3, 0, 0, 0], score_transform="rank")
    # Members: minus -9, plus 1, minus 3; ranks 0, 1, 2 over 2.
    noise = candidates[:3] - MEAN
    expected = MEAN + 0.5 * noise[1] - noise[2]
    np.testing.assert_allclose(state.mean, expected, rtol=1e-5, atol=1e-6)


# --- the update ----------------------------------------------------------------------------------


def numpy_generation(mean, candidates, scores, config, noise_std, step_size):
    """Algorithm 1 with All Better 2, in plain loops."""
    n, repeats = config.population_size, config.num_evals
    num_members = 2 * n if config.mirrored else n
    perturbed = scores[: num_members * repeats].reshape(num_members, repeats)
    values = perturbed.mean(axis=1) if config.eval_aggregate == "mean" else perturbed.min(axis=1)
    incumbent = np.mean(scores[num_members * repeats :])
    noise, member_scores = [], []
    for i in range(n):
        plus, minus = values[i], values[n + i] if config.mirrored else -INF
        eps = candidates[i * repeats] - mean
        noise.append(-eps if minus > plus else eps)
        member_scores.append(max(plus, minus))
    advantages = [max(0.0, k - incumbent) for k in member_scores]
    weights = [a / sum(advantages) if sum(advantages) > 0 else 0.0 for a in advantages]
    step = step_size * sum(f * eps for f, eps in zip(weights, noise, strict=True))
    if config.update_rule == "paper":
        step = step / (n * noise_std)
    return (1 - config.weight_decay) * mean + step


@pytest.mark.parametrize("update_rule", ["authors", "paper"])
@pytest.mark.parametrize(("by", "mirrored"), [("mean", True), ("min", True), ("mean", False)])
def test_generations_equal_a_numpy_loop(update_rule, by, mirrored):
    config = NESConfig(
        population_size=4, num_evals=3, eval_aggregate=by, update_rule=update_rule,
        num_incumbent_evals=None, mirrored=mirrored,
        noise_std=0.2, noise_std_decay=0.9, step_size=0.5, step_size_decay=0.8, weight_decay=0.1,
    )  # fmt: skip
    strategy = config.make(DIMS)
    ask, tell = map(jax.jit, whole_generations(strategy))
    state = strategy.init(jax.random.key(0), jnp.array(MEAN))
    rng = np.random.default_rng(0)
    mean = MEAN.astype(np.float64)
    for number in range(3):
        candidates, state = ask(jax.random.key(number), state)
        scores = rng.normal(size=num_trainings(strategy))
        scores[-4:] -= 0.5
        state = tell(jax.random.key(0), candidates, jnp.float32(scores), state)
        mean = numpy_generation(
            mean, np.asarray(candidates, np.float64), scores, config,
            noise_std=0.2 * 0.9**number, step_size=0.5 * 0.8**number,
        )  # fmt: skip
        np.testing.assert_allclose(strategy.incumbent(state), mean, rtol=1e-4, atol=1e-5)


def test_diverged_scores_never_reach_the_mean():
    # Member 0 diverged with both signs; members 1 and 2 score 5 and 3 by their plus. The lowest
    # score of all is 1, which the incumbent's agent that diverged gets: mean (1 + 1 + 4) / 3 = 2,
    # advantages 3 and 1, weights 3/4 and 1/4.
    state, candidates = told([NAN, 5, 3, INF, NAN, 1, 1, NAN, 4])
    noise = candidates[:3] - MEAN
    expected = MEAN + 0.75 * noise[1] + 0.25 * noise[2]
    np.testing.assert_allclose(state.mean, expected, rtol=1e-5, atol=1e-6)


def test_a_std_that_has_decayed_to_nothing_moves_nothing():
    key, strategy = jax.random.key(0), NESConfig(update_rule="paper", population_size=4).make(DIMS)
    state = strategy.init(key, jnp.array(MEAN))
    state = dataclasses.replace(state, noise_std=jnp.float32(0))
    candidates, state = strategy.ask(key, state)
    scores = jnp.arange(float(len(candidates)))
    state = strategy.tell(key, candidates, scores, jnp.float32(0), state)
    np.testing.assert_array_equal(state.mean, MEAN)


# --- contract of every strategy ------------------------------------------------------------------


def evosax_strategy(name):
    config = EvosaxConfig(name=name, population_size=16, num_incumbent_evals=2, noise_std=0.1)
    return config.make(DIMS)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_candidates_have_our_std_and_come_in_pairs_where_the_strategy_says_so(name):
    dims, std, decay = 200, 0.05, 0.5 if name == "open_es" else 1.0
    size = 32 if ALGORITHMS[name].mirrored else 33
    config = EvosaxConfig(name=name, population_size=size, noise_std=std, noise_std_decay=decay)
    strategy = config.make(dims)
    state = jax.jit(strategy.init)(jax.random.key(0), np.zeros(dims, np.float32))
    members = np.asarray(jax.jit(strategy.ask)(jax.random.key(1), state)[0])
    assert strategy.mirrored == (np.abs(members[:16] + members[16:32]).max() < 1e-6)
    assert members.std() == pytest.approx(std, rel=0.15)


def test_what_an_algorithm_does_not_use_is_refused():
    assert refused(EvosaxConfig, name="cma_es", step_size=0.1) == "es.step_size"
    assert refused(EvosaxConfig, name="pgpe", noise_std_decay=0.9) == "es.noise_std_decay"


def test_step_size_and_decay_of_the_noise_reach_an_algorithm():
    dims, key = 200, jax.random.key(0)
    fields = {"noise_std": 0.1, "noise_std_decay": 0.5, "step_size": 0.02}
    strategy = EvosaxConfig(name="open_es", population_size=64, **fields).make(dims)
    state = strategy.init(key, jnp.zeros(dims))
    members, state = strategy.ask(key, state)
    state = strategy.tell(key, members, members.sum(axis=1), jnp.float32(0), state)
    mean = strategy.incumbent(state)
    np.testing.assert_allclose(np.abs(mean), 0.02, rtol=1e-2)  # Adam's first step
    members, _ = strategy.ask(jax.random.key(1), state)
    assert float(jnp.std(members - mean)) == pytest.approx(0.05, rel=0.1)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_scores_that_are_all_equal_change_nothing(name):
    strategy, key = evosax_strategy(name), jax.random.key(0)
    members, state = strategy.ask(key, strategy.init(key, jnp.ones(DIMS)))
    for score in (7.0, NAN):
        told = strategy.tell(key, members, jnp.full(16, score), jnp.float32(score), state)
        chex.assert_trees_all_equal(told, state)


def another_of_evosax(num_dims):
    """An algorithm without a name here, as an object; it keeps the best candidate so far."""
    from evosax.algorithms import HillClimbing

    algorithm = HillClimbing(
        population_size=16, solution=jnp.zeros(num_dims), std_schedule=lambda generation: 0.1
    )
    return from_evosax(algorithm, num_incumbent_evals=2)


TARGET = np.array([0.5, -0.4, 0.3, -0.2, 0.6, -0.5], np.float32)


def climb(strategy, generations):
    """Scores of the incumbent on a smooth concave function, one for each generation.

    Two trainings of each generation diverge, others each time, and in the tenth all do.
    """
    ask, tell = whole_generations(strategy)
    index = jnp.arange(num_trainings(strategy))

    def generation(state, scan):
        number, key = scan
        key_ask, key_tell = jax.random.split(key)
        candidates, state = ask(key_ask, state)
        true_scores = -jnp.sum((candidates - TARGET) ** 2, axis=-1)
        diverged = jnp.isin(index, (5 * number + jnp.array([0, 1])) % 16) | (number == 10)
        scores = jnp.where(diverged, NAN, true_scores)
        return tell(key_tell, candidates, scores, state), true_scores[-1]

    state = strategy.init(jax.random.key(0), jnp.zeros(DIMS))
    scan = jnp.arange(generations), jax.random.split(jax.random.key(1), generations)
    state, scores = jax.jit(lambda state: jax.lax.scan(generation, state, scan))(state)
    assert np.isfinite(strategy.incumbent(state)).all()
    return np.asarray(scores)


@pytest.mark.parametrize("name", [*ALGORITHMS, "another"])
def test_every_algorithm_maximises_scores_though_some_trainings_diverge(name):
    # A wrong sign would run away from the target. Start: -|target|^2 = -1.15.
    strategy = another_of_evosax(DIMS) if name == "another" else evosax_strategy(name)
    scores = climb(strategy, generations=80)
    np.testing.assert_allclose(scores[0], -1.15, rtol=1e-5)
    assert scores[-1] > -0.75  # a third of the way, in score
