"""Grid worlds drawn as maps of characters, and the paper's two grid worlds.

Source: `docs/reference.md` 6.1 and 6.2.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool

from sejax.envs.base import Task
from sejax.envs.environment import Environment, EnvParams, EnvState, Step
from sejax.envs.spec import Discrete, TaskSpec
from sejax.options import Finite, Options, require

MOVES = ((0, 1), (0, -1), (1, 0), (-1, 0))  # actions RIGHT, LEFT, DOWN, UP: (rows, columns)
CLIFF_WALKING = (*[" " * 12] * 3, "SOOOOOOOOOOG")
ROOM_2X2 = ("S ", " G")


@struct.dataclass
class GridState(EnvState):
    """Where the agent is: `index` = row * number of columns + column, `[]` int32."""

    index: Array


@struct.dataclass
class GridParams(EnvParams):
    """Reward of a step, by the cell that it ends in; the defaults are for the 2x2 room."""

    step_reward: float = -0.01
    goal_reward: float = 1.0
    hole_reward: float = -1.0
    max_steps_in_episode: int = 10


class GridWorld(Environment[GridState, GridParams]):
    """A deterministic world of cells.

    A move into a wall or off the map leaves the agent in place and earns the reward of its cell.
    Entering the goal or a hole terminates. Observations are the cell's index, `[]` int32.

    Example:
      >>> env = GridWorld(["S ", " G"])
      >>> obs, state = env.reset_env(None, env.default_params)
      >>> obs, state, reward, terminated, info = env.step_env(None, state, 2, env.default_params)
      >>> int(obs), round(float(reward), 2), bool(terminated)
      (2, -0.01, False)
    """

    def __init__(self, rows: Sequence[str], params: GridParams | None = None):
        """Reads a map.

        Args:
          rows: strings of equal length: one S where episodes start, G for goals, O for holes, # for
            walls and a space for floor.
          params: `default_params`; the defaults of `GridParams` if not given.

        Raises:
          ConfigError: for another map.
        """
        rows = ["".join(row) for row in rows]
        characters = "".join(rows)
        is_map = len({*map(len, rows)}) == 1 and {*characters} <= {*"SGO# "}
        rule = "must be texts of one length, with one S, else G, O, # and spaces"
        require(is_map and characters.count("S") == 1, "rows", rule, got=rows)
        cells = np.array([list(row) for row in rows])
        self.spaces = Discrete(cells.size), Discrete(len(MOVES))
        self._default_params = params or GridParams()
        self.start_index = int(np.flatnonzero(cells == "S")[0])
        self.is_goal = (cells == "G").ravel()  # [num_states]
        self.is_hole = (cells == "O").ravel()  # [num_states]
        self.next_indices = _next_indices(cells)  # [num_states, 4]

    def start(self, key: Array) -> GridState:
        """Puts the agent on the map's S; the key has no effect."""
        return GridState(index=jnp.int32(self.start_index), time=0)

    def step_env(
        self, key: Array, state: GridState, action: Array, params: GridParams
    ) -> Step[GridState]:
        """Moves by one cell: action 0 RIGHT, 1 LEFT, 2 DOWN, 3 UP, `[]` int32."""
        index = jnp.asarray(self.next_indices)[state.index, action]
        state = GridState(index=index, time=state.time + 1)
        is_hole = jnp.asarray(self.is_hole)[index]
        is_goal = jnp.asarray(self.is_goal)[index]
        reward = jnp.where(is_hole, params.hole_reward, params.step_reward)
        reward = jnp.where(is_goal, params.goal_reward, reward)
        return self.after(state, reward, params)

    def observe(self, state: GridState) -> Array:
        return state.index

    def is_terminated(self, state: GridState, params: GridParams) -> Bool[Array, ""]:
        return jnp.asarray(self.is_goal | self.is_hole)[state.index]


def _next_indices(cells: np.ndarray) -> np.ndarray:
    """Index reached from each cell by each action, `[num_states, 4]` int32."""
    index = np.arange(cells.size).reshape(cells.shape)
    padded = np.pad(np.where(cells == "#", -1, index), 1, constant_values=-1)  # -1: a wall
    targets = [np.roll(padded, (-down, -right), (0, 1))[1:-1, 1:-1] for down, right in MOVES]
    columns = [np.where(target < 0, index, target).ravel() for target in targets]
    return np.stack(columns, axis=1).astype(np.int32)


@dataclass(frozen=True, kw_only=True)
class CliffWalking(Options):
    """Each step costs 1; a step off the cliff costs 100 and ends the episode.

    Attributes:
      goal_reward: Reward of the move into the goal: 0 in the authors' code; -1 in the paper's text.

    Source: paper, appendix "Qualitative Study of Reward Networks on the Cliff Walking Task";
    `docs/reference.md` 6.1.
    """

    group: ClassVar[str] = "env"
    spec: ClassVar[TaskSpec] = TaskSpec(
        observation=Discrete(48), action=Discrete(4), max_steps=50, solved_reward=-20.0
    )

    goal_reward: Finite = 0.0

    def make(self) -> Task:
        rewards = {"step_reward": -1.0, "goal_reward": self.goal_reward, "hole_reward": -100.0}
        params = GridParams(**rewards, max_steps_in_episode=self.spec.max_steps)
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
        return Task.of(self.spec, name="gridworld_2x2", env=GridWorld(ROOM_2X2))
