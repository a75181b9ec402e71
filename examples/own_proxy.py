"""A proxy of one's own: a synthetic environment that is linear, learned for CartPole.

    python own_proxy.py
    python -m sejax.run env=cartpole proxy=own_proxy:LinearSE    # in this folder

The script takes 90 seconds on four cores; agents that act at random return about 20:

    returns of agents that trained on the proxy: 13 28 56 84 124
    linear_cartpole.safetensors: best 124, 35 weights

A proxy is a gymnax environment whose params hold the weights that are learned.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from gymnax.environments import environment
from jax import Array

import sejax
from sejax.options import Positive


@dataclass(frozen=True, kw_only=True)
class LinearSE(sejax.ProxyConfig):
    """A linear world for any task whose observations are vectors."""

    init_std: Positive = 0.3

    def make(self, task: sejax.Task) -> "LinearEnv":
        return LinearEnv(task, self)


@struct.dataclass
class LinearState(environment.EnvState):
    obs: Array
    time: Array | int


class LinearEnv(sejax.ProxyEnv):
    r"""Linear dynamics and a quadratic cost, whose best policies are feedback laws.

    .. math:: (s' - s,\; c) = W (s, a, 1), \quad r = \max(1 - c^2, 0)

    Episodes start as in the real task and end at its step limit.
    """

    def init_weights(self, key: Array) -> dict[str, Array]:
        shape = self.task.obs_dim + 1, self.task.obs_dim + self.task.action_dim + 1
        return {"matrix": self.config.init_std * jax.random.normal(key, shape)}

    def reset_env(self, key: Array, params: sejax.ProxyParams) -> tuple[Array, LinearState]:
        obs, _ = self.task.env.reset_env(key, self.task.params)
        return obs, LinearState(obs=obs, time=jnp.int32(0))

    def step_env(
        self, key: Array, state: LinearState, action: Array, params: sejax.ProxyParams
    ) -> tuple[Array, LinearState, Array, Array, dict[Any, Any]]:
        if self.task.num_actions is not None:
            action = jax.nn.one_hot(action, self.task.num_actions)
        inputs = jnp.concatenate([state.obs, action, jnp.ones(1)])
        *change, cost = params.weights["matrix"] @ inputs
        obs = jnp.clip(state.obs + jnp.array(change), -10.0, 10.0)  # it may be unstable
        state = LinearState(obs=obs, time=state.time + 1)
        return obs, state, jnp.maximum(1 - cost**2, 0.0), jnp.bool_(False), {}


def main() -> None:
    parser = argparse.ArgumentParser(description="Learns a linear synthetic CartPole.")
    parser.add_argument("--generations", type=int, default=25)
    parser.add_argument("--population", type=int, default=32)
    parser.add_argument("--steps", type=int, default=2000, help="of each training")
    parser.add_argument("--out", type=Path, default=Path("linear_cartpole.safetensors"))
    args = parser.parse_args()
    sejax.configure_xla()  # a device for each core
    parts = sejax.config([  # the settings for CartPole, with some changes
        "env=cartpole", "es.noise_std=0.1", "es.noise_std_decay=1",
        f"es.population_size={args.population}", f"training.max_steps={args.steps}",
        f"training.max_episodes={args.steps}",
    ]).parts()  # fmt: skip
    parts["proxy"] = proxy = LinearSE().make(parts["task"])
    learn = sejax.make_learner(**parts, generations=args.generations)
    result = jax.jit(learn)(jax.random.key(0))
    every_fifth = result.info.incumbent_mean[::5]
    print("returns of agents that trained on the proxy:", *(f"{x:.0f}" for x in every_fifth))
    sejax.save(args.out, proxy, result.weights, score=float(result.score))
    _, params = sejax.load(args.out, proxy=LinearSE())  # a file's names are never imported
    print(f"{args.out}: best {result.score:.0f}, {params.weights['matrix'].size} weights")


if __name__ == "__main__":
    main()
