"""The PPO agent in torch: makes the golden numbers that `test_ppo.py` holds sejax against."""

import jax
import numpy as np
import torch
from support import raveled
from test_ppo import CONFIG, CONFIGS, GOLDEN, KEY, KINDS, MAX_ACTION, STEPS, ppo, random_steps
from torch_networks import TorchMLP, tensors, write_golden

from sejax.agents.ppo import shuffled


def loss_fn(log_prob, entropy, value, old_log_prob, returns, advantage=None):
    ratio = torch.exp(log_prob - old_log_prob)
    advantage = (returns - value).detach() if advantage is None else normalized(advantage)
    clipped = ratio.clamp(1 - CONFIG.clip_ratio, 1 + CONFIG.clip_ratio)
    surrogate = torch.min(ratio * advantage, clipped * advantage)
    error = torch.nn.functional.mse_loss(value, returns)
    terms = -surrogate + CONFIG.value_weight * error - CONFIG.entropy_weight * entropy
    return terms.mean()


def normalized(x):
    return (x - x.mean()) / (x.std() + 1e-5)


class TorchPPO:
    """The same agent in torch, from the same parameters."""

    def __init__(self, kind, params):
        self.kind, self.config = kind, CONFIGS[kind]
        self.actor, self.critic = (
            TorchMLP(params[name]["params"], "tanh") for name in ("actor", "critic")
        )
        self.std = torch.nn.Parameter(torch.tensor(np.array(params["std"])))
        parameters = [*self.actor.parameters(), *self.critic.parameters(), self.std]
        self.parameters = parameters
        self.returns = []  # of all rollouts
        self.optimizer = torch.optim.Adam(
            parameters, lr=CONFIG.learning_rate, eps=self.config.adam_eps
        )

    def evaluate(self, obs, action):
        if self.kind != "continuous":
            policy = torch.distributions.Categorical(logits=self.actor(obs))
            return policy.log_prob(action.long()), policy.entropy()
        policy = torch.distributions.Normal(torch.tanh(self.actor(obs)) * MAX_ACTION, self.std)
        return policy.log_prob(action).sum(1), policy.entropy().sum(1)

    def update(self, steps, ended):
        steps = tensors(steps)
        old_log_prob = self.evaluate(steps.obs, steps.action)[0].detach()
        if self.config.advantages == "gae":
            returns, advantage = self.bootstrapped(steps, ended)
        else:
            returns, advantage = self.monte_carlo(steps, ended), None
        moved = []
        for rows in self.minibatches():
            log_prob, entropy = self.evaluate(steps.obs[rows], steps.action[rows])
            value = self.critic(steps.obs[rows])[:, 0]
            part = None if advantage is None else advantage[rows]
            loss = loss_fn(log_prob, entropy, value, old_log_prob[rows], returns[rows], part)
            moved.append((torch.exp(log_prob - old_log_prob[rows]) - 1).abs())
            self.optimizer.zero_grad()
            loss.backward()
            if self.config.max_grad_norm is not None:
                torch.nn.utils.clip_grad_norm_(self.parameters, self.config.max_grad_norm)
            self.optimizer.step()
        moved = torch.cat(moved[1:])
        assert (moved > CONFIG.clip_ratio).any() and (moved < CONFIG.clip_ratio).any()

    def minibatches(self):
        """The steps that each Adam step learns from; which ones is a matter of sejax's draw."""
        config = self.config
        if config.num_minibatches == 1:
            return [slice(None)] * config.epochs
        order = shuffled(KEY, config.epochs, config.num_minibatches, STEPS)
        return [torch.tensor(np.array(rows)).long() for rows in order]

    @torch.no_grad()
    def bootstrapped(self, steps, ended):
        """Returns of TD(lambda) and generalised advantages."""
        discounts = self.config.discount * steps.discount
        reward = steps.reward
        if self.config.normalize_rewards:
            later = 0.0
            for t in reversed(range(len(ended))):
                later = reward[t] + discounts[t] * (0.0 if ended[t] else later)
                self.returns.append(later)
            reward = reward / torch.stack(self.returns).std(correction=0)
        advantage, later = [], 0.0
        value, next_value = self.critic(steps.obs)[:, 0], self.critic(steps.next_obs)[:, 0]
        for t in reversed(range(len(ended))):
            delta = reward[t] + discounts[t] * next_value[t] - value[t]
            later = delta + discounts[t] * self.config.gae_lambda * (0.0 if ended[t] else later)
            advantage.insert(0, later)
        advantage = torch.stack(advantage)
        return advantage + value, advantage

    def monte_carlo(self, steps, ended):
        """Normalised returns."""
        returns, later = [], 0.0
        for r, end in zip(reversed(steps.reward.tolist()), reversed(ended), strict=True):
            later = r + CONFIG.discount * (0.0 if end else later)
            returns.insert(0, later)
        return normalized(torch.tensor(returns))

    def flat(self):
        actor, critic = ({"params": x.nested()} for x in (self.actor, self.critic))
        std = self.std.detach().numpy()
        return {"params": raveled({"actor": actor, "critic": critic, "std": std})}


def initial(kind):
    agent = ppo(kind)
    return TorchPPO(kind, agent.init(jax.random.key(1), agent.hparams).params)


if __name__ == "__main__":
    write_golden(GOLDEN, {kind: initial(kind) for kind in KINDS}, (0, 1, 2), random_steps)
