"""The room of 2 x 2 cells of the paper's study of score transforms."""

from dataclasses import dataclass
from typing import ClassVar

from sejax.envs.base import Facts, Task

MAP = (
    "S ",
    " G",
)


@dataclass(frozen=True, kw_only=True)
class GridWorld2x2:
    """Two steps from start to goal.

    Source: paper, appendix "Evaluation of Score Transformation Variants"; `docs/reference.md` 6.2.
    """

    facts: ClassVar[Facts] = Facts("discrete", "discrete", max_steps=10)

    def make(self) -> Task:
        from sejax.envs.dynamics.gridworld import GridParams, GridWorld

        params = GridParams(
            step_reward=-0.01,
            goal_reward=1.0,
            hole_reward=-1.0,
            max_steps_in_episode=self.facts.max_steps,
        )
        return Task(
            name="gridworld_2x2", env=GridWorld(MAP, params), params=params, solved_reward=0.8
        )
