"""The dueling network in torch: makes the golden numbers that `test_ddqn.py` compares with.

The rest of the agent is that of `torch_ddqn.py`.
"""

import torch
from test_ddqn import DUELING_CASES, GOLDEN
from torch_ddqn import TorchDDQN, write
from torch_networks import TorchMLP

PARTS = ("features", "value", "advantage")


class DuelingNet(torch.nn.Module):
    """Each part is a network of its own, from the same parameters."""

    def __init__(self, params, activation):
        super().__init__()
        self.parts = torch.nn.ModuleDict(
            {name: TorchMLP(params[name], activation) for name in PARTS}
        )

    def forward(self, x):
        features = self.parts["features"](x)
        advantage = self.parts["advantage"](features)
        return self.parts["value"](features) + advantage - advantage.mean(1, keepdim=True)

    def nested(self):
        """The parameters as the agent nests them."""
        return {name: part.nested() for name, part in self.parts.items()}


class TorchDuelingDDQN(TorchDDQN):
    """The agent of `torch_ddqn.py` with that network."""

    def network(self, params):
        return DuelingNet(params, self.config.activation)


if __name__ == "__main__":
    write(GOLDEN / "dueling_updates.npz", DUELING_CASES, TorchDuelingDDQN)
