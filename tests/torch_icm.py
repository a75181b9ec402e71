"""The curiosity module in torch: makes the golden numbers that `test_icm.py` compares with.

Remake them with `python tests/torch_icm.py` where torch is installed.
"""

import jax
import numpy as np
import torch
from support import raveled
from test_icm import CONFIG, GOLDEN, KINDS, WIDTH, curious, model_of, random_batch
from torch.nn import functional
from torch_networks import TorchMLP, dense_arrays, linear

NUM_UPDATES = 5


class TorchICM(torch.nn.Module):
    """The three models from the same parameters; inputs are `[batch, feature]`."""

    def __init__(self, params):
        super().__init__()
        forward = params["forward"]
        blocks = [linear(forward[f"Dense_{i}"]) for i in range(2 * CONFIG.num_residual_blocks)]
        self.features = TorchMLP(params["features"], "leaky_relu")
        self.inverse = TorchMLP(params["inverse"], "relu")
        self.before = TorchMLP(forward["MLP_0"], "leaky_relu")
        self.blocks = torch.nn.ModuleList(blocks)
        self.after = TorchMLP(forward["MLP_1"], "leaky_relu")

    def forward(self, obs, action, next_obs):
        features, next_features = self.features(obs), self.features(next_obs)
        x = self.before(torch.cat([features, action], 1))
        for first, second in zip(self.blocks[::2], self.blocks[1::2], strict=True):
            hidden = functional.leaky_relu(first(torch.cat([x, action], 1)))
            x = x + second(torch.cat([hidden, action], 1))
        inverse = self.inverse(torch.cat([features, next_features], 1))
        return next_features, self.after(x), inverse

    def arrays(self):
        """The parameters as flax nests them."""
        forward = {"MLP_0": self.before.nested(), "MLP_1": self.after.nested()}
        forward |= dense_arrays(self.blocks)
        nets = {"features": self.features.nested(), "inverse": self.inverse.nested()}
        return {"params": nets | {"forward": forward}}


def tensors(batch):
    """Observations, actions as the models take them, and next observations, rows-major."""
    obs, next_obs = (torch.tensor(np.array(x)).T for x in (batch.obs, batch.next_obs))
    action = torch.tensor(np.array(batch.action))
    if action.ndim == 1:
        return obs, functional.one_hot(action.long(), WIDTH).float(), next_obs
    return obs, action.T, next_obs


def train(model, optimizer, batch):
    """One step of Adam; returns the bonus of the batch after it."""
    obs, action, next_obs = tensors(batch)
    next_features, predicted, inverse = model(obs, action, next_obs)
    if batch.action.ndim == 1:
        inverse_loss = functional.cross_entropy(
            inverse, torch.tensor(np.array(batch.action)).long()
        )
    else:
        inverse_loss = functional.mse_loss(inverse, action)
    beta = CONFIG.forward_weight
    loss = (1 - beta) * inverse_loss + beta * functional.mse_loss(predicted, next_features)
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    with torch.no_grad():
        next_features, predicted, _ = model(obs, action, next_obs)
        return CONFIG.reward_scale * ((next_features - predicted) ** 2).mean(1)


def main():
    """Writes parameters and bonuses after one and five updates on the test's batches."""
    arrays = {}
    _, unravel = model_of(CONFIG)
    for kind in KINDS:
        agent = curious(kind)
        params = agent.init(jax.random.key(1), agent.hparams).params
        arrays[f"{kind}/params/0"] = params
        model = TorchICM(unravel(params)["params"])
        optimizer = torch.optim.Adam(model.parameters(), lr=CONFIG.learning_rate)
        for number in range(1, NUM_UPDATES + 1):
            bonus = train(model, optimizer, random_batch(number, kind))
            if number in (1, NUM_UPDATES):
                arrays[f"{kind}/params/{number}"] = raveled(model.arrays())
                arrays[f"{kind}/bonus/{number}"] = bonus.numpy()
    np.savez(GOLDEN, **{name: np.asarray(x) for name, x in arrays.items()})


if __name__ == "__main__":
    main()
