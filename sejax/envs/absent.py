"""A task that cannot be had here, of which a proxy's file says what agents see.

A synthetic environment that takes no initial states from its task needs no more: it can be loaded
without the package that the task needs, on a device that it does not run on, or by a stranger.
"""

import functools
import json
from typing import Any, NoReturn

import jax.numpy as jnp
from gymnax.environments import environment, spaces

from sejax.envs.base import Task
from sejax.errors import ConfigError


class AbsentEnv(environment.Environment[Any, Any]):
    """Spaces alone: whoever wants to reset or step it is told why there is no more.

    Attributes:
      reason: the message of the error that says why.
      observes_vectors: that `as_vectors` need not reset it to see what it observes.
    """

    observes_vectors = True

    def __init__(self, task_name: str, interface: dict[str, Any], reason: str):
        super().__init__()
        self.reason = reason
        self._task_name = task_name
        self._observation = _space(interface["observation"])
        self._action = _space(interface["action"])

    def fail(self) -> NoReturn:
        """Raises the reason as a `ConfigError`."""
        raise ConfigError(self.reason)

    def reset_env(self, key: Any, params: Any) -> NoReturn:
        self.fail()

    def step_env(self, key: Any, state: Any, action: Any, params: Any) -> NoReturn:
        self.fail()

    @property
    def name(self) -> str:
        return self._task_name

    @property
    def num_actions(self) -> int:
        return (
            self._action.n if isinstance(self._action, spaces.Discrete) else self._action.shape[0]
        )

    def action_space(self, params: Any = None) -> Any:
        return self._action

    def observation_space(self, params: Any = None) -> Any:
        return self._observation


def make(name: str, interface: dict[str, Any], origin: dict[str, Any], reason: str) -> Task:
    """The task of that name, built once; what needs more than its interface raises `reason`.

    Args:
      name: of the task.
      interface: as of `Task.interface`.
      origin: as of `Task.origin`, for files that are written of it.
      reason: why the task itself cannot be had.
    """
    return _make(name, json.dumps([interface, origin], sort_keys=True), reason)


@functools.cache
def _make(name: str, known: str, reason: str) -> Task:
    interface, origin = json.loads(known)
    return Task(
        name=name,
        env=AbsentEnv(name, interface, reason),
        max_steps=interface["max_steps"],
        origin=origin,
    )


def require_present(task: Task) -> Task:
    """The task, if it can be run.

    Raises:
      ConfigError: for what `make` made: why it cannot.
    """
    if isinstance(task.env, AbsentEnv):
        task.env.fail()
    return task


def _space(plain: dict[str, Any]) -> Any:
    if "n" in plain:
        return spaces.Discrete(plain["n"])
    low, high = (
        jnp.array([end if x is None else x for x in plain[name]], jnp.float32)
        for name, end in (("low", -jnp.inf), ("high", jnp.inf))
    )
    return spaces.Box(low, high, low.shape, jnp.float32)
