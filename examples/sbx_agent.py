"""DQN of sbx, Stable-Baselines3 in JAX, on the synthetic environment (SE) of CartPole.

    pip install '.[sb3]' sbx-rl
    python sbx_agent.py

Five agents train for 2,500 steps on the SE, as many on CartPole itself. All are tested there.
It takes 25 seconds of one core:

    return on CartPole after 2500 steps on the SE: 200 200 200 200 200
    return on CartPole after 2500 steps on CartPole: 102 80 190 150 168

Agent and SE pass NumPy arrays to one another, and only the agent is JAX. Where both are to be one
compiled program: `rejax_agent.py`.
"""

import argparse
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
from sbx import DQN
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

import sejax.gym

HPARAMS = dict(  # RL Zoo's
    learning_rate=2.3e-3, batch_size=64, buffer_size=100_000, learning_starts=1000, gamma=0.99,
    target_update_interval=10, train_freq=256, gradient_steps=128, exploration_fraction=0.16,
    exploration_final_eps=0.04, policy_kwargs={"net_arch": [256, 256]},
)  # fmt: skip


def make_real() -> gymnasium.Env[Any, Any]:
    env = Monitor(gymnasium.make("CartPole-v1", max_episode_steps=200))
    env.reset(seed=10_000)  # of tests; an agent that trains there sets its own
    return env


def main() -> None:
    parser = argparse.ArgumentParser(description="Trains sbx's DQN on an SE and on CartPole.")
    parser.add_argument("--steps", type=int, default=2500, help="of each training")
    parser.add_argument("--seeds", type=int, default=5, help="agents on each of the two")
    parser.add_argument("--episodes", type=int, default=10, help="of each agent's test")
    args = parser.parse_args()
    worlds: dict[str, Callable[[], Any]] = {
        "the SE": partial(sejax.gym.make_sb3, "cartpole"),
        "CartPole": make_real,
    }
    for name, make in worlds.items():
        print(f"return on CartPole after {args.steps} steps on {name}:", end="", flush=True)
        for seed in range(args.seeds):
            model = DQN("MlpPolicy", make(), seed=seed, **HPARAMS).learn(args.steps)
            mean_return, _ = evaluate_policy(model, make_real(), n_eval_episodes=args.episodes)
            print(f" {mean_return:.0f}", end="", flush=True)
        print()


if __name__ == "__main__":
    main()
