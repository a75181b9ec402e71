"""sejax.ops.keys: the keys of a loop's steps are bits that nothing but chance relates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sejax.ops.keys import step_keys

NUM_STEPS, NUM_PURPOSES = 20_000, 6  # those of the trainer
LOOPS = (0, 1, 2**31 - 1)  # seeds


@jax.jit
def of_steps(key, steps):
    """Words of a loop's steps and purposes, `[step, purpose, 2]`."""
    keys = jax.vmap(lambda step: jnp.stack(step_keys(key, step, NUM_PURPOSES)))(steps)
    return jax.random.key_data(keys)


@pytest.fixture(scope="module")
def drawn():
    """Words of all steps and purposes of three loops, `[loop, step, purpose, 2]`."""
    steps = jnp.arange(NUM_STEPS)
    return np.stack([of_steps(jax.random.key(seed), steps) for seed in LOOPS])


# --- the hash ------------------------------------------------------------------------------------


def plain_mix(x):
    """C. Wellons's lowbias32 in Python's integers."""
    x ^= x >> 16
    x = x * 0x7FEB352D % 2**32
    x ^= x >> 15
    x = x * 0x846CA68B % 2**32
    return x ^ x >> 16


def plain_words(low, high, step, num):
    weyl = 0x9E3779B9
    low = plain_mix(low ^ plain_mix(step))
    high = plain_mix((high + low * weyl + step) % 2**32)
    return [
        (plain_mix((low + (i + 1) * weyl) % 2**32), plain_mix((high + (i + 2) * weyl) % 2**32))
        for i in range(0, 2 * num, 2)
    ]


@pytest.mark.parametrize("loop", [(0, 0), (1, 0), (0xDEADBEEF, 12345), (2**32 - 1, 2**32 - 1)])
def test_keys_are_the_hash_in_plain_integers(loop):
    assert plain_mix(1) == 0x688990C0  # by hand
    key = jax.random.wrap_key_data(jnp.array(loop, jnp.uint32))
    steps = [0, 1, 2, 199, 2**31 - 1]
    expected = [plain_words(*loop, step, NUM_PURPOSES) for step in steps]
    np.testing.assert_array_equal(of_steps(key, jnp.array(steps)), np.array(expected, np.uint32))


# --- statistics ----------------------------------------------------------------------------------


def test_no_two_steps_purposes_or_loops_share_a_key(drawn):
    # Nor does a loop repeat the first word alone, which seeds a draw from the replay buffer.
    for first in drawn[..., 0].transpose(0, 2, 1).reshape(-1, NUM_STEPS):
        assert np.unique(first).size == NUM_STEPS
    keys = np.uint64(drawn[..., 0]) << np.uint64(32) | np.uint64(drawn[..., 1])
    assert np.unique(keys).size == keys.size == 3 * NUM_STEPS * NUM_PURPOSES


def test_each_word_is_uniform(drawn):
    # Chi-square of 256 equally likely values has mean 255 and variance 510.
    expected = NUM_STEPS / 256
    for of_word in drawn.transpose(0, 2, 3, 1).reshape(-1, NUM_STEPS):
        for shift in (0, 8, 16, 24):
            counts = np.bincount(of_word >> shift & 255, minlength=256)
            chi_square = ((counts - expected) ** 2 / expected).sum()
            assert abs(chi_square - 255) < 5.5 * np.sqrt(510)


# --- as keys of JAX ------------------------------------------------------------------------------


@pytest.mark.parametrize("impl", ["threefry2x32", "rbg", "unsafe_rbg"])
def test_keys_have_the_implementation_of_the_loops(impl):
    loop = jax.random.key(7, impl=impl)
    of_step = jax.jit(jax.vmap(lambda step: jnp.stack(step_keys(loop, step, 3))))
    keys = of_step(jnp.arange(500)).reshape(-1)
    assert str(jax.random.key_impl(keys)) == impl
    assert np.unique(jax.random.key_data(keys), axis=0).shape == (1500, 4 if "rbg" in impl else 2)
    uniform = jax.jit(jax.vmap(jax.random.uniform))(keys)
    assert abs(float(uniform.mean()) - 0.5) < 5 / np.sqrt(12 * 1500)
