"""What sort of states and actions each task has, known without importing any task.

Configurations are checked before gymnax is imported, which takes seconds; a test holds this table
against the tasks.
"""

from typing import NamedTuple

from sejax.errors import unknown_name


class TaskKind(NamedTuple):
    """`states` is "vector" or "discrete", `actions` "discrete" or "continuous"."""

    states: str
    actions: str


KINDS = {
    "cartpole": TaskKind("vector", "discrete"),
    "acrobot": TaskKind("vector", "discrete"),
    "cliff_walking": TaskKind("discrete", "discrete"),
    "gridworld_2x2": TaskKind("discrete", "discrete"),
    "mountain_car_continuous": TaskKind("vector", "continuous"),
    "pendulum": TaskKind("vector", "continuous"),
}


def kind(name: str) -> TaskKind:
    """The kind of a task.

    Raises:
      ConfigError: if the name is unknown.
    """
    if name not in KINDS:
        raise unknown_name("env", name, KINDS)
    return KINDS[name]
