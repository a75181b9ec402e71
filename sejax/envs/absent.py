"""A task that cannot be made here, of which a proxy's file says what agents see.

A synthetic environment that takes no initial states from its task needs no more: it can be loaded
without the package that the task needs, or on a device that the task does not run on.
"""

import functools
import json
from typing import Any, NoReturn

from sejax.envs.base import Task
from sejax.envs.environment import Environment
from sejax.envs.spec import TaskSpec
from sejax.errors import ConfigError


class AbsentEnv(Environment):
    """Spaces alone; `reset_env` and `step_env` raise the reason why there is no more."""

    def __init__(self, task_name: str, spec: TaskSpec, reason: str):
        self._task_name, self._reason = task_name, reason
        self.spaces = spec.observation, spec.action

    def fail(self) -> NoReturn:
        """Raises the reason as a `ConfigError`."""
        raise ConfigError(self._reason)

    def reset_env(self, key: Any, params: Any) -> NoReturn:
        self.fail()

    def step_env(self, key: Any, state: Any, action: Any, params: Any) -> NoReturn:
        self.fail()

    @property
    def name(self) -> str:
        return self._task_name


def make(name: str, interface: dict[str, Any], origin: dict[str, Any], reason: str) -> Task:
    """The task of that name, built once; what needs more than its interface raises `reason`.

    Args:
      name: of the task.
      interface: as of `TaskSpec.interface`.
      origin: as of `Task`, for files that are written of it.
      reason: why the task itself cannot be made.
    """
    return _make(name, json.dumps([interface, origin], sort_keys=True), reason)


@functools.cache
def _make(name: str, known: str, reason: str) -> Task:
    interface, origin = json.loads(known)
    spec = TaskSpec.of_interface(interface)
    env = AbsentEnv(name, spec, reason)
    return Task(name=name, env=env, max_steps=spec.max_steps, origin=origin)


def require_present(task: Task) -> Task:
    """The task, if it can be run.

    Raises:
      ConfigError: for what `make` made: why it cannot.
    """
    if isinstance(task.env, AbsentEnv):
        task.env.fail()
    return task
