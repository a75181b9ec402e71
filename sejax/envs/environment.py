"""The base class of our environments: a gymnax 1.x `Environment` that does not import gymnax.

Importing anything of gymnax imports all its environments, and with them seaborn and pandas, which
takes 1.3 CPU s. The methods are gymnax's and the spaces that they return too, so that code which
takes an environment of gymnax takes one of ours; only `isinstance` tells them apart. gymnax is
imported when its spaces are asked for.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array

from sejax.envs.spec import Box, Discrete, Space
from sejax.options import ConfigError


@struct.dataclass
class EnvState:
    time: Array | int  # steps since the reset


@struct.dataclass
class EnvParams:
    max_steps_in_episode: int = 1


class Environment:
    """An environment whose `step_env` and `reset_env` act on one element.

    Attributes:
      spaces: of observations and actions; None in a wrapper, whose methods `observation_space` and
        `action_space` say.
    """

    spaces: tuple[Space, Space] | None = None

    @property
    def default_params(self) -> Any:
        return EnvParams()

    def reset_env(self, key: Any, params: Any) -> tuple[Any, Any]:
        """First observation and state of an episode."""
        raise NotImplementedError

    def step_env(self, key: Any, state: Any, action: Any, params: Any) -> tuple[Any, ...]:
        """`(obs, state, reward, terminated, info)` of one step; never resets."""
        raise NotImplementedError

    def get_obs(self, state: Any, params: Any = None, key: Any = None) -> Any:
        raise NotImplementedError

    def is_terminated(self, state: Any, params: Any) -> Any:
        raise NotImplementedError

    def is_truncated(self, state: Any, params: Any) -> Any:
        """Whether the step limit is reached."""
        return state.time >= params.max_steps_in_episode

    def discount(self, state: Any, params: Any) -> Array:
        """0 in a terminal state, else 1."""
        return jax.lax.select(self.is_terminated(state, params), 0.0, 1.0)

    @functools.partial(jax.jit, static_argnames=("self",))
    def reset(self, key: Array, params: Any = None) -> tuple[Any, Any]:
        """As `reset_env`; for loops that are not sejax's."""
        return self.reset_env(key, self.default_params if params is None else params)

    @functools.partial(jax.jit, static_argnames=("self",))
    def step(self, key: Array, state: Any, action: Any, params: Any = None) -> tuple[Any, ...]:
        """A step, and a reset where it ends the episode; for loops that are not sejax's.

        Returns:
          `(obs, state, reward, terminated, truncated, info)`, whose `info` has the
          `final_observation` of the step.
        """
        params = self.default_params if params is None else params
        key_step, key_reset = jax.random.split(key)
        next_obs, state, reward, terminated, info = self.step_env(key_step, state, action, params)
        truncated = self.is_truncated(state, params)
        obs, state = jax.tree.map(
            functools.partial(jax.lax.select, terminated | truncated),
            self.reset_env(key_reset, params),
            (next_obs, state),
        )
        ends = {"terminated": terminated, "truncated": truncated, "final_observation": next_obs}
        return obs, state, reward, terminated, truncated, {**info, **ends}

    def observation_space(self, params: Any = None) -> Any:
        """gymnax's `Box` or `Discrete`."""
        assert self.spaces is not None
        return _of_gymnax(self.spaces[0])

    def action_space(self, params: Any = None) -> Any:
        """gymnax's `Box` or `Discrete`."""
        assert self.spaces is not None
        return _of_gymnax(self.spaces[1])

    @property
    def num_actions(self) -> int:
        """Number of discrete actions, or length of a continuous one."""
        assert self.spaces is not None
        return self.spaces[1].size

    @property
    def name(self) -> str:
        return type(self).__name__


def spaces_of(env: Any) -> tuple[Space, Space]:
    """Spaces of the observations and actions of any environment.

    Raises:
      ConfigError: if one is neither a box nor discrete.
    """
    if isinstance(env, Environment) and env.spaces is not None:
        return env.spaces
    with jax.ensure_compile_time_eval():  # gymnax computes some spaces
        params = env.default_params
        return (
            space_of_gymnax(env.observation_space(params), "observations", type(env).__name__),
            space_of_gymnax(env.action_space(params), "actions", type(env).__name__),
        )


def _of_gymnax(space: Space) -> Any:
    """A space as one of gymnax."""
    from gymnax.environments import spaces

    if isinstance(space, Discrete):
        return spaces.Discrete(space.n)
    low, high = (jnp.array(bound, jnp.float32) for bound in (space.low, space.high))
    return spaces.Box(low, high, low.shape, jnp.float32)


def space_of_gymnax(space: Any, what: str, name: str) -> Space:
    """A space of gymnax as ours, a box of any shape flattened.

    Args:
      space: of gymnax.
      what: it is a space of, for the message.
      name: of the environment, for the message.

    Raises:
      ConfigError: if it is neither a box nor discrete.
    """
    from gymnax.environments import spaces

    if isinstance(space, spaces.Discrete):
        return Discrete(int(space.n))
    if isinstance(space, spaces.Box):
        bounds = (np.broadcast_to(np.float32(x), space.shape) for x in (space.low, space.high))
        return Box(*(tuple(bound.ravel().tolist()) for bound in bounds))
    raise ConfigError(
        f"env must have {what} in a gymnax Box or Discrete space, because networks take vectors "
        f"and tables take indices; got {space!r} in {name}. Make them one array in a subclass of "
        f"sejax.envs.wrappers.Wrapper."
    )
