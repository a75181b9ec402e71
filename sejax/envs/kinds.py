"""What sort of states, actions and episodes each task has, known without importing any task.

Configurations are checked before gymnax is imported, which takes seconds; a test holds this table
against the tasks.
"""

import math
from typing import NamedTuple

from sejax.errors import require, unknown_name


class TaskKind(NamedTuple):
    """What a task is like.

    Attributes:
      states: "vector" or "discrete".
      actions: "discrete" or "continuous".
      max_steps: the paper's step limit of an episode.
      has_physics: whether the physics backend can be chosen.
      has_goal_reward: whether the reward for the move into the goal can be chosen.
      has_info: whether its steps tell more than the observation; see `Task.info_keys`.
    """

    states: str
    actions: str
    max_steps: int
    has_physics: bool = False
    has_goal_reward: bool = False
    has_info: bool = False


KINDS = {
    "cartpole": TaskKind("vector", "discrete", 200),
    "acrobot": TaskKind("vector", "discrete", 500),
    "cliff_walking": TaskKind("discrete", "discrete", 50, has_goal_reward=True),
    "gridworld_2x2": TaskKind("discrete", "discrete", 10),
    "mountain_car_continuous": TaskKind("vector", "continuous", 999),
    "pendulum": TaskKind("vector", "continuous", 200),
    "halfcheetah": TaskKind("vector", "continuous", 1000, has_physics=True, has_info=True),
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


def check_choices(name: str, backend: str | None, goal_reward: float | None) -> None:
    """Checks what of a task can be chosen.

    Raises:
      ConfigError: if the task is unknown, leaves no such choice, or has not these physics.
    """
    physical = [task for task, its_kind in KINDS.items() if its_kind.has_physics]
    require(backend is None or kind(name).has_physics, "env.backend", f"be null in {name}",
            f"only {', '.join(physical)} can choose its physics", backend,
            "env.backend=null")  # fmt: skip
    if backend is not None and backend not in PHYSICS_BACKENDS:
        raise unknown_name("env.backend", backend, PHYSICS_BACKENDS)
    rewarding = [task for task, its_kind in KINDS.items() if its_kind.has_goal_reward]
    require(goal_reward is None or kind(name).has_goal_reward, "env.goal_reward",
            f"be null in {name}", f"only {', '.join(rewarding)} can choose it", goal_reward,
            "env.goal_reward=null")  # fmt: skip
    require(goal_reward is None or math.isfinite(goal_reward), "env.goal_reward", "be finite",
            "it is a reward", goal_reward, "env.goal_reward=-1")  # fmt: skip
