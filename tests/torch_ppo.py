"""The PPO agent in torch: makes the golden numbers that `test_ppo.py` holds sejax against.

torch is large and not needed for the tests, so that what it computed is kept in the repository.
Remake it with `python tests/torch_ppo.py` where torch is installed.
"""

import jax
import numpy as np
import torch
from jax.flatten_util import ravel_pytree
from test_ppo import CONFIG, GOLDEN, KINDS, MAX_ACTION, loss_inputs, networks, ppo, random_steps

NUM_PHASES = 2


def loss_fn(log_prob, entropy, value, old_log_prob, returns):
    ratio = torch.exp(log_prob - old_log_prob)
    advantage = (returns - value).detach()
    clipped = ratio.clamp(1 - CONFIG.clip_ratio, 1 + CONFIG.clip_ratio)
    surrogate = torch.min(ratio * advantage, clipped * advantage)
    error = torch.nn.functional.mse_loss(value, returns)
    terms = -surrogate + CONFIG.value_weight * error - CONFIG.entropy_weight * entropy
    return terms.mean()


class TorchPPO:
    """The same agent in torch, from the same parameters."""

    def __init__(self, kind, params):
        self.kind = kind
        self.actor, self.critic = (self._network(params[name]) for name in ("actor", "critic"))
        self.std = torch.nn.Parameter(torch.tensor(np.array(params["std"])))
        parameters = [*self.actor.parameters(), *self.critic.parameters(), self.std]
        self.optimizer = torch.optim.Adam(parameters, lr=CONFIG.learning_rate)

    def _network(self, params):
        layers = []
        for i in range(CONFIG.num_layers + 1):
            kernel, bias = (np.array(params["params"][f"Dense_{i}"][x]) for x in ("kernel", "bias"))
            layer = torch.nn.Linear(kernel.shape[1], kernel.shape[0])
            layer.weight.data, layer.bias.data = torch.tensor(kernel), torch.tensor(bias)
            layers += [layer, torch.nn.Tanh()]
        return torch.nn.Sequential(*layers[:-1])

    def evaluate(self, obs, action):
        if self.kind == "discrete":
            policy = torch.distributions.Categorical(logits=self.actor(obs))
            return policy.log_prob(action.long()), policy.entropy()
        policy = torch.distributions.Normal(torch.tanh(self.actor(obs)) * MAX_ACTION, self.std)
        return policy.log_prob(action).sum(1), policy.entropy().sum(1)

    def learn(self, obs, action, reward, ended):
        returns, later = [], 0.0
        for r, end in zip(reversed(reward.tolist()), reversed(ended.tolist()), strict=True):
            later = r + CONFIG.discount * (0.0 if end else later)
            returns.insert(0, later)
        returns = torch.tensor(returns)
        returns = (returns - returns.mean()) / (returns.std() + 1e-5)
        old_log_prob = self.evaluate(obs, action)[0].detach()
        for _ in range(CONFIG.epochs):
            log_prob, entropy = self.evaluate(obs, action)
            value = self.critic(obs)[:, 0]
            loss = loss_fn(log_prob, entropy, value, old_log_prob, returns)
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
        moved = (torch.exp(log_prob - old_log_prob) - 1).abs()
        assert (moved > CONFIG.clip_ratio).any() and (moved < CONFIG.clip_ratio).any()

    def flat(self):
        def arrays(network):
            linear = [layer for layer in network if isinstance(layer, torch.nn.Linear)]
            return {
                "params": {
                    f"Dense_{i}": {
                        "kernel": layer.weight.detach().numpy(),
                        "bias": layer.bias.detach().numpy(),
                    }
                    for i, layer in enumerate(linear)
                }
            }

        nested = {
            "actor": arrays(self.actor),
            "critic": arrays(self.critic),
            "std": self.std.detach().numpy(),
        }
        return ravel_pytree(nested)[0]


def loss_arrays():
    """The loss of the test's inputs and its gradients."""
    inputs = {name: torch.tensor(np.array(x)) for name, x in loss_inputs().items()}
    wanted = ("log_prob", "entropy", "value")
    for name in wanted:
        inputs[name].requires_grad_()
    loss = loss_fn(**inputs)
    gradients = torch.autograd.grad(loss, [inputs[name] for name in wanted])
    named = {f"loss/{name}": g.numpy() for name, g in zip(wanted, gradients, strict=True)}
    return {"loss": loss.item()} | named


def main():
    """Writes the loss, and the parameters before and after each learning phase."""
    arrays = loss_arrays()
    for kind in KINDS:
        _, _, unravel = networks(kind)
        agent = ppo(kind)
        params = agent.init(jax.random.key(1), agent.hparams).params
        reference = TorchPPO(kind, unravel(params))
        arrays[f"{kind}/params/0"] = params
        for number in range(1, NUM_PHASES + 1):
            steps, ended = random_steps(kind, number)
            columns = (steps.obs, steps.action, steps.reward, ended)
            reference.learn(*(torch.tensor(np.array(x)) for x in columns))
            arrays[f"{kind}/params/{number}"] = reference.flat()
    np.savez(GOLDEN, **{name: np.asarray(x) for name, x in arrays.items()})


if __name__ == "__main__":
    main()
