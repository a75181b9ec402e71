"""Exploration that dies down from episode to episode."""

import jax.numpy as jnp
from jaxtyping import Array


def decayed_epsilon(
    init: Array | float, minimum: Array | float, decay: Array | float, episode: Array
) -> Array:
    """Share of random actions in an episode, counted from 0, `[]` float32.

    It is `init` in episode 0, even where that is less than `minimum`, and
    `max(init * decay**episode, minimum)` afterwards.

    Source: `reference_details.md` 3.4.
    """
    epsilon = jnp.maximum(init * decay**episode, minimum)
    return jnp.where(episode == 0, init, epsilon)
