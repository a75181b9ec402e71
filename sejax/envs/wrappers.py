"""Environments around another one: each action repeated, or everything as vectors."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sejax.envs.environment import Environment, space_of_gymnax, spaces_of
from sejax.envs.spec import Box, Discrete, Space
from sejax.options import ConfigError


class Wrapper(Environment):
    """An environment that is another one but for what a subclass changes."""

    def __init__(self, env: Any):
        self.env = env

    @property
    def default_params(self) -> Any:
        return self.env.default_params

    @property
    def name(self) -> str:
        return self.env.name

    @property
    def num_actions(self) -> int:
        return self.env.num_actions

    def reset_env(self, key: Any, params: Any) -> tuple[Any, Any]:
        return self.env.reset_env(key, params)

    def step_env(self, key: Any, state: Any, action: Any, params: Any) -> tuple[Any, ...]:
        return self.env.step_env(key, state, action, params)

    def get_obs(self, state: Any, params: Any = None, key: Any = None) -> Any:
        return self.env.get_obs(state, params, key)

    def is_truncated(self, state: Any, params: Any) -> Any:
        return self.env.is_truncated(state, params)

    def is_terminated(self, state: Any, params: Any) -> Any:
        return self.env.is_terminated(state, params)

    def action_space(self, params: Any = None) -> Any:
        return super().action_space() if self.spaces else self.env.action_space(params)

    def observation_space(self, params: Any = None) -> Any:
        return super().observation_space() if self.spaces else self.env.observation_space(params)


class ActionRepeat(Wrapper):
    """An environment in which each decision lasts `num_repeats` steps, or to the episode's end.

    Rewards add up undiscounted, and `info["num_steps"]` says how many steps were made. State,
    parameters and spaces are the wrapped environment's.

    Source: paper, appendix "MountainCarContinuous-v0 and HalfCheetah-v3" (number of action
    repeats); `docs/reference.md` 1.8. There an SE is stepped on after its episode has ended; here
    no step is made that cannot count.
    """

    def __init__(self, env: Any, num_repeats: int):
        super().__init__(env)
        self.num_repeats = num_repeats

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


def _select(condition: Any, a: Any, b: Any) -> Any:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


@functools.cache
def repeat_actions(env: Any, num_repeats: int) -> Any:
    """The environment in which actions last for `num_repeats` steps; itself for 1."""
    return env if num_repeats == 1 else ActionRepeat(env, num_repeats)


class AsVectors(Wrapper):
    """An environment with float32 vectors as observations and continuous actions in [-1, 1].

    Observations of any shape are flattened, row by row; an action `[n]` is scaled linearly to the
    bounds of the wrapped environment's box and takes its shape. Discrete ones stay as they are.

    Args:
      env: the environment.
      spaces: its spaces of observations and actions.
      action_shape: shape of its actions.
    """

    def __init__(self, env: Any, spaces: tuple[Space, Space], action_shape: tuple[int, ...]):
        super().__init__(env)
        observation, action = spaces
        self._raw_action, self._action_shape = action, action_shape
        if isinstance(action, Box):
            action = Box.symmetric(*[1.0] * action.size)
        self.spaces = observation, action

    def reset_env(self, key: Any, params: Any) -> tuple[Any, Any]:
        obs, state = self.env.reset_env(key, params)
        return self._vector(obs), state

    def step_env(self, key: Any, state: Any, action: Any, params: Any) -> tuple[Any, ...]:
        if isinstance(self._raw_action, Box):
            low, high = (
                np.reshape(np.asarray(x, np.float32), self._action_shape)
                for x in (self._raw_action.low, self._raw_action.high)
            )
            action = low + (jnp.reshape(action, self._action_shape) + 1) / 2 * (high - low)
            action = jnp.clip(action, low, high)
        obs, *rest = self.env.step_env(key, state, action, params)
        return self._vector(obs), *rest

    def get_obs(self, state: Any, params: Any = None, key: Any = None) -> Any:
        return self._vector(self.env.get_obs(state, params, key))

    def _vector(self, obs: Any) -> Float[Array, " obs_dim"] | Array:
        if self.spaces is not None and isinstance(self.spaces[0], Discrete):
            return obs
        return jnp.ravel(obs).astype(jnp.float32)


def as_vectors(env: Any, params: Any, name: str) -> tuple[Any, Space, Space]:
    """An environment as agents can take it, itself or in `AsVectors`, and its spaces.

    Raises:
      ConfigError: for spaces other than boxes and discrete ones, or actions without bounds.
    """
    if isinstance(env, Environment) and env.spaces is not None:
        return env, *env.spaces
    raw = env.observation_space(params), env.action_space(params)
    observation = space_of_gymnax(raw[0], "observations", name)
    action = space_of_gymnax(raw[1], "actions", name)
    plain_obs = isinstance(observation, Discrete)
    if not plain_obs:  # what comes, as a space may say otherwise (gymnax's FourRooms)
        came = jax.eval_shape(lambda: env.reset_env(jax.random.key(0), params)[0])
        plain_obs = came.ndim == 1 and came.dtype == jnp.float32
    if isinstance(action, Box):
        _require_bounds(action, raw[1], name)
    if plain_obs and (isinstance(action, Discrete) or _is_symmetric(action, raw[1].shape)):
        return env, observation, action
    vectors = AsVectors(env, (observation, action), raw[1].shape)
    return vectors, *spaces_of(vectors)


def _require_bounds(box: Box, space: Any, name: str) -> None:
    low, high = np.array(box.low), np.array(box.high)
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
        raise ConfigError(
            f"env must have bounded actions, because agents draw and squash them within bounds; "
            f"got {space!r} in {name}. Give its action space a low and a high."
        )


def _is_symmetric(box: Box, shape: tuple[int, ...]) -> bool:
    """Whether a box is a vector between the same -x and x in each dimension."""
    return len(shape) == 1 and {-x for x in box.low} == set(box.high) and len({*box.high}) == 1
