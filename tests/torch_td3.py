"""TD3 in torch, for both kinds of actions: makes the golden numbers of `test_td3.py`.

torch is large and not needed for the tests, so that what it computed is kept in the repository.
Remake it with `python tests/torch_td3.py` where torch is installed.
"""

import numpy as np
import torch
from test_td3 import (
    CASES,
    CHECKED_UPDATES,
    GOLDEN,
    MAX_ACTION,
    NAMES,
    case_batch,
    case_noise,
    initial_params,
    nested_params,
)

from sejax.agents.td3 import DiscreteTD3Config


class TorchMLP(torch.nn.Module):
    """The authors' layout: hidden layers that share an activation and a layer norm, and a head."""

    def __init__(self, params, config):
        super().__init__()
        self.layers = torch.nn.ModuleList()
        for i in range(config.num_layers + 1):
            kernel, bias = params[f"Dense_{i}"]["kernel"], params[f"Dense_{i}"]["bias"]
            layer = torch.nn.Linear(kernel.shape[1], kernel.shape[0])
            layer.weight.data = torch.tensor(np.array(kernel))
            layer.bias.data = torch.tensor(np.array(bias))
            self.layers.append(layer)
        self.activate = {
            "tanh": torch.nn.Tanh, "relu": torch.nn.ReLU,
            "leaky_relu": torch.nn.LeakyReLU, "prelu": torch.nn.PReLU,
        }[config.activation]()  # fmt: skip
        if config.activation == "prelu":
            self.activate.weight.data = torch.tensor([float(params["prelu_slope"])])
        self.norm = None
        if "LayerNorm_0" in params:
            self.norm = torch.nn.LayerNorm(config.hidden_size)
            self.norm.weight.data = torch.tensor(np.array(params["LayerNorm_0"]["scale"]))
            self.norm.bias.data = torch.tensor(np.array(params["LayerNorm_0"]["bias"]))

    def forward(self, x):
        for i, layer in enumerate(self.layers[:-1]):
            x = layer(x)
            if self.norm is not None and i > 0:
                x = self.norm(x)
            x = self.activate(x)
        return self.layers[-1](x)

    def nested(self):
        out = {
            f"Dense_{i}": {"kernel": m.weight.detach().numpy(), "bias": m.bias.detach().numpy()}
            for i, m in enumerate(self.layers)
        }
        if self.norm is not None:
            scale, bias = self.norm.weight.detach().numpy(), self.norm.bias.detach().numpy()
            out["LayerNorm_0"] = {"scale": scale, "bias": bias}
            out["width"] = np.float32(len(scale))
        if isinstance(self.activate, torch.nn.PReLU):
            out["prelu_slope"] = self.activate.weight.detach().numpy()[0]
        return out


class TorchTD3:
    """One agent; activations are `[batch, feature]`."""

    def __init__(self, params, config):
        self.config = config
        self.is_discrete = isinstance(config, DiscreteTD3Config)
        actor, critics, target_actor, target_critics = nested_params(config, params)
        self.actor, self.target_actor = TorchMLP(actor, config), TorchMLP(target_actor, config)
        self.critics = [TorchMLP(x, config) for x in critics]
        self.target_critics = [TorchMLP(x, config) for x in target_critics]
        rate = config.learning_rate
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), lr=rate)
        self.critic_optimizer = torch.optim.Adam(
            [p for critic in self.critics for p in critic.parameters()], lr=rate
        )
        self.num_updates = 0

    def policy(self, actor, obs, gumbel):
        outputs = actor(obs)
        if not self.is_discrete:
            return MAX_ACTION * torch.tanh(outputs)
        config = self.config
        schedule = torch.linspace(
            config.temperature, config.temperature * config.final_temperature,
            config.temperature_steps + 1,
        )  # fmt: skip
        temperature = schedule[min(self.num_updates, config.temperature_steps)]
        soft = torch.softmax((outputs + gumbel) / temperature, dim=-1)
        if not config.one_hot_actions:
            return soft
        hard = torch.nn.functional.one_hot(soft.argmax(-1), soft.shape[-1])
        return hard - soft.detach() + soft

    def update(self, batch, noise):
        self.num_updates += 1
        config = self.config
        obs, action, next_obs, smoothing, target_gumbel, gumbel = (
            None if x is None else torch.tensor(np.array(x)).T
            for x in (batch.obs, batch.action, batch.next_obs, *noise)
        )
        reward, discount, weight = (
            torch.tensor(np.array(x)) for x in (batch.reward, batch.discount, batch.weight)
        )
        counted = weight > 0

        def q_value(critic, obs, action):
            return critic(torch.cat([obs, action], dim=1))[:, 0]

        with torch.no_grad():
            smoothing = smoothing * config.target_noise_std
            smoothing = smoothing.clamp(-config.target_noise_clip, config.target_noise_clip)
            next_action = self.policy(self.target_actor, next_obs, target_gumbel)
            if self.is_discrete:
                next_action = next_action + smoothing
            else:
                next_action = next_action + smoothing * MAX_ACTION
                next_action = next_action.clamp(-MAX_ACTION, MAX_ACTION)
            next_q = [q_value(critic, next_obs, next_action) for critic in self.target_critics]
            goal = reward + config.discount * discount * torch.min(*next_q)
        loss = sum(
            torch.nn.functional.mse_loss(q_value(critic, obs, action)[counted], goal[counted])
            for critic in self.critics
        )
        self.critic_optimizer.zero_grad()
        loss.backward()
        self.critic_optimizer.step()
        if self.num_updates % config.policy_delay == 0:
            chosen = self.policy(self.actor, obs, gumbel)
            self.actor_optimizer.zero_grad()
            (-q_value(self.critics[0], obs, chosen)[counted].mean()).backward()
            self.actor_optimizer.step()
            self.move_targets()

    @torch.no_grad()
    def move_targets(self):
        tau = self.config.tau
        networks = [self.actor, *self.critics]
        targets = [self.target_actor, *self.target_critics]
        for network, target in zip(networks, targets, strict=True):
            for fast, slow in zip(network.parameters(), target.parameters(), strict=True):
                slow.copy_(tau * fast + (1 - tau) * slow)

    def flat(self):
        """Parameters as the agent keeps them."""
        from jax.flatten_util import ravel_pytree

        def rows(networks):
            return np.stack([ravel_pytree(x.nested())[0] for x in networks])

        return {
            "actor": rows([self.actor])[0],
            "critics": rows(self.critics),
            "target_actor": rows([self.target_actor])[0],
            "target_critics": rows(self.target_critics),
        }


def main():
    """Writes all parameters after some of the updates on the test's batches and noise."""
    arrays = {}
    for case, config in CASES.items():
        reference = TorchTD3(initial_params(config), config)
        for number in range(1, max(CHECKED_UPDATES) + 1):
            reference.update(case_batch(config, number), case_noise(config, number))
            if number in CHECKED_UPDATES:
                after = reference.flat()
                arrays |= {f"{case}/{name}/{number}": after[name].copy() for name in NAMES}
    np.savez(GOLDEN, **arrays)


if __name__ == "__main__":
    main()
