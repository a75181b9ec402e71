"""sejax's TD3 once more, in eager PyTorch, on an SE for Pendulum: the yardstick.

It means the same as `sejax.agents.td3` for continuous actions and takes its hyperparameters from
the same configuration. What is here, and how to be quick in eager PyTorch, is `torch_reference`'s.

What was tried for speed, in microseconds on one thread of an AVX-512 machine for one update of the
critics, loss to gradient; at the paper's hyperparameters (256 rows, two hidden layers of 128), and
at those of `preset=best` (64 rows, one hidden layer of 64):

- both critics as one batched product: 1,100 and 190, which is used here; one after the other 1,200
  and 270. The matrix products alone, at this core's rate for such shapes, take 600 of the 1,100.
"""

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch_reference import (
    ACTIVATIONS,
    Batch,
    ReplayBuffer,
    Step,
    SyntheticEnv,
    Trainable,
    TrainResult,
    init_mlp,
    mlp,
    train_for,
)

from sejax.agents.td3 import TD3Config
from sejax.training import TrainingConfig

OBS_DIM, ACTION_DIM, MAX_ACTION = 3, 1, 2.0  # Pendulum-v1


def train(env: SyntheticEnv, hp: TD3Config, training: TrainingConfig, seed: int) -> TrainResult:
    """Trains one agent on a Pendulum SE for `training.max_steps` steps.

    Raises:
      ValueError: if the configurations ask for what is not built here.
    """
    max_steps = training.max_steps
    if type(hp) is not TD3Config or training.stop_rule != "never" or max_steps is None:
        raise ValueError("the reference is of agent=td3, training.stop_rule=never, "
                         "training.max_steps=N.")  # fmt: skip
    torch.manual_seed(seed)
    rng = random.Random(seed)
    agent = TD3Agent(hp, max_steps)
    return train_for(env, agent, lambda: reset_pendulum(rng), max_steps)


def reset_pendulum(rng: random.Random) -> Tensor:
    """An initial observation: cosine and sine of the angle, and the speed."""
    angle, speed = rng.uniform(-math.pi, math.pi), rng.uniform(-1, 1)
    return torch.tensor([math.cos(angle), math.sin(angle), speed])


# --- networks ---------------------------------------------------------------------------------


def stack_critics(critics: Sequence[list[Tensor]]) -> list[Tensor]:
    """Parameters for `q_values` from those of each critic as `mlp` takes them.

    Weights become `[critic, in, out]`, biases `[critic, 1, out]`.
    """
    stacked = [torch.stack(leaves) for leaves in zip(*critics, strict=True)]
    weights = [weight.transpose(1, 2).contiguous() for weight in stacked[::2]]
    biases = [bias[:, None] for bias in stacked[1::2]]
    return [leaf for layer in zip(weights, biases, strict=True) for leaf in layer]


def q_values(critics: list[Tensor], obs: Tensor, action: Tensor, activation: str) -> Tensor:
    """Q of each critic, `[critic, batch, 1]`."""
    x = torch.cat([obs, action], dim=1).expand(len(critics[0]), -1, -1)
    *hidden, weight, bias = critics
    for w, b in zip(hidden[::2], hidden[1::2], strict=True):
        x = ACTIVATIONS[activation](torch.baddbmm(b, x, w))
    return torch.baddbmm(bias, x, weight)


# --- TD3 --------------------------------------------------------------------------------------


@dataclass
class TD3State:
    """One agent; `td3_update` changes it in place. The critics' parameters are `stack_critics`."""

    actor: Trainable
    critics: Trainable
    target_actor: list[Tensor]
    target_critics: list[Tensor]
    num_updates: int = 0


def td3_state(actor: list[Tensor], critics: list[Tensor]) -> TD3State:
    """A fresh agent with these parameters (copied); the targets start as the networks."""
    return TD3State(
        actor=Trainable(actor),
        critics=Trainable(critics),
        target_actor=[p.clone() for p in actor],
        target_critics=[p.clone() for p in critics],
    )


def init_td3(config: TD3Config) -> TD3State:
    """An agent with random parameters from torch's generator."""
    hidden = [config.hidden_size] * config.num_layers
    actor = init_mlp([OBS_DIM, *hidden, ACTION_DIM], config.activation)
    sizes = [OBS_DIM + ACTION_DIM, *hidden, 1]
    critics = stack_critics([init_mlp(sizes, config.activation) for _ in range(2)])
    return td3_state(actor, critics)


def td3_update(state: TD3State, batch: Batch, smoothing: Tensor, config: TD3Config) -> None:
    """One learning step of Fujimoto et al. (2018), algorithm 1, in place.

    `smoothing [batch, action_dim]` is standard normal.
    """
    state.num_updates += 1
    state.critics.descend(critic_loss(state, batch, smoothing, config), config.learning_rate)
    if state.num_updates % config.policy_delay == 0:
        state.actor.descend(actor_loss(state, batch, config), config.learning_rate)
        torch._foreach_lerp_(
            [*state.target_actor, *state.target_critics],
            [*state.actor.values, *state.critics.values],
            config.tau,
        )


def critic_loss(state: TD3State, batch: Batch, smoothing: Tensor, config: TD3Config) -> Tensor:
    """Sum of the critics' mean squared errors to the smaller target Q at the smoothed action."""
    activation, clip = config.activation, config.target_noise_clip
    with torch.no_grad():
        noise = (config.target_noise_std * smoothing).clamp_(-clip, clip)
        squashed = torch.tanh(mlp(state.target_actor, batch.next_obs, activation))
        next_action = squashed.add_(noise).clamp_(-1, 1).mul_(MAX_ACTION)
        next_q = q_values(state.target_critics, batch.next_obs, next_action, activation).amin(0)
        targets = torch.addcmul(batch.reward, batch.discount, next_q, value=config.discount)
    q = q_values(state.critics.params, batch.obs, batch.action, activation)
    return torch.sum((q - targets) ** 2) / len(targets)


def actor_loss(state: TD3State, batch: Batch, config: TD3Config) -> Tensor:
    """Minus the first critic's mean Q of the actor's actions."""
    outputs = mlp(state.actor.params, batch.obs, config.activation)
    first = [leaf[:1] for leaf in state.critics.values]
    return -q_values(first, batch.obs, MAX_ACTION * torch.tanh(outputs), config.activation).mean()


class TD3Agent:
    """What `train_for` takes: acts with noise, and learns in every step after the first episodes.

    In those, as in sejax, actions are uniformly random.
    """

    def __init__(self, config: TD3Config, max_steps: int):
        capacity = min(config.buffer_size, max_steps)
        self.state = init_td3(config)
        self._config = config
        self._buffer = ReplayBuffer(capacity, config.batch_size, OBS_DIM, ACTION_DIM)
        self._warm_up_episodes = config.warmup_episodes

    @torch.no_grad()
    def act(self, obs: Tensor) -> Tensor:
        if self._warm_up_episodes:
            return torch.empty(ACTION_DIM).uniform_(-MAX_ACTION, MAX_ACTION)
        squashed = torch.tanh(mlp(self.state.actor.values, obs, self._config.activation))
        noise = torch.randn(ACTION_DIM)
        squashed.add_(noise, alpha=self._config.action_noise_std)
        return squashed.clamp_(-1, 1).mul_(MAX_ACTION)

    def observe(self, obs: Tensor, action: int | Tensor, step: Step, ended: bool) -> None:
        self._buffer.store(obs, step.obs, action, step.reward, step.discount)
        if not self._warm_up_episodes:
            smoothing = torch.randn(self._config.batch_size, ACTION_DIM)
            td3_update(self.state, self._buffer.sample(), smoothing, self._config)
        elif ended:
            self._warm_up_episodes -= 1

    def all_finite(self) -> bool:
        return self.state.actor.all_finite() and self.state.critics.all_finite()
