"""sejax.es.score_transforms: each of the eight on numbers worked by hand, and their laws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import refused

from sejax.es.nes import NESConfig
from sejax.es.score_transforms import TRANSFORMS, transform_of
from sejax.options import ConfigError

NAN, INF = np.nan, np.inf
SCORES = [3.0, NAN, 1.0, 2.0]


@jax.jit
def all_of_them(scores, incumbent):
    """Weights by name: one program for each number of members."""
    return {name: transform(scores, incumbent) for name, transform in TRANSFORMS.items()}


def transform(name, scores, incumbent):
    return np.asarray(all_of_them(np.array(scores, np.float32), np.float32(incumbent))[name])


# By name: the weights of each candidate. A score of nan counts as the worst finite one.
WORKED = {
    # Scores 3, nan, 1, 2 and an incumbent of 1.5.
    "usual": (SCORES, 1.5, {
        "linear": [1, 0, 0, 0.5],  # (3-1)/2, 0/2, 0/2, (2-1)/2
        "rank": [1, 0, 1 / 3, 2 / 3],  # candidates with a lower score: 3, 0, 1, 2; over 3 - 0
        # n = 4. Ranks from the best: 1, 4, 3, 2. max(0, ln 3 - ln R) = 1.098612, 0, 0, 0.405465.
        # Their sum is 1.504077; shares 0.730423, 0, 0, 0.269577; less 1/4: 0.480423, -0.25,
        # -0.25, 0.019577; divided by 0.480423.
        "nes": [1, -0.520375, -0.520375, 0.040750],
        # The same without the 1/4: 0.269577 / 0.730423 = 0.369070.
        "nes_unnormalized": [1, 0, 0, 0.369070],
        "single_best": [1, 0, 0, 0],
        "single_better": [1, 0, 0, 0],
        "all_better_1": [1, 0, 0, 1 / 3],  # advantages 1.5, 0, 0, 0.5 over the largest
        "all_better_2": [0.75, 0, 0, 0.25],  # over their sum
    }),
    "as good as the best": (SCORES, 3.0, {
        "linear": [1, 0, 0, 0.5], "single_best": [1, 0, 0, 0],  # not asked
        "single_better": 0, "all_better_1": 0, "all_better_2": 0,
    }),
    # Below the worst finite score, 1, by their range, 2: advantages over -1 are 4, 0, 2, 3.
    "incumbent diverged": (SCORES, NAN, {
        "single_better": [1, 0, 0, 0],
        "all_better_1": [1, 0, 0.5, 0.75],
        "all_better_2": [4 / 9, 0, 2 / 9, 3 / 9],
    }),
    "ties": ([2, 5, 5, 1], 1.0, {
        "linear": [0.25, 1, 1, 0],  # (K - 1) / 4
        "rank": [0.5, 1, 1, 0],  # lower scores: 1, 2, 2, 0; divided by 2
        # Ranks from the best, ties sharing the better: 3, 1, 1, 4. Shares 0, 1/2, 1/2, 0; less
        # 1/4: -0.25, 0.25, 0.25, -0.25; divided by 0.25.
        "nes": [-1, 1, 1, -1],
        "nes_unnormalized": [0, 1, 1, 0],
        "single_best": [0, 1, 1, 0],
        "single_better": [0, 1, 1, 0],
        "all_better_1": [0.25, 1, 1, 0],  # advantages over 1: 1, 4, 4, 0
        "all_better_2": [1 / 9, 4 / 9, 4 / 9, 0],
    }),
    "all equal": ([7.0] * 4, 1.0, {
        "single_best": 1, "single_better": 1, "all_better_1": 1, "all_better_2": 0.25,
    }),
}  # fmt: skip


@pytest.mark.parametrize("case", WORKED)
def test_weights_worked_by_hand(case):
    scores, incumbent, weights = WORKED[case]
    for name, expected in weights.items():
        got = transform(name, scores, incumbent)
        np.testing.assert_allclose(
            got, np.broadcast_to(expected, 4), rtol=1e-5, atol=1e-6, err_msg=name
        )


@pytest.mark.parametrize("name", ["linear", "rank", "nes", "nes_unnormalized"])
def test_equal_scores_weigh_nothing_where_a_difference_is_needed(name):
    for size in (2, 3, 4, 7, 16, 31):
        np.testing.assert_array_equal(transform(name, [7.0] * size, 1.0), 0.0)


@pytest.mark.parametrize("name", TRANSFORMS)
@pytest.mark.parametrize("incumbent", [1.0, NAN])
def test_a_generation_that_diverged_as_a_whole_weighs_nothing(name, incumbent):
    for size in (2, 3, 16):
        for scores in ([NAN] * size, [NAN, INF] + [-INF] * (size - 2)):
            np.testing.assert_array_equal(transform(name, scores, incumbent), 0.0)


# --- laws ----------------------------------------------------------------------------------------

# Sixteenths in [-64, 64], exact in float32, so that float comparisons are those of the reals.
finite_scores = st.integers(-1024, 1024).map(lambda n: n / 16)
scores_lists = st.lists(
    st.one_of(finite_scores, st.sampled_from([NAN, INF, -INF])), min_size=6, max_size=6
)


@pytest.mark.parametrize("name", TRANSFORMS)
@given(scores=scores_lists, incumbent=finite_scores, order=st.permutations(range(6)))
def test_permuting_the_members_permutes_their_weights(name, scores, incumbent, order):
    weights = transform(name, scores, incumbent)
    permuted = transform(name, [scores[i] for i in order], incumbent)
    np.testing.assert_allclose(permuted, weights[list(order)], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", TRANSFORMS)
@given(scores=scores_lists, incumbent=st.one_of(finite_scores, st.just(NAN)))
def test_weights_are_finite_bounded_and_never_fall_with_the_score(name, scores, incumbent):
    weights = transform(name, scores, incumbent)
    assert np.isfinite(weights).all() and np.abs(weights).max() <= 1 + 1e-6
    ranked = np.where(np.isfinite(scores), scores, -INF)  # not finite: worst
    ordered = weights[np.argsort(ranked, kind="stable")]
    assert (np.diff(ordered) >= -1e-5).all()


@pytest.mark.parametrize("name", ["single_better", "all_better_1", "all_better_2"])
@given(scores=scores_lists, incumbent=finite_scores)
def test_only_members_better_than_the_incumbent_weigh(name, scores, incumbent):
    weights = transform(name, scores, incumbent)
    better = np.isfinite(scores) & (np.array(scores) > incumbent)
    assert (weights[~better] == 0).all()
    assert weights.any() == better.any()
    if name == "all_better_2" and better.any():
        np.testing.assert_allclose(weights.sum(), 1, rtol=1e-5)


@pytest.mark.parametrize("name", ["single_better", "all_better_1", "all_better_2"])
@pytest.mark.parametrize("score", [0.99, -0.1, -93.3, -99_900.1])
def test_rounding_of_the_incumbents_mean_is_no_advantage(name, score):
    """A mean in single precision of equal scores may be some last digits below them."""
    score = np.float32(score)
    for below in range(8):
        incumbent = score - np.float32(below) * np.spacing(np.abs(score))
        assert not transform(name, [score] * 4, incumbent).any()
    better = score + np.float32(1e-4) * np.abs(score)
    np.testing.assert_array_equal(transform(name, [score, better, score], score), [0, 1, 0])


def test_all_are_better_than_an_incumbent_without_a_score():
    weights = transform("all_better_2", [-3e7, -3e7, NAN], NAN)  # also if 32 bits cannot subtract 1
    np.testing.assert_array_equal(weights, [0.5, 0.5, 0])


# --- of one's own --------------------------------------------------------------------------------


def squared(scores):
    return scores**2


def test_a_function_of_ones_own_sees_the_worst_finite_score_for_a_diverged_one():
    own = jax.jit(transform_of(squared, 4))
    np.testing.assert_allclose(own(np.float32([3, NAN, 1, 2]), 0.0), [9, 1, 1, 4])
    np.testing.assert_array_equal(own(np.full(4, NAN, np.float32), 0.0), np.zeros(4))
    unbounded = jax.jit(transform_of(lambda scores: 1 / (scores + 2), 2))
    np.testing.assert_array_equal(unbounded(np.float32([-2, 2]), 0.0), [0, 0.25])


def test_a_function_of_ones_own_may_be_typed_or_given(tmp_path, monkeypatch):
    (tmp_path / "my_transforms.py").write_text("def linear(scores):\n    return scores\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    scores = np.float32([3, -1])
    for choice in ("my_transforms:linear", lambda scores: scores):
        config = NESConfig(score_transform=choice, population_size=2)
        assert hash(config) == hash(NESConfig(score_transform=choice, population_size=2))
        np.testing.assert_array_equal(transform_of(choice, 2)(scores, 0.0), scores)
        made = jax.jit(lambda: config.make(3).init(jax.random.key(0), jnp.zeros(3)).mean)  # noqa: B023
        assert made().shape == (3,)  # made while something else is traced


@pytest.mark.parametrize("own", [
    lambda scores: scores[:1],
    lambda scores: scores.mean(),
    lambda scores: (scores - scores.mean()) / scores.std(),  # not finite for equal scores
    lambda scores: scores if scores[0] > 0 else -scores,  # not for JAX
    lambda scores, incumbent: scores,
])  # fmt: skip
def test_a_function_that_gives_no_weights_is_refused(own):
    with pytest.raises(ConfigError) as error:  # of any length: a place in a user's code is not cut
        NESConfig(score_transform=own).make(3)
    assert error.value.field == "es.score_transform"


@pytest.mark.parametrize("choice", ["linaer", 3, None, ["rank"], "a b:c", "rank.py:f"])
def test_what_is_neither_a_name_nor_a_function_is_refused(choice):
    assert refused(NESConfig, score_transform=choice) == "es.score_transform"
