"""TD3 in torch, for both kinds of actions: makes the golden numbers of `test_td3.py`."""

import functools

import jax
import numpy as np
import torch
from support import raveled
from test_td3 import (
    CASES,
    CHECKED_UPDATES,
    GOLDEN,
    MAX_ACTION,
    case_batch,
    case_noise,
    initial_params,
)
from torch_networks import TorchMLP, follow, tensors, write_golden

from sejax.agents.td3 import DiscreteTD3Config


class TorchTD3:
    """One agent; activations are `[batch, feature]`."""

    def __init__(self, params, config):
        self.config = config
        self.is_discrete = isinstance(config, DiscreteTD3Config)
        network = functools.partial(TorchMLP, activation=config.activation)
        nested = {name: x["params"] for name, x in params.items()}
        self.actor, self.target_actor = network(nested["actor"]), network(nested["target_actor"])
        self.critics, self.target_critics = (
            [network(jax.tree.map(lambda x, i=i: x[i], nested[name])) for i in range(2)]
            for name in ("critics", "target_critics")
        )
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
        batch, noise = tensors((batch, noise))
        obs, action, next_obs, smoothing, target_gumbel, gumbel = (
            None if x is None else x.T for x in (batch.obs, batch.action, batch.next_obs, *noise)
        )
        counted = batch.weight > 0

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
            goal = batch.reward + config.discount * batch.discount * torch.min(*next_q)
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
            targets = self.target_actor, *self.target_critics
            for slow, fast in zip(targets, (self.actor, *self.critics), strict=True):
                follow(slow, fast, config.tau)

    def flat(self):
        """Parameters as the agent keeps them."""
        return {
            "actor": raveled(self.actor.nested()),
            "critics": np.stack([raveled(x.nested()) for x in self.critics]),
            "target_actor": raveled(self.target_actor.nested()),
            "target_critics": np.stack([raveled(x.nested()) for x in self.target_critics]),
        }


if __name__ == "__main__":
    references = {case: TorchTD3(initial_params(config), config) for case, config in CASES.items()}
    write_golden(
        GOLDEN, references, CHECKED_UPDATES,
        lambda case, number: (case_batch(CASES[case], number), case_noise(CASES[case], number)),
    )  # fmt: skip
