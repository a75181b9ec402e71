"""Repeating each action of an agent for several steps of the world."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from gymnax.environments import environment


class ActionRepeat(environment.Environment[Any, Any]):
    """A world in which each decision lasts for `num_repeats` steps or until the episode ends.

    Rewards add up undiscounted, and `info["num_steps"]` says how many steps were made. State,
    parameters and spaces are the wrapped world's.

    Source: paper, appendix "MountainCarContinuous-v0 and HalfCheetah-v3" (number of action
    repeats); `reference_details.md` 1.8. There an SE is stepped on after its episode has ended;
    here no step is made that cannot count.
    """

    def __init__(self, env: Any, num_repeats: int):
        super().__init__()
        self.env = env
        self.num_repeats = num_repeats

    @property
    def default_params(self) -> Any:
        return self.env.default_params

    def reset_env(self, key: Any, params: Any) -> tuple[Any, Any]:
        return self.env.reset_env(key, params)

    def step_env(self, key: Any, state: Any, action: Any, params: Any) -> tuple[Any, ...]:
        total, num_steps = jnp.float32(0), jnp.int32(0)
        ended = jnp.bool_(False)
        out: Any = None
        for step_key in jax.random.split(key, self.num_repeats):
            new = self.env.step_env(step_key, state, action, params)
            out = new if out is None else _select(ended, out, new)
            _, state, reward, terminated, info = out
            total = total + jnp.where(ended, 0.0, reward)
            num_steps = num_steps + ~ended
            ended = terminated | self.env.is_truncated(state, params) | info.get("nonfinite", False)
        obs, state, _, terminated, info = out
        return obs, state, total, terminated, {**info, "num_steps": num_steps}

    def get_obs(self, state: Any, params: Any = None, key: Any = None) -> Any:
        return self.env.get_obs(state, params, key)

    def is_truncated(self, state: Any, params: Any) -> Any:
        return self.env.is_truncated(state, params)

    @property
    def name(self) -> str:
        return self.env.name

    @property
    def num_actions(self) -> int:
        return self.env.num_actions

    def action_space(self, params: Any = None) -> Any:
        return self.env.action_space(params)

    def observation_space(self, params: Any = None) -> Any:
        return self.env.observation_space(params)


def _select(condition: Any, a: Any, b: Any) -> Any:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


@functools.cache
def repeat_actions(env: Any, num_repeats: int) -> Any:
    """The world in which actions last for `num_repeats` steps; itself for 1."""
    return env if num_repeats == 1 else ActionRepeat(env, num_repeats)
