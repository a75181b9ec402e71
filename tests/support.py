"""What several test modules share: plain references and tiny configurations."""

import numpy as np


def numpy_forward(params, x, activation, num_layers, prelu_slope=0.25):
    """The MLP on a single input `[in]`, by plain loops over units."""
    activate = {
        "tanh": np.tanh,
        "relu": lambda x: np.maximum(x, 0),
        "leaky_relu": lambda x: np.where(x >= 0, x, 0.01 * x),
        "prelu": lambda x: np.where(x >= 0, x, prelu_slope * x),
    }[activation]
    for layer in range(num_layers + 1):
        kernel = np.asarray(params[f"Dense_{layer}"]["kernel"], np.float64)
        bias = np.asarray(params[f"Dense_{layer}"]["bias"], np.float64)
        x = np.array(
            [sum(w * v for w, v in zip(row, x, strict=True)) for row in kernel]
        ) + bias
        if layer < num_layers:
            x = activate(x)
    return x
