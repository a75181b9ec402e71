"""A task's spec: its spaces, limits and thresholds, known without making the task."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Discrete:
    """The indices 0 to n - 1."""

    n: int

    @property
    def size(self) -> int:
        """Length of the one-hot vector."""
        return self.n


@dataclass(frozen=True)
class Box:
    """Vectors between two bounds, which may be infinite.

    Attributes:
      low, high: the bounds.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    @classmethod
    def symmetric(cls, *high: float) -> "Box":
        """Vectors whose entries lie between minus and plus these bounds."""
        return cls(tuple(-x for x in high), high)

    @property
    def size(self) -> int:
        """Length of the vectors."""
        return len(self.high)


Space = Discrete | Box


def sizes_of(observation: Space, action: Space) -> tuple[tuple[str, int], ...]:
    """Kind and size of the observations and of the actions, `(("Box", 4), ("Discrete", 2))`.

    An agent fits all spaces of the same sizes, whatever their bounds.
    """
    return tuple((type(space).__name__, space.size) for space in (observation, action))


@dataclass(frozen=True, kw_only=True, eq=False)
class TaskSpec:
    """What is known of a task without making it.

    A task's configuration may have a spec as its attribute `spec`. Then settings that do not suit
    the task are refused before its environment is imported, which can take seconds. A `Task` is a
    spec, too. Specs are compared by identity.

    Attributes:
      observation: space of the observations, indices or vectors.
      action: space of the actions: indices, or vectors in [-x, x] for the same x everywhere.
      max_steps: step limit of an episode.
      solved_reward: mean return per episode at which the task counts as solved; inf if undefined.
      info_keys: entries of a step's `info`, each `[]`, that say more than the observation; reward
        networks can weigh them.
      augmented_keys: the `info_keys` that describe only the state; reward networks can see them.
    """

    observation: Space
    action: Space
    max_steps: int
    solved_reward: float = math.inf
    info_keys: tuple[str, ...] = ()
    augmented_keys: tuple[str, ...] = ()

    @classmethod
    def of_interface(cls, interface: Mapping[str, Any]) -> "TaskSpec":
        """Inverse of `interface`."""
        return cls(
            observation=_space_of(interface["observation"]),
            action=_space_of(interface["action"]),
            max_steps=interface["max_steps"],
        )

    @property
    def interface(self) -> dict[str, Any]:
        """What agents see, as plain values that a proxy's file keeps.

        `observation` and `action` are `{"n": categories}` or the bounds of a vector, `{"low": [x],
        "high": [x]}`, with None for no bound; `max_steps` is the step limit.
        """
        return {
            "observation": _plain(self.observation),
            "action": _plain(self.action),
            "max_steps": self.max_steps,
        }

    @property
    def states(self) -> str:
        """Kind of the observations: "discrete" or "vector"."""
        return "discrete" if isinstance(self.observation, Discrete) else "vector"

    @property
    def actions(self) -> str:
        """Kind of the actions: "discrete" or "continuous"."""
        return "discrete" if isinstance(self.action, Discrete) else "continuous"

    @property
    def is_solvable(self) -> bool:
        """Whether the task has a solved reward."""
        return math.isfinite(self.solved_reward)

    @property
    def num_states(self) -> int | None:
        """Number of states of a task whose observation is an index; None for vectors."""
        return self.observation.n if isinstance(self.observation, Discrete) else None

    @property
    def obs_dim(self) -> int:
        """Length of the observation that networks see; an index is one-hot to them."""
        return self.observation.size

    @property
    def num_actions(self) -> int | None:
        """Number of discrete actions; None for continuous ones."""
        return self.action.n if isinstance(self.action, Discrete) else None

    @property
    def action_dim(self) -> int:
        """Length of the action that networks see; a discrete one is one-hot to them."""
        return self.action.size

    @property
    def max_action(self) -> float:
        """Continuous actions lie in [-max_action, max_action]; 1 for discrete ones."""
        return 1.0 if isinstance(self.action, Discrete) else max(self.action.high)


def _plain(space: Space) -> dict[str, Any]:
    """A space of `TaskSpec.interface`, its bounds in single precision."""
    if isinstance(space, Discrete):
        return {"n": space.n}
    return {
        name: [float(np.float32(x)) if math.isfinite(x) else None for x in bound]
        for name, bound in vars(space).items()
    }


def _space_of(plain: Mapping[str, Any]) -> Space:
    """Inverse of `_plain`."""
    if "n" in plain:
        return Discrete(plain["n"])
    low = tuple(-math.inf if x is None else float(x) for x in plain["low"])
    high = tuple(math.inf if x is None else float(x) for x in plain["high"])
    return Box(low, high)
