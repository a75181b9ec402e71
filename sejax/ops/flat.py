"""Parameters as one flat vector: Adam over one array costs a third of Adam over four."""

from collections.abc import Callable
from typing import Any

import jax
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

ADAM = optax.scale_by_adam()


def flatten(tree: Any) -> Array:
    """A pytree of arrays as one vector `[num_params]`."""
    return ravel_pytree(tree)[0]


def unflattener(init: Callable[..., Any], *example: Any) -> Callable[[Array], Any]:
    """Builds the inverse of `flatten` for what `init(key, *example)` returns."""
    return inverse_of_flatten(jax.eval_shape(init, jax.random.key(0), *example))


def inverse_of_flatten(shapes: Any) -> Callable[[Array], Any]:
    """The inverse of `flatten`, built from shapes alone.

    Plain form: the second result of `jax.flatten_util.ravel_pytree`, which needs the arrays.
    """
    leaves, structure = jax.tree.flatten(shapes)

    def unflatten(vector: Array) -> Any:
        parts = jax.lax.split(vector, [leaf.size for leaf in leaves])
        return structure.unflatten(
            [
                part.reshape(leaf.shape).astype(leaf.dtype)
                for part, leaf in zip(parts, leaves, strict=True)
            ]
        )

    return unflatten


def adam_step(
    params: Array, opt_state: optax.OptState, gradient: Array, learning_rate: Array | float
) -> tuple[Array, optax.OptState]:
    """One step of Adam on flat parameters, with a traced learning rate.

    Plain form: `optax.adam(learning_rate)` on the pytree (`tests/test_flat.py`).
    """
    direction: Any
    direction, opt_state = ADAM.update(gradient, opt_state)
    return params - learning_rate * direction, opt_state
