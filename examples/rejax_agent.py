"""DQN of rejax on a shipped synthetic environment (SE) as a gymnax environment.

    pip install . rejax
    python rejax_agent.py

Ten agents train on the SE, and ten on CartPole itself, each ten in one compiled program. All are
tested on CartPole at the start and as they go. It takes 30 seconds of one core, most of them to
compile:

    return on CartPole every 500 steps on the SE: 60 200 200 200 200 200
    return on CartPole every 500 steps on CartPole: 60 12 145 184 195 192
"""

import argparse
from typing import Any

import gymnax
import jax
import numpy as np
import rejax
from jax import Array
from rejax.evaluate import evaluate

import sejax
from sejax.envs import with_one_done

MAX_STEPS = 200  # of CartPole


def main() -> None:
    parser = argparse.ArgumentParser(description="Trains rejax's DQN on an SE and on CartPole.")
    parser.add_argument("--steps", type=int, default=2500, help="of each training")
    parser.add_argument("--test-every", type=int, default=500, help="steps")
    parser.add_argument("--agents", type=int, default=10, help="on each of the two")
    parser.add_argument("--episodes", type=int, default=10, help="of each test")
    args = parser.parse_args()
    sejax.register_gymnax()
    synthetic, weights = gymnax.make("sejax/cartpole")
    real, real_params = gymnax.make("CartPole-v1")
    real_params = real_params.replace(max_steps_in_episode=MAX_STEPS)

    def test_on_real(algorithm: rejax.DQN, state: Any, key: Array) -> Array:
        act = algorithm.make_act(state)
        _, returns = evaluate(act, key, with_one_done(real), real_params, args.episodes, MAX_STEPS)
        return returns.mean()

    keys = jax.random.split(jax.random.key(0), args.agents)
    for name, env, params in (("the SE", synthetic, weights), ("CartPole", real, real_params)):
        algorithm = rejax.DQN.create(
            env=with_one_done(env), env_params=params, total_timesteps=args.steps,
            eval_freq=args.test_every, buffer_size=args.steps, fill_buffer=args.steps // 10,
            batch_size=64, learning_rate=1e-3, target_update_freq=50, polyak=0.0,
            exploration_fraction=0.5,
        ).replace(eval_callback=test_on_real)  # fmt: skip
        _, returns = jax.jit(jax.vmap(algorithm.train))(keys)  # [agent, test]
        means = np.mean(returns, axis=0)
        print(f"return on CartPole every {args.test_every} steps on {name}:",
              *(f"{x:.0f}" for x in means))  # fmt: skip


if __name__ == "__main__":
    main()
