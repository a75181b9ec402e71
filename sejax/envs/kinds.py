"""What sort of states and actions each task has, known without importing any task.

Configurations are checked before gymnax is imported, which takes seconds; a test holds this table
against the tasks.
"""

from typing import NamedTuple

from sejax.errors import require, unknown_name


class TaskKind(NamedTuple):
    """What a task is like.

    Attributes:
      states: "vector" or "discrete".
      actions: "discrete" or "continuous".
      has_physics: whether the physics backend can be chosen.
      has_info: whether its steps tell more than the observation; see `Task.info_keys`.
    """

    states: str
    actions: str
    has_physics: bool = False
    has_info: bool = False


KINDS = {
    "cartpole": TaskKind("vector", "discrete"),
    "acrobot": TaskKind("vector", "discrete"),
    "cliff_walking": TaskKind("discrete", "discrete"),
    "gridworld_2x2": TaskKind("discrete", "discrete"),
    "mountain_car_continuous": TaskKind("vector", "continuous"),
    "pendulum": TaskKind("vector", "continuous"),
    "halfcheetah": TaskKind("vector", "continuous", has_physics=True, has_info=True),
}
# brax's; the first is the default: nearly MuJoCo at less than twice the cost of the cheapest, where
# no other one moves like MuJoCo at all (docs/halfcheetah.md).
PHYSICS_BACKENDS = ("mjx", "spring", "positional", "generalized")


def kind(name: str) -> TaskKind:
    """The kind of a task.

    Raises:
      ConfigError: if the name is unknown.
    """
    if name not in KINDS:
        raise unknown_name("env", name, KINDS)
    return KINDS[name]


def check_backend(name: str, backend: str | None) -> None:
    """Checks a choice of physics.

    Raises:
      ConfigError: if the task is unknown, it has no choice of physics, or has not this one.
    """
    physical = [task for task, its_kind in KINDS.items() if its_kind.has_physics]
    require(backend is None or kind(name).has_physics, "env.backend", f"be null in {name}",
            f"only {', '.join(physical)} can choose its physics", backend,
            "env.backend=null")  # fmt: skip
    if backend is not None and backend not in PHYSICS_BACKENDS:
        raise unknown_name("env.backend", backend, PHYSICS_BACKENDS)
