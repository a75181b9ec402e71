"""sejax's PPO once more, in eager PyTorch, on a CartPole SE: the yardstick.

It means the same as `sejax.agents.ppo` for discrete actions and takes its hyperparameters from the
same configuration. What is here, and how to be quick in eager PyTorch, is `torch_reference`'s.

What was tried for speed, in microseconds on one thread of an AVX-512 machine for loss and gradient
of one epoch at the paper's hyperparameters (2,001 rows, two hidden layers of 64): the actor and the
critic one after the other 2,150 with ReLU in place, 2,450 without; both as one batched product
3,400. The matrix products alone, at this core's rate for such shapes, take 880.
"""

import random
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch_reference import (
    MAX_STEPS,
    NUM_ACTIONS,
    OBS_DIM,
    CartPole,
    Step,
    SyntheticEnv,
    Trainable,
    TrainResult,
    init_mlp,
    mlp,
    train_for,
)

from sejax.agents.ppo import PPOConfig
from sejax.training import TrainingConfig

MAX_LOG_RATIO = 20.0  # as in sejax.agents.ppo
AS_IN_THE_PAPER = ("advantages", "rollout_steps", "num_minibatches", "max_grad_norm", "adam_eps")


def train(env: SyntheticEnv, hp: PPOConfig, training: TrainingConfig, seed: int) -> TrainResult:
    """Trains one agent on a CartPole SE for `training.max_steps` steps.

    Raises:
      ValueError: if the configurations ask for what is not built here.
    """
    max_steps = training.max_steps
    paper = PPOConfig.paper()
    is_papers = type(hp) is PPOConfig and all(
        getattr(hp, name) == getattr(paper, name) for name in AS_IN_THE_PAPER
    )
    if not is_papers or training.stop_rule != "never" or max_steps is None:
        raise ValueError("the reference is of PPOConfig.paper(), training.stop_rule=never, "
                         "training.max_steps=N.")  # fmt: skip
    torch.manual_seed(seed)
    random.seed(seed)
    rng = np.random.default_rng(seed)
    agent = PPOAgent(hp)
    return train_for(env, agent, lambda: torch.from_numpy(CartPole.reset(rng, 1)[0]), max_steps)


def rollout_length(config: PPOConfig) -> int:
    """Steps between two learning phases."""
    return config.update_episodes * MAX_STEPS // config.action_repeat + 1


@dataclass
class PPOState:
    """One agent; `ppo_phase` changes it in place. Actor and critic share Adam's parameters."""

    networks: Trainable
    num_actor_params: int

    def split(self, params: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        """The actor's and the critic's of these parameters."""
        return params[: self.num_actor_params], params[self.num_actor_params :]


def ppo_state(actor: list[Tensor], critic: list[Tensor]) -> PPOState:
    """A fresh agent with these parameters (copied)."""
    return PPOState(networks=Trainable([*actor, *critic]), num_actor_params=len(actor))


def init_ppo(config: PPOConfig) -> PPOState:
    """An agent with random parameters from torch's generator."""
    hidden = [config.hidden_size] * config.num_layers
    actor = init_mlp([OBS_DIM, *hidden, NUM_ACTIONS], config.activation)
    return ppo_state(actor, init_mlp([OBS_DIM, *hidden, 1], config.activation))


def ppo_phase(
    state: PPOState,
    obs: Tensor,
    action: Tensor,
    reward: list[float],
    ended: list[bool],
    config: PPOConfig,
) -> None:
    """A learning phase: `epochs` Adam steps on the whole rollout, in place.

    Rows are steps in order; `action [steps, 1]` are indices.
    """
    returns = normalized_returns(reward, ended, config.discount)
    with torch.no_grad():
        actor, _ = state.split(state.networks.values)
        old_log_prob, _ = evaluate(mlp(actor, obs, config.activation), action)
    actor, critic = state.split(state.networks.params)
    for _ in range(config.epochs):
        log_prob, entropy = evaluate(mlp(actor, obs, config.activation), action)
        value = mlp(critic, obs, config.activation)
        loss = ppo_loss(log_prob, entropy, value, old_log_prob, returns, config)
        state.networks.descend(loss, config.learning_rate)


def normalized_returns(reward: list[float], ended: list[bool], discount: float) -> Tensor:
    """Monte-Carlo returns within each episode, with mean 0 and std 1, `[steps, 1]`."""
    returns, later = [], 0.0
    for r, end in zip(reversed(reward), reversed(ended), strict=True):
        later = r + (0.0 if end else discount * later)
        returns.append(later)
    column = torch.tensor(returns[::-1])[:, None]
    return (column - column.mean()) / (column.std() + 1e-5)


def evaluate(logits: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
    """Log-probability of the actions and entropy in nats, both `[steps, 1]`."""
    log_probs = F.log_softmax(logits, dim=1)
    entropy = -(log_probs.exp() * log_probs).sum(1, keepdim=True)
    return log_probs.gather(1, action), entropy


def ppo_loss(
    log_prob: Tensor,
    entropy: Tensor,
    value: Tensor,
    old_log_prob: Tensor,
    returns: Tensor,
    config: PPOConfig,
) -> Tensor:
    """What a learning phase minimises: Schulman et al. (2017), eq. 7 and 9."""
    advantage = returns - value.detach()
    ratio = (log_prob - old_log_prob).clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO).exp()
    clipped = ratio.clamp(1 - config.clip_ratio, 1 + config.clip_ratio)
    surrogate = torch.minimum(ratio * advantage, clipped * advantage).mean()
    value_error = F.mse_loss(value, returns)
    return config.value_weight * value_error - surrogate - config.entropy_weight * entropy.mean()


class PPOAgent:
    """What `train_for` takes: samples actions, and learns when the rollout is full."""

    def __init__(self, config: PPOConfig):
        length = rollout_length(config)
        self.state = init_ppo(config)
        self._actor, _ = self.state.split(self.state.networks.values)
        self._config = config
        self._obs = torch.zeros(length, OBS_DIM)
        self._obs_numpy = self._obs.numpy()  # the same memory
        self._actions: list[int] = []
        self._rewards: list[float] = []
        self._ended: list[bool] = []

    @torch.no_grad()
    def act(self, obs: Tensor) -> int:
        probabilities = mlp(self._actor, obs, self._config.activation).softmax(0).tolist()
        return random.choices(range(NUM_ACTIONS), probabilities)[0]

    def observe(self, obs: Tensor, action: int | Tensor, step: Step, ended: bool) -> None:
        self._obs_numpy[len(self._actions)] = obs.numpy()
        self._actions.append(cast(int, action))
        self._rewards.append(step.reward)
        self._ended.append(ended)
        if len(self._actions) == len(self._obs):
            actions = torch.tensor(self._actions)[:, None]
            ppo_phase(self.state, self._obs, actions, self._rewards, self._ended, self._config)
            self._actions, self._rewards, self._ended = [], [], []

    def all_finite(self) -> bool:
        return self.state.networks.all_finite()
