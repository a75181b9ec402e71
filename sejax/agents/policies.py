"""How actions come of a network's outputs: distributions, and epsilon-greedy ones."""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sejax.ops.keys import words


class Distribution(NamedTuple):
    """A distribution of actions, given the actor's outputs and the Gaussian's std.

    Attributes:
      num_outputs: of the actor.
      std_dim: length of the std; 0 for a softmax, whose actions are indices.
      sample: `(key, outputs, std) -> action`, for one observation.
      mode: `outputs -> action`, for one observation.
      evaluate: `(outputs, std, action) -> (log_prob, entropy)`, for `[outputs, batch]` and a batch
        of actions; both `[batch]`, in nats.
      env_action: `action -> action` as the environment takes it.
    """

    num_outputs: int
    std_dim: int
    sample: Callable[[Array, Array, Array], Array]
    mode: Callable[[Array], Array]
    evaluate: Callable[[Array, Array, Array], tuple[Array, Array]]
    env_action: Callable[[Array], Array]


def softmax(num_actions: int) -> Distribution:
    """The actions `0..num_actions-1`, with logits as outputs."""

    def evaluate(
        outputs: Float[Array, "actions batch"], std: Array, action: Int[Array, " batch"]
    ) -> tuple[Float[Array, " batch"], Float[Array, " batch"]]:
        log_probs = jax.nn.log_softmax(outputs, axis=0)
        entropy = -jnp.sum(jnp.exp(log_probs) * log_probs, axis=0)
        return select_action(log_probs, action), entropy

    return Distribution(
        num_outputs=num_actions,
        std_dim=0,
        sample=lambda key, outputs, std: jax.random.categorical(key, outputs).astype(jnp.int32),
        mode=lambda outputs: jnp.argmax(outputs).astype(jnp.int32),
        evaluate=evaluate,
        env_action=lambda action: action,
    )


def gaussian(action_dim: int, max_action: float) -> Distribution:
    """Independent normal actions with mean `max_action * tanh(outputs)` and a given std.

    Differs: the authors' mean is `tanh(outputs)`, which cannot reach the whole range of a task
    whose largest action is not 1, such as Pendulum. The std is in units of the action, as theirs.

    Source: `docs/reference.md` 4.5.
    """

    def mode(outputs: Float[Array, "action_dim *batch"]) -> Float[Array, "action_dim *batch"]:
        return max_action * jnp.tanh(outputs)

    def sample(key: Array, outputs: Array, std: Array) -> Float[Array, " action_dim"]:
        return mode(outputs) + std * jax.random.normal(key, outputs.shape)

    def evaluate(
        outputs: Float[Array, "action_dim batch"], std: Array, action: Array
    ) -> tuple[Float[Array, " batch"], Float[Array, " batch"]]:
        standardized = (action - mode(outputs)) / std[:, None]
        log_scale = jnp.sum(jnp.log(std) + 0.5 * math.log(2 * math.pi))
        log_prob = -0.5 * jnp.sum(standardized**2, axis=0) - log_scale
        return log_prob, jnp.broadcast_to(log_scale + 0.5 * std.size, log_prob.shape)

    return Distribution(
        num_outputs=action_dim,
        std_dim=action_dim,
        sample=sample,
        mode=mode,
        evaluate=evaluate,
        env_action=lambda action: jnp.clip(action, -max_action, max_action),
    )


# --- values of actions ---------------------------------------------------------------------------


def select_action(q_values: Float[Array, "actions batch"], action: Array) -> Float[Array, " batch"]:
    """Q of each column's action, by mask: gathers and their gradients are slow on CPU."""
    mask = jnp.arange(q_values.shape[0])[:, None] == action[None, :]
    return jnp.sum(jnp.where(mask, q_values, 0.0), axis=0)


def decayed_epsilon(
    init: Array | float, minimum: Array | float, decay: Array | float, episode: Array
) -> Array:
    """Share of random actions in an episode, counted from 0, `[]` float32.

    It is `init` in episode 0, even where that is less than `minimum`, and
    `max(init * decay**episode, minimum)` afterwards.

    Source: `docs/reference.md` 3.4.
    """
    epsilon = jnp.maximum(init * decay**episode, minimum)
    return jnp.where(episode == 0, init, epsilon)


def epsilon_greedy(
    key: Array, q_row: Float[Array, " num_actions"], epsilon: Array
) -> Int[Array, ""]:
    """A uniform action with probability epsilon, else the first of the best.

    The key's own words decide; it must not be used for anything else.
    """
    bits = words(key)
    random_action = (bits[0] % jnp.uint32(q_row.shape[0])).astype(jnp.int32)
    uniform = (bits[1] >> 8).astype(jnp.float32) * jnp.float32(2**-24)
    return jnp.where(uniform < epsilon, random_action, jnp.argmax(q_row).astype(jnp.int32))
