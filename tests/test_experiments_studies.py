"""What experiments have in common: intervals; and the search of score transforms."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import sejax
from experiments import score_transforms
from experiments.common.statistics import difference_interval, mean_interval, worst_tenth
from sejax.bilevel import make_bilevel

# --- score transforms -----------------------------------------------------------------------------


def test_a_run_counts_the_updates_before_the_incumbent_that_solves_the_task(monkeypatch):
    """Runs that solve the task at a known generation, in place of compiled ones."""

    def advance(state):
        generation = np.where(state.solved, state.generation, state.generation + 1)
        solved = generation > np.array([3, 0, 9, 1, 4])
        return SimpleNamespace(generation=generation, solved=solved, incumbent_score=generation)

    start = SimpleNamespace(generation=np.zeros(5, int), solved=np.zeros(5, bool))
    monkeypatch.setattr(score_transforms, "make_search", lambda *_: (lambda *_: start, advance))
    settings = score_transforms.ScoreTransforms.of(runs=5, generations=5, seed=3)
    cell = score_transforms.compute_cell(settings, "nes", True)
    assert list(cell["updates"]) == [3, 0, 5, 1, 4]
    assert list(cell["solved"]) == [True, True, False, True, True]


@pytest.mark.slow
def test_the_search_is_the_bilevel_loop(monkeypatch):
    monkeypatch.setattr(score_transforms, "RUNS_AT_ONCE", 2)
    init, advance = score_transforms.make_search("single_best", True, 2, None)
    keys, sizes = jax.random.split(jax.random.key(0), 3), np.float32([0.1, 1.0, 5.0])
    state = start = init(keys, sizes)
    words = ["es.score_transform=single_best", "es.mirrored=true", "es.population_size=2"]
    program = make_bilevel(**sejax.config([*score_transforms.SETTINGS, *words]).parts())
    expected = jax.jit(jax.vmap(program.init))(keys)
    es_state = expected.es_state.replace(step_size=jnp.asarray(sizes))
    expected, generation = expected.replace(es_state=es_state), jax.vmap(program.generation)
    for _ in range(2):
        state, (expected, _) = advance(state), jax.jit(generation)(expected)
    for new, old in zip(jax.tree.leaves(state), jax.tree.leaves(start), strict=True):
        assert new.sharding.is_equivalent_to(old.sharding, old.ndim), "else it is compiled twice"
    np.testing.assert_allclose(state.incumbent_score, expected.incumbent_score, rtol=1e-5)
    np.testing.assert_allclose(state.es_state.mean, expected.es_state.mean, rtol=1e-4, atol=1e-6)


# --- intervals, against scipy ---------------------------------------------------------------------


@pytest.mark.parametrize("size", [5, 6, 10, 33])
def test_intervals_are_those_of_scipys_t_tests(size):
    values = np.random.default_rng(size).exponential(size=size)
    expected = scipy.stats.ttest_1samp(values, 0).confidence_interval()
    assert mean_interval(values) == pytest.approx(tuple(expected))
    others = np.random.default_rng(0).normal(size=7)
    welch = scipy.stats.ttest_ind(values, others, equal_var=False).confidence_interval()
    assert difference_interval(values, others) == pytest.approx(tuple(welch))


def test_fewer_than_five_values_have_no_interval():
    four = [1.0, 2.0, 3.0, 4.0]
    assert np.isnan([mean_interval(four), difference_interval(four, [1.0] * 9)]).all()


def test_the_worst_tenth_is_the_mean_of_the_lowest_values():
    assert worst_tenth(np.random.default_rng(0).permutation(20)) == 0.5
    assert worst_tenth([3.0, 1.0, 2.0]) == 1.0 and worst_tenth(range(11)) == 0.5
    assert np.isnan(worst_tenth([np.nan, 1.0]))


def test_equal_runs_have_no_uncertainty():
    assert mean_interval([3.0] * 5) == (3.0, 3.0)
    assert difference_interval([3.0] * 5, [1.0] * 6) == (2.0, 2.0)
