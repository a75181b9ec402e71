"""Grid worlds as Gymnasium environments, for the tasks that Gymnasium has not."""

from typing import Any, NoReturn

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from sejax.envs import gridworld

Info = dict[str, Any]  # of a reset or a step; and what a reset is told
MAPS = {"cliff_walking": gridworld.CLIFF_WALKING, "gridworld_2x2": gridworld.ROOM_2X2}
# Reward of a step into the floor, the goal and a hole.
REWARDS = {"cliff_walking": (-1.0, 0.0, -100.0), "gridworld_2x2": (-0.01, 1.0, -1.0)}
MOVES = ((0, 1), (0, -1), (1, 0), (-1, 0))  # actions RIGHT, LEFT, DOWN, UP: (rows, columns)


class GridWorld(gymnasium.Env[int, int]):
    """A deterministic world of cells, `sejax.envs.gridworld` step by step.

    Observations are the cell's index, row * number of columns + column. Actions are 0 RIGHT, 1
    LEFT, 2 DOWN, 3 UP. Entering the goal or a hole (the cliff) terminates; a move off the map stays
    in place. There is no step limit: see `sejax.gym.make`.

    Gymnasium's `CliffWalking-v1` is another task on the same map: its actions are 0 UP, 1 RIGHT, 2
    DOWN, 3 LEFT, whoever falls off the cliff goes on from the start, and the move into the goal
    costs 1 like any other.

    Args:
      name: cliff_walking or gridworld_2x2.
      goal_reward: of the move into the goal, if not the task's usual one.

    Example:
      >>> env = GridWorld("gridworld_2x2")
      >>> env.reset()
      (0, {})
      >>> env.step(2)
      (2, -0.01, False, False, {})
    """

    metadata: Info = {"render_modes": []}  # noqa: RUF012 (as Gymnasium declares it)

    def __init__(self, name: str, goal_reward: float | None = None):
        self._rows = MAPS[name]
        step, goal, hole = REWARDS[name]
        goal = goal if goal_reward is None else goal_reward
        self._rewards = {"S": step, " ": step, "G": goal, "O": hole}
        self._start = "".join(self._rows).index("S")
        self._index: int | None = None
        self.observation_space = spaces.Discrete(len("".join(self._rows)))
        self.action_space = spaces.Discrete(len(MOVES))
        arguments = {"name": name, "goal_reward": goal_reward}
        self.spec = EnvSpec(name, f"{__name__}:GridWorld", kwargs=arguments)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[int, Info]:
        """Puts the agent on the map's S; `options` has no effect."""
        super().reset(seed=seed)
        self._index = self._start
        return self._index, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, Info]:
        """Moves by one cell.

        Raises:
          gymnasium.error.ResetNeeded: if no episode is running.
          gymnasium.error.InvalidAction: for an action that is none of the four.
        """
        if self._index is None:
            raise gymnasium.error.ResetNeeded("call reset() first: no episode is running")
        if not self.action_space.contains(action):
            raise gymnasium.error.InvalidAction(f"{action!r} is none of {self.action_space}")
        height, width = len(self._rows), len(self._rows[0])
        position = np.add(divmod(self._index, width), MOVES[action])
        row, column = np.clip(position, 0, (height - 1, width - 1)).tolist()
        obs, cell = row * width + column, self._rows[row][column]
        terminated = cell in "GO"
        self._index = None if terminated else obs
        return obs, self._rewards[cell], terminated, False, {}

    def render(self) -> NoReturn:
        """Raises `NotImplementedError`: there is no picture."""
        raise NotImplementedError("a GridWorld has no picture: its observations are cell numbers")
