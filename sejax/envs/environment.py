"""A gymnax 1.x `Environment` that does not import gymnax.

Importing anything of gymnax imports all its environments, and with them seaborn and pandas. That
takes a CPU second. `reset`, `step`, `reset_env`, `step_env`, `is_truncated`, `action_space` and
`observation_space` are gymnax's, and so are the spaces. So gymnax's wrappers take ours too; only
`isinstance` tells them apart. gymnax is imported when `reset`, `step` or a space is asked for.
"""

import dataclasses
from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool

from sejax.envs.spec import Box, Discrete, Space, TaskSpec
from sejax.options import ConfigError


@struct.dataclass
class EnvState:
    """State of an episode; `Environment` has an example of a subclass.

    A subclass has the decorator `flax.struct.dataclass` too, and is made by keywords.
    """

    time: Array | int  # steps since the reset


@struct.dataclass
class EnvParams:
    """What steps read besides the state; subclassed as `EnvState`, with a default for each."""

    max_steps_in_episode: Array | int = 1


State = TypeVar("State", bound=EnvState)
Params = TypeVar("Params", bound=EnvParams)
Step = tuple[Array, State, Array, Array, dict[str, Array]]  # obs, state, reward, terminated, info


class Environment(Generic[State, Params]):
    """An environment whose `step_env` and `reset_env` act on one element.

    A subclass adds `step_env`, and `start` and `observe` (or `reset_env`). It adds `is_terminated`
    if the state tells whether an episode terminates.

    Args:
      spec: its spaces, and the step limit of `default_params`.
      params: `default_params` without this limit.

    Attributes:
      spaces: of observations and actions; None in a wrapper, where the methods `observation_space`
        and `action_space` give them.

    Example:
      >>> import sejax
      >>> @struct.dataclass
      ... class Place(EnvState):
      ...     x: Array
      >>> class Reach(Environment):
      ...     def start(self, key):
      ...         return Place(time=0, x=jax.random.uniform(key))
      ...     def observe(self, state):
      ...         return state.x[None]
      ...     def step_env(self, key, state, action, params):
      ...         state = Place(time=state.time + 1, x=state.x + 0.1 * action[0])
      ...         return self.after(state, -jnp.abs(state.x), params)
      >>> spec = TaskSpec(observation=Box((-1.0,), (1.0,)), action=Box.symmetric(1.0), max_steps=50)
      >>> sejax.Task.of(spec, name="reach", env=Reach(spec)).obs_dim
      1
    """

    spaces: tuple[Space, Space] | None = None

    def __init__(self, spec: TaskSpec, params: EnvParams | None = None):
        self.spaces = spec.observation, spec.action
        params = params or EnvParams()
        self._default_params = dataclasses.replace(params, max_steps_in_episode=spec.max_steps)

    @property
    def default_params(self) -> Params:
        return self._default_params  # type: ignore[return-value]

    def reset_env(self, key: Array, params: Params) -> tuple[Array, State]:
        """First observation and state of an episode."""
        state = self.start(key)
        return self.observe(state), state

    def start(self, key: Array) -> State:
        """First state of an episode."""
        raise NotImplementedError(f"{self.name} needs start, or reset_env")

    def step_env(self, key: Array, state: State, action: Array, params: Params) -> Step[State]:
        """`(obs, state, reward, terminated, info)` of one step; never resets."""
        raise NotImplementedError(f"{self.name} needs step_env")

    def observe(self, state: State) -> Array:
        """The observation of a state."""
        raise NotImplementedError(f"{self.name} needs observe, or reset_env")

    def is_terminated(self, state: State, params: Params) -> Bool[Array, ""]:
        """Whether a state is terminal; False if only a step can tell, or if no state is."""
        return jnp.bool_(False)

    def is_truncated(self, state: State, params: Params) -> Bool[Array, ""]:
        """Whether the step limit is reached."""
        return jnp.asarray(state.time >= params.max_steps_in_episode)

    def get_obs(
        self, state: State, params: Params | None = None, key: Array | None = None
    ) -> Array:
        """As `observe`, under gymnax's name."""
        return self.observe(state)

    def after(self, state: State, reward: Array, params: Params) -> Step[State]:
        """What `step_env` returns for a step that leads to this state."""
        terminated = self.is_terminated(state, params)
        info = {"discount": jax.lax.select(terminated, 0.0, 1.0)}
        return self.observe(state), state, reward, terminated, info

    def reset(self, key: Array, params: Params | None = None) -> tuple[Array, State]:
        """As `reset_env`; for loops that are not sejax's."""
        return _gymnax_class().reset(self, key, params)

    def step(
        self, key: Array, state: State, action: Array, params: Params | None = None
    ) -> tuple[Array, State, Array, Array, Array, dict[str, Array]]:
        """A step, and a reset where it ends the episode; for loops that are not sejax's.

        Returns:
          `(obs, state, reward, terminated, truncated, info)`, whose `info` has the
          `final_observation` of the step.
        """
        return _gymnax_class().step(self, key, state, action, params)

    def observation_space(self, params: Params | None = None) -> Any:
        """gymnax's `Box` or `Discrete`."""
        return _as_gymnax(spaces_of(self)[0])

    def action_space(self, params: Params | None = None) -> Any:
        """gymnax's `Box` or `Discrete`."""
        return _as_gymnax(spaces_of(self)[1])

    @property
    def num_actions(self) -> int:
        """Number of discrete actions, or length of a continuous one."""
        return spaces_of(self)[1].size

    @property
    def name(self) -> str:
        return type(self).__name__


def _gymnax_class() -> Any:
    from gymnax.environments.environment import Environment as GymnaxEnvironment

    return GymnaxEnvironment


def spaces_of(env: Environment, params: EnvParams | None = None) -> tuple[Space, Space]:
    """Spaces of the observations and actions of any gymnax environment, boxes flattened.

    Raises:
      ConfigError: if one is neither a box nor discrete.
    """
    if isinstance(env, Environment) and env.spaces is not None:
        return env.spaces
    with jax.ensure_compile_time_eval():  # gymnax computes some spaces
        params = env.default_params if params is None else params
        observation = _of_gymnax(env.observation_space(params), "observations")
        return observation, _of_gymnax(env.action_space(params), "actions")


def _as_gymnax(space: Space) -> Any:
    from gymnax.environments import spaces

    if isinstance(space, Discrete):
        return spaces.Discrete(space.n)
    shape = () if space.size == 1 else (space.size,)  # gymnax's wrappers want numbers
    low = jnp.array(space.low, jnp.float32).reshape(shape)
    high = jnp.array(space.high, jnp.float32).reshape(shape)
    return spaces.Box(low, high, (space.size,), jnp.float32)


def _of_gymnax(space: Any, elements: str) -> Space:
    from gymnax.environments import spaces

    if isinstance(space, spaces.Discrete):
        return Discrete(int(space.n))
    if isinstance(space, spaces.Box):
        low = np.broadcast_to(np.float32(space.low), space.shape)
        high = np.broadcast_to(np.float32(space.high), space.shape)
        return Box(tuple(low.ravel().tolist()), tuple(high.ravel().tolist()))
    fix = "Make them one array in a sejax.envs.wrappers.Wrapper."
    raise ConfigError("env", f"must have {elements} in a Box or Discrete", got=repr(space), fix=fix)
