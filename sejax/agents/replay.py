"""Experience replay: a ring of packed rows, sampled uniformly with replacement.

A transition is one float32 row, so that storing is a single write and sampling a single gather.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, Float, Int, UInt32

from sejax.agents.partial_batch import block_size
from sejax.ops.keys import murmur

_VECTOR = 8  # float32 lanes of AVX2


class Transition(NamedTuple):
    """One step, or a feature-major batch of them (`[obs_dim, batch]`, `[batch]`).

    `action` is an index or, where actions are vectors, `[action_dim]` or `[action_dim, batch]`.
    `discount` is what the target bootstraps with before the agent's gamma: 0 where the episode
    terminated, 1 elsewhere, anything in an SE with a soft done. `weight` is 0 in columns that only
    fill a batch up.
    """

    obs: Array
    action: Array
    reward: Array
    discount: Array
    next_obs: Array
    weight: Array | float = 1.0

    @property
    def rows(self) -> "Transition":
        """A feature-major batch turned: `[batch, obs_dim]`, with a weight `[batch]` for each row.

        Under `jax.vmap` a function of one transition then takes a batch.
        """
        weight = jnp.broadcast_to(self.weight, self.reward.shape)
        return jax.tree.map(jnp.transpose, self._replace(weight=weight))


def num_columns(batch: Transition) -> Array | float:
    """Columns of a batch that count, i.e. do not only fill it up."""
    return jnp.sum(jnp.broadcast_to(batch.weight, batch.reward.shape))


def row_width(obs_dim: int, action_dim: int | None = None) -> int:
    """Number of floats in a packed transition; `action_dim` is None for an action's index."""
    return 2 * obs_dim + (action_dim or 1) + 2


def init(
    capacity: int, obs_dim: int, action_dim: int | None = None
) -> Float[Array, "capacity width"]:
    """An empty buffer."""
    return jnp.zeros((capacity, row_width(obs_dim, action_dim)), jnp.float32)


def pack(transition: Transition) -> Float[Array, " width"]:
    """One transition as a row."""
    parts = (
        transition.obs,
        transition.next_obs,
        transition.action,
        transition.reward,
        transition.discount,
    )
    return jnp.concatenate([jnp.atleast_1d(x).astype(jnp.float32) for x in parts])


def store(
    rows: Float[Array, "capacity width"],
    step: Int[Array, ""],
    transition: Transition,
    active: Array | bool = True,
) -> Float[Array, "capacity width"]:
    """Writes the transition of the agent's `step`-th step; the oldest row gives way when full."""
    return write_row(rows, step, pack(transition), active)


def write_row(
    rows: Float[Array, "capacity width"],
    step: Int[Array, ""],
    row: Float[Array, " width"],
    active: Array | bool = True,
) -> Float[Array, "capacity width"]:
    """Writes a row into the ring.

    The write is dropped where `active` is False: an index out of range costs nothing, where a
    select would copy the buffer.
    """
    capacity = rows.shape[0]
    if active is True:
        return jax.lax.dynamic_update_slice(rows, row[None], (step % capacity, 0))
    index = jnp.where(active, step % capacity, capacity)
    return rows.at[index].set(row, mode="drop")


def sample(
    rows: Float[Array, "capacity width"],
    seed: UInt32[Array, ""],
    num_stored: Int[Array, ""],
    batch_size: int,
    action_dim: int | None = None,
    in_use: Array | None = None,
) -> Transition:
    """Draws a feature-major batch, uniformly with replacement, from the first `num_stored` rows.

    Args:
      rows: the buffer.
      seed: 32 random bits for this draw.
      num_stored: rows written so far, at least 1; more than the capacity counts as the capacity.
      batch_size: number of rows to draw (static).
      action_dim: length of an action, or None if it is an index.
      in_use: draw only the first so many of the columns, `[]`; None for all of them.

    Returns:
      A batch whose width is `batch_size` rounded up to whole vectors of the CPU, or with `in_use`
      to whole blocks of a batch; the columns beyond what was asked for have weight 0. A remainder
      costs more than the arithmetic on up to seven more columns.

    Source: `docs/reference.md` 3.5 (with replacement, from the first stored transition on).
    """
    size = jnp.minimum(num_stored, rows.shape[0])
    width = rows.shape[1]

    def columns(first: Array | int, count: int) -> Float[Array, "width count"]:
        index = sample_indices(seed, size, count, first)[None, :] * width
        return jax.lax.platform_dependent(
            rows.reshape(-1),
            index + jnp.arange(width)[:, None],
            cpu=_gather_outlined,
            default=_gather,
        )

    step = _VECTOR if in_use is None else block_size(batch_size)
    padded_size = -(-batch_size // step) * step
    if in_use is None:
        batch = columns(0, padded_size)
        is_padding = jnp.arange(padded_size) >= batch_size
        weight = 1.0 if padded_size == batch_size else 1.0 - is_padding
    else:

        def draw_block(i: Array, batch: Array) -> Array:
            return jax.lax.dynamic_update_slice(batch, columns(i * step, step), (0, i * step))

        num_blocks = jnp.ceil(in_use / step).astype(jnp.int32)
        empty = jnp.zeros((width, padded_size), rows.dtype)
        batch = jax.lax.fori_loop(0, num_blocks, draw_block, empty)
        weight = jnp.float32(jnp.arange(padded_size) < in_use)
    return unpack(batch, action_dim)._replace(weight=weight)


def unpack(rows: Float[Array, "width batch"], action_dim: int | None = None) -> Transition:
    """Packed transitions, feature-major, as a batch."""
    obs_dim = (rows.shape[0] - 2 - (action_dim or 1)) // 2
    action = rows[2 * obs_dim : -2]
    return Transition(
        obs=rows[:obs_dim],
        next_obs=rows[obs_dim : 2 * obs_dim],
        action=action[0].astype(jnp.int32) if action_dim is None else action,
        reward=rows[-2],
        discount=rows[-1],
    )


def _gather(flat: Float[Array, " n"], index: Int[Array, "width batch"]) -> Array:
    return flat.at[index].get(mode="promise_in_bounds")


def _gather_outlined(flat: Array, index: Array) -> Array:
    """The gather as a computation of its own.

    XLA would fuse it with what makes the indices and hash each row's index anew for each of its
    numbers; with several devices in a process it would then also hand half of that to another core.
    """
    with set_xla_metadata(inlineable="false"):
        return jax.jit(_gather)(flat, index)


def sample_indices(
    seed: UInt32[Array, ""], size: Int[Array, ""], batch_size: int, first: Array | int = 0
) -> Int[Array, " batch"]:
    """Uniform indices in [0, size) of the columns from `first` on: a hash of `seed` and column.

    threefry takes half as long as the learning step at these sizes. The hash is the finaliser
    of MurmurHash3 on a Weyl sequence; 24 of its bits choose the index, so that the bias is below
    size / 2**24.
    """
    counter = jnp.uint32(first) + jnp.arange(batch_size, dtype=jnp.uint32)
    x = murmur(seed + counter * jnp.uint32(0x9E3779B9))
    fraction = (x >> 8).astype(jnp.float32) * jnp.float32(2**-24)  # [0, 1)
    index = (fraction * size.astype(jnp.float32)).astype(jnp.int32)
    return jnp.minimum(index, size - 1)  # rounding may reach size
