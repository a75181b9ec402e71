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
    batch = jax.tree.map(np.asarray, sample(filled(3), np.uint32(1), np.int32(3), 20))
    assert batch.obs.shape == (OBS_DIM, 24)  # feature-major, filled up with columns of no weight
    np.testing.assert_array_equal(batch.weight, [1.0] * 20 + [0.0] * 4)
    assert batch.action.dtype == jnp.int32 and set(batch.action.tolist()) == {0, 1, 2}
    stored = [transition(number) for number in batch.action]
    for name in ("obs", "reward", "discount", "next_obs"):
        expected = np.stack([getattr(row, name) for row in stored], axis=-1)
        np.testing.assert_array_equal(getattr(batch, name), expected)


@pytest.mark.parametrize("in_use", [1, 32, 33, 100])
def test_a_batch_in_use_is_the_beginning_of_the_whole_one(in_use):
    rows, seed, num_steps = filled(5), np.uint32(7), np.int32(5)
    whole = sample(rows, seed, num_steps, 104)
    part = sample(rows, seed, num_steps, 100, None, np.float32(in_use))
    np.testing.assert_array_equal(part.weight, np.arange(part.reward.shape[0]) < in_use)
    for name in ("obs", "action", "reward", "discount", "next_obs"):
        values, expected = np.asarray(getattr(part, name)), np.asarray(getattr(whole, name))
        np.testing.assert_array_equal(values[..., :in_use], expected[..., :in_use])
        assert np.isfinite(values).all()


def test_a_full_buffer_overwrites_its_oldest_rows():
    # Capacity 5 after steps 0..7: rows hold steps 5, 6, 7, 3, 4.
    np.testing.assert_array_equal(filled(8)[:, -3], [5, 6, 7, 3, 4])
    batch = sample(filled(8), np.uint32(0), np.int32(8), 200)  # more steps than rows
    assert set(np.asarray(batch.action).tolist()) == {3, 4, 5, 6, 7}


@given(step=st.integers(0, 2**31 - 1))
def test_a_write_changes_one_row_and_that_of_an_inactive_lane_none(step):
    rows = filled(4)
    written = store(rows, np.int32(step), transition(7), np.bool_(True))
    np.testing.assert_array_equal(written, store(rows, np.int32(step), transition(7)))
    assert np.flatnonzero((np.asarray(written) != rows).any(axis=1)) == [step % CAPACITY]
    kept = store(rows, np.int32(step), transition(7), np.bool_(False))
    np.testing.assert_array_equal(kept, rows)


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
    draw = jax.jit(jax.vmap(lambda seed: buffers.sample_indices(seed, np.int32(size), batch)))
    indices = np.asarray(draw(jax.random.bits(jax.random.key(0), (500,))))
    # Neighbouring draws are independent: pairs are uniform over the 50 x 50 squares, 5 x 5 binned.
    pairs = (indices[:, :-1] // 10) * 5 + indices[:, 1:] // 10
    # Each place in the batch is uniform by itself, too.
    for drawn, num_values in (*((indices[:, place], size) for place in (0, 1, batch - 1)),
                              (indices, size), (pairs, 25)):  # fmt: skip
        assert abs(chi_square_z(np.bincount(drawn.ravel(), minlength=num_values))) < 5


def test_consecutive_seeds_draw_unrelated_batches():
    # Seeds are 32 random bits, but even counters must not give shifted copies of one batch.
    draws = [np.asarray(sample_indices(np.uint32(seed), np.int32(1000), 100)) for seed in range(20)]
    equal = [np.mean(a == b) for i, a in enumerate(draws) for b in draws[:i]]
    assert np.mean(equal) < 0.01  # 1 in 1000 by chance
