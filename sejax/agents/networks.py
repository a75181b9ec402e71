"""Networks as functions of their parameters as one vector, which Adam moves fastest."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array

from sejax.ops import flat
from sejax.ops.networks import init_narrowed


class FlatNetwork(NamedTuple):
    """A network as functions of its parameters as one vector.

    Attributes:
      init: `(key, hidden_size) -> params`, `[num_params]`. `hidden_size` is the number of units in
        use, or None for all.
      apply: `(params, x) -> outputs`, `[out, *batch]` for `x [in, *batch]`.
    """

    init: Callable[[Array, Array | None], Array]
    apply: Callable[[Array, Array], Array]


def flat_network(network: nn.Module, num_inputs: int) -> FlatNetwork:
    """A network for inputs `[num_inputs, *batch]`."""
    unflatten = flat.unflattener(network.init, jnp.zeros(num_inputs))

    def init(key: Array, hidden_size: Array | None = None) -> Array:
        return flat.flatten(init_narrowed(network, key, num_inputs, hidden_size))

    def apply(params: Array, x: Array) -> Array:
        outputs: Any = network.apply(unflatten(params), x)
        return outputs

    return FlatNetwork(init, apply)
