"""The DDQN agent in torch: makes the golden numbers that `test_ddqn.py` holds sejax against.

torch is large and not needed for the tests, so that what it computed is kept in the repository.
Remake it with `python tests/torch_ddqn.py` where torch is installed.
"""

import jax
import numpy as np
import torch
from test_ddqn import CASES, GOLDEN, NUM_ACTIONS, OBS_DIM, q_network, random_batch

from sejax.agents.buffers import Transition
from sejax.agents.dqn import make_ddqn

NUM_UPDATES = 5


class TorchDDQN:
    """The same agent in torch, from the same parameters."""

    def __init__(self, params, target_params, config):
        self.config = config
        self.online, self.slope = self._network(params)
        self.target, self.target_slope = self._network(target_params)
        parameters = [*self.online.parameters()] + ([self.slope] if self.slope is not None else [])
        self.optimizer = torch.optim.Adam(parameters, lr=config.learning_rate)
        self.num_updates = 0

    def _network(self, params):
        layers = []
        for i in range(self.config.num_layers + 1):
            kernel, bias = params[f"Dense_{i}"]["kernel"], params[f"Dense_{i}"]["bias"]
            layer = torch.nn.Linear(kernel.shape[1], kernel.shape[0])
            layer.weight.data = torch.tensor(np.array(kernel))
            layer.bias.data = torch.tensor(np.array(bias))
            layers.append(layer)
        slope = params.get("prelu_slope")
        slope = None if slope is None else torch.nn.Parameter(torch.tensor([float(slope)]))
        return torch.nn.ModuleList(layers), slope

    def q_values(self, layers, slope, x):
        activate = {
            "tanh": torch.tanh,
            "relu": torch.relu,
            "leaky_relu": torch.nn.functional.leaky_relu,
            "prelu": lambda h: torch.nn.functional.prelu(h, slope),
        }[self.config.activation]
        for layer in layers[:-1]:
            x = activate(layer(x))
        return layers[-1](x)

    def update(self, batch):
        tensors = Transition(*(torch.tensor(np.array(x)) for x in batch))
        obs, next_obs = tensors.obs.T, tensors.next_obs.T
        q = self.q_values(self.online, self.slope, obs)
        q = q.gather(1, tensors.action.long()[:, None])[:, 0]
        with torch.no_grad():
            values = self.q_values(self.target, self.target_slope, next_obs)
            if self.config.double:
                best = self.q_values(self.online, self.slope, next_obs).argmax(1)
                value = values.gather(1, best[:, None])[:, 0]
            else:
                value = values.max(1).values
            goal = tensors.reward + self.config.discount * tensors.discount * value
        kinds = {"squared": torch.nn.functional.mse_loss,
                 "huber": torch.nn.functional.smooth_l1_loss}  # fmt: skip
        loss = kinds[self.config.loss](q, goal)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.num_updates += 1
        if self.num_updates % self.config.target_update_every:
            return
        tau = self.config.tau
        with torch.no_grad():
            pairs = [*zip(self.target.parameters(), self.online.parameters(), strict=True)]
            if self.slope is not None:
                pairs.append((self.target_slope, self.slope))
            for slow, fast in pairs:
                slow.copy_(tau * fast + (1 - tau) * slow)

    def arrays(self, layers, slope):
        out = {
            f"Dense_{i}": {"kernel": m.weight.detach().numpy(), "bias": m.bias.detach().numpy()}
            for i, m in enumerate(layers)
        }
        return out if slope is None else {**out, "prelu_slope": slope.detach().numpy()[0]}


def main():
    """Writes the parameters before, after one, and after five updates on the test's batches."""
    arrays = {}
    for case, config in CASES.items():
        _, nested = q_network(config)
        agent = make_ddqn(config, OBS_DIM, NUM_ACTIONS)
        params = agent.init(jax.random.key(1), agent.hparams).params
        # Target and online network apart from the start, so that it shows which is used where.
        target_params = params[::-1]
        reference = TorchDDQN(nested(params), nested(target_params), config)
        arrays |= {f"{case}/params/0": params, f"{case}/target_params/0": target_params}
        for number in range(1, NUM_UPDATES + 1):
            reference.update(random_batch(number))
            if number in (1, NUM_UPDATES):
                for name, layers, slope in (
                    ("params", reference.online, reference.slope),
                    ("target_params", reference.target, reference.target_slope),
                ):
                    flat, _ = jax.flatten_util.ravel_pytree(reference.arrays(layers, slope))
                    arrays[f"{case}/{name}/{number}"] = flat
    np.savez(GOLDEN, **{name: np.asarray(x) for name, x in arrays.items()})


if __name__ == "__main__":
    main()
