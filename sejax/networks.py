"""Multilayer perceptrons, initialised and shaped as the paper's.

Activations are *feature-major*, `[feature, batch]`: `kernel @ x` with the batch last runs 1.5 to
1.7 times faster on CPU than rows-major for layers this small. A single input is `[feature]`.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

PRELU_SLOPE = 0.25


def uniform_fan_in(fan_in: int) -> Callable[..., Array]:
    """Initialiser U(-1/sqrt(fan_in), 1/sqrt(fan_in)) for weights and biases alike.

    Source: the default of the paper's networks (`reference_details.md` 1.9).
    """
    bound = fan_in**-0.5

    def init(key: Array, shape: tuple[int, ...]) -> Array:
        return jax.random.uniform(key, shape, minval=-bound, maxval=bound)

    return init


class Dense(nn.Module):
    """Affine map on feature-major input: `[in] -> [out]` or `[in, batch] -> [out, batch]`."""

    features: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        fan_in = x.shape[0]
        kernel = self.param("kernel", uniform_fan_in(fan_in), (self.features, fan_in))
        bias = self.param("bias", uniform_fan_in(fan_in), (self.features,))
        if x.ndim == 1:
            return kernel @ x + bias
        return affine(kernel, bias, x)


# A product over at most this many terms is written out as a sum, which XLA fuses with what
# surrounds it; calling the matrix library for it costs more than the arithmetic.
_MAX_UNROLLED = 8


@jax.custom_vjp
def affine(
    kernel: Float[Array, "out in"], bias: Float[Array, " out"], x: Float[Array, "in batch"]
) -> Float[Array, "out batch"]:
    """`kernel @ x + bias`, with products over few terms unrolled in both passes."""
    return _product(kernel, x) + bias[:, None]


def _affine_forward(kernel: Array, bias: Array, x: Array) -> tuple[Array, tuple[Array, Array]]:
    return affine(kernel, bias, x), (kernel, x)


def _affine_backward(residuals: tuple[Array, Array], gradient: Array) -> tuple[Array, ...]:
    kernel, x = residuals
    num_outputs = kernel.shape[0]
    if num_outputs <= _MAX_UNROLLED:
        # The result of a product is stored, whereas XLA would compute a gradient that comes out of
        # a chain of cheap operations anew for each of the `in` rows that the last line makes.
        gradient = jnp.eye(num_outputs) @ gradient
    # Summed as a product: XLA's row sums take several times as long.
    bias_gradient = gradient @ jnp.ones(gradient.shape[1])
    return gradient @ x.T, bias_gradient, _product(kernel.T, gradient)


affine.defvjp(_affine_forward, _affine_backward)


def _product(a: Float[Array, "rows inner"], b: Float[Array, "inner batch"]) -> Array:
    inner = a.shape[1]
    if inner > _MAX_UNROLLED:
        return a @ b
    terms = [a[:, i : i + 1] * b[i : i + 1] for i in range(inner)]
    return functools.reduce(jnp.add, terms)


class MLP(nn.Module):
    """`num_layers` hidden layers of `hidden_size` units with an activation, then a linear head.

    `activation` is one of `configs.ACTIVATIONS`. PReLU has one slope for the whole network, as in
    the authors' code. `learn_prelu_slope` makes it a parameter (agents); otherwise it stays at 0.25
    (proxies: the authors' NES perturbs the weights and biases of linear layers only).

    Source: paper, appendix "SE hyperparameters"; `reference_details.md` 1.10 and 1.11.
    """

    num_outputs: int
    hidden_size: int
    num_layers: int
    activation: str
    learn_prelu_slope: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "in *batch"]) -> Float[Array, "out *batch"]:
        activate = self._activation_fn()
        for _ in range(self.num_layers):
            x = activate(Dense(self.hidden_size)(x))
        return Dense(self.num_outputs)(x)

    def _activation_fn(self) -> Callable[[Array], Array]:
        if self.activation == "prelu":
            slope: Array | float = PRELU_SLOPE
            if self.learn_prelu_slope:
                slope = self.param("prelu_slope", nn.initializers.constant(PRELU_SLOPE), ())
            return lambda x: jnp.where(x >= 0, x, slope * x)
        return {"tanh": jnp.tanh, "relu": nn.relu, "leaky_relu": nn.leaky_relu}[self.activation]
