"""The grid worlds. Their dynamics are `sejax.envs.dynamics.gridworld`.

A map has a cell for each character: S the start, G a goal, O a hole, # a wall, a space for floor.
"""

from dataclasses import dataclass
from typing import ClassVar

from sejax.envs.base import Task
from sejax.envs.spec import Discrete, TaskSpec
from sejax.options import Options, finite, option

CLIFF_WALKING = (
    "            ",
    "            ",
    "            ",
    "SOOOOOOOOOOG",
)
ROOM_2X2 = (
    "S ",
    " G",
)


@dataclass(frozen=True, kw_only=True)
class CliffWalking(Options):
    """Each step costs 1, and stepping off the cliff 100 and the episode.

    Source: paper, appendix "Qualitative Study of Reward Networks on the Cliff Walking Task";
    `docs/reference.md` 6.1.
    """

    group: ClassVar[str] = "env"
    spec: ClassVar[TaskSpec] = TaskSpec(
        observation=Discrete(48), action=Discrete(4), max_steps=50, solved_reward=-20.0
    )

    goal_reward: float = option(
        0.0,
        finite("it is a reward"),
        help="Of the move into the goal: 0 in the authors' code; -1 in the paper's text.",
    )

    def make(self) -> Task:
        from sejax.envs.dynamics.gridworld import GridParams, GridWorld

        params = GridParams(
            step_reward=-1.0,
            goal_reward=self.goal_reward,
            hole_reward=-100.0,
            max_steps_in_episode=self.spec.max_steps,
        )
        return Task.of(self.spec, name="cliff_walking", env=GridWorld(CLIFF_WALKING, params))


@dataclass(frozen=True, kw_only=True)
class GridWorld2x2:
    """A room of 2 x 2 cells; two steps from start to goal.

    Source: paper, appendix "Evaluation of Score Transformation Variants"; `docs/reference.md` 6.2.
    """

    spec: ClassVar[TaskSpec] = TaskSpec(
        observation=Discrete(4), action=Discrete(4), max_steps=10, solved_reward=0.8
    )

    def make(self) -> Task:
        from sejax.envs.dynamics.gridworld import GridParams, GridWorld

        params = GridParams(step_reward=-0.01, goal_reward=1.0, hole_reward=-1.0)
        return Task.of(self.spec, name="gridworld_2x2", env=GridWorld(ROOM_2X2, params))
