"""What an agent keeps of its steps, and what each learning step reads of it.

A transition is one float32 row, so that storing is a single write and sampling a single gather.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, Float, Int, PyTree, UInt32

from sejax.ops import cpu
from sejax.ops.keys import WEYL, murmur, unit_interval
from sejax.options import require

Rows = Float[Array, "capacity width"]  # packed transitions, see `pack`
T = TypeVar("T")

# Columns of the reward and the discount in a packed transition.
_REWARD, _DISCOUNT = -2, -1


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
        """A feature-major batch transposed to `[batch, obs_dim]`, with weights `[batch]`.

        `jax.vmap` then maps a function of one transition over it.
        """
        weight = jnp.broadcast_to(self.weight, self.reward.shape)
        return jax.tree.map(jnp.transpose, self._replace(weight=weight))


class Rollout(NamedTuple):
    """All steps since the last learning phase, in order.

    Attributes:
      rows: packed transitions with one more column, which is 1 where the episode ended.
    """

    rows: Float[Array, "steps width"]

    @property
    def ended(self) -> Float[Array, " steps"]:
        """1 at the last step of an episode, else 0."""
        return self.rows[:, -1]

    def transitions(self, obs_dim: int, is_discrete: bool) -> Transition:
        """The steps, feature-major. Discrete actions in one column are indices."""
        steps = self.rows[:, :-1].T  # without `ended`
        action_dim = steps.shape[0] - 2 * obs_dim - 2
        return unpack(steps, None if is_discrete and action_dim == 1 else action_dim)

    def with_bonus(self, bonus: Float[Array, " steps"]) -> "Rollout":
        """The same steps with a bonus added to each reward."""
        return self._replace(rows=self.rows.at[:, _REWARD - 1].add(bonus))  # before `ended`


@dataclass(frozen=True, kw_only=True)
class Buffer:
    """Pure functions over an agent's large arrays, which are updated in place.

    Attributes:
      init: `() -> arrays`.
      store: `(arrays, step, transition, ended, active) -> arrays`; writes the `step`-th step, and
        nothing if `active` is False. `ended` says whether the episode ended with it.
      batch: `(key, arrays, num_steps, transition, in_use) -> batch` for `Agent.update`, after
        `num_steps` steps; `transition` is the last of them. If `in_use` is not None, columns
        from that number on have weight 0.
      learns_every: steps from one update to the next; above 1 `batch` gets None as `transition`.
    """

    init: Callable[[], PyTree]
    store: Callable[[PyTree, Array, Transition, Array, Array | bool], PyTree]
    batch: Callable[[Array, PyTree, Array, Transition | None, Array | None], PyTree]
    learns_every: int = 1


# `(example, max_steps) -> Buffer`: for at most `max_steps` transitions, shaped like `example`.
BufferMaker = Callable[[Transition, int], Buffer]


def replay_buffer(batch_size: int, buffer_size: int) -> BufferMaker:
    """A ring of the last `buffer_size` steps, from which batches are drawn uniformly.

    It keeps observations that are vectors. A batch is a feature-major `Transition`, whose columns
    are `batch_size` rounded up to whole vectors of the CPU. Multiply losses by `weight`, which is
    0 in columns beyond `batch_size` and the number 1.0 if there are none; divide by `batch_size`.
    """

    def make(example: Transition, max_steps: int) -> Buffer:
        obs_dim, action_dim = _dims(example)
        shape = (min(buffer_size, max_steps), row_width(obs_dim, action_dim))
        return Buffer(
            init=lambda: jnp.zeros(shape, jnp.float32),
            store=lambda rows, step, transition, ended, active: write_row(
                rows, step, pack(transition), active
            ),
            batch=lambda key, rows, num_steps, transition, in_use: sample(
                rows, jax.random.key_data(key)[0], num_steps, batch_size, action_dim, in_use
            ),
        )

    return make


def rollout_buffer(length: int) -> BufferMaker:
    """The last `length` steps in order, overwritten once the agent has learned from them.

    It keeps observations that are vectors. A batch is a `Rollout`.
    """

    def make(example: Transition, max_steps: int) -> Buffer:
        shape = (length, row_width(*_dims(example)) + 1)
        return Buffer(
            init=lambda: jnp.zeros(shape, jnp.float32),
            store=lambda rows, step, transition, ended, active: write_row(
                rows, step, jnp.append(pack(transition), jnp.float32(ended)), active
            ),
            batch=lambda key, rows, num_steps, transition, in_use: Rollout(rows),
            learns_every=length,
        )

    return make


def no_buffer() -> BufferMaker:
    """Keeps nothing: each learning step sees the step just made, a single `Transition`."""

    def make(example: Transition, max_steps: int) -> Buffer:
        return Buffer(
            init=lambda: jnp.zeros(0),
            store=lambda arrays, step, transition, ended, active: arrays,
            batch=lambda key, arrays, num_steps, transition, in_use: transition,
        )

    return make


def _dims(example: Transition) -> tuple[int, int | None]:
    """Length of an observation, and of an action unless it is an index.

    Raises:
      ConfigError: for observations that are indices.
    """
    require(example.obs.ndim, "agent.buffer", "must be no_buffer() where observations are indices")
    action_dim = example.action.shape[0] if example.action.ndim else None
    return example.obs.shape[0], action_dim


# --- packed rows ---------------------------------------------------------------------------------


def row_width(obs_dim: int, action_dim: int | None = None) -> int:
    """Number of floats in a packed transition; `action_dim` is None if actions are indices."""
    return 2 * obs_dim + (action_dim or 1) + 2


def pack(step: Transition) -> Float[Array, " width"]:
    """One transition as a row: observation, next observation, action, reward, discount.

    `unpack` reads it. Its weight is left out: a stored step counts in full.
    """
    parts = step.obs, step.next_obs, step.action, step.reward, step.discount
    return jnp.concatenate([jnp.atleast_1d(x).astype(jnp.float32) for x in parts])


def unpack(rows: Float[Array, "width batch"], action_dim: int | None = None) -> Transition:
    """Packed transitions, feature-major, as a batch."""
    obs_dim = (rows.shape[0] - 2 - (action_dim or 1)) // 2
    action = rows[2 * obs_dim : _REWARD]
    return Transition(
        obs=rows[:obs_dim],
        next_obs=rows[obs_dim : 2 * obs_dim],
        action=action[0].astype(jnp.int32) if action_dim is None else action,
        reward=rows[_REWARD],
        discount=rows[_DISCOUNT],
    )


def write_row(
    rows: Rows, step: Int[Array, ""], row: Float[Array, " width"], active: Array | bool = True
) -> Rows:
    """Writes the row of the agent's `step`-th step into the ring; a full one loses its oldest row.

    If `active` is False, an index out of range drops the write. That costs nothing; a select would
    copy the buffer.
    """
    capacity = rows.shape[0]
    if active is True:
        return jax.lax.dynamic_update_slice(rows, row[None], (step % capacity, 0))
    index = jnp.where(active, step % capacity, capacity)
    return rows.at[index].set(row, mode="drop")


# --- sampling ------------------------------------------------------------------------------------


def sample(
    rows: Rows,
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
      in_use: number of columns that count, `[]`; None for all columns.

    Returns:
      A batch. Its width is `batch_size` rounded up to whole vectors of the CPU or, with `in_use`,
      to whole blocks of a batch. Columns beyond the number asked for have weight 0.

    Source: `docs/reference.md` 3.5 (with replacement, from the first stored transition on).
    """
    width = rows.shape[1]
    multiple = cpu.VECTOR if in_use is None else block_size(batch_size)
    padded_size = -(-batch_size // multiple) * multiple
    index = sample_indices(seed, jnp.minimum(num_stored, rows.shape[0]), padded_size)
    batch = jax.lax.platform_dependent(
        rows.reshape(-1),
        index[None, :] * width + jnp.arange(width)[:, None],
        cpu=_gather_outlined,
        default=_gather,
    )
    num_counted = batch_size if in_use is None else in_use
    is_whole = in_use is None and padded_size == batch_size
    weight = 1.0 if is_whole else jnp.float32(jnp.arange(padded_size) < num_counted)
    return unpack(batch, action_dim)._replace(weight=weight)


def _gather(flat: Float[Array, " n"], index: Int[Array, "width batch"]) -> Array:
    return flat.at[index].get(mode="promise_in_bounds")


def _gather_outlined(flat: Array, index: Array) -> Array:
    """The gather as a computation of its own.

    Otherwise XLA would fuse it with the computation of the indices, and hash a row's index again
    for each number of the row. With several devices in a process it would also hand half of that
    work to another core.
    """
    with set_xla_metadata(inlineable="false"):
        return jax.jit(_gather)(flat, index)


def sample_indices(
    seed: UInt32[Array, ""], size: Int[Array, ""], batch_size: int
) -> Int[Array, " batch"]:
    """Uniform indices in [0, size): a hash of `seed` and column.

    At these sizes threefry would take half as long as the learning step. The hash is the finaliser
    of MurmurHash3 on a Weyl sequence. 24 of its bits choose the index, so that the bias is below
    size / 2**24.
    """
    x = murmur(seed + jnp.arange(batch_size, dtype=jnp.uint32) * jnp.uint32(WEYL))
    index = (unit_interval(x) * size.astype(jnp.float32)).astype(jnp.int32)
    return jnp.minimum(index, size - 1)  # rounding may reach size


# --- batches with only the first columns in use --------------------------------------------------


def num_columns(batch: Transition) -> Array | float:
    """Number of columns of a batch that count. Other columns only fill the batch up."""
    return jnp.sum(jnp.broadcast_to(batch.weight, batch.reward.shape))


def block_size(width: int) -> int:
    """Columns in a block of a batch that has room for `width`."""
    return max(cpu.MIN_BLOCK, cpu.whole_vectors(-(-width // cpu.NUM_BLOCKS)))


def sum_over_batch(fn: Callable[[PyTree], T], batch: PyTree, batch_size: Array | None) -> T:
    """Sum of `fn` over the columns of a batch; blocks without columns in use cost nothing.

    Args:
      fn: maps a batch to a pytree of sums over its columns. Columns of weight 0 must add nothing.
      batch: pytree of arrays. Their last axis has the columns, as many as `sample` draws; scalars
        belong to all columns.
      batch_size: number of columns that count, from the first on, `[]`; the others must have weight
        0. None for all columns, in one go.

    Returns:
      What `fn(batch)` returns, up to the order of summation.
    """
    if batch_size is None:
        return fn(batch)
    size = block_size(max(x.shape[-1] for x in jax.tree.leaves(batch) if jnp.ndim(x)))

    def block(index: Array) -> T:
        def cut(x: Array) -> Array:
            if not jnp.ndim(x):
                return x
            return jax.lax.dynamic_slice_in_dim(x, index * size, size, axis=-1)

        return fn(jax.tree.map(cut, batch))

    num_blocks = jnp.ceil(batch_size / size).astype(jnp.int32)
    zeros = jax.tree.map(jnp.zeros_like, jax.eval_shape(block, num_blocks))

    def add(index: Array, total: T) -> T:
        return jax.tree.map(jnp.add, total, block(index))

    return jax.lax.fori_loop(0, num_blocks, add, zeros)
