"""SAC in torch, for both kinds of actions: makes the golden numbers of `test_sac.py`.

Densities and entropies are those of torch's distributions, and each loss has an optimizer of its
own.
"""

import jax
import numpy as np
import torch
from support import raveled
from test_sac import ACTION_DIM, CASES, CHECKED_UPDATES, GOLDEN, case_batch, case_noise, state_of
from torch.distributions import Categorical, Independent, Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform
from torch_networks import TorchMLP, follow, tensors, write_golden


class TorchSAC:
    """One agent; activations are `[batch, feature]`."""

    def __init__(self, case):
        self.is_discrete, self.config = CASES[case]
        activation = self.config.activation
        params, target_critics = state_of(case).params, state_of(case).target_critics

        def pair(critics):
            return torch.nn.ModuleList(
                TorchMLP(jax.tree.map(lambda x, i=i: x[i], critics["params"]), activation)
                for i in range(2)
            )

        self.actor = TorchMLP(params.actor["params"], activation)
        self.critics, self.target_critics = pair(params.critics), pair(target_critics)
        self.log_alpha = torch.nn.Parameter(torch.tensor(float(params.log_alpha)))
        self.optimizers = [
            torch.optim.Adam(parameters, lr=self.config.learning_rate)
            for parameters in (
                self.actor.parameters(), self.critics.parameters(), [self.log_alpha]
            )
        ]  # fmt: skip

    def alpha(self):
        fixed = self.config.alpha
        return fixed if fixed is not None else self.log_alpha.exp().detach()

    def soft_values(self, critics, obs, noise):
        """The lesser critic's value and the entropy."""
        outputs = self.actor(obs)
        if self.is_discrete:
            policy = Categorical(logits=outputs)
            q = torch.minimum(*(critic(obs) for critic in critics))
            return (policy.probs * q).sum(1), policy.entropy()
        mean, log_std = outputs.chunk(2, dim=1)
        gaussian = Normal(mean, log_std.clamp(-20, 2).exp())
        u = gaussian.mean + gaussian.stddev * noise
        squash = TanhTransform(cache_size=1)
        policy = Independent(TransformedDistribution(gaussian, [squash]), 1)
        action = squash(u)
        q = torch.minimum(*(self.q_value(critic, obs, action) for critic in critics))
        return q, -policy.log_prob(action)

    def q_value(self, critic, obs, action):
        if self.is_discrete:
            return critic(obs).gather(1, action[:, None])[:, 0]
        return critic(torch.cat([obs, action], dim=1))[:, 0]

    def update(self, batch, noise):
        config = self.config
        batch, noise = tensors((batch, noise))
        counted = batch.weight > 0
        (obs, action, reward, discount, next_obs), (next_noise, noise) = jax.tree.map(
            lambda x: x.T[counted], (batch[:5], tuple(noise))
        )
        action = action.long() if self.is_discrete else action
        with torch.no_grad():
            q, entropy = self.soft_values(self.target_critics, next_obs, next_noise)
            target = reward + config.discount * discount * (q + self.alpha() * entropy)
        critic_loss = sum(
            0.5 * torch.nn.functional.mse_loss(self.q_value(critic, obs, action), target)
            for critic in self.critics
        )
        q, entropy = self.soft_values(self.critics, obs, noise)
        actor_loss = (-self.alpha() * entropy - q).mean()
        goal = (
            config.target_entropy_fraction * np.log(ACTION_DIM)
            if self.is_discrete else config.target_entropy * ACTION_DIM
        )  # fmt: skip
        alpha_loss = (self.log_alpha * (entropy.detach() - goal)).mean()
        losses = [actor_loss, critic_loss, alpha_loss]
        groups = [list(self.actor.parameters()), list(self.critics.parameters()), [self.log_alpha]]
        gradients = [torch.autograd.grad(loss, group, retain_graph=True)
                     for loss, group in zip(losses, groups, strict=True)]  # fmt: skip
        if config.alpha is not None:
            del gradients[2]
        for optimizer, group, gradient in zip(self.optimizers, groups, gradients, strict=False):
            for parameter, value in zip(group, gradient, strict=True):
                parameter.grad = value
            optimizer.step()
        follow(self.target_critics, self.critics, config.tau)

    def flat(self):
        """Parameters as the agent keeps them."""

        def stacked(critics):
            return jax.tree.map(lambda *x: np.stack(x), *(critic.nested() for critic in critics))

        log_alpha = self.log_alpha.detach().numpy()
        return {
            "params": raveled([self.actor.nested(), stacked(self.critics), log_alpha]),
            "target_critics": raveled(stacked(self.target_critics)),
        }


if __name__ == "__main__":
    write_golden(
        GOLDEN, {case: TorchSAC(case) for case in CASES}, CHECKED_UPDATES,
        lambda case, number: (case_batch(case, number), case_noise(case, number)),
    )  # fmt: skip
