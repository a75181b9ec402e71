"""Sums over as many columns of a batch as a traced number says, at the cost of those alone."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

_NUM_BLOCKS, _MIN_SIZE = 4, 32  # enough to waste little, large enough for efficient products
_MULTIPLE = 8  # vector width of a CPU


def block_size(width: int) -> int:
    """Columns in a block of a batch that has room for `width`."""
    return max(_MIN_SIZE, -(-width // (_NUM_BLOCKS * _MULTIPLE)) * _MULTIPLE)


def sum_over_batch(fn: Callable[[Any], Array], batch: Any, batch_size: Array | None) -> Array:
    """Sum of `fn` over the columns of a batch.

    Args:
      fn: `batch -> Array`, a sum over the batch's columns in which those of weight 0 count nothing.
      batch: pytree of arrays whose last axis are the columns; scalars belong to all of them.
      batch_size: columns that count, from the first on, `[]`; the others must have weight 0. None
        for all, in one go.

    Returns:
      What `fn(batch)` returns, up to the order of summation.
    """
    if batch_size is None:
        return fn(batch)
    width = max(x.shape[-1] for x in jax.tree.leaves(batch) if jnp.ndim(x))
    size = block_size(width)
    padded = -(-width // size) * size

    def pad(x: Array) -> Array:
        missing = [(0, 0)] * (jnp.ndim(x) - 1) + [(0, padded - width)]
        return jnp.pad(x, missing) if jnp.ndim(x) and padded > width else x

    batch = jax.tree.map(pad, batch)

    def block(index: Array) -> Any:
        def cut(x: Array) -> Array:
            if not jnp.ndim(x):
                return x
            return jax.lax.dynamic_slice_in_dim(x, index * size, size, axis=-1)

        return fn(jax.tree.map(cut, batch))

    num_blocks = jnp.ceil(batch_size / size).astype(jnp.int32)
    zero = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(block, num_blocks))
    return jax.lax.fori_loop(0, num_blocks, lambda i, total: total + block(i), zero)
