"""Many agents at once in PyTorch, as `gpu.py` compares with: DDQN on an SE of three networks.

What a good PyTorch programmer would write for a GPU: the agents' parameters are stacked,
`torch.func.vmap` makes one batched product of each layer, and all agents take each step together.
Loss, networks and SE are those of `torch_reference.py`. Agents learn from the first step on
(`warmup_episodes=0`), and none stops at a number that is not finite.
"""

import dataclasses
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.func import grad, vmap
from torch_reference import (
    ABSURD,
    MAX_STEPS,
    NUM_ACTIONS,
    OBS_DIM,
    Batch,
    SyntheticEnv,
    ddqn_loss,
    init_mlp,
    mlp,
)

from sejax.agents.dqn import DDQNConfig

BUILT = (
    *("batch_size", "buffer_size", "hidden_size", "num_layers", "activation", "learning_rate"),
    *("tau", "discount", "epsilon_init", "epsilon_min", "epsilon_decay"),
)  # hyperparameters; of them the buffer is never full


class Agents:
    """DDQN agents side by side; every array has the agents as its first axis.

    Attributes:
      online, target: parameters of `mlp`.
    """

    def __init__(self, networks: list[list[Tensor]], config: DDQNConfig, device: str):
        stacked = [torch.stack(each).to(device) for each in zip(*networks, strict=True)]
        self.online, self.target = stacked, [x.clone() for x in stacked]
        self._config = config
        self._optimizer = torch.optim.Adam(self.online, lr=config.learning_rate, fused=True)

    def values(self, obs: Tensor) -> Tensor:
        """Q values `[agent, action]` of an observation each, `[agent, obs_dim]`."""
        return vmap(lambda params, x: mlp(params, x, self._config.activation))(self.online, obs)

    def update(self, batch: Batch) -> None:
        """One step of Adam on each agent's own batch, and one soft update of the targets."""

        def loss(online: list[Tensor], target: list[Tensor], *mine: Tensor) -> Tensor:
            state: Any = SimpleNamespace(
                online=SimpleNamespace(params=online, values=online), target=target
            )
            return ddqn_loss(state, Batch(*mine), self._config)

        gradients = vmap(grad(loss))(self.online, self.target, *batch)
        for param, gradient in zip(self.online, gradients, strict=True):
            param.grad = gradient
        self._optimizer.step()
        torch._foreach_lerp_(self.target, self.online, self._config.tau)


class Step(NamedTuple):
    """What a step of the SE makes, `[agent, ...]`."""

    next_obs: Tensor
    reward: Tensor
    discount: Tensor  # for the target
    terminated: Tensor


def take(env: SyntheticEnv, obs: Tensor, action: Tensor) -> Step:
    """A step of each agent in the SE; an absurd number ends the episode where it was."""
    out = env.outputs(obs, action)
    absurd = ~(out.abs().amax(1, keepdim=True) < ABSURD)  # not a number either
    terminated = absurd | (out[:, -1:] > 0.5)
    discount = 1.0 - out[:, -1:] if env.soft else 1.0 - terminated.float()
    return Step(
        next_obs=torch.where(absurd, obs, out[:, :OBS_DIM]),
        reward=torch.where(absurd, 0.0, out[:, -2:-1]),
        discount=torch.where(absurd, 0.0, discount),
        terminated=terminated,
    )


WIDTHS = (OBS_DIM, OBS_DIM, 1, 1, 1)  # of the parts of a stored row, as in `Batch`


def packed(obs: Tensor, action: Tensor, step: Step) -> Tensor:
    """Transitions as rows `[agent, sum(WIDTHS)]`."""
    return torch.cat([obs, step.next_obs, action[:, None].float(), step.reward, step.discount], 1)


def drawn(stored: Tensor, num_stored: int, batch_size: int) -> Batch:
    """A batch of each agent, `[agent, batch, ...]`, of rows `[step, agent, sum(WIDTHS)]`."""
    num_agents, device = stored.shape[1], stored.device
    rows = torch.randint(num_stored, (batch_size, num_agents), device=device)
    parts = stored[rows, torch.arange(num_agents, device=device)].transpose(0, 1)
    obs, next_obs, action, reward, discount = parts.split(WIDTHS, dim=2)
    return Batch(obs, next_obs, action.long(), reward, discount)


@torch.no_grad()
def train(
    env: SyntheticEnv, config: DDQNConfig, num_agents: int, num_steps: int, device: str
) -> int:
    """Trains agents for so many steps each, and returns the steps of all.

    Episodes begin as CartPole's do.

    Raises:
      ValueError: if the configuration asks for what is not built here.
    """
    built = DDQNConfig(**{name: getattr(config, name) for name in BUILT})
    if config != dataclasses.replace(built, warmup_episodes=config.warmup_episodes):
        raise ValueError(f"only these hyperparameters are built: {', '.join(BUILT)}.")
    sizes = [OBS_DIM, *[config.hidden_size] * config.num_layers, NUM_ACTIONS]
    networks = [init_mlp(sizes, config.activation) for _ in range(num_agents)]
    agents = Agents(networks, config, device)
    stored = torch.zeros(num_steps, num_agents, sum(WIDTHS), device=device)
    obs = starts(num_agents, device)
    time = torch.zeros(num_agents, device=device)
    epsilon = torch.full((num_agents,), config.epsilon_init, device=device)
    for i in range(num_steps):
        explores = torch.rand(num_agents, device=device) < epsilon
        random = torch.randint(NUM_ACTIONS, (num_agents,), device=device)
        action = torch.where(explores, random, agents.values(obs).argmax(1))
        step = take(env, obs, action)
        stored[i] = packed(obs, action, step)
        time += 1
        ended = step.terminated[:, 0] | (time >= MAX_STEPS)
        obs = torch.where(ended[:, None], starts(num_agents, device), step.next_obs)
        time = torch.where(ended, 0.0, time)
        decayed = (epsilon * config.epsilon_decay).clamp(min=config.epsilon_min)
        epsilon = torch.where(ended, decayed, epsilon)
        agents.update(drawn(stored, i + 1, config.batch_size))
    agents.online[0].sum().item()  # waits for the device
    return num_agents * num_steps


def starts(num: int, device: str) -> Tensor:
    """First observations of CartPole, `[num, 4]`."""
    return 0.1 * torch.rand(num, OBS_DIM, device=device) - 0.05
