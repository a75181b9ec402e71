"""sejax.ops.networks: initial values, layout and the forward pass."""

import functools
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import assert_close, numpy_forward, random_like, shapes_of

from sejax.ops.networks import MLP, affine, fast_tanh, tanh
from sejax.options import Activation


@functools.cache
def network(num_inputs, *sizes, **options):
    """The jitted network, and random parameters for it."""
    net = MLP(*sizes, **options)
    shapes = shapes_of(net.init, jax.random.key(0), np.zeros(num_inputs))["params"]
    return jax.jit(lambda params, x: net.apply({"params": params}, x)), random_like(shapes)


def test_initial_weights_and_biases_are_uniform_within_one_over_root_fan_in():
    net = MLP(num_outputs=50, hidden_size=200, num_layers=2, activation="relu")
    params = jax.jit(net.init)(jax.random.key(0), np.zeros(9, np.float32))["params"]
    # fan-in of each layer: the input, then the hidden size twice; for biases that of their layer.
    for layer, (fan_in, fan_out) in enumerate([(9, 200), (200, 200), (200, 50)]):
        bound = fan_in**-0.5
        weights = jax.tree.map(np.asarray, params[f"Dense_{layer}"])
        assert weights["kernel"].shape == (fan_out, fan_in) and weights["bias"].shape == (fan_out,)
        for values in weights.values():
            assert np.abs(values).max() <= bound
            assert values.max() > 0.85 * bound and values.min() < -0.85 * bound
            # Variance of U(-b, b) is b^2 / 3; its estimate has relative std sqrt(0.8 / n).
            tolerance = 5 * np.sqrt(0.8 / values.size)
            assert abs(values.var() / (bound**2 / 3) - 1) < tolerance


@pytest.mark.parametrize("num_layers", [1, 2])
@pytest.mark.parametrize("activation", get_args(Activation))
def test_forward_of_one_input_or_a_batch_equals_a_numpy_loop(activation, num_layers):
    apply, params = network(4, 3, 5, num_layers, activation)
    batch = np.random.default_rng(0).normal(size=(4, 5)) * 2  # [feature, batch]
    columns = [numpy_forward(params, x, activation, num_layers) for x in batch.T]
    expected = np.stack(columns, axis=1)
    for inputs, outputs in ((batch, expected), (batch[:, 1], expected[:, 1])):
        np.testing.assert_allclose(apply(params, np.float32(inputs)), outputs, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("function", "cut", "error"), [(tanh, 8, 3.3e-7), (fast_tanh, 7, 1.4e-6)])
def test_rational_tanh_is_tanh_within_its_stated_error(function, cut, error):
    x = np.linspace(-12, 12, 400_001, dtype=np.float32)
    at = jax.jit(lambda x: jax.jvp(function, (x,), (jnp.ones_like(x),)))
    y, slope = map(np.asarray, at(x))
    exact = np.tanh(np.float64(x))
    assert 0.6 * error < np.abs(y - exact).max() <= error
    near_zero = np.abs(x) < 0.1
    np.testing.assert_allclose(y[near_zero], exact[near_zero], rtol=1e-6)
    np.testing.assert_allclose(slope, 1 - exact**2, atol=2.2 * error)
    # Odd, within [-1, 1], constant beyond the cut, and increasing but for rounding.
    np.testing.assert_array_equal(y, -y[::-1])
    assert np.abs(y).max() <= 1 and slope.min() >= 0
    np.testing.assert_array_equal(y[x >= cut], y[-1])
    assert np.diff(y).min() > -4 * np.finfo(np.float32).eps
    if function is tanh:  # exact to rounding: within 6 units in the last place
        assert (np.abs(y - exact) / np.spacing(np.abs(exact).astype(np.float32))).max() <= 6
    # Of extremes, too, and differentiated twice: tanh'' = -2 y (1 - y^2).
    extremes = np.float32([0, -0.0, 1e-30, 1e30, -np.inf, np.inf, np.nan])
    y, slope = at(extremes)
    np.testing.assert_allclose(y, np.tanh(extremes), atol=error)
    np.testing.assert_allclose(slope, 1 - np.tanh(extremes) ** 2, atol=2.2 * error)
    np.testing.assert_array_equal(y[:3], extremes[:3])
    np.testing.assert_allclose(jax.grad(jax.grad(function))(0.5), -0.72686198, atol=1e-5)


def test_a_learned_prelu_slope_is_one_number_that_starts_at_a_quarter():
    net = MLP(3, hidden_size=5, num_layers=2, activation="prelu", learn_prelu_slope=True)
    assert net.init(jax.random.key(0), jnp.zeros(4))["params"]["prelu_slope"] == 0.25


def test_layer_norm_of_a_feature_major_batch_equals_that_of_single_inputs():
    apply, params = network(4, 3, 5, 2, "tanh", layer_norm=True)
    batch = np.float32(np.random.default_rng(3).normal(size=(4, 7)))  # [feature, batch]
    alone = np.stack([apply(params, x) for x in batch.T], axis=1)
    np.testing.assert_allclose(apply(params, batch), alone, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("num_inputs", "num_outputs"), [
    (3, 2), (20, 2), (3, 20), (20, 20), (64, 64), (128, 128),  # wide ones are not transposed
])  # fmt: skip
def test_affine_and_its_gradient_equal_the_plain_product(num_inputs, num_outputs):
    shapes = [(num_outputs, num_inputs), (num_outputs,), (num_inputs, 7), (num_outputs, 7)]
    *args, weight = random_like([np.zeros(shape) for shape in shapes], scale=1.0)

    def plain(kernel, bias, x):
        return kernel @ x + bias[:, None]

    def values_of(fn):
        total = jax.value_and_grad(lambda *args: jnp.sum(weight * fn(*args)), (0, 1, 2))
        return jax.jit(total)(*args)

    assert_close(values_of(affine), values_of(plain), rtol=1e-4, atol=1e-5)
