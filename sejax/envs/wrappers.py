"""Wrappers of environments: they repeat actions, score a part of the steps, or make vectors."""

import copy
import dataclasses
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from sejax.envs.environment import Environment, EnvParams, EnvState, Params, State, Step, spaces_of
from sejax.envs.spec import Box, Discrete, Space
from sejax.options import require


class Wrapper(Environment[State, Params]):
    """An environment that acts as another one; a subclass changes a part."""

    def __init__(self, env: Environment):
        self.env = env

    @property
    def default_params(self) -> Params:
        return self.env.default_params

    def reset_env(self, key: Array, params: Params) -> tuple[Array, State]:
        return self.env.reset_env(key, params)

    def step_env(self, key: Array, state: State, action: Array, params: Params) -> Step[State]:
        return self.env.step_env(key, state, action, params)

    def get_obs(
        self, state: State, params: Params | None = None, key: Array | None = None
    ) -> Array:
        return self.env.get_obs(state, params, key)

    def is_terminated(self, state: State, params: Params) -> Array:
        return self.env.is_terminated(state, params)

    def is_truncated(self, state: State, params: Params) -> Array:
        return self.env.is_truncated(state, params)

    def action_space(self, params: Params | None = None) -> Any:
        return super().action_space() if self.spaces else self.env.action_space(params)

    def observation_space(self, params: Params | None = None) -> Any:
        return super().observation_space() if self.spaces else self.env.observation_space(params)


class ActionRepeat(Wrapper[EnvState, EnvParams]):
    """An environment in which each decision lasts `num_repeats` steps, or to the episode's end.

    Rewards add up undiscounted, `info["sejax_num_steps"]` says how many steps were made, and other
    entries are the last step's. State, parameters and spaces are the wrapped environment's.

    Source: paper, appendix "MountainCarContinuous-v0 and HalfCheetah-v3" (number of action
    repeats); `docs/reference.md` 1.8. There an SE is stepped on after its episode has ended; here
    steps after the end have no effect.
    """

    def __init__(self, env: Environment, num_repeats: int):
        super().__init__(env)
        self.num_repeats = num_repeats
        if isinstance(env, Environment):
            self.spaces = env.spaces  # without a proxy's default params, whose weights are drawn

    def step_env(
        self, key: Array, state: EnvState, action: Array, params: EnvParams
    ) -> Step[EnvState]:
        total = jnp.float32(0)
        num_steps = jnp.int32(0)
        ended = jnp.bool_(False)
        out: Any = None
        for step_key in jax.random.split(key, self.num_repeats):
            new = self.env.step_env(step_key, state, action, params)
            out = new if out is None else jax.tree.map(partial(jnp.where, ended), out, new)
            obs, state, reward, terminated, info = out
            total = total + jnp.where(ended, 0.0, reward)
            num_steps = num_steps + ~ended
            ended = terminated | self.env.is_truncated(state, params) | info.get("nonfinite", False)
        return obs, state, total, terminated, {**info, "sejax_num_steps": num_steps}


@cache
def repeat_actions(env: Environment, num_repeats: int) -> Environment:
    """The environment in which actions last for `num_repeats` steps; `env` itself for 1."""
    return env if num_repeats == 1 else ActionRepeat(env, num_repeats)


@struct.dataclass
class PartState(EnvState):
    env_state: EnvState  # of the wrapped environment


@struct.dataclass
class PartParams(EnvParams):
    scored_steps: Array | int = 1  # may exceed the task's step limit


class PartlyScored(Wrapper[PartState, PartParams]):
    """An environment that scores an episode's first `scored_steps`, which may exceed its limit.

    The reward is 0 after the task's step limit, where a repeated action ends too.
    `info["scored_reward"]` is the reward of a decision that begins within the scored steps, and 0
    after them. An episode lasts to the later of both limits.

    Args:
      env: the environment.
      params: the environment's own params; the wrapper's are `PartParams`.
    """

    def __init__(self, env: Environment, params: EnvParams):
        super().__init__(env)
        self.params = params

    def reset_env(self, key: Array, params: PartParams) -> tuple[Array, PartState]:
        obs, env_state = self.env.reset_env(key, self.params)
        return obs, PartState(time=jnp.int32(0), env_state=env_state)

    def step_env(
        self, key: Array, state: PartState, action: Array, params: PartParams
    ) -> Step[PartState]:
        limit = self.params.max_steps_in_episode
        is_within = state.time < limit
        until = jnp.where(is_within, limit, self._longest(params))
        obs, env_state, reward, terminated, info = self.env.step_env(
            key, state.env_state, action, self._with_limit(until)
        )
        scored = jnp.where(state.time < params.scored_steps, reward, 0.0)
        state = PartState(time=state.time + info.get("sejax_num_steps", 1), env_state=env_state)
        reward = jnp.where(is_within, reward, 0.0)
        return obs, state, reward, terminated, {**info, "scored_reward": scored}

    def is_truncated(self, state: PartState, params: PartParams) -> Array:
        return self.env.is_truncated(state.env_state, self._with_limit(self._longest(params)))

    def _longest(self, params: PartParams) -> Array:
        return jnp.maximum(self.params.max_steps_in_episode, params.scored_steps)

    def _with_limit(self, steps: Array) -> EnvParams:
        return dataclasses.replace(self.params, max_steps_in_episode=steps)


class AsVectors(Wrapper[EnvState, EnvParams]):
    """An environment with float32 vectors as observations and continuous actions in [-1, 1].

    Observations of any shape are flattened, row by row; an action `[n]` is scaled linearly to the
    bounds of the wrapped environment's box and takes its shape. Discrete spaces stay as they are.

    Args:
      env: the environment.
      spaces: its spaces of observations and actions.
      action_shape: shape of its actions.
    """

    def __init__(
        self, env: Environment, spaces: tuple[Space, Space], action_shape: tuple[int, ...]
    ):
        super().__init__(env)
        observation, action = spaces
        self.spaces = spaces
        self._bounds = None
        if isinstance(action, Box):
            self._bounds = np.array([action.low, action.high], np.float32).reshape(2, *action_shape)
            self.spaces = observation, Box.symmetric(*[1.0] * action.size)

    def reset_env(self, key: Array, params: EnvParams) -> tuple[Array, EnvState]:
        obs, state = self.env.reset_env(key, params)
        return self._vector(obs), state

    def step_env(
        self, key: Array, state: EnvState, action: Array, params: EnvParams
    ) -> Step[EnvState]:
        if self._bounds is not None:
            low, high = self._bounds
            action = low + (jnp.reshape(action, low.shape) + 1) / 2 * (high - low)
            action = jnp.clip(action, low, high)
        obs, state, reward, terminated, info = self.env.step_env(key, state, action, params)
        return self._vector(obs), state, reward, terminated, info

    def get_obs(
        self, state: EnvState, params: EnvParams | None = None, key: Array | None = None
    ) -> Array:
        return self._vector(self.env.get_obs(state, params, key))

    def _vector(self, obs: Array) -> Float[Array, " obs_dim"] | Array:
        if self.spaces is not None and isinstance(self.spaces[0], Discrete):
            return obs
        return jnp.ravel(obs).astype(jnp.float32)


def as_vectors(env: Environment, params: EnvParams) -> Environment:
    """An environment that agents can use: `env` itself, or `env` in `AsVectors`.

    Raises:
      ConfigError: for a space that is no box and not discrete, or actions without bounds.
    """
    observation, action = spaces_of(env, params)
    is_own = isinstance(env, Environment) and env.spaces is not None
    # Spaces of gymnax only where they are needed: importing them starts jax's backend.
    shape = (action.size,) if is_own else env.action_space(params).shape
    has_plain_obs = is_own or isinstance(observation, Discrete)
    if not has_plain_obs:  # a real observation tells; a space may be wrong (gymnax's FourRooms)
        obs = jax.eval_shape(lambda: env.reset_env(jax.random.key(0), params)[0])
        has_plain_obs = obs.ndim == 1 and obs.dtype == jnp.float32
    if isinstance(action, Box):
        low, high = np.array(action.low), np.array(action.high)
        is_bounded = np.isfinite([low, high]).all() and (low < high).all()
        require(is_bounded, "env", "must have actions with a finite low < high", got=action)
        is_vector = len(shape) == 1 and len({*-low, *high}) == 1  # the same [-x, x] everywhere
    if has_plain_obs and (isinstance(action, Discrete) or is_vector):
        return env
    return AsVectors(env, (observation, action), shape)


def with_one_done(env: Any) -> Any:
    """An environment with the five-value `step` of gymnax before 1.0, which rejax calls.

    It returns `(obs, state, reward, done, info)`; an episode is done where it is terminated or
    truncated. All else is as before.

    Args:
      env: an environment of gymnax 1.x, such as an SE, an RN or the `env` of a task.

    Example:
      >>> task = sejax.envs.make("cartpole")
      >>> env = with_one_done(task.env)
      >>> _, state = env.reset(jax.random.key(0))
      >>> len(env.step(jax.random.key(1), state, 0))
      5
    """
    old = copy.copy(env)

    def step(*args: Any, **named: Any) -> tuple[Array, Any, Array, Array, dict[str, Array]]:
        obs, state, reward, terminated, truncated, info = env.step(*args, **named)
        return obs, state, reward, terminated | truncated, info

    vars(old)["step"] = step
    return old
