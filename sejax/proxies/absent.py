"""Tasks that cannot be made here, for SEs that need no more of them than their spaces."""

import functools
import json
from typing import NoReturn

from jaxtyping import Array, PyTree

from sejax.envs.base import Task
from sejax.envs.environment import Environment
from sejax.envs.spec import TaskSpec
from sejax.options import ConfigError
from sejax.proxies.header import Header


class AbsentEnv(Environment):
    """The spaces of a task that cannot be made here, for an SE that needs no more of it.

    Such an SE can be loaded without the package that its task needs, or on a device that the task
    does not run on. `reset_env` and `step_env` raise the reason as a `ConfigError`.
    """

    def __init__(self, task_name: str, spec: TaskSpec, reason: str):
        super().__init__(spec)
        self._task_name, self._reason = task_name, reason

    def fail(self) -> NoReturn:
        """Raises the reason as a `ConfigError`."""
        raise ConfigError(self._reason, "task")

    def reset_env(self, key: Array, params: PyTree) -> NoReturn:
        self.fail()

    def step_env(self, key: Array, state: PyTree, action: Array, params: PyTree) -> NoReturn:
        self.fail()

    @property
    def name(self) -> str:
        return self._task_name


def absent_task(header: Header, reason: str) -> Task:
    """A task of which no more is known than what a proxy's file says; built once.

    Args:
      header: of the file.
      reason: why the task itself cannot be made.
    """
    known = json.dumps([header.interface, header.config["env"]], sort_keys=True)
    return _absent_task(header.task, known, reason)


@functools.cache
def _absent_task(name: str, known: str, reason: str) -> Task:
    interface, origin = json.loads(known)
    spec = TaskSpec.of_interface(interface)
    env = AbsentEnv(name, spec, reason)
    return Task(name=name, env=env, max_steps=spec.max_steps, origin=origin)


def require_present(task: Task) -> Task:
    """The task, if it can be run.

    Raises:
      ConfigError: for one of `absent_task`: why it cannot.
    """
    if isinstance(task.env, AbsentEnv):
        task.env.fail()
    return task
