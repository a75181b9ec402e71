"""Parameters as one flat vector: Adam over one array costs a third of Adam over four."""

from collections.abc import Callable

import jax
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

ADAM = optax.scale_by_adam()


def flatten(tree: PyTree) -> Array:
    """A pytree of arrays as one vector `[num_params]`."""
    return ravel_pytree(tree)[0]


def unflattener(init: Callable[..., PyTree], *example: PyTree) -> Callable[[Array], PyTree]:
    """Builds the inverse of `flatten` for what `init(key, *example)` returns."""
    return inverse_of_flatten(jax.eval_shape(init, jax.random.key(0), *example))


def inverse_of_flatten(shapes: PyTree) -> Callable[[Array], PyTree]:
    """The inverse of `flatten`, built from shapes alone.

    Plain form: the second result of `jax.flatten_util.ravel_pytree`, which needs the arrays.
    """
    leaves, structure = jax.tree.flatten(shapes)

    def unflatten(vector: Array) -> PyTree:
        parts = zip(jax.lax.split(vector, [leaf.size for leaf in leaves]), leaves, strict=True)
        arrays = [x.reshape(leaf.shape).astype(leaf.dtype) for x, leaf in parts]
        return jax.tree.unflatten(structure, arrays)

    return unflatten


def adam_step(
    params: Array, opt_state: optax.OptState, gradient: Array, learning_rate: Array | float
) -> tuple[Array, optax.OptState]:
    """One step of Adam on flat parameters, with a traced learning rate.

    Plain form: `optax.adam(learning_rate)` on the pytree (`tests/test_flat.py`).
    """
    direction, opt_state = ADAM.update(gradient, opt_state)
    return params - learning_rate * direction, opt_state
