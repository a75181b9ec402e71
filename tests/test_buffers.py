"""sejax.agents.buffers: what is stored, what gives way, and what is drawn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sejax.agents import buffers

OBS_DIM = 3
CAPACITY = 5


@jax.jit
def store(rows, step, transition, active=True):
    return buffers.write_row(rows, step, buffers.pack(transition), active)


sample = jax.jit(buffers.sample, static_argnums=(3, 4))
sample_indices = jax.jit(buffers.sample_indices, static_argnums=2)


def transition(number):
    """A transition all of whose entries tell its number apart from every other's."""
    return buffers.Transition(
        obs=np.arange(OBS_DIM, dtype=np.float32) + 10 * number,
        action=np.int32(number),
        reward=np.float32(number + 0.5),
        discount=np.float32(number / 64),
        next_obs=np.arange(OBS_DIM, dtype=np.float32) - 10 * number,
    )


def filled(num_steps):
    rows = np.zeros((CAPACITY, buffers.row_width(OBS_DIM)), np.float32)
    for number in range(num_steps):
        rows = store(rows, np.int32(number), transition(number))
    return np.asarray(rows)


def test_what_is_stored_comes_back_unchanged():
    rows = filled(3)
    batch = jax.tree.map(np.asarray, sample(rows, np.uint32(1), np.int32(3), 24))
    assert batch.obs.shape == (OBS_DIM, 24) and batch.reward.shape == (24,)  # feature-major
    assert batch.action.dtype == jnp.int32
    assert set(np.asarray(batch.action).tolist()) == {0, 1, 2}
    for column, number in enumerate(np.asarray(batch.action)):
        expected = transition(int(number))
        np.testing.assert_array_equal(batch.obs[:, column], expected.obs)
        np.testing.assert_array_equal(batch.next_obs[:, column], expected.next_obs)
        assert batch.reward[column] == expected.reward
        assert batch.discount[column] == expected.discount


@pytest.mark.parametrize("in_use", [1, 31, 32, 33, 100])
def test_a_batch_in_use_is_the_beginning_of_the_whole_one(in_use):
    rows, seed, num_steps = filled(5), np.uint32(7), np.int32(5)
    whole = jax.tree.map(np.asarray, sample(rows, seed, num_steps, 104))
    some = sample(rows, seed, num_steps, 100, None, np.float32(in_use))
    for name in ("obs", "action", "reward", "discount", "next_obs"):
        got, expected = np.asarray(getattr(some, name)), getattr(whole, name)
        np.testing.assert_array_equal(got[..., :in_use], expected[..., :in_use])
        assert np.isfinite(got).all()
    np.testing.assert_array_equal(some.weight, np.arange(some.reward.shape[0]) < in_use)


def test_a_full_buffer_overwrites_its_oldest_rows():
    # Capacity 5 after steps 0..7: rows hold steps 5, 6, 7, 3, 4.
    actions = filled(8)[:, -3]
    np.testing.assert_array_equal(actions, [5, 6, 7, 3, 4])
    batch = sample(filled(8), np.uint32(0), np.int32(8), 200)  # more steps than rows
    assert set(np.asarray(batch.action).tolist()) == {3, 4, 5, 6, 7}


def test_a_write_of_an_inactive_lane_is_dropped():
    rows = filled(4)
    for step in (0, 3, 4, CAPACITY, 3 * CAPACITY + 2):
        kept = store(rows, np.int32(step), transition(99), np.bool_(False))
        np.testing.assert_array_equal(kept, rows)


@given(step=st.integers(0, 2**31 - 1))
def test_a_masked_write_of_an_active_lane_equals_the_plain_one(step):
    rows = filled(4)
    plain = store(rows, np.int32(step), transition(7))
    masked = store(rows, np.int32(step), transition(7), np.bool_(True))
    np.testing.assert_array_equal(masked, plain)
    assert (np.asarray(plain) != np.asarray(rows)).any(axis=1).sum() == 1


@given(seed=st.integers(0, 2**32 - 1), size=st.integers(1, 2_000_000))
def test_indices_lie_in_the_stored_range(seed, size):
    indices = np.asarray(sample_indices(np.uint32(seed), np.int32(size), 199))
    assert indices.dtype == np.int32
    assert indices.min() >= 0 and indices.max() < size


def chi_square_z(counts):
    """Standardised chi-square of counts against a uniform distribution."""
    counts = np.asarray(counts, np.float64)
    expected = counts.sum() / counts.size
    freedom = counts.size - 1
    return (((counts - expected) ** 2 / expected).sum() - freedom) / np.sqrt(2 * freedom)


def test_indices_are_uniform_within_a_batch_and_over_batches():
    size, batch = 50, 200
    seeds = jax.random.bits(jax.random.key(0), (500,))
    indices = np.asarray(
        jax.jit(jax.vmap(lambda s: buffers.sample_indices(s, np.int32(size), batch)))(seeds)
    )
    assert abs(chi_square_z(np.bincount(indices.ravel(), minlength=size))) < 5
    for position in (0, 1, batch - 1):  # each place in the batch by itself
        assert abs(chi_square_z(np.bincount(indices[:, position], minlength=size))) < 5
    # Neighbouring draws are independent: pairs are uniform over the 50 x 50 squares, 5 x 5 binned.
    pairs = (indices[:, :-1] // 10) * 5 + indices[:, 1:] // 10
    assert abs(chi_square_z(np.bincount(pairs.ravel(), minlength=25))) < 5


def test_consecutive_seeds_draw_unrelated_batches():
    # Seeds are 32 random bits, but even counters must not give shifted copies of one batch.
    draws = [np.asarray(sample_indices(np.uint32(seed), np.int32(1000), 100)) for seed in range(20)]
    equal = [np.mean(a == b) for i, a in enumerate(draws) for b in draws[:i]]
    assert np.mean(equal) < 0.01  # 1 in 1000 by chance


def test_a_batch_is_filled_up_with_columns_of_no_weight():
    batch = sample(filled(3), np.uint32(1), np.int32(3), 20)
    assert batch.obs.shape == (OBS_DIM, 24)
    np.testing.assert_array_equal(batch.weight, [1.0] * 20 + [0.0] * 4)
