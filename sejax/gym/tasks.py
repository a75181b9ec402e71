"""The real tasks behind proxies, as Gymnasium has them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit

from sejax.gym.gridworld import MAPS, GridWorld
from sejax.options import ConfigError, registry, require, shortened, told
from sejax.options.plain import to_plain
from sejax.proxies.header import Header

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
    def of_interface(cls, interface: Mapping[str, Any]) -> "RealTask":
        """The task of a proxy's file (`TaskSpec.interface`), without `starts`."""
        return cls(
            observation_space=_space(interface["observation"]),
            action_space=_space(interface["action"]),
            max_steps=interface["max_steps"],
        )

    @classmethod
    def of_env(cls, env: gymnasium.Env[Any, Any]) -> "RealTask":
        """A task given as an environment with Gymnasium's `TimeLimit` around it.

        Raises:
          ConfigError: if it has no such limit.
        """
        limit = env.spec.max_episode_steps if env.spec else None
        require(
            limit,
            "task",
            "must have a step limit, because an episode of an SE may never end by itself; got "
            f"{shortened(env)}. Set max_steps.",
        )
        return cls(
            observation_space=env.observation_space,
            action_space=env.action_space,
            max_steps=int(limit or 0),
            starts=_EnvStarts(env),
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
        raise ConfigError(
            f"task must be one that Gymnasium can make here, because initial states, actions and "
            f"an RN's steps are those of the real task; {env_id} raised {told(error)}.",
            "task",
        ) from error


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
    stored = RealTask.of_interface(header.interface)
    if isinstance(task, str):
        task = RealTask.of_gymnasium(task, stored.max_steps)
    if task is None:
        return _task_with_starts(header) if needs_starts else stored
    require(
        isinstance(task, RealTask),
        "task",
        "must be a sejax.gym.RealTask, or an id of Gymnasium, because an SE takes its spaces from "
        f"there; got {type(task).__name__}. Set task=sejax.gym.RealTask.of_env(env).",
    )
    require(
        is_close(task.action_space, stored.action_space),
        "task",
        f"must have the actions that the SE was learned with, {stored.action_space}, because "
        f"others mean something else to its networks; got {shortened(task.action_space)}. Set task "
        "to one with these, such as gymnasium.wrappers.RescaleAction makes.",
    )
    return task


def _task_with_starts(header: Header) -> RealTask:
    """The task of a file from Gymnasium, which may simulate an id of gymnax differently."""
    config = header.config["env"]
    env = same_env(config)
    if env is not None:
        return RealTask.of_env(env)
    gymnax_id = header.task_kind.removeprefix(GYMNAX)
    if gymnax_id != header.task_kind and gymnax_id in gymnasium.registry:
        return RealTask.of_gymnasium(gymnax_id, registry.configure("env", config).max_steps)
    raise _unknown_task(header, "sejax.gym.make(source, task=sejax.gym.RealTask(...))")


def rn_env(header: Header, env_id: Any, render_mode: str | None) -> gymnasium.Env[Any, Any]:
    """The task of an RN: one that is given by its id, or the file's.

    Raises:
      ConfigError: for an id that is not a string, or if the task must be given.
    """
    fix = "sejax.gym.RewardNetwork(env, source)"
    require(
        isinstance(env_id, str | None),
        "task",
        "must be an id of Gymnasium for a reward network, because its dynamics are the real "
        f"task's; got {shortened(shortened(env_id, 80))}. Set {fix}.",
    )
    if env_id is not None:
        return make_gymnasium(env_id, render_mode=render_mode)
    env = same_env(header.config["env"], render_mode=render_mode)
    if env is None:
        raise _unknown_task(header, fix)
    return env


def _unknown_task(header: Header, fix: str) -> ConfigError:
    """Error for a task that only the caller can give."""
    options = [f"{key}={x}" for key, x in header.config["env"].items() if key != "name"]
    name = header.task_kind + (f" ({', '.join(options)})" if options else "")
    return ConfigError(
        f"task must be given for {shortened(name, 80)}, because Gymnasium has no environment that "
        f"is the same; got none. Set {fix}, or an id of Gymnasium.",
        "task",
    )


# --- spaces ---------------------------------------------------------------------------------------


def _space(plain: Mapping[str, Any]) -> spaces.Space[Any]:
    """A space of `sejax.envs.TaskSpec.interface`."""
    if "n" in plain:
        return spaces.Discrete(plain["n"])
    low, high = (
        np.array([end if x is None else x for x in plain[name]], np.float32)
        for name, end in (("low", -np.inf), ("high", np.inf))
    )
    return spaces.Box(low, high, dtype=np.float32)


def is_close(space: spaces.Space[Any], other: spaces.Space[Any]) -> bool:
    """Whether two spaces are the same, but for rounding and the dtype."""
    if isinstance(space, spaces.Box) and isinstance(other, spaces.Box):
        bounds = ((space.low, other.low), (space.high, other.high))
        return space.shape == other.shape and all(np.allclose(*pair) for pair in bounds)
    return num_categories(space) == num_categories(other)


def num_categories(space: spaces.Space[Any]) -> int | None:
    """Size of a `Discrete` space; None for a `Box`."""
    return int(space.n) if isinstance(space, spaces.Discrete) else None


def vector_size(space: spaces.Space[Any], name: str) -> int:
    """Length of the vector that networks see; an index is one-hot to them.

    Raises:
      ConfigError: for a space of another kind.
    """
    if isinstance(space, spaces.Box) and len(space.shape) == 1:
        return space.shape[0]
    is_index = isinstance(space, spaces.Discrete) and space.start == 0
    require(
        is_index,
        name,
        "must be a Box of vectors or a Discrete from 0, because networks take vectors; got "
        f"{shortened(space)}. Set {name} to that of `sejax.Task`.",
    )
    return int(space.n)  # type: ignore[attr-defined]
