"""sejax.ops.optimizers: the same as optax's, and no step without a gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from support import random_like, shapes_of

from sejax.ops.networks import MLP
from sejax.ops.optimizers import ADAM, apply_gradient, clip_by_global_norm

NET = MLP(2, hidden_size=3, num_layers=1, activation="prelu", learn_prelu_slope=True)
PARAMS = random_like(shapes_of(NET.init, jax.random.key(0), np.zeros(4)))


@pytest.mark.parametrize("rate", [0.1, 0.5])
def test_adam_is_optaxs(rate):
    optimizer = optax.adam(rate)

    @jax.jit
    def both(params, rate):
        expected, state, expected_state = params, ADAM.init(params), optimizer.init(params)
        for seed in (1, 2, 3):
            gradient = random_like(PARAMS, seed)
            params, state = apply_gradient(params, state, gradient, rate)
            updates, expected_state = optimizer.update(gradient, expected_state)
            expected = optax.apply_updates(expected, updates)
        return params, expected

    for got, expected in zip(*map(jax.tree.leaves, both(PARAMS, rate)), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)


def test_no_gradient_moves_nothing_not_even_by_rounding():
    start = jnp.float32([1.0, -2.0, 1e-30])
    after, _ = apply_gradient(start, ADAM.init(start), jnp.zeros(3), 0.1)
    np.testing.assert_array_equal(after, start)


@pytest.mark.parametrize("max_norm", [0.5, 100.0])
def test_a_gradient_is_clipped_as_by_optax(max_norm):
    gradient = random_like(PARAMS, 1)
    clip, expected = clip_by_global_norm(max_norm), optax.clip_by_global_norm(max_norm)
    got, expected = (x.update(gradient, x.init(PARAMS))[0] for x in (clip, expected))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), got, expected)
