"""What an agent keeps of its steps, and what of it each learning step gets to see."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sejax.agents import replay
from sejax.agents.replay import Transition
from sejax.ops.keys import words


class Memory(NamedTuple):
    """Pure functions over an agent's large arrays, which are updated in place.

    Attributes:
      init: `() -> arrays`.
      store: `(arrays, step, transition, ended, active) -> arrays`; writes the `step`-th step, and
        nothing if `active` is False. `ended` says whether the episode ended there.
      batch: `(key, arrays, num_steps, transition, batch_size) -> batch` for `Agent.update`, after
        `num_steps` steps, the last of which was `transition`. Columns from `batch_size` on, if that
        is given, have weight 0.
      rest: `(batch, active) -> batch`, which an agent that has stopped makes nothing of: in lanes
        its updates are made, in vain, until all have stopped. Where updates always take as long
        there is nothing to gain, and the batch stays as it is.
    """

    init: Callable[[], Any]
    store: Callable[..., Any]
    batch: Callable[..., Any]
    rest: Callable[[Any, Array | bool], Any] = lambda batch, active: batch


# `(example, max_steps) -> Memory`: for transitions like `example`, of which there are at most
# `max_steps`.
MemoryMaker = Callable[[Transition, int], Memory]


_REWARD = -3  # column of a rollout's rows; the discount and `ended` follow


class Rollout(NamedTuple):
    """All steps since the last learning phase, in order.

    Attributes:
      rows: packed transitions with one more column, which is 1 where the episode ended.
      is_full: whether as many steps as a phase takes are there.
    """

    rows: Float[Array, "steps width"]
    is_full: Bool[Array, ""]

    @property
    def ended(self) -> Float[Array, " steps"]:
        """1 at the last step of an episode, else 0."""
        return self.rows[:, -1]

    def transitions(self, obs_dim: int, is_discrete: bool) -> Transition:
        """The steps, feature-major. Discrete actions in one column are indices."""
        steps = self.rows[:, :-1].T  # without `ended`
        action_dim = steps.shape[0] - 2 * obs_dim - 2
        is_index = is_discrete and action_dim == 1
        return replay.unpack(steps, None if is_index else action_dim)

    def with_bonus(self, bonus: Float[Array, " steps"]) -> "Rollout":
        """The same steps with a bonus on each one's reward."""
        return self._replace(rows=self.rows.at[:, _REWARD].add(bonus))


def replay_memory(batch_size: int, buffer_size: int) -> MemoryMaker:
    """A ring of the last `buffer_size` steps, from which batches are drawn uniformly."""

    def make(example: Transition, max_steps: int) -> Memory:
        obs_dim, action_dim = _dims(example)
        capacity = min(buffer_size, max_steps)

        def batch(
            key: Array,
            rows: Array,
            num_steps: Array,
            transition: Transition,
            in_use: Array | None = None,
        ) -> Transition:
            return replay.sample(rows, words(key)[0], num_steps, batch_size, action_dim, in_use)

        return Memory(
            init=lambda: replay.init(capacity, obs_dim, action_dim),
            store=lambda rows, step, transition, ended, active: replay.store(
                rows, step, transition, active
            ),
            batch=batch,
        )

    return make


def rollout_memory(length: int) -> MemoryMaker:
    """The last `length` steps in order, overwritten when they have been learned from."""

    def make(example: Transition, max_steps: int) -> Memory:
        obs_dim, action_dim = _dims(example)

        def store(
            rows: Array, step: Array, transition: Transition, ended: Array, active: Array | bool
        ) -> Array:
            row = jnp.append(replay.pack(transition), jnp.float32(ended))
            return replay.write_row(rows, step, row, active)

        def batch(
            key: Array,
            rows: Array,
            num_steps: Array,
            transition: Transition,
            in_use: Array | None = None,
        ) -> Rollout:
            return Rollout(rows=rows, is_full=num_steps % length == 0)

        width = replay.row_width(obs_dim, action_dim) + 1
        return Memory(
            init=lambda: jnp.zeros((length, width)),
            store=store,
            batch=batch,
            rest=lambda rollout, active: rollout._replace(is_full=rollout.is_full & active),
        )

    return make


def no_memory() -> MemoryMaker:
    """Keeps nothing: each learning step sees the step just made."""

    def make(example: Transition, max_steps: int) -> Memory:
        return Memory(
            init=lambda: jnp.zeros(0),
            store=lambda arrays, step, transition, ended, active: arrays,
            batch=lambda key, arrays, num_steps, transition, in_use=None: transition,
        )

    return make


def _dims(example: Transition) -> tuple[int, int | None]:
    """Length of an observation, and of an action unless it is an index."""
    return example.obs.shape[0], example.action.shape[0] if example.action.ndim else None
