"""Optimizers whose numbers do not depend on the program around them.

XLA turns the division of an array by a number into a product in some programs, and not in others.
So an agent would learn other weights on two devices than on one (a slow test of
`tests/test_run.py`). The optimizers here invert numbers first. The plain forms are optax's.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

Params = TypeVar("Params")  # a pytree

_DECAYS = 0.9, 0.999  # of the means of the gradient and of its square


def scale_by_adam(eps: float = 1e-8) -> optax.GradientTransformation:
    """Adam's direction.

    Plain form: `optax.scale_by_adam(eps=eps)`, which divides by the two bias corrections.
    """
    plain = optax.scale_by_adam(*_DECAYS, eps=eps)

    def update(
        gradient: optax.Updates, state: optax.ScaleByAdamState, params: optax.Params | None = None
    ) -> tuple[optax.Updates, optax.OptState]:
        mean = optax.tree.update_moment(gradient, state.mu, _DECAYS[0], 1)
        square = optax.tree.update_moment_per_elem_norm(gradient, state.nu, _DECAYS[1], 2)
        count = optax.safe_increment(state.count)
        mean_scale, square_scale = 1 / (1 - jnp.array(_DECAYS) ** count)
        direction = jax.tree.map(
            lambda m, s: m * mean_scale / (jnp.sqrt(s * square_scale) + eps), mean, square
        )
        return direction, optax.ScaleByAdamState(count, mean, square)

    return optax.GradientTransformation(plain.init, update)


def clip_by_global_norm(max_norm: float) -> optax.GradientTransformation:
    """Scales a gradient longer than `max_norm` down to this norm.

    Plain form: `optax.clip_by_global_norm(max_norm)`. It sums the squares of each array separately:
    eleven kernels more on a GPU for PPO's two networks.
    """

    def clip(gradient: optax.Updates, params: optax.Params | None) -> optax.Updates:
        vector, _ = ravel_pytree(gradient)
        scale = jnp.minimum(1.0, max_norm / jnp.linalg.norm(vector))
        return jax.tree.map(lambda x: x * scale, gradient)

    return optax.stateless(clip)


ADAM = scale_by_adam()


def apply_gradient(
    params: Params, opt_state: optax.OptState, gradient: Params, learning_rate: Array | float
) -> tuple[Params, optax.OptState]:
    """A step of `optax.adam` with a traced learning rate."""
    direction, opt_state = ADAM.update(gradient, opt_state)
    return jax.tree.map(lambda x, dx: x - learning_rate * dx, params, direction), opt_state
