"""The curiosity module in torch: makes the golden numbers that `test_icm.py` compares with."""

import jax
import torch
from support import raveled
from test_icm import CONFIG, GOLDEN, KINDS, WIDTH, curious, random_batch
from torch.nn import functional
from torch_networks import TorchMLP, dense_arrays, linear, tensors, write_golden


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
        self.optimizer = torch.optim.Adam(self.parameters(), lr=CONFIG.learning_rate)
        self.bonus = {}  # of the last batch

    def forward(self, obs, action, next_obs):
        features, next_features = self.features(obs), self.features(next_obs)
        x = self.before(torch.cat([features, action], 1))
        for first, second in zip(self.blocks[::2], self.blocks[1::2], strict=True):
            hidden = functional.leaky_relu(first(torch.cat([x, action], 1)))
            x = x + second(torch.cat([hidden, action], 1))
        inverse = self.inverse(torch.cat([features, next_features], 1))
        return next_features, self.after(x), inverse

    def update(self, batch):
        """One step of Adam; `bonus` has that of the batch after it."""
        batch = tensors(batch)
        obs, next_obs = batch.obs.T, batch.next_obs.T
        if batch.action.ndim == 1:
            wanted, inverse_loss_fn = batch.action.long(), functional.cross_entropy
            action = functional.one_hot(wanted, WIDTH).float()
        else:
            wanted = action = batch.action.T
            inverse_loss_fn = functional.mse_loss
        next_features, predicted, inverse = self(obs, action, next_obs)
        beta = CONFIG.forward_weight
        forward_loss = functional.mse_loss(predicted, next_features)
        loss = (1 - beta) * inverse_loss_fn(inverse, wanted) + beta * forward_loss
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        with torch.no_grad():
            next_features, predicted, _ = self(obs, action, next_obs)
            bonus = CONFIG.reward_scale * ((next_features - predicted) ** 2).mean(1)
        self.bonus = {"bonus": bonus.numpy()}

    def flat(self):
        """The parameters as the agent keeps them, and the bonuses of the last batch."""
        forward = {"MLP_0": self.before.nested(), "MLP_1": self.after.nested()}
        forward |= dense_arrays(self.blocks)
        nets = {"features": self.features.nested(), "inverse": self.inverse.nested()}
        return {"params": raveled(nets | {"forward": forward}), **self.bonus}


def initial(kind):
    agent = curious(kind)
    return TorchICM(agent.init(jax.random.key(1), agent.hparams).params["params"])


if __name__ == "__main__":
    write_golden(
        GOLDEN, {kind: initial(kind) for kind in KINDS}, (0, 1, 5),
        lambda kind, number: [random_batch(number, kind)],
    )  # fmt: skip
