"""The real tasks behind proxies, as Gymnasium has them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit

from sejax.envs.spec import Box, Discrete, Space, TaskSpec
from sejax.gym.gridworld import MAPS, GridWorld
from sejax.options import ConfigError, registry, require, shortened, told
from sejax.options.plain import to_plain
from sejax.proxies.header import Header, is_same_space

# The tasks that Gymnasium has too, with the same spaces, dynamics and initial states.
GYMNASIUM_IDS = {
    "cartpole": "CartPole-v1",
    "cartpole_v1": "CartPole-v1",
    "acrobot": "Acrobot-v1",
    "mountain_car": "MountainCar-v0",
    "mountain_car_continuous": "MountainCarContinuous-v0",
    "pendulum": "Pendulum-v1",
    "halfcheetah": "HalfCheetah-v5",
    "hopper": "Hopper-v5",
    "walker2d": "Walker2d-v5",
    "swimmer": "Swimmer-v5",
    "inverted_pendulum": "InvertedPendulum-v5",
    "ant": "Ant-v5",
    "reacher": "Reacher-v5",
}
GYMNASIUM_BACKENDS = ("mujoco", "mjx")  # of halfcheetah: the others have other dynamics
GYMNAX = "gymnax/"

Starts = Callable[[np.random.Generator], Any]


@dataclass(frozen=True, kw_only=True)
class RealTask:
    """What an SE takes from the task that it stands in for.

    Attributes:
      observation_space: a `Box` of vectors, or `Discrete`. An SE uses the bounds of a `Box` only
        for its units (`state_units=bounds`).
      action_space: a `Discrete`, or a `Box` of vectors.
      max_steps: steps after which an episode is truncated, if the SE has no horizon of its own.
      starts: draws the first observation of an episode with a generator; must be picklable for the
        environment to be. None if the SE has learned its initial states.
    """

    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]
    max_steps: int
    starts: Starts | None = None

    @classmethod
    def of_gymnasium(cls, env_id: str, max_steps: int | None = None) -> "RealTask":
        """A task that Gymnasium knows.

        Args:
          env_id: such as `"CartPole-v1"`.
          max_steps: replaces Gymnasium's limit.

        Raises:
          ConfigError: if Gymnasium cannot make it, or has no limit for it and none is given.
        """
        return cls.of_env(make_gymnasium(env_id, max_steps))

    @classmethod
    def of_spec(cls, spec: TaskSpec) -> "RealTask":
        """The task of a proxy's file, without `starts`."""
        return cls(
            observation_space=_gymnasium_space(spec.observation),
            action_space=_gymnasium_space(spec.action),
            max_steps=spec.max_steps,
        )

    @classmethod
    def of_env(cls, env: gymnasium.Env[Any, Any]) -> "RealTask":
        """A task given as an environment with Gymnasium's `TimeLimit` around it.

        Raises:
          ConfigError: if it has no such limit.
        """
        limit = env.spec.max_episode_steps if env.spec else None
        require(limit, "task", f"must have a step limit; got {shortened(env)}. Set max_steps.")
        return cls(
            observation_space=env.observation_space,
            action_space=env.action_space,
            max_steps=int(limit or 0),
            starts=_EnvStarts(env),
        )

    @property
    def spec(self) -> TaskSpec:
        """Its spaces and its limit, as sejax has them.

        Raises:
          ConfigError: for a space whose elements networks cannot take.
        """
        return TaskSpec(
            observation=space_of(self.observation_space, "task.observation_space"),
            action=space_of(self.action_space, "task.action_space"),
            max_steps=self.max_steps,
        )


class _EnvStarts:
    """First observations of an environment, as its wrappers show them."""

    def __init__(self, env: gymnasium.Env[Any, Any]):
        self._env = env

    def __call__(self, rng: np.random.Generator) -> Any:
        self._env.unwrapped.np_random = rng
        return self._env.reset()[0]


def make_gymnasium(
    env_id: str, max_steps: int | None = None, **options: Any
) -> gymnasium.Env[Any, Any]:
    """An environment of Gymnasium's registry.

    Args:
      env_id: such as `"CartPole-v1"`.
      max_steps: replaces Gymnasium's limit.
      **options: of the environment.

    Raises:
      ConfigError: if Gymnasium cannot make it.
    """
    try:
        return gymnasium.make(
            env_id, max_episode_steps=max_steps, disable_env_checker=True, **options
        )
    except (gymnasium.error.Error, ImportError) as error:
        message = f"task must be one that Gymnasium can make here; {env_id} raised {told(error)}."
        raise ConfigError(message, "task") from error


def same_env(config: Mapping[str, Any], **options: Any) -> gymnasium.Env[Any, Any] | None:
    """The task that a file names, with its step limit, if Gymnasium or sejax.gym has the same.

    Args:
      config: plain values of the task's configuration.
      **options: of `gymnasium.make`, such as `render_mode`.

    Raises:
      ConfigError: for an option that the task does not have here, or if Gymnasium cannot make it.
    """
    name = str(config.get("name"))
    if name not in (*GYMNASIUM_IDS, *MAPS):
        return None
    # Gymnasium takes more options, such as the path of a model: what a file says is read by the
    # fields that the task has here.
    task = registry.configure("env", config)
    fields = to_plain(task)
    if fields.pop("backend", "mujoco") not in GYMNASIUM_BACKENDS:
        return None
    max_steps = task.spec.max_steps
    if name in MAPS:
        return TimeLimit(GridWorld(name, **fields), max_steps)
    return make_gymnasium(GYMNASIUM_IDS[name], max_steps, **options, **fields)


def se_task(header: Header, task: RealTask | str | None, needs_starts: bool) -> RealTask:
    """What an SE takes from its task: from its file if that is enough.

    Args:
      header: of the file.
      task: one that is given, or its id in Gymnasium; None for the file's.
      needs_starts: whether the SE's episodes begin where the real task's do.

    Raises:
      ConfigError: if it must be given, or the one given has other actions than the file's.
    """
    learned = RealTask.of_spec(header.spec)
    if isinstance(task, str):
        task = RealTask.of_gymnasium(task, learned.max_steps)
    if task is None:
        return _task_with_starts(header) if needs_starts else learned
    require(
        isinstance(task, RealTask),
        "task",
        f"must be a sejax.gym.RealTask or an id of Gymnasium; got {type(task).__name__}. Set "
        "task=sejax.gym.RealTask.of_env(env).",
    )
    require(
        is_same_space(task.spec.action, header.spec.action),
        "task",
        f"must have the actions of the SE's task, {shortened(learned.action_space)}; got "
        f"{shortened(task.action_space)}. gymnasium.wrappers.RescaleAction makes such.",
    )
    return task


def _task_with_starts(header: Header) -> RealTask:
    """The task of a file from Gymnasium, which may simulate an id of gymnax differently."""
    config = header.config["env"]
    env = same_env(config)
    if env is not None:
        return RealTask.of_env(env)
    _, is_gymnax, env_id = str(config.get("name")).partition(GYMNAX)
    if is_gymnax and env_id in gymnasium.registry:
        return RealTask.of_gymnasium(env_id, registry.configure("env", config).max_steps)
    raise _unknown_task(header, "sejax.gym.make(source, task=sejax.gym.RealTask(...))")


def rn_env(
    header: Header, env_id: RealTask | str | None, render_mode: str | None
) -> gymnasium.Env[Any, Any]:
    """The task of an RN: one that is given by its id, or the file's.

    Raises:
      ConfigError: for an id that is not a string, or if the task must be given.
    """
    fix = "sejax.gym.RewardNetwork(env, source)"
    if env_id is None:
        env = same_env(header.config["env"], render_mode=render_mode)
        if env is None:
            raise _unknown_task(header, fix)
        return env
    require(
        isinstance(env_id, str),
        "task",
        f"must be an id of Gymnasium for a reward network; got {shortened(env_id)}. Set {fix}.",
    )
    return make_gymnasium(str(env_id), render_mode=render_mode)


def _unknown_task(header: Header, fix: str) -> ConfigError:
    """Error for a task that only the caller can give."""
    return ConfigError(
        f"task must be given, because Gymnasium has none that is the same; got "
        f"{shortened(header.config['env'])}. Set {fix}, or an id of Gymnasium.",
        "task",
    )


# --- spaces ---------------------------------------------------------------------------------------


def _gymnasium_space(space: Space) -> spaces.Space[Any]:
    if isinstance(space, Discrete):
        return spaces.Discrete(space.n)
    low, high = (np.array(bound, np.float32) for bound in (space.low, space.high))
    return spaces.Box(low, high, dtype=np.float32)


def space_of(space: spaces.Space[Any], name: str) -> Space:
    """A space of Gymnasium as sejax has it.

    Raises:
      ConfigError: if its elements are neither vectors nor indices from 0 on.
    """
    if isinstance(space, spaces.Box) and len(space.shape) == 1:
        return Box(tuple(space.low.tolist()), tuple(space.high.tolist()))
    if isinstance(space, spaces.Discrete) and space.start == 0:
        return Discrete(int(space.n))
    raise ConfigError(
        f"{name} must be a Box of vectors or a Discrete from 0; got {shortened(space)}.", name
    )
