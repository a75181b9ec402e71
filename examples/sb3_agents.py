"""Agents of Stable-Baselines3 on the synthetic environments (SEs) of two tasks, beside the tasks.

    pip install '.[sb3]'
    python sb3_agents.py

PPO and DQN train for 2,500 steps, three of each on each task's SE and three on the task itself.
All are tested on the task: mean return and its deviation between agents. It takes 50 seconds of one
core:

    task      agent     trained on the SE    on the real task
    cartpole  PPO             200.0 ± 0.0         75.0 ± 79.2
    cartpole  DQN             200.0 ± 0.0        165.0 ± 11.3
    acrobot   PPO             -91.2 ± 8.0      -258.1 ± 175.5
    acrobot   DQN             -75.8 ± 0.2        -500.0 ± 0.0

Hyperparameters are RL Zoo's for CartPole, on Acrobot too. With its own for each task, and more
agents: `benchmarks/stock_agents.py`.
"""

import argparse
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

import sejax.gym

TASKS = {"cartpole": ("CartPole-v1", 200), "acrobot": ("Acrobot-v1", 500)}  # id and step limit
TEST_SEED = 10_000


def linear(initial: float) -> Callable[[float], float]:
    """From `initial` to 0 over a training."""
    return lambda progress_remaining: progress_remaining * initial


# Each with the number of environments that it acts in.
AGENTS: dict[str, tuple[Callable[..., Any], int]] = {
    "PPO": (partial(
        PPO, n_steps=32, batch_size=256, n_epochs=20, gamma=0.98, gae_lambda=0.8, ent_coef=0.0,
        learning_rate=linear(1e-3), clip_range=linear(0.2),
    ), 8),
    "DQN": (partial(
        DQN, learning_rate=2.3e-3, batch_size=64, buffer_size=100_000, learning_starts=1000,
        gamma=0.99, target_update_interval=10, train_freq=256, gradient_steps=128,
        exploration_fraction=0.16, exploration_final_eps=0.04,
        policy_kwargs={"net_arch": [256, 256]},
    ), 1),
}  # fmt: skip


def make_real(task: str) -> gymnasium.Env[Any, Any]:
    env_id, max_steps = TASKS[task]
    env = Monitor(gymnasium.make(env_id, max_episode_steps=max_steps))
    env.reset(seed=TEST_SEED)  # of tests; an agent that trains there sets its own
    return env


def train_and_test(agent: str, task: str, make_envs: Callable[[], VecEnv], args: Any) -> str:
    """Mean return on the real task, and its deviation between agents, after training."""
    means = []
    for seed in range(args.seeds):
        make_agent, _ = AGENTS[agent]
        model = make_agent("MlpPolicy", make_envs(), seed=seed, device="cpu").learn(args.steps)
        means.append(evaluate_policy(model, make_real(task), n_eval_episodes=args.episodes)[0])
    return f"{np.mean(means):.1f} ± {np.std(means):.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description="Trains PPO and DQN on SEs and on the real tasks.")
    parser.add_argument("--steps", type=int, default=2500, help="of each training")
    parser.add_argument("--seeds", type=int, default=3, help="agents of each kind")
    parser.add_argument("--episodes", type=int, default=10, help="of each agent's test")
    args = parser.parse_args()
    torch.set_num_threads(1)  # which is faster where networks are small
    print(f"{'task':<10}{'agent':<7}{'trained on the SE':>20}{'on the real task':>20}")
    for task in TASKS:
        for agent, (_, num_envs) in AGENTS.items():
            synthetic = partial(sejax.gym.make_sb3, task, num_envs)
            real = partial(make_vec_env, partial(make_real, task), num_envs)
            cells = [train_and_test(agent, task, make, args) for make in (synthetic, real)]
            print(f"{task:<10}{agent:<7}{cells[0]:>20}{cells[1]:>20}", flush=True)


if __name__ == "__main__":
    main()
