"""The classic control tasks. Dynamics and resets are Gymnasium's (`sejax.envs.dynamics.classic`).

Sources: step limits and solved rewards of cartpole, acrobot and mountain_car_continuous: paper,
appendix, fixed hyperparameters. Of the others: Gymnasium's registry.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

from sejax.envs.base import Task
from sejax.envs.spec import Box, Discrete, TaskSpec

_NONE = 3.4028234663852886e38  # how CartPole writes that a number has no bound
_CARTPOLE = Box.symmetric(4.8, _NONE, math.radians(24), _NONE)
_CAR = Box(low=(-1.2, -0.07), high=(0.6, 0.07))  # position and velocity


@dataclass(frozen=True)
class ClassicTask:
    """A task without options.

    Attributes:
      name: of the task.
      dynamics: class of `sejax.envs.dynamics.classic`.
      spec: what is known of it.
    """

    name: ClassVar[str]
    dynamics: ClassVar[str]
    spec: ClassVar[TaskSpec]

    def make(self) -> Task:
        from sejax.envs.dynamics import classic

        return Task.of(self.spec, name=self.name, env=getattr(classic, self.dynamics)(self.spec))


class CartPole(ClassicTask):
    """A pole on a cart; each step that it stands is rewarded with 1. CartPole-v0."""

    name = "cartpole"
    dynamics = "CartPoleEnv"
    spec = TaskSpec(observation=_CARTPOLE, action=Discrete(2), max_steps=200, solved_reward=195.0)


class CartPoleV1(ClassicTask):
    """`cartpole` with a longer episode. CartPole-v1."""

    name = "cartpole_v1"
    dynamics = "CartPoleEnv"
    spec = TaskSpec(observation=_CARTPOLE, action=Discrete(2), max_steps=500, solved_reward=475.0)


class Acrobot(ClassicTask):
    """A double pendulum that must swing its tip above a line; each step costs 1. Acrobot-v1."""

    name = "acrobot"
    dynamics = "AcrobotEnv"
    spec = TaskSpec(
        observation=Box.symmetric(1.0, 1.0, 1.0, 1.0, 4 * math.pi, 9 * math.pi),
        action=Discrete(3),
        max_steps=500,
        solved_reward=-100.0,
    )


class MountainCar(ClassicTask):
    """An underpowered car that must reach a hilltop; each step costs 1. MountainCar-v0."""

    name = "mountain_car"
    dynamics = "MountainCarEnv"
    spec = TaskSpec(observation=_CAR, action=Discrete(3), max_steps=200, solved_reward=-110.0)


class MountainCarContinuous(ClassicTask):
    """The car with a force to choose, which is charged; the hilltop is worth 100.

    MountainCarContinuous-v0.
    """

    name = "mountain_car_continuous"
    dynamics = "MountainCarContinuousEnv"
    spec = TaskSpec(observation=_CAR, action=Box.symmetric(1.0), max_steps=999, solved_reward=90.0)


class Pendulum(ClassicTask):
    """A pendulum to be swung up and held; distance from upright, speed and torque are charged.

    Pendulum-v1. The solved reward is our choice: neither the paper nor Gymnasium defines one.
    """

    name = "pendulum"
    dynamics = "PendulumEnv"
    spec = TaskSpec(
        observation=Box.symmetric(1.0, 1.0, 8.0),
        action=Box.symmetric(2.0),
        max_steps=200,
        solved_reward=-250.0,
    )
