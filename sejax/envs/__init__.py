"""The real tasks: gymnax environments with the paper's step limits and solved thresholds.

A task is a file here, with its facts on top and what takes seconds to import inside `make`.
"""

from typing import Any

from sejax import registry
from sejax.envs import light_gymnax
from sejax.envs.base import Facts, Task

light_gymnax.install()

__all__ = ["Facts", "Task", "facts_of", "make", "make_from", "names"]


def names() -> list[str]:
    """Names that `make` takes, beside `gymnax/ID` and `module:attribute`."""
    return registry.names("env")


def make(name: str, **options: Any) -> Task:
    """Builds a task once and returns the same object ever after.

    Args:
      name: one of `names()`, `gymnax/` and an id that gymnax knows, or `module:attribute`.
      **options: fields of its configuration, as `backend="spring"` for halfcheetah.

    Raises:
      ConfigError: for an unknown name or option, the known ones nearest first; or if it needs a
        package that is not installed.

    Example:
      >>> make("cartpole").solved_reward
      195.0
    """
    return make_from(registry.configure("env", {"name": name, **options}))


def make_from(config: Any) -> Task:
    """The task that a configuration describes, built once; it knows where it came from."""
    task = registry.make("env", config)
    if task.origin is None:
        object.__setattr__(task, "origin", registry.describe("env", config))
    return task


def facts_of(config: Any) -> Facts:
    """What a task's configuration says of it, or else the task itself."""
    stated = getattr(config, "facts", None)
    return stated if isinstance(stated, Facts) else make_from(config).facts
