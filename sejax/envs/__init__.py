"""The real tasks: environments with the paper's step limits and solved thresholds.

`classic`, `gridworld` and `mujoco.tasks` say what each task is (a `TaskSpec`) and make it.
"""

from sejax.envs.base import Task as Task
from sejax.envs.spec import Box as Box
from sejax.envs.spec import Discrete as Discrete
from sejax.envs.spec import TaskSpec as TaskSpec
from sejax.envs.wrappers import with_one_done as with_one_done
from sejax.options import registry
from sejax.options.plain import configure, to_plain
from sejax.options.registry import Makes


def names() -> list[str]:
    """Names that `make` takes, beside `gymnax/ID` and `module:attribute`."""
    return registry.names("env")


def make(name: str, **options: object) -> Task:
    """Builds a task once; later calls return the same object.

    Args:
      name: one of `names()`, `gymnax/` and an id that gymnax knows, or `module:attribute`.
      **options: fields of its configuration, as `backend="spring"` for halfcheetah.

    Raises:
      ConfigError: for an unknown name or option, with the known ones, nearest first; or if the task
        needs a package that is not installed.

    Example:
      >>> make("cartpole").solved_reward
      195.0
    """
    return make_from(configure("env", {"name": name, **options}))


def make_from(config: Makes[Task]) -> Task:
    """The task that a configuration describes, built once; its `origin` is the configuration."""
    task = registry.make("env", config)
    if task.origin is None:  # set once, before anybody else has the task
        vars(task)["origin"] = to_plain(config, "env")
    return task


def spec_of(config: Makes[Task]) -> TaskSpec:
    """The spec that a task's configuration states, or else the task itself."""
    stated = getattr(config, "spec", None)
    return stated if isinstance(stated, TaskSpec) else make_from(config)
