"""PPO of rejax on MuJoCo's HalfCheetah: physics, agent and tests are one compiled JAX program.

    pip install '.[mujoco]' rejax
    python rejax_mujoco.py

The physics is Gymnasium's HalfCheetah-v5, on the CPU. Scores are means of whole episodes, before
training and as it goes. It takes minutes:

    score on halfcheetah every 40,960 steps: -445 -187 253 482 634 769
"""

import argparse

import jax
import numpy as np
import rejax

import sejax


def main() -> None:
    parser = argparse.ArgumentParser(description="Trains rejax's PPO on HalfCheetah.")
    parser.add_argument("--env", default="halfcheetah", help="a task of sejax.envs")
    parser.add_argument("--steps", type=int, default=204_800, help="of each training")
    parser.add_argument("--test-every", type=int, default=40_960, help="steps")
    parser.add_argument("--agents", type=int, default=1)
    parser.add_argument("--rollout", type=int, default=2048, help="steps")
    args = parser.parse_args()
    task = sejax.envs.make(args.env)
    algorithm = rejax.PPO.create(
        env=sejax.envs.with_one_done(task.env), env_params=task.params, num_envs=1,
        total_timesteps=args.steps, eval_freq=args.test_every, num_steps=args.rollout,
        num_minibatches=args.rollout // 64, num_epochs=10, learning_rate=3e-4, gamma=0.99,
        gae_lambda=0.95, clip_eps=0.2, ent_coef=0.0, vf_coef=0.5, max_grad_norm=0.5,
        normalize_observations=True, normalize_rewards=True,
    )  # fmt: skip
    keys = jax.random.split(jax.random.key(0), args.agents)
    _, (_, returns) = jax.jit(jax.vmap(algorithm.train))(keys)  # [agent, test, episode]
    print(f"score on {task.name} every {args.test_every:,} steps:",
          *(f"{x:.0f}" for x in np.mean(returns, axis=(0, 2))))  # fmt: skip


if __name__ == "__main__":
    main()
