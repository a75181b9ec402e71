"""A reward network (RN) as a wrapper around CartPole, under agents of Stable-Baselines3.

    pip install '.[sb3]'
    python reward_network_wrapper.py

A2C and PPO with their default hyperparameters train until ten episodes on CartPole return 195 on
average, tested every 500 steps; five of each with the RN, five without. It takes 90 seconds of one
core:

    A2C with the RN: solved after 500 1,500 500 500 inf steps, median 500
    A2C without it: solved after 1,500 6,500 6,000 6,500 7,500 steps, median 6,500
    PPO with the RN: solved after 2,500 4,500 6,500 2,500 2,500 steps, median 2,500
    PPO without it: solved after 8,500 5,000 2,500 2,500 8,500 steps, median 5,000

(inf: not within 10,000.) PPO first learns after 2,048 steps: 2,500 are the fewest that it can need.

The RN was learned with a DDQN of sejax. It pays differences of a potential in the place of
CartPole's reward, which these agents never see, and takes the agent's discount for that.
"""

import argparse
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import EvalCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.env_util import make_vec_env

import sejax.gym

AGENTS: dict[str, Any] = {"A2C": A2C, "PPO": PPO}
DISCOUNT = 0.99
SOLVED = 195.0


def make_real() -> gymnasium.Env[Any, Any]:
    return gymnasium.make("CartPole-v1", max_episode_steps=200)


def steps_to_solve(agent: str, env: gymnasium.Env[Any, Any], seed: int, args: Any) -> float:
    """Training steps until the test that solves CartPole; infinite if none does."""
    model = AGENTS[agent]("MlpPolicy", env, gamma=DISCOUNT, seed=seed, device="cpu")
    test = EvalCallback(
        make_vec_env(make_real, args.episodes, seed=10_000), StopTrainingOnRewardThreshold(SOLVED),
        eval_freq=args.test_every, n_eval_episodes=args.episodes, verbose=0,
    )  # fmt: skip
    model.learn(args.max_steps, test)
    return model.num_timesteps if test.best_mean_reward >= SOLVED else np.inf


def main() -> None:
    parser = argparse.ArgumentParser(description="Trains agents with an RN and without.")
    parser.add_argument("--agents", nargs="+", default=list(AGENTS), choices=AGENTS)
    parser.add_argument("--seeds", type=int, default=5, help="of each agent")
    parser.add_argument("--max-steps", type=int, default=10_000, help="of a training")
    parser.add_argument("--test-every", type=int, default=500, help="steps")
    parser.add_argument("--episodes", type=int, default=10, help="of each test")
    args = parser.parse_args()
    torch.set_num_threads(1)  # which is faster where networks are small
    for agent in args.agents:
        for name in ("with the RN", "without it"):
            steps = []
            for seed in range(args.seeds):
                env = make_real()
                if name == "with the RN":
                    env = sejax.gym.RewardNetwork(env, "cartpole-rn", discount=DISCOUNT)
                steps.append(steps_to_solve(agent, env, seed, args))
            print(f"{agent} {name}: solved after", *(f"{x:,.0f}" for x in steps), "steps, "
                  f"median {np.median(steps):,.0f}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
