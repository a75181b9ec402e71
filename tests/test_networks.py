"""sejax.networks: initial values, layout and the forward pass."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import numpy_forward

from sejax.networks import ACTIVATIONS, MLP, PRELU_SLOPE, affine


def test_initial_weights_and_biases_are_uniform_within_one_over_root_fan_in():
    net = MLP(num_outputs=50, hidden_size=200, num_layers=2, activation="relu")
    params = net.init(jax.random.key(0), jnp.zeros(9))["params"]
    # fan-in of each layer: the input, then the hidden size twice; for biases that of their layer.
    for layer, (fan_in, fan_out) in enumerate([(9, 200), (200, 200), (200, 50)]):
        bound = fan_in**-0.5
        kernel = np.asarray(params[f"Dense_{layer}"]["kernel"])
        bias = np.asarray(params[f"Dense_{layer}"]["bias"])
        assert kernel.shape == (fan_out, fan_in) and bias.shape == (fan_out,)
        for values in (kernel, bias):
            assert np.abs(values).max() <= bound
            assert values.max() > 0.85 * bound and values.min() < -0.85 * bound
            # Variance of U(-b, b) is b^2 / 3; its estimate has relative std sqrt(0.8 / n).
            tolerance = 5 * np.sqrt(0.8 / values.size)
            assert abs(values.var() / (bound**2 / 3) - 1) < tolerance


def test_layers_are_initialised_independently():
    net = MLP(num_outputs=8, hidden_size=8, num_layers=2, activation="relu")
    params = net.init(jax.random.key(0), jnp.zeros(8))["params"]
    kernels = [np.asarray(params[f"Dense_{i}"]["kernel"]).ravel() for i in range(3)]
    correlations = np.corrcoef(kernels)[np.triu_indices(3, 1)]
    assert np.abs(correlations).max() < 5 / np.sqrt(64)


@pytest.mark.parametrize("num_layers", [1, 2])
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_forward_equals_a_numpy_loop(activation, num_layers):
    net = MLP(num_outputs=3, hidden_size=5, num_layers=num_layers, activation=activation)
    params = net.init(jax.random.key(1), jnp.zeros(4))["params"]
    for x in np.random.default_rng(0).normal(size=(5, 4)) * 2:
        expected = numpy_forward(params, x, activation, num_layers)
        got = net.apply({"params": params}, jnp.float32(x))
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)


def test_a_feature_major_batch_equals_single_inputs():
    net = MLP(num_outputs=3, hidden_size=5, num_layers=2, activation="tanh")
    variables = net.init(jax.random.key(2), jnp.zeros(4))
    batch = jax.random.normal(jax.random.key(3), (4, 7))  # [feature, batch]
    together = net.apply(variables, batch)
    assert together.shape == (3, 7)
    for column in range(7):
        alone = net.apply(variables, batch[:, column])
        np.testing.assert_allclose(together[:, column], alone, rtol=1e-5, atol=1e-6)


def test_the_prelu_slope_of_a_proxy_is_fixed_and_no_parameter():
    net = MLP(num_outputs=1, hidden_size=3, num_layers=2, activation="prelu")
    params = net.init(jax.random.key(0), jnp.zeros(2))["params"]
    assert set(params) == {"Dense_0", "Dense_1", "Dense_2"}
    assert PRELU_SLOPE == 0.25


def test_a_learned_prelu_slope_is_one_parameter_of_the_whole_network():
    net = MLP(3, hidden_size=5, num_layers=2, activation="prelu", learn_prelu_slope=True)
    params = net.init(jax.random.key(0), jnp.zeros(4))["params"]
    assert params["prelu_slope"].shape == () and params["prelu_slope"] == 0.25
    params = {**params, "prelu_slope": jnp.float32(0.6)}
    x = np.array([0.3, -1.0, 2.0, -0.5])
    expected = numpy_forward(params, x, "prelu", num_layers=2, prelu_slope=0.6)
    got = net.apply({"params": params}, jnp.float32(x))
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)
    gradient = jax.grad(lambda p: net.apply({"params": p}, jnp.float32(x)).sum())(params)
    assert gradient["prelu_slope"] != 0


def test_other_activations_have_no_slope_to_learn():
    net = MLP(3, hidden_size=5, num_layers=1, activation="tanh", learn_prelu_slope=True)
    params = net.init(jax.random.key(0), jnp.zeros(4))["params"]
    assert set(params) == {"Dense_0", "Dense_1"}


@pytest.mark.parametrize(("num_inputs", "num_outputs"), [(3, 2), (20, 2), (3, 20), (20, 20)])
def test_affine_and_its_gradient_equal_the_plain_product(num_inputs, num_outputs):
    keys = jax.random.split(jax.random.key(0), 4)
    kernel = jax.random.normal(keys[0], (num_outputs, num_inputs))
    bias = jax.random.normal(keys[1], (num_outputs,))
    x = jax.random.normal(keys[2], (num_inputs, 7))
    weight = jax.random.normal(keys[3], (num_outputs, 7))

    def of(fn):
        return jax.value_and_grad(lambda *args: jnp.sum(weight * fn(*args)), (0, 1, 2))(
            kernel, bias, x
        )

    value, gradients = of(affine)
    expected, expected_gradients = of(lambda k, b, x: k @ x + b[:, None])
    np.testing.assert_allclose(value, expected, rtol=1e-5)
    for got, wanted in zip(gradients, expected_gradients, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-4, atol=1e-5)
