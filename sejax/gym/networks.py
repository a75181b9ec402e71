"""The forward pass of a stored network in NumPy, for one input or a batch of them."""

import itertools
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.linalg import block_diag

Layers = list[tuple[np.ndarray, np.ndarray]]  # kernel [in, out] and bias [out] of each

# Activations that are computed at once. Arrays of 96 KB stay in the cache. For larger
# arrays C's allocator asks the system for fresh pages each time, which took ten times the product.
BLOCK = 24 * 1024

ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "tanh": np.tanh,
    "fast_tanh": np.tanh,  # they differ by at most 1.4e-6
    "relu": lambda x: np.maximum(x, 0),
    "leaky_relu": lambda x: np.maximum(x, 0.01 * x),
    "prelu": lambda x: np.maximum(x, 0.25 * x),  # the slope that proxies keep
}


def forward(layers: Layers, activation: str, x: np.ndarray) -> np.ndarray:
    """Outputs `[*batch, out]` of inputs `[*batch, in]`; they may overflow without a warning."""
    with np.errstate(over="ignore", invalid="ignore"):
        if x.ndim == 1:
            return _apply(layers, activation, x)
        size = max(1, BLOCK // max(len(bias) for _, bias in layers))
        blocks = [x[i : i + size] for i in range(0, len(x), size)]
        return np.concatenate([_apply(layers, activation, block) for block in blocks])


def _apply(layers: Layers, activation: str, x: np.ndarray) -> np.ndarray:
    for i, (kernel, bias) in enumerate(layers):
        x = (ACTIVATIONS[activation](x) if i else x) @ kernel
        x += bias
    return x


def network_layers(weights: Mapping[str, np.ndarray], network: str) -> Layers:
    """A network's layers, empty if the network is missing; files hold kernels as `[out, in]`."""
    names = (f"{network}/Dense_{i}" for i in itertools.count())
    present = itertools.takewhile(lambda name: f"{name}/kernel" in weights, names)
    return [(weights[f"{name}/kernel"].T, weights[f"{name}/bias"]) for name in present]


def joined(networks: Sequence[Layers]) -> Layers:
    """Joins networks of the same input into one, which gives their outputs one after the other.

    One product with zeros between the blocks takes less time than three small products.
    """
    whole: Layers = []
    for parts in zip(*networks, strict=True):
        kernels, biases = zip(*parts, strict=True)
        kernel = block_diag(*kernels) if whole else np.concatenate(kernels, axis=1)
        whole.append((np.asfortranarray(kernel), np.concatenate(biases)))
    return whole


def shapes_of(networks: Mapping[str, Sequence[int]]) -> dict[str, tuple[int, ...]]:
    """Shapes of networks' tensors in a file, given the numbers of inputs and of layers' units.

    Example:
      >>> shapes_of({"reward": [6, 1]})
      {'reward/Dense_0/kernel': (1, 6), 'reward/Dense_0/bias': (1,)}
    """
    shapes: dict[str, tuple[int, ...]] = {}
    for name, units in networks.items():
        for i, (num_inputs, num_outputs) in enumerate(itertools.pairwise(units)):
            shapes[f"{name}/Dense_{i}/kernel"] = (num_outputs, num_inputs)
            shapes[f"{name}/Dense_{i}/bias"] = (num_outputs,)
    return shapes
