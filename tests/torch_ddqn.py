"""The DDQN agent in torch, as an independent reference for one learning step."""

import numpy as np
import torch

from sejax.agents.replay import Transition


class TorchDDQN:
    """The same agent in torch, from the same parameters."""

    def __init__(self, params, target_params, config):
        self.config = config
        self.online, self.slope = self._network(params)
        self.target, self.target_slope = self._network(target_params)
        parameters = [*self.online.parameters()] + ([self.slope] if self.slope is not None else [])
        self.optimizer = torch.optim.Adam(parameters, lr=config.learning_rate)

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
            best = self.q_values(self.online, self.slope, next_obs).argmax(1)
            values = self.q_values(self.target, self.target_slope, next_obs)
            value = values.gather(1, best[:, None])[:, 0]
            goal = tensors.reward + self.config.discount * tensors.discount * value
        loss = torch.nn.functional.mse_loss(q, goal)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        tau = self.config.target_update_rate
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
