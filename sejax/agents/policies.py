"""How actions are chosen by their values."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sejax.agents.base import Hparams
from sejax.ops.keys import unit_interval


def value_of_action(values: Float[Array, "actions batch"], action: Array) -> Float[Array, " batch"]:
    """The value, such as Q or a log probability, of each column's own action.

    It is read by mask: gathers and their gradients are slow on CPU.

    Args:
      values: a number for each action, in each column.
      action: `[batch]` indices.
    """
    mask = jnp.arange(values.shape[0])[:, None] == action[None, :]
    return jnp.sum(jnp.where(mask, values, 0.0), axis=0)


def decayed_epsilon(hparams: Hparams, episode: Array) -> Array:
    """Share of random actions in an episode, counted from 0, `[]` float32.

    It is `epsilon_init` in episode 0, even where that is less than `epsilon_min`, and
    `max(epsilon_init * epsilon_decay**episode, epsilon_min)` afterwards.

    Source: `docs/reference.md` 3.4.
    """
    is_first = episode == 0
    decayed = hparams.epsilon_init * hparams.epsilon_decay**episode
    return jnp.where(is_first, hparams.epsilon_init, jnp.maximum(decayed, hparams.epsilon_min))


def epsilon_greedy(
    key: Array, q_row: Float[Array, " num_actions"], epsilon: Array, explore: bool = True
) -> Int[Array, ""]:
    """A uniform action with probability epsilon, else the first of the best actions.

    Without `explore` (a Python bool, as in `Agent.act`) it is always the latter, and the key has no
    effect. The random bits are the key's own data: do not use the key for anything else.
    """
    if not explore:
        return jnp.argmax(q_row).astype(jnp.int32)
    bits = jax.random.key_data(key)
    random_action = (bits[0] % jnp.uint32(q_row.shape[0])).astype(jnp.int32)
    uniform = unit_interval(bits[1])
    return jnp.where(uniform < epsilon, random_action, jnp.argmax(q_row).astype(jnp.int32))
