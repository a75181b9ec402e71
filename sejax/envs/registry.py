"""Registry of the real tasks.

gymnax is imported only when a task is made: it costs seconds, and `names()` must answer at once.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sejax.errors import unknown_name


@dataclass(frozen=True, kw_only=True, eq=False)
class Task:
    """A real task: what an agent is tested on, and what counts as solved.

    Attributes:
      name: the registry's name.
      env: gymnax `Environment`; one instance for each name, so that `jit` caches hold.
      params: its `EnvParams`, with the paper's step limit in `max_steps_in_episode`.
      solved_reward: mean return per episode at which the task counts as solved.
    """

    name: str
    env: Any
    params: Any
    solved_reward: float

    @property
    def max_steps(self) -> int:
        return int(self.params.max_steps_in_episode)

    @property
    def obs_dim(self) -> int:
        return int(self.env.observation_space(self.params).shape[0])

    @property
    def num_actions(self) -> int:
        return int(self.env.num_actions)


def _cartpole() -> Task:
    from gymnax.environments.classic_control.cartpole import CartPole

    env = CartPole()
    params = env.default_params.replace(max_steps_in_episode=200)
    return Task(name="cartpole", env=env, params=params, solved_reward=195.0)


def _acrobot() -> Task:
    from gymnax.environments.classic_control.acrobot import Acrobot

    env = Acrobot()
    params = env.default_params.replace(max_steps_in_episode=500)
    return Task(name="acrobot", env=env, params=params, solved_reward=-100.0)


_TASKS: dict[str, Callable[[], Task]] = {"cartpole": _cartpole, "acrobot": _acrobot}


def names() -> tuple[str, ...]:
    """Names that `make` takes."""
    return tuple(_TASKS)


@functools.cache
def make(name: str) -> Task:
    """Builds a task once and returns the same object ever after.

    Raises:
      ConfigError: if the name is unknown; the message lists the known ones, nearest first.

    Source: paper, appendix, fixed hyperparameters (episode length and solved reward).
    """
    if name not in _TASKS:
        raise unknown_name("env", name, names())
    return _TASKS[name]()
