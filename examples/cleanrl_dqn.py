"""DQN in a single file in the style of CleanRL, trained on a synthetic environment (SE).

    pip install '.[gym]' torch
    python cleanrl_dqn.py
    python cleanrl_dqn.py --env-id CartPole-v1                   # on the real task

Nothing in it knows of sejax but the id of the environment. It is tested on the real task as it
goes, and takes 4 seconds of one core:

    return on CartPole-v1 every 500 steps on sejax.gym:sejax/cartpole: 200 200 200 200 200
    return on CartPole-v1 every 500 steps on CartPole-v1: 9 86 112 124 162

Source: Mnih et al., "Human-level control through deep reinforcement learning" (2015).
"""

import argparse
import copy
from dataclasses import dataclass, fields

import gymnasium
import numpy as np
import torch
from torch import nn


@dataclass
class Args:
    env_id: str = "sejax.gym:sejax/cartpole"  # what it trains on; Gymnasium imports sejax.gym
    test_env_id: str = "CartPole-v1"
    max_test_steps: int = 200  # of a test's episode
    test_every: int = 500
    test_episodes: int = 10
    seed: int = 1
    total_steps: int = 2500
    num_envs: int = 8
    learning_rate: float = 1e-3
    hidden_size: int = 64
    buffer_size: int = 10_000
    batch_size: int = 64
    gamma: float = 0.99
    start_epsilon: float = 1.0
    end_epsilon: float = 0.05
    exploration_fraction: float = 0.5  # of the steps: epsilon falls in it
    learning_starts: int = 200
    train_frequency: int = 2  # steps for each update
    target_frequency: int = 50  # updates for each copy to the target network


def parse_args() -> Args:
    parser = argparse.ArgumentParser(description="Trains DQN and tests it on the real task.")
    for field in fields(Args):
        name = field.name.replace("_", "-")
        parser.add_argument(f"--{name}", type=type(field.default), default=field.default)
    return Args(**vars(parser.parse_args()))


class QNetwork(nn.Sequential):
    def __init__(self, obs_dim: int, num_actions: int, hidden_size: int):
        super().__init__(
            nn.Linear(obs_dim, hidden_size), nn.ReLU(),
            nn.Linear(hidden_size, hidden_size), nn.ReLU(),
            nn.Linear(hidden_size, num_actions),
        )  # fmt: skip

    @torch.no_grad()
    def greedy(self, obs: np.ndarray) -> np.ndarray:
        """Actions `[batch]` for observations `[batch, obs_dim]`."""
        return self(torch.as_tensor(obs)).argmax(dim=1).numpy()


class ReplayBuffer:
    """The latest transitions, in a ring."""

    def __init__(self, capacity: int, obs_dim: int):
        self.obs, self.next_obs = np.zeros((2, capacity, obs_dim), np.float32)
        self.actions = np.zeros(capacity, np.int64)
        self.rewards, self.terminated = np.zeros((2, capacity), np.float32)
        self.size = self.position = 0

    def add(self, *batch: np.ndarray) -> None:
        places = (self.position + np.arange(len(batch[0]))) % len(self.obs)
        for mine, new in zip(self._arrays, batch, strict=True):
            mine[places] = new
        self.position = int(places[-1]) + 1
        self.size = min(self.size + len(places), len(self.obs))

    def sample(self, batch_size: int, rng: np.random.Generator) -> list[torch.Tensor]:
        places = rng.integers(self.size, size=batch_size)
        return [torch.as_tensor(x[places]) for x in self._arrays]

    @property
    def _arrays(self) -> tuple[np.ndarray, ...]:
        return self.obs, self.actions, self.rewards, self.next_obs, self.terminated


def test(network: QNetwork, args: Args) -> float:
    """Mean return of greedy episodes on the real task."""
    env = gymnasium.make(args.test_env_id, max_episode_steps=args.max_test_steps)
    total = 0.0
    for episode in range(args.test_episodes):
        obs, _ = env.reset(seed=10_000 + episode)
        over = False
        while not over:
            action = network.greedy(obs[None])[0]
            obs, reward, terminated, truncated, _ = env.step(action)
            total += float(reward)
            over = terminated or truncated
    return total / args.test_episodes


def main() -> None:
    args = parse_args()
    torch.set_num_threads(1)  # which is faster where networks are small
    torch.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)

    envs = gymnasium.make_vec(args.env_id, num_envs=args.num_envs)
    obs_dim = gymnasium.spaces.flatdim(envs.single_observation_space)
    num_actions = gymnasium.spaces.flatdim(envs.single_action_space)
    online = QNetwork(obs_dim, num_actions, args.hidden_size)
    target = copy.deepcopy(online)
    optimizer = torch.optim.Adam(online.parameters(), lr=args.learning_rate)
    buffer = ReplayBuffer(args.buffer_size, obs_dim)

    obs, _ = envs.reset(seed=args.seed)
    goes_on = np.ones(args.num_envs, np.bool_)
    step = num_updates = 0
    print(f"return on {args.test_env_id} every {args.test_every} steps on {args.env_id}:", end="")
    while step < args.total_steps:
        progress = min(step / (args.exploration_fraction * args.total_steps), 1.0)
        epsilon = args.start_epsilon + progress * (args.end_epsilon - args.start_epsilon)
        explores = rng.random(args.num_envs) < epsilon
        random_actions = rng.integers(num_actions, size=args.num_envs)
        actions = np.where(explores, random_actions, online.greedy(obs))
        next_obs, rewards, terminated, truncated, _ = envs.step(actions)
        # Where an episode has ended, this step began the next one and is none of the agent's
        # (AutoresetMode.NEXT_STEP).
        if goes_on.any():
            buffer.add(*(x[goes_on] for x in (obs, actions, rewards, next_obs, terminated)))
        before, step = step, step + int(goes_on.sum())
        obs, goes_on = next_obs, ~(terminated | truncated)

        if step > args.learning_starts:
            for _ in range(step // args.train_frequency - before // args.train_frequency):
                old_obs, taken, reward, new_obs, end = buffer.sample(args.batch_size, rng)
                with torch.no_grad():
                    next_q = target(new_obs).max(dim=1).values
                    target_q = reward + args.gamma * next_q * (1 - end)
                q = online(old_obs).gather(1, taken[:, None])[:, 0]
                optimizer.zero_grad()
                nn.functional.mse_loss(q, target_q).backward()
                optimizer.step()
                num_updates += 1
                if num_updates % args.target_frequency == 0:
                    target.load_state_dict(online.state_dict())
        if step // args.test_every > before // args.test_every:
            print(f" {test(online, args):.0f}", end="", flush=True)
    print()


if __name__ == "__main__":
    main()
