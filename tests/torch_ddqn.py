"""The DDQN agent in torch: makes the golden numbers that `test_ddqn.py` holds sejax against."""

import jax
import torch
from support import raveled
from test_ddqn import (
    CASES,
    DUELING_CASES,
    GOLDEN,
    NUM_ACTIONS,
    OBS_DIM,
    nested_params,
    random_batch,
)
from torch_networks import TorchMLP, follow, tensors, write_golden

from sejax.agents.dqn import DDQN

PARTS = ("features", "value", "advantage")


class TorchDDQN:
    """The same agent in torch, from the same parameters."""

    def __init__(self, params, target_params, config):
        self.config = config
        self.online, self.target = self.network(params), self.network(target_params)
        self.optimizer = torch.optim.Adam(self.online.parameters(), lr=config.learning_rate)

    def network(self, params):
        return TorchMLP(params, self.config.activation)

    def update(self, batch):
        batch = tensors(batch)
        next_obs = batch.next_obs.T
        q = self.online(batch.obs.T).gather(1, batch.action.long()[:, None])[:, 0]
        with torch.no_grad():
            values = self.target(next_obs)
            if self.config.double:
                best = self.online(next_obs).argmax(1)
                value = values.gather(1, best[:, None])[:, 0]
            else:
                value = values.max(1).values
            goal = batch.reward + self.config.discount * batch.discount * value
        loss = torch.nn.functional.mse_loss(q, goal)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        follow(self.target, self.online, self.config.tau)

    def flat(self):
        """Parameters as the agent keeps them."""
        nets = {"params": self.online, "target_params": self.target}
        return {name: raveled(net.nested()) for name, net in nets.items()}


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
    """The same with the dueling network."""

    def network(self, params):
        return DuelingNet(params, self.config.activation)


def initial(case, config):
    agent, nested = DDQN(config, OBS_DIM, NUM_ACTIONS).agent(), nested_params(config)
    params = agent.init(jax.random.key(1), agent.hparams).params
    # Target and online network apart from the start, so that it shows which is used where.
    make = TorchDDQN if case in CASES else TorchDuelingDDQN
    return make(nested(params), nested(params[::-1]), config)


if __name__ == "__main__":
    references = {case: initial(case, config) for case, config in (CASES | DUELING_CASES).items()}
    write_golden(GOLDEN, references, (0, 1, 5), lambda case, number: [random_batch(number)])
