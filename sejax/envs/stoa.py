"""Environments of other JAX suites, by suite and id: `env=stoa/navix/Navix-Empty-5x5-v0`.

[stoa](https://github.com/EdanToledo/Stoa) gives the suites one interface, in which an episode says
whether it was terminated or truncated and no step resets; here it becomes sejax's. Observations of
several arrays become one vector, in the order of their fields (of a dictionary, its names), and
continuous actions lie in [-1, 1]. A suite is installed beside sejax's
extra `stoa`. Two players, or several actions at once, do not fit an agent of sejax.
"""

import math
import pkgutil
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, PyTree

from sejax import options
from sejax.envs.base import Task
from sejax.envs.environment import Environment, EnvParams, EnvState, Step
from sejax.envs.spec import Box, Discrete, Space, TaskSpec
from sejax.options import Options, counts, option, require

PREFIX = "stoa/"
LIMITS = ("max_steps", "max_timesteps", "time_limit", "episode_length")  # as suites call it


# Of each suite the function that makes an environment of an id, and, in `stoa.env_adapters`, the
# class that takes it.
SUITES = {
    "brax": ("brax.envs:get_environment", "brax:BraxToStoa"),
    "craftax": ("sejax.envs.stoa:make_craftax", "gymnax:GymnaxToStoa"),
    "jumanji": ("jumanji:make", "jumanji:JumanjiToStoa"),
    "navix": ("navix:make", "navix:NavixToStoa"),
    "pgx": ("pgx:make", "pgx:PGXToStoa"),
    "playground": ("sejax.envs.stoa:make_playground", "playground:MuJoCoPlaygroundToStoa"),
    "xminigrid": ("xminigrid:make", "xminigrid:XMiniGridToStoa"),
}


@dataclass(frozen=True, kw_only=True)
class StoaTask(Options):
    """An environment of a suite that stoa has an adapter for.

    Attributes:
      solved_reward: mean return that counts as solved; null: undefined
      max_steps: null: the environment's own, or 1,000 where it has none.

    Raises:
      ConfigError: when it is made, for a suite that is not known or not installed, or an id that it
        cannot make.
    """

    group: ClassVar[str] = "env"

    name: str = f"{PREFIX}navix/Navix-Empty-5x5-v0"
    solved_reward: float | None = None
    max_steps: int | None = option(None, counts("an episode has steps"))

    def make(self) -> Task:
        suite, _, name = self.name.removeprefix(PREFIX).partition("/")
        if suite not in SUITES or not name:
            raise options.unknown_name("env", self.name, [f"{PREFIX}{x}/ID" for x in SUITES])
        maker, adapter = SUITES[suite]
        try:
            theirs = pkgutil.resolve_name(maker)(name)
            args = theirs if isinstance(theirs, tuple) else (theirs,)  # with its params
            env = pkgutil.resolve_name(f"stoa.env_adapters.{adapter}")(*args)
        except Exception as error:
            is_missing = isinstance(error, ImportError)
            install = f"Install it with pip install 'sejax[stoa]' {suite}."
            fix = install if is_missing else "Set another id."
            raise options.ConfigError(
                f"env must be an environment that {suite} can make here; {name} raised "
                f"{options.told(error)}. {fix}",
                "env",
            ) from error
        return Task(
            name=self.name,
            env=StoaEnv(env, self.max_steps or _limit(args)),
            solved_reward=math.inf if self.solved_reward is None else self.solved_reward,
        )


def make_craftax(name: str) -> Any:
    """An environment of craftax, which has gymnax's interface and a copy of its spaces."""
    from craftax.craftax_env import make_craftax_env_from_name
    from gymnax.environments import spaces

    env = make_craftax_env_from_name(name, auto_reset=False)
    space = spaces.Discrete(env.action_space(env.default_params).n)
    env.action_space = lambda params=None: space
    return env


def make_playground(name: str) -> Any:
    """An environment of MuJoCo Playground on JAX: its default, Warp, wants a GPU of NVIDIA."""
    from mujoco_playground import registry

    return registry.load(name, config_overrides={"impl": "jax"})


def _limit(theirs: tuple[object, ...]) -> int:
    """The environment's own step limit, of what its suite has made."""
    stated = (
        getattr(x, name, None)
        for part in theirs
        for x in (part, getattr(part, "default_params", None), getattr(part, "_config", None))
        for name in LIMITS
    )
    return next((int(x) for x in stated if isinstance(x, int)), 1000)


@struct.dataclass
class StoaState(EnvState):
    inner: PyTree  # the suite's
    truncated: Array


class StoaEnv(Environment[StoaState, EnvParams]):
    """A stoa environment in sejax's own interface.

    Args:
      env: the adapter's, of one of the suites.
      max_steps: step limit of an episode.

    Raises:
      ConfigError: for several players, several actions at once, or actions without bounds.
    """

    def __init__(self, env: Any, max_steps: int):
        self._env = env
        space = env.action_space()

        def first() -> tuple[Array, Array]:
            state, step = env.reset(jax.random.key(0))
            reward = env.step(state, jnp.zeros(space.shape, space.dtype))[1].reward
            return _vector(step.observation), reward

        obs, reward = jax.eval_shape(first)
        must = f"must have one player; got {reward.size} of them. Set another one."
        require(reward.size == 1, "env", must)
        action, self._bounds = _action_space(space)
        observation = Box.symmetric(*[math.inf] * obs.size)
        super().__init__(TaskSpec(observation=observation, action=action, max_steps=max_steps))

    def reset_env(self, key: Array, params: EnvParams) -> tuple[Array, StoaState]:
        inner, step = self._env.reset(key)
        state = StoaState(time=jnp.int32(0), inner=inner, truncated=jnp.bool_(False))
        return _vector(step.observation), state

    def step_env(
        self, key: Array, state: StoaState, action: Array, params: EnvParams
    ) -> Step[StoaState]:
        if self._bounds is not None:
            low, high = self._bounds
            action = low + (action.reshape(low.shape) + 1) / 2 * (high - low)
        inner, step = self._env.step(state.inner, action)
        # jumanji's last steps all come as terminated; the discount tells which are not.
        terminated = step.last() & (step.discount == 0)
        truncated = step.last() & ~terminated
        after = StoaState(time=state.time + 1, inner=inner, truncated=truncated)
        info = {"discount": jnp.float32(step.discount)}
        return _vector(step.observation), after, jnp.float32(step.reward), terminated, info

    def is_truncated(self, state: StoaState, params: EnvParams) -> Array:
        return jnp.asarray(state.truncated | (state.time >= params.max_steps_in_episode))


def _vector(observation: PyTree) -> Array:
    leaves = jax.tree.leaves(observation)
    return jnp.concatenate([jnp.ravel(x).astype(jnp.float32) for x in leaves])


def _action_space(space: Any) -> tuple[Space, tuple[np.ndarray, np.ndarray] | None]:
    """The space as agents act, [-1, 1] for actions of any bounds, and these bounds."""
    if hasattr(space, "num_values"):
        must = f"must have one action at a time; got {space.num_values}. Set another one."
        require(np.ndim(space.num_values) == 0, "env", must)
        return Discrete(int(space.num_values)), None
    low, high = (
        np.broadcast_to(x, space.shape).astype("f4") for x in (space.minimum, space.maximum)
    )
    require(
        np.isfinite([low, high]).all() and (low < high).all(),
        "env",
        f"must have bounded actions; got {space.minimum} to {space.maximum}. Set another one.",
    )
    return Box.symmetric(*[1.0] * low.size), (low, high)
