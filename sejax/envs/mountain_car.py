"""MountainCar-v0: Gymnasium's dynamics, 200 steps."""

from dataclasses import dataclass
from typing import ClassVar

from sejax.envs.base import Facts, Task


@dataclass(frozen=True, kw_only=True)
class MountainCar:
    """An underpowered car that is to reach a hilltop, paid -1 a step until it does.

    Source: Gymnasium's registry (episode length and reward threshold).
    """

    facts: ClassVar[Facts] = Facts("vector", "discrete", max_steps=200)

    def make(self) -> Task:
        from gymnax.environments.classic_control import mountain_car

        return Task(
            name="mountain_car",
            env=mountain_car.MountainCar(),
            params=mountain_car.EnvParams(),
            max_steps=self.facts.max_steps,
            solved_reward=-110.0,
        )
