"""What the golden agents in torch share: a perceptron from our parameters and back, their files.

torch is large and not needed for the tests, so that what it computed is kept in the repository.
Where it is installed, `python tests/torch_NAME.py` makes the numbers of `test_NAME.py` again.
"""

import jax
import numpy as np
import torch


class TorchMLP(torch.nn.Module):
    """The authors' layout: hidden layers that share an activation and a layer norm, and a head."""

    def __init__(self, params, activation):
        super().__init__()
        num_layers = sum(name.startswith("Dense_") for name in params)
        self.layers = torch.nn.ModuleList(linear(params[f"Dense_{i}"]) for i in range(num_layers))
        self.activate = {
            "tanh": torch.nn.Tanh, "relu": torch.nn.ReLU,
            "leaky_relu": torch.nn.LeakyReLU, "prelu": torch.nn.PReLU,
        }[activation]()  # fmt: skip
        if activation == "prelu":
            self.activate.weight.data = torch.tensor([float(params["prelu_slope"])])
        self.norm = None
        if "LayerNorm_0" in params:
            scale, bias = (np.array(params["LayerNorm_0"][name]) for name in ("scale", "bias"))
            self.norm = torch.nn.LayerNorm(len(scale))
            self.norm.weight.data, self.norm.bias.data = torch.tensor(scale), torch.tensor(bias)

    def forward(self, x):
        for i, layer in enumerate(self.layers[:-1]):
            x = layer(x)
            if self.norm is not None and i > 0:
                x = self.norm(x)
            x = self.activate(x)
        return self.layers[-1](x)

    def nested(self):
        """The parameters as flax nests them."""
        out = dense_arrays(self.layers)
        if self.norm is not None:
            scale, bias = self.norm.weight.detach().numpy(), self.norm.bias.detach().numpy()
            out["LayerNorm_0"] = {"scale": scale, "bias": bias}
            out["width"] = np.float32(len(scale))
        if isinstance(self.activate, torch.nn.PReLU):
            out["prelu_slope"] = self.activate.weight.detach().numpy()[0]
        return out


def linear(dense):
    """A layer of torch from one of flax."""
    layer = torch.nn.Linear(*dense["kernel"].shape[::-1])
    layer.weight.data = torch.tensor(np.array(dense["kernel"]))
    layer.bias.data = torch.tensor(np.array(dense["bias"]))
    return layer


def dense_arrays(layers):
    """Layers of torch as flax names and nests them."""
    return {
        f"Dense_{i}": {"kernel": x.weight.detach().numpy(), "bias": x.bias.detach().numpy()}
        for i, x in enumerate(layers)
    }


@torch.no_grad()
def follow(slow, fast, tau):
    """Moves the parameters of a target network towards those of the other."""
    for target, source in zip(slow.parameters(), fast.parameters(), strict=True):
        target.copy_(tau * source + (1 - tau) * target)


def tensors(tree):
    """A pytree's arrays in torch."""
    return jax.tree.map(lambda x: torch.tensor(np.array(x)), tree)


def write_golden(path, references, checked, inputs):
    """Writes what `flat()` gives of each case's agent after some updates; 0 is before the first.

    Args:
      references: agents by the names of their cases.
      checked: numbers of updates.
      inputs: of a case and the number of an update, its arguments.
    """
    arrays = {}
    for case, reference in references.items():
        for number in range(max(checked) + 1):
            if number > 0:
                reference.update(*inputs(case, number))
            if number in checked:
                now = reference.flat().items()
                arrays |= {f"{case}/{name}/{number}": np.array(x) for name, x in now}
    np.savez(path, **arrays)
