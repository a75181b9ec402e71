"""sejax.ops.flat: parameters as one vector and back, and Adam against optax."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from support import assert_equal, random_like, raveled, shapes_of

from sejax.ops import flat
from sejax.ops.networks import MLP

NET = MLP(2, hidden_size=3, num_layers=1, activation="prelu", learn_prelu_slope=True)
TREE = random_like(shapes_of(NET.init, jax.random.key(0), np.zeros(4)))


def test_a_vector_of_parameters_is_turned_back_into_them():
    vector = jax.jit(flat.flatten)(TREE)
    assert vector.shape == (4 * 3 + 3 + 3 * 2 + 2 + 1,) and vector.dtype == jnp.float32
    np.testing.assert_array_equal(vector, raveled(TREE))
    tree = jax.jit(flat.unflattener(NET.init, np.zeros(4)))(vector)
    assert jax.tree.structure(tree) == jax.tree.structure(TREE)
    assert_equal(tree, TREE)


@pytest.mark.parametrize("rate", [0.1, 0.5])
def test_adam_on_the_vector_is_optaxs_on_the_tree(rate):
    gradients = [random_like(TREE, seed) for seed in (1, 2, 3)]
    optimizer = optax.adam(rate)

    @jax.jit
    def both(tree, rate):
        params, opt_state = flat.flatten(tree), optimizer.init(tree)
        flat_state = flat.ADAM.init(params)
        for gradient in gradients:
            vector = flat.flatten(gradient)
            params, flat_state = flat.adam_step(params, flat_state, vector, rate)
            updates, opt_state = optimizer.update(gradient, opt_state)
            tree = optax.apply_updates(tree, updates)
        return params, flat.flatten(tree)

    np.testing.assert_allclose(*both(TREE, jnp.float32(rate)), rtol=1e-5, atol=1e-6)


def test_no_gradient_moves_nothing_not_even_by_rounding():
    start = jnp.float32([1.0, -2.0, 1e-30])
    after, _ = flat.adam_step(start, flat.ADAM.init(start), jnp.zeros(3), 0.1)
    np.testing.assert_array_equal(after, start)
