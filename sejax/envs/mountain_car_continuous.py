"""MountainCarContinuous-v0 with Gymnasium's dynamics, 999 steps."""

from dataclasses import dataclass
from typing import ClassVar

from sejax.envs.base import Facts, Task


@dataclass(frozen=True, kw_only=True)
class MountainCarContinuous:
    """An underpowered car that is to reach a hilltop, paid 100 there and charged for force.

    Source: paper, appendix, fixed hyperparameters (episode length and solved reward).
    """

    facts: ClassVar[Facts] = Facts("vector", "continuous", max_steps=999)

    def make(self) -> Task:
        from sejax.envs.dynamics.mountain_car_continuous import EnvParams, MountainCarContinuousEnv

        return Task(
            name="mountain_car_continuous",
            env=MountainCarContinuousEnv(),
            params=EnvParams(),
            max_steps=self.facts.max_steps,
            solved_reward=90.0,
        )
