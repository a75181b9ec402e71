"""The real tasks behind proxies, as Gymnasium has them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from sejax import envs
from sejax.envs.spec import Discrete, Space, TaskSpec
from sejax.options import require, shortened
from sejax.options.plain import configure, to_plain
from sejax.options.registry import BUILT_IN
from sejax.proxies.header import Header
from sejax.proxies.synthetic import SyntheticConfig

# The tasks that Gymnasium has too, with the same spaces, dynamics and initial states.
GYMNASIUM_IDS = {
    "cartpole": "CartPole-v1",
    "cartpole_v1": "CartPole-v1",
    "acrobot": "Acrobot-v1",
    "mountain_car": "MountainCar-v0",
    "mountain_car_continuous": "MountainCarContinuous-v0",
    "pendulum": "Pendulum-v1",
    **{name: f"{x.partition(':')[2]}-v5" for name, x in BUILT_IN["env"].items() if "mujoco" in x},
}
GRIDS = ("cliff_walking", "gridworld_2x2")

Env = gymnasium.Env[Any, Any]
Info = dict[str, Any]  # of a reset or a step; also the options of a reset


@dataclass(frozen=True, kw_only=True)
class RealTask:
    """The part that an SE uses of the task that it stands in for.

    Attributes:
      observation_space: a `Box` of vectors, or `Discrete`. An SE uses the bounds of a `Box` only
        for its units (`state_units=bounds`).
      action_space: a `Discrete`, or a `Box` of vectors.
      max_steps: steps after which an episode is truncated, if the SE has no horizon of its own.
      starts: draws the first observation of an episode with a generator. The environment can be
        pickled only if it can. Only an SE that begins in states of the task has them.
    """

    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]
    max_steps: int
    starts: Callable[[np.random.Generator], Any] | None = None

    @classmethod
    def of_spec(cls, spec: TaskSpec) -> "RealTask":
        """The task of a proxy's file, without `starts`."""
        observations, actions = map(_gymnasium_space, (spec.observation, spec.action))
        return cls(observation_space=observations, action_space=actions, max_steps=spec.max_steps)

    @classmethod
    def of_env(cls, env: Env) -> "RealTask":
        """A task given as an environment that `gymnasium.make` has made with a step limit.

        The SE resets it, with a generator of its own: do not use it for anything else.

        Raises:
          ConfigError: if it has no such limit.
        """
        limit = env.spec.max_episode_steps if env.spec else None
        fix = "Make it with gymnasium.make(ID, max_episode_steps=N)."
        require(limit, "task", "must have a step limit", got=env, fix=fix)
        return cls(
            observation_space=env.observation_space,
            action_space=env.action_space,
            max_steps=int(limit or 0),
            starts=partial(_first_observation, env),
        )


def _first_observation(env: Env, rng: np.random.Generator) -> Any:
    """The first observation of an episode, as the environment's wrappers show it."""
    env.unwrapped.np_random = rng
    return env.reset()[0]


def real_env(header: Header, **options: Any) -> Env:
    """The task of a file, with its step limit, if Gymnasium or sejax.gym has the same task.

    Args:
      header: the file's header.
      **options: options of `gymnasium.make`, such as `render_mode`.

    Raises:
      ConfigError: if neither has it, or for an option that the task does not have here.
      gymnasium.error.Error: if Gymnasium cannot make it.
    """
    config = header.config["env"]
    limit = header.spec.max_steps
    name = str(config.get("name"))
    is_known = name in GYMNASIUM_IDS or name in GRIDS
    # Gymnasium takes more options, such as the path of a model. A file may set only the fields that
    # the task has here.
    fields = to_plain(configure("env", config)) if is_known else {}
    is_known &= fields.pop("backend", "mujoco") != "spring"  # it has other dynamics
    rule = "must be given, because Gymnasium does not have the same task"
    use = "ID of Gymnasium, or RealTask(...) for an SE, or RewardNetwork(env, source)"
    require(is_known, "task", rule, got=config, use=use)
    if name in GRIDS:
        mode = options.get("render_mode")
        require(mode is None, "render_mode", "must be None in grid worlds", got=mode, use="None")
        return gymnasium.wrappers.TimeLimit(GridWorld(name, **fields), limit)
    return gymnasium.make(GYMNASIUM_IDS[name], max_episode_steps=limit, **options, **fields)


def se_task(header: Header, config: SyntheticConfig, task: RealTask | str | None) -> RealTask:
    """The part that an SE uses of its task, from its file if that is enough.

    Args:
      header: the file's header.
      config: the SE's configuration.
      task: the user's task, or its id in Gymnasium; None for the file's.

    Raises:
      ConfigError: if the task must be given, or if it has other actions or another step limit than
        the file's.
    """
    learned = RealTask.of_spec(header.spec)
    limit = learned.max_steps
    if task is None:
        if not config.needs_task:
            return learned
        task = RealTask.of_env(real_env(header, disable_env_checker=True))
    if isinstance(task, str):
        env = gymnasium.make(task, max_episode_steps=limit, disable_env_checker=True)
        task = RealTask.of_env(env)
    has_limit = config.max_steps(task.max_steps) == config.max_steps(limit)
    require(has_limit, "task", f"must have max_steps={limit}", got=task.max_steps)
    is_same = task.action_space == learned.action_space
    rule = f"must have actions of {learned.action_space}"
    are_boxes = {type(task.action_space), type(learned.action_space)} == {spaces.Box}
    fix = "Wrap it in RescaleAction." if are_boxes else "Give the id of the proxy's own."
    require(is_same, "task", rule, got=task.action_space, fix=fix)
    is_same = signature(task.observation_space) == signature(learned.observation_space)
    rule = f"must observe {shortened(learned.observation_space)}"
    require(is_same, "task", rule, got=task.observation_space)
    return replace(task, observation_space=learned.observation_space)


# --- grid worlds ----------------------------------------------------------------------------------


class GridWorld(gymnasium.Env[int, int]):
    """A deterministic world of cells, `sejax.envs.gridworld` step by step.

    Observations are the cell's index, row * number of columns + column. Actions are 0 RIGHT, 1
    LEFT, 2 DOWN, 3 UP. Entering the goal or a hole (the cliff) terminates; a move off the map stays
    in place. There is no step limit (see `sejax.gym.make`), and no picture.

    Gymnasium's `CliffWalking-v1` is another task on the same map. Its actions are 0 UP, 1 RIGHT, 2
    DOWN, 3 LEFT. An agent that falls off the cliff goes on from the start. The move into the goal
    costs 1 like any other.

    Args:
      name: cliff_walking or gridworld_2x2.
      **options: fields of the task's configuration, such as `goal_reward`.

    Example:
      >>> env = GridWorld("gridworld_2x2")
      >>> env.reset()
      (0, {})
      >>> env.step(2)
      (2, -0.01, False, False, {})
    """

    def __init__(self, name: str, **options: Any):
        task = envs.make(name, **options)
        self._world: Any = task.env
        self._params: Any = task.params
        self._index: int | None = None
        self.observation_space = spaces.Discrete(task.obs_dim)
        self.action_space = spaces.Discrete(task.action_dim)
        self.spec = EnvSpec(name, f"{__name__}:GridWorld", kwargs={"name": name, **options})

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[int, Info]:
        """Puts the agent on the map's S; `options` has no effect."""
        super().reset(seed=seed)
        self._index = start = self._world.start_index
        return start, {}

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
        obs = int(self._world.next_indices[self._index, action])
        is_goal = self._world.is_goal[obs]
        terminated = bool(is_goal or self._world.is_hole[obs])
        reward = self._params.step_reward
        if terminated:
            reward = self._params.goal_reward if is_goal else self._params.hole_reward
        self._index = None if terminated else obs
        return obs, reward, terminated, False, {}


# --- spaces ---------------------------------------------------------------------------------------


def signature(space: spaces.Space[Any]) -> tuple[object, ...]:
    """What must be equal for two spaces to be of one task."""
    size = space.is_np_flattenable and spaces.flatdim(space)
    return type(space), space.shape, size, getattr(space, "start", 0)


def _gymnasium_space(space: Space) -> spaces.Space[Any]:
    if isinstance(space, Discrete):
        return spaces.Discrete(space.n)
    low, high = np.array([space.low, space.high], np.float32)
    return spaces.Box(low, high, dtype=np.float32)
