"""The DDQN agent in torch: makes the golden numbers that `test_ddqn.py` holds sejax against.

torch is large and not needed for the tests, so that what it computed is kept in the repository.
Remake it with `python tests/torch_ddqn.py` where torch is installed.
"""

import jax
import numpy as np
import torch
from jax.flatten_util import ravel_pytree
from test_ddqn import CASES, GOLDEN, NUM_ACTIONS, OBS_DIM, nested_params, random_batch
from torch_networks import TorchMLP, follow

from sejax.agents.buffers import Transition
from sejax.agents.dqn import make_ddqn

NUM_UPDATES = 5


class TorchDDQN:
    """The same agent in torch, from the same parameters."""

    def __init__(self, params, target_params, config):
        self.config = config
        self.online, self.target = self.network(params), self.network(target_params)
        self.optimizer = torch.optim.Adam(self.online.parameters(), lr=config.learning_rate)
        self.num_updates = 0

    def network(self, params):
        return TorchMLP(params, self.config.activation)

    def update(self, batch):
        tensors = Transition(*(torch.tensor(np.array(x)) for x in batch))
        obs, next_obs = tensors.obs.T, tensors.next_obs.T
        q = self.online(obs)
        q = q.gather(1, tensors.action.long()[:, None])[:, 0]
        with torch.no_grad():
            values = self.target(next_obs)
            if self.config.double:
                best = self.online(next_obs).argmax(1)
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
        if self.num_updates % self.config.target_update_every == 0:
            follow(self.target, self.online, self.config.tau)


def golden(case, config, nested, make_reference=TorchDDQN):
    """Parameters before, after one, and after five updates on the test's batches."""
    agent = make_ddqn(config, OBS_DIM, NUM_ACTIONS)
    params = agent.init(jax.random.key(1), agent.hparams).params
    # Target and online network apart from the start, so that it shows which is used where.
    target_params = params[::-1]
    reference = make_reference(nested(params), nested(target_params), config)
    arrays = {f"{case}/params/0": params, f"{case}/target_params/0": target_params}
    for number in range(1, NUM_UPDATES + 1):
        reference.update(random_batch(number))
        if number in (1, NUM_UPDATES):
            for name, net in (("params", reference.online), ("target_params", reference.target)):
                arrays[f"{case}/{name}/{number}"] = ravel_pytree(net.nested())[0]
    return {name: np.array(x) for name, x in arrays.items()}


def main():
    arrays = {}
    for case, config in CASES.items():
        arrays |= golden(case, config, nested_params(config))
    np.savez(GOLDEN / "ddqn_updates.npz", **arrays)


if __name__ == "__main__":
    main()
