"""The dueling network in torch: makes the golden numbers that `test_dueling.py` compares with.

The rest of the agent is that of `torch_ddqn.py`. Remake them with `python tests/torch_dueling.py`
where torch is installed.
"""

import jax
import numpy as np
import torch
from jax.flatten_util import ravel_pytree
from test_ddqn import OBS_DIM, random_batch
from test_dueling import ACTIVATIONS, GOLDEN, NUM_ACTIONS, config_with, nested_params
from torch_ddqn import NUM_UPDATES, TorchDDQN

from sejax.agents.dqn import make_ddqn

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

    def arrays(self):
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
    """The agent of `torch_ddqn.py` with that network, which keeps its slopes itself."""

    def _network(self, params):
        return DuelingNet(params, self.config.activation), None

    def q_values(self, network, slope, x):
        return network(x)


def main():
    """Writes the parameters before, after one, and after five updates on the test's batches."""
    arrays = {}
    for activation in ACTIVATIONS:
        config = config_with(activation)
        nested = nested_params(config)
        agent = make_ddqn(config, OBS_DIM, NUM_ACTIONS)
        params = agent.init(jax.random.key(1), agent.hparams).params
        # Target and online network apart from the start, so that it shows which is used where.
        target_params = params[::-1]
        reference = TorchDuelingDDQN(nested(params), nested(target_params), config)
        arrays |= {f"{activation}/params/0": params, f"{activation}/target_params/0": target_params}
        for number in range(1, NUM_UPDATES + 1):
            reference.update(random_batch(number))
            if number in (1, NUM_UPDATES):
                for name, net in (
                    ("params", reference.online),
                    ("target_params", reference.target),
                ):
                    arrays[f"{activation}/{name}/{number}"], _ = ravel_pytree(net.arrays())
    np.savez(GOLDEN, **{name: np.asarray(x) for name, x in arrays.items()})


if __name__ == "__main__":
    main()
