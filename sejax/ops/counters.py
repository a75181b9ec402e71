"""Counts beyond 2**31 in compiled programs, which count in 32 bits.

A wide count is `[2]` int32, `high * 2**16 + low`, with `low` in [0, 2**16): up to 2**47.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

_BITS = 16
_MASK = 2**_BITS - 1


def wide_zeros(*shape: int) -> Int[Array, "*shape 2"]:
    """Wide counts of 0."""
    return jnp.zeros((*shape, 2), jnp.int32)


def wide_sum(numbers: Int[Array, "*shape n"]) -> Int[Array, "*shape 2"]:
    """The sum over the last axis of at most 2**15 numbers in [0, 2**31), as wide counts."""
    high, low = (numbers >> _BITS).sum(axis=-1), (numbers & _MASK).sum(axis=-1)
    return _normal(high, low)


def wide_add(a: Int[Array, "*shape 2"], b: Int[Array, "*shape 2"]) -> Int[Array, "*shape 2"]:
    """The sum of wide counts."""
    total = a + b
    return _normal(total[..., 0], total[..., 1])


def exact(count: Any) -> Any:
    """Wide counts `[..., 2]` on the host, as NumPy int64 `[...]`."""
    count = np.asarray(count, np.int64)
    return (count[..., 0] << _BITS) + count[..., 1]


def _normal(high: Array, low: Array) -> Array:
    return jnp.stack([high + (low >> _BITS), low & _MASK], axis=-1)
