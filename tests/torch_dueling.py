"""The dueling network in torch: makes the golden numbers that `test_dueling.py` compares with.

The rest of the agent is that of `torch_ddqn.py`. Remake them with `python tests/torch_dueling.py`
where torch is installed.
"""

import numpy as np
import torch
from test_dueling import ACTIVATIONS, GOLDEN, config_with, nested_params
from torch_ddqn import TorchDDQN, golden

PARTS = ("features", "value", "advantage")


class DuelingNet(torch.nn.Module):
    """Each part a stack of layers that shares one activation, from the same parameters."""

    def __init__(self, params, activation):
        super().__init__()
        self.parts = torch.nn.ModuleDict(
            {name: self._part(params[name], activation) for name in PARTS}
        )

    @staticmethod
    def _part(params, activation):
        if activation == "prelu":
            act = torch.nn.PReLU()
            act.weight.data = torch.tensor([float(params["prelu_slope"])])
        else:
            act = torch.nn.Tanh()
        layers = []
        for i in range(sum(name.startswith("Dense_") for name in params)):
            dense = params[f"Dense_{i}"]
            layer = torch.nn.Linear(*dense["kernel"].shape[::-1])
            layer.weight.data = torch.tensor(np.array(dense["kernel"]))
            layer.bias.data = torch.tensor(np.array(dense["bias"]))
            layers += [act, layer] if layers else [layer]
        return torch.nn.Sequential(*layers)

    def forward(self, x):
        features = self.parts["features"](x)
        advantage = self.parts["advantage"](features)
        return self.parts["value"](features) + advantage - advantage.mean(1, keepdim=True)

    def nested(self):
        """The parameters as the agent nests them."""
        out = {}
        for name, part in self.parts.items():
            linear = [m for m in part if isinstance(m, torch.nn.Linear)]
            out[name] = {
                f"Dense_{i}": {"kernel": m.weight.detach().numpy(), "bias": m.bias.detach().numpy()}
                for i, m in enumerate(linear)
            }
            slopes = [m.weight.item() for m in part if isinstance(m, torch.nn.PReLU)]
            if slopes:
                out[name]["prelu_slope"] = np.float32(slopes[0])
        return out


class TorchDuelingDDQN(TorchDDQN):
    """The agent of `torch_ddqn.py` with that network."""

    def network(self, params):
        return DuelingNet(params, self.config.activation)


def main():
    arrays = {}
    for activation in ACTIVATIONS:
        config = config_with(activation)
        arrays |= golden(activation, config, nested_params(config), TorchDuelingDDQN)
    np.savez(GOLDEN, **arrays)


if __name__ == "__main__":
    main()
