"""Multilayer perceptrons, initialised and shaped as the paper's.

Activations are *feature-major*, `[feature, batch]`: for layers this small, `kernel @ x` with the
batch last runs 1.5 to 1.7 times as fast on a CPU as `x @ kernel.T`. A single input is `[feature]`.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float, PyTree

PRELU_SLOPE = 0.25


def _rational_tanh(
    numerator: tuple[float, ...], denominator: tuple[float, ...], cut: float
) -> Callable[[Array], Array]:
    """An odd rational function in place of tanh; its input is clipped to +-`cut`.

    Plain form: `jnp.tanh`, equal up to the error below (`tests/test_networks.py`). XLA's tanh has
    degree 13 over 6, and selects for small and for large inputs.

    Args:
      numerator: coefficients of x times powers of x^2, the lowest first.
      denominator: coefficients of powers of x^2.
      cut: the function is constant beyond it.
    """

    @jax.custom_jvp
    def tanh(x: Array) -> Array:
        x = jnp.clip(x, -cut, cut)
        square = x * x
        return x * _polynomial(numerator, square) / _polynomial(denominator, square)

    tanh.defjvps(lambda dx, y, x: (1 - y * y) * dx)  # autodiff of a quotient costs more
    return tanh


def _polynomial(coefficients: tuple[Array | float, ...], x: Array) -> Array | float:
    """A polynomial by Horner's scheme; the coefficient of the lowest power comes first."""
    return functools.reduce(lambda value, c: value * x + c, reversed(coefficients))


# Coefficients: linear programs found the function nearest to tanh up to the cut, of this form and
# with slope 1 at 0. For `fast_tanh` no value may exceed 1; the error was bisected. Both functions
# increase, but for rounding, and stay within [-1, 1].
#
# Exact to rounding: off by at most 3.3e-7, 6 units in the last place (XLA's tanh: 2.7e-7 and 5).
# A hidden layer of `preset=paper`'s DDQN takes 0.78 of the time with it, a learning step 0.90.
tanh = _rational_tanh(
    (1.0, 0.134394869, 3.56568652e-3, 2.17972718e-5, 1.50901975e-8),
    (1.0, 0.467728108, 2.61418652e-2, 3.4016461e-4, 8.46649471e-7),
    cut=8.0,
)
# Off by at most 1.4e-6. The layer takes 0.67 of the time.
fast_tanh = _rational_tanh(
    (1.0, 0.123211934, 2.29220956e-3, 3.99148978e-6),
    (1.0, 0.45653853, 2.11477332e-2, 1.4388554e-4),
    cut=7.0,
)
_ACTIVATIONS = {"tanh": tanh, "fast_tanh": fast_tanh, "relu": nn.relu, "leaky_relu": nn.leaky_relu}


def uniform_fan_in(fan_in: int) -> Callable[..., Array]:
    """Initialiser U(-1/sqrt(fan_in), 1/sqrt(fan_in)) for weights and biases alike.

    Source: the default of the paper's networks (`docs/reference.md` 1.9).
    """
    bound = fan_in**-0.5
    return functools.partial(jax.random.uniform, minval=-bound, maxval=bound)


class Dense(nn.Module):
    """Affine map on feature-major input: `[in] -> [out]` or `[in, batch] -> [out, batch]`."""

    features: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        fan_in = x.shape[0]
        kernel = self.param("kernel", uniform_fan_in(fan_in), (self.features, fan_in))
        bias = self.param("bias", uniform_fan_in(fan_in), (self.features,))
        return kernel @ x + bias if x.ndim == 1 else affine(kernel, bias, x)


# A product over at most this many terms is written out as a sum. XLA fuses it with the operations
# around it; a call of the matrix library would cost more than the arithmetic.
_MAX_UNROLLED = 8
_WIDE = 64  # a kernel with at least this many units is read row by row


@jax.custom_vjp
def affine(
    kernel: Float[Array, "out in"], bias: Float[Array, " out"], x: Float[Array, "in batch"]
) -> Float[Array, "out batch"]:
    """`kernel @ x + bias`, with products over few terms unrolled in both passes.

    Plain form: `kernel @ x + bias[:, None]`, equal up to rounding (`tests/test_networks.py`,
    `test_affine_and_its_gradient_equal_the_plain_product`). A training of DDQN in CartPole takes
    0.78 of the time.
    """
    return _product(kernel, x) + bias[:, None]


def _affine_forward(kernel: Array, bias: Array, x: Array) -> tuple[Array, tuple[Array, Array]]:
    return affine(kernel, bias, x), (kernel, x)


def _affine_backward(residuals: tuple[Array, Array], gradient: Array) -> tuple[Array, ...]:
    kernel, x = residuals
    num_outputs = kernel.shape[0]
    if num_outputs <= _MAX_UNROLLED:
        # The result of a product is stored. Without one XLA would compute the gradient, a chain of
        # cheap operations, anew for each of the `in` rows of the last line.
        gradient = jnp.eye(num_outputs) @ gradient
    # Summed as a product: XLA's row sums take several times as long.
    bias_gradient = gradient @ jnp.ones(gradient.shape[1])
    return gradient @ x.T, bias_gradient, _transposed_product(kernel, gradient)


affine.defvjp(_affine_forward, _affine_backward)


def _transposed_product(
    kernel: Float[Array, "out in"], gradient: Float[Array, "out batch"]
) -> Float[Array, "in batch"]:
    """`kernel.T @ gradient`; the matrix library reads a wide kernel row by row.

    Plain form: `kernel.T @ gradient`. With a wide kernel the library computes the plain form at 0.4
    of the speed of a product without transposition. Barriers keep XLA from restoring that form.
    """
    num_outputs = kernel.shape[0]
    if min(kernel.shape) < _WIDE or gradient.shape[1] >= 2 * num_outputs:
        return _product(kernel.T, gradient)
    return jax.lax.optimization_barrier(jax.lax.optimization_barrier(gradient.T) @ kernel).T


def _product(a: Float[Array, "rows inner"], b: Float[Array, "inner batch"]) -> Array:
    inner = a.shape[1]
    if inner > _MAX_UNROLLED:
        return a @ b
    return functools.reduce(jnp.add, [a[:, i : i + 1] * b[i : i + 1] for i in range(inner)])


class MLP(nn.Module):
    """`num_layers` hidden layers of `hidden_size` units with an activation, then a linear head.

    `activation` is one of `sejax.options.Activation`. PReLU has one slope for the whole network, as
    in the authors' code. `learn_prelu_slope` makes it a parameter (agents); otherwise it stays at
    0.25 (proxies: the authors' NES perturbs the weights and biases of linear layers only).
    `layer_norm` normalises each column over the units of every hidden layer but the first, before
    the activation; its scale and bias are learned and, as in the authors' code, the same in all
    layers. The norm covers only the units that `narrow` has left.

    Source: paper, appendix "SE hyperparameters"; `docs/reference.md` 1.10 and 1.11.
    """

    num_outputs: int
    hidden_size: int
    num_layers: int
    activation: str
    learn_prelu_slope: bool = False
    layer_norm: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "in *batch"]) -> Float[Array, "out *batch"]:
        activate = self._activation_fn()
        normalize = self._layer_norm_fn()
        for layer in range(self.num_layers):
            x = Dense(self.hidden_size)(x)
            if layer > 0:
                x = normalize(x)
            x = activate(x)
        return Dense(self.num_outputs)(x)

    def _layer_norm_fn(self) -> Callable[[Array], Array]:
        if not self.layer_norm:
            return lambda x: x
        normalize = nn.LayerNorm(
            epsilon=1e-5, reduction_axes=0, feature_axes=0, use_fast_variance=False
        )
        # A parameter that never changes. Rounded: averages in a target network may not be whole.
        width = self.param("width", nn.initializers.constant(self.hidden_size), ())
        in_use = jnp.arange(self.hidden_size) < jnp.round(jax.lax.stop_gradient(width))

        def normalize_in_use(x: Array) -> Array:
            mask = in_use if x.ndim == 1 else in_use[:, None]
            return jnp.where(mask, normalize(x, mask=jnp.broadcast_to(mask, x.shape)), 0.0)

        return normalize_in_use

    def _activation_fn(self) -> Callable[[Array], Array]:
        if self.activation == "prelu":
            slope: Array | float = PRELU_SLOPE
            if self.learn_prelu_slope:
                slope = self.param("prelu_slope", nn.initializers.constant(PRELU_SLOPE), ())
            return lambda x: jnp.where(x >= 0, x, slope * x)
        return _ACTIVATIONS[self.activation]


def init_narrowed(
    network: nn.Module, key: Array, num_inputs: int, hidden_size: Array | None = None
) -> PyTree:
    """Variables of a fresh network with `hidden_size` hidden units in use; None for all."""
    params = network.init(key, jnp.zeros(num_inputs))["params"]
    return {"params": params if hidden_size is None else narrow(params, hidden_size)}


def narrow(params: dict[str, PyTree], hidden_size: Array) -> dict[str, PyTree]:
    """Freshly initialised parameters of an `MLP` in which only the first `hidden_size` units count.

    All weights into and out of the other units are 0. They stay 0 in training, because every
    activation maps 0 to 0 with a finite slope. So the network equals one with `hidden_size` units,
    and its weights are distributed as in a fresh network of that size.

    Args:
      params: of an `MLP`; or of a `DuelingMLP`, whose shared part is narrowed.
      hidden_size: `[]`, at most the network's.
    """
    if "features" in params:
        return {**params, "features": narrow(params["features"], hidden_size)}
    num_layers = sum(name.startswith("Dense_") for name in params)
    full_size = params["Dense_0"]["bias"].shape[0]
    in_use = jnp.arange(full_size) < hidden_size
    widen = jnp.sqrt(full_size / hidden_size)  # weights are uniform in +-1/sqrt(fan_in)
    narrowed = dict(params)
    for layer in range(num_layers):
        kernel = params[f"Dense_{layer}"]["kernel"]
        bias = params[f"Dense_{layer}"]["bias"]
        if layer > 0:
            kernel, bias = kernel * in_use[None, :] * widen, bias * widen
        if layer < num_layers - 1:
            kernel, bias = kernel * in_use[:, None], bias * in_use
        narrowed[f"Dense_{layer}"] = {"kernel": kernel, "bias": bias}
    if "width" in params:
        narrowed["width"] = jnp.float32(hidden_size)
    return narrowed


class DuelingMLP(nn.Module):
    r"""Dueling network: a value and an advantage stream on shared features.

    .. math:: Q(s, a) = V(s) + A(s, a) - \frac{1}{|A|} \sum_{a'} A(s, a')

    The streams are `MLP`s on the outputs of the shared `features`, which have no activation. PReLU
    has a learned slope for each of the three parts.

    Differs: the mean is over the actions of each sample. The authors take it over the actions of
    the whole batch, so that a sample's Q values depend on the other samples of its batch.

    Source: Wang et al., "Dueling Network Architectures for Deep RL" (2016), eq. 9; paper, appendix,
    tables of DDQN and Dueling DDQN; `docs/reference.md` 4.2.
    """

    features: MLP
    value: MLP
    advantage: MLP

    def __call__(self, x: Float[Array, "in *batch"]) -> Float[Array, "actions *batch"]:
        features = self.features(x)
        value, advantage = self.value(features), self.advantage(features)  # value: [1, *batch]
        return value + advantage - jnp.mean(advantage, axis=0, keepdims=True)
