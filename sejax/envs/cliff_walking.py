"""Cliff Walking: a grid of 4 x 12 cells with a cliff between start and goal."""

from dataclasses import dataclass
from typing import ClassVar

from sejax import errors
from sejax.envs.base import Facts, Task

MAP = (
    "            ",
    "            ",
    "            ",
    "SOOOOOOOOOOG",
)


@dataclass(frozen=True, kw_only=True)
class CliffWalking:
    """Each step costs 1, and stepping off the cliff 100 and the episode.

    Source: paper, appendix "Qualitative Study of Reward Networks on the Cliff Walking Task";
    `docs/reference.md` 6.1.
    """

    facts: ClassVar[Facts] = Facts("discrete", "discrete", max_steps=50)

    goal_reward: float = 0.0  # of the move into the goal: 0 in the authors' code; paper's text: -1

    def __post_init__(self) -> None:
        errors.require(
            abs(self.goal_reward) < float("inf"),
            "env.goal_reward",
            "be finite",
            "it is a reward",
            self.goal_reward,
            "env.goal_reward=-1",
        )

    def make(self) -> Task:
        from sejax.envs.dynamics.gridworld import GridParams, GridWorld

        params = GridParams(
            step_reward=-1.0,
            goal_reward=self.goal_reward,
            hole_reward=-100.0,
            max_steps_in_episode=self.facts.max_steps,
        )
        return Task(
            name="cliff_walking", env=GridWorld(MAP, params), params=params, solved_reward=-20.0
        )
