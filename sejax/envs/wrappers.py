"""Worlds seen through a frame: each action repeated, or everything as vectors."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnax.environments import environment, spaces
from jaxtyping import Array, Float

from sejax.errors import ConfigError


class Wrapper(environment.Environment[Any, Any]):
    """A world that is another one but for what a subclass changes."""

    def __init__(self, env: Any):
        super().__init__()
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
        return self.env.action_space(params)

    def observation_space(self, params: Any = None) -> Any:
        return self.env.observation_space(params)


class ActionRepeat(Wrapper):
    """A world in which each decision lasts for `num_repeats` steps or until the episode ends.

    Rewards add up undiscounted, and `info["num_steps"]` says how many steps were made. State,
    parameters and spaces are the wrapped world's.

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
    """The world in which actions last for `num_repeats` steps; itself for 1."""
    return env if num_repeats == 1 else ActionRepeat(env, num_repeats)


class AsVectors(Wrapper):
    """A world whose observations are float32 vectors and whose continuous actions are in [-1, 1].

    Observations of any shape are flattened, row by row; an action `[n]` is scaled linearly to the
    bounds of the wrapped world's box and takes its shape. Discrete ones stay as they are.

    Args:
      env: the world.
      params: its params, which its spaces are taken from, once: gymnax computes some of them.
    """

    def __init__(self, env: Any, params: Any):
        super().__init__(env)
        self._raw_action = env.action_space(params)
        self._action = self._raw_action
        if isinstance(self._raw_action, spaces.Box):
            size = int(np.prod(self._raw_action.shape))
            self._action = spaces.Box(-1.0, 1.0, (size,), jnp.float32)
        self._obs = env.observation_space(params)
        self._is_index = isinstance(self._obs, spaces.Discrete)
        if not self._is_index:
            size = int(np.prod(self._obs.shape))
            bounds = (
                _full(x, self._obs.shape).reshape(size) for x in (self._obs.low, self._obs.high)
            )
            self._obs = spaces.Box(*bounds, (size,), jnp.float32)

    def reset_env(self, key: Any, params: Any) -> tuple[Any, Any]:
        obs, state = self.env.reset_env(key, params)
        return self._vector(obs), state

    def step_env(self, key: Any, state: Any, action: Any, params: Any) -> tuple[Any, ...]:
        space = self._raw_action
        if isinstance(space, spaces.Box):
            low, high = (_full(x, space.shape) for x in (space.low, space.high))
            action = low + (jnp.reshape(action, space.shape) + 1) / 2 * (high - low)
            action = jnp.clip(action, low, high)
        obs, *rest = self.env.step_env(key, state, action, params)
        return self._vector(obs), *rest

    def get_obs(self, state: Any, params: Any = None, key: Any = None) -> Any:
        return self._vector(self.env.get_obs(state, params, key))

    def action_space(self, params: Any = None) -> Any:
        return self._action

    def observation_space(self, params: Any = None) -> Any:
        return self._obs

    def _vector(self, obs: Any) -> Float[Array, " obs_dim"] | Array:
        return obs if self._is_index else jnp.ravel(obs).astype(jnp.float32)


def _full(bound: Any, shape: tuple[int, ...]) -> np.ndarray:
    """A space's bound for each of its numbers."""
    return np.broadcast_to(np.asarray(bound, np.float32), shape)


def as_vectors(env: Any, params: Any, name: str) -> Any:
    """The world itself if agents can take it as it is, else `AsVectors` of it.

    Raises:
      ConfigError: for spaces that no vector or index stands for, or actions without bounds.
    """
    obs, action = env.observation_space(params), env.action_space(params)
    for what, space in (("observations", obs), ("actions", action)):
        if not isinstance(space, spaces.Box | spaces.Discrete):
            raise ConfigError(
                f"env must have {what} in a gymnax Box or Discrete space, because networks take "
                f"vectors and tables take indices; got {space!r} in {name}. Make them "
                f"one array in a subclass of sejax.envs.wrappers.Wrapper."
            )
    plain_obs = isinstance(obs, spaces.Discrete) or getattr(env, "observes_vectors", False)
    if not plain_obs:  # what comes, as a space may say otherwise (gymnax's FourRooms)
        came = jax.eval_shape(lambda: env.reset_env(jax.random.key(0), params)[0])
        plain_obs = came.ndim == 1 and came.dtype == jnp.float32
    plain_action = isinstance(action, spaces.Discrete) or _is_symmetric(action, name)
    return env if plain_obs and plain_action else AsVectors(env, params)


def _is_symmetric(space: Any, name: str) -> bool:
    """Whether a box is a vector between the same -x and x in each dimension."""
    low, high = np.asarray(space.low), np.asarray(space.high)
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
        raise ConfigError(
            f"env must have bounded actions, because agents draw and squash them within bounds; "
            f"got {space!r} in {name}. Give its action space a low and a high."
        )
    return len(space.shape) == 1 and bool((high == high.flat[0]).all() and (low == -high).all())
