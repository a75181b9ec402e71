"""Registry of the real tasks.

gymnax is imported only when a task is made: it costs seconds, and `names()` must answer at once.
"""

import functools
import io
import warnings
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass
from typing import Any

from sejax.envs.kinds import KINDS, PHYSICS_BACKENDS, check_choices, kind
from sejax.errors import ConfigError


@dataclass(frozen=True, kw_only=True, eq=False)
class Task:
    """A real task: what an agent is tested on, and what counts as solved.

    Attributes:
      name: the registry's name.
      env: gymnax `Environment`; one instance for each name, so that `jit` caches hold.
      params: its `EnvParams`, with the paper's step limit in `max_steps_in_episode`.
      solved_reward: mean return per episode at which the task counts as solved.
      info_keys: entries of a step's `info` that say more of the state than the observation, each
        `[]`; what reward networks can weigh.
      augmented_keys: those that describe the state alone, as input for reward networks.
    """

    name: str
    env: Any
    params: Any
    solved_reward: float
    info_keys: tuple[str, ...] = ()
    augmented_keys: tuple[str, ...] = ()

    @property
    def max_steps(self) -> int:
        return int(self.params.max_steps_in_episode)

    @property
    def num_states(self) -> int | None:
        """Number of states of a task whose observation is an index; None for vectors."""
        return _num_categories(self.env.observation_space(self.params))

    @property
    def obs_dim(self) -> int:
        """Length of the observation that networks see; an index is one-hot to them."""
        return self.num_states or int(self.env.observation_space(self.params).shape[0])

    @property
    def num_actions(self) -> int | None:
        """Number of discrete actions; None for continuous ones."""
        return _num_categories(self.env.action_space(self.params))

    @property
    def action_dim(self) -> int:
        """Length of the action that networks see; a discrete one is one-hot to them."""
        return self.num_actions or int(self.env.action_space(self.params).shape[0])

    @property
    def max_action(self) -> float:
        """Continuous actions lie in [-max_action, max_action]; 1 for discrete ones."""
        if self.num_actions is not None:
            return 1.0
        import numpy as np

        return float(np.max(self.env.action_space(self.params).high))


def _num_categories(space: Any) -> int | None:
    """Size of a gymnax `Discrete` space; None for a `Box`."""
    from gymnax.environments import spaces

    return int(space.n) if isinstance(space, spaces.Discrete) else None


def _cartpole() -> Task:
    from gymnax.environments.classic_control.cartpole import CartPole, EnvParams

    params = EnvParams(max_steps_in_episode=kind("cartpole").max_steps)
    return Task(name="cartpole", env=CartPole(), params=params, solved_reward=195.0)


def _acrobot() -> Task:
    from gymnax.environments.classic_control.acrobot import Acrobot, EnvParams

    params = EnvParams(max_steps_in_episode=kind("acrobot").max_steps)
    return Task(name="acrobot", env=Acrobot(), params=params, solved_reward=-100.0)


def _cliff_walking(goal_reward: float = 0.0) -> Task:
    from sejax.envs.gridworld import CLIFF_WALKING, GridParams, GridWorld

    params = GridParams(
        step_reward=-1.0,
        goal_reward=goal_reward,
        hole_reward=-100.0,
        max_steps_in_episode=kind("cliff_walking").max_steps,
    )
    env = GridWorld(CLIFF_WALKING, params)
    return Task(name="cliff_walking", env=env, params=params, solved_reward=-20.0)


def _gridworld_2x2() -> Task:
    from sejax.envs.gridworld import ROOM_2X2, GridParams, GridWorld

    params = GridParams(max_steps_in_episode=kind("gridworld_2x2").max_steps)
    env = GridWorld(ROOM_2X2, params)
    return Task(name="gridworld_2x2", env=env, params=params, solved_reward=0.8)


def _mountain_car_continuous() -> Task:
    from sejax.envs.mountain_car_continuous import EnvParams, MountainCarContinuous

    env = MountainCarContinuous()
    params = EnvParams(max_steps_in_episode=kind("mountain_car_continuous").max_steps)
    return Task(name="mountain_car_continuous", env=env, params=params, solved_reward=90.0)


def _pendulum() -> Task:
    from gymnax.environments.classic_control.pendulum import EnvParams, Pendulum

    params = EnvParams(max_steps_in_episode=kind("pendulum").max_steps)
    # Our choice of threshold: neither the paper nor Gymnasium defines one.
    return Task(name="pendulum", env=Pendulum(), params=params, solved_reward=-250.0)


def _halfcheetah(backend: str) -> Task:
    try:
        # On import brax tells at length of other physics, and that its envs are not maintained.
        with warnings.catch_warnings(action="ignore"), redirect_stdout(io.StringIO()):
            from sejax.envs.halfcheetah import INFO_KEYS, CheetahParams, HalfCheetah

            env = HalfCheetah(backend)
    except ImportError as error:
        raise ConfigError(
            "env=halfcheetah needs brax, because its physics are brax's; it is not installed "
            f"({error}). Install it with pip install 'sejax[brax]'."
        ) from error

    params = CheetahParams(max_steps_in_episode=kind("halfcheetah").max_steps)
    return Task(
        name="halfcheetah", env=env, params=params, solved_reward=3000.0,
        info_keys=INFO_KEYS, augmented_keys=("x_position", "x_velocity"),
    )  # fmt: skip


_TASKS: dict[str, Callable[..., Task]] = {
    "cartpole": _cartpole,
    "acrobot": _acrobot,
    "cliff_walking": _cliff_walking,
    "gridworld_2x2": _gridworld_2x2,
    "mountain_car_continuous": _mountain_car_continuous,
    "pendulum": _pendulum,
    **{
        f"halfcheetah-{backend}": functools.partial(_halfcheetah, backend)
        for backend in PHYSICS_BACKENDS
    },
}


def names() -> tuple[str, ...]:
    """Names that `make` takes."""
    return tuple(KINDS)


def make(name: str, backend: str | None = None, goal_reward: float | None = None) -> Task:
    """Builds a task once and returns the same object ever after.

    Args:
      name: one of `names()`.
      backend: physics of a brax task, one of `PHYSICS_BACKENDS`; None is the first.
      goal_reward: reward for the move into the goal in Cliff Walking; None is 0.

    Raises:
      ConfigError: if a name is unknown; the message lists the known ones, nearest first. Also if
        the task leaves no such choice, or needs a package that is not installed.

    Source: paper, appendix, fixed hyperparameters (episode length and solved reward).
    """
    check_choices(name, backend, goal_reward)
    if kind(name).has_physics:
        return _make(f"{name}-{backend or PHYSICS_BACKENDS[0]}")
    return _make(name) if goal_reward is None else _make(name, float(goal_reward))


@functools.cache
def _make(key: str, *choices: float) -> Task:
    return _TASKS[key](*choices)
