"""The real tasks behind proxies, as Gymnasium has them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit

from sejax import registry, serialize
from sejax.errors import ConfigError, require, shortened, told
from sejax.gym.gridworld import MAPS, GridWorld
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
GYMNASIUM_BACKENDS = ("mujoco", "mjx")  # of halfcheetah: the others move otherwise
PREFIX = "gymnax/"

Starts = Callable[[np.random.Generator], Any]


@dataclass(frozen=True, kw_only=True)
class RealTask:
    """What an SE takes from the task that it stands in for.

    Attributes:
      observation_space: a `Box` of vectors, whose bounds only matter to an SE that has its units by
        them (`state_units=bounds`), or `Discrete`.
      action_space: a `Discrete`, or a `Box` of vectors.
      max_steps: steps after which an episode is cut, if the SE has no horizon of its own.
      starts: the first observation of an episode, drawn with a generator; must be picklable for the
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
          max_steps: in the place of Gymnasium's limit.

        Raises:
          ConfigError: if Gymnasium cannot make it, or has no limit for it and none is given.
        """
        return cls.of_env(make_gymnasium(env_id, max_steps))

    @classmethod
    def of_interface(cls, interface: Mapping[str, Any]) -> "RealTask":
        """What a proxy's file says of its task, `sejax.Task.interface`; it has no `starts`."""
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
            "have a step limit",
            "an episode of an SE may never end by itself",
            env,
            "max_steps",
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
      max_steps: in the place of Gymnasium's limit.
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
            f"an RN's steps are those of the real task; {env_id} raised {told(error)}."
        ) from error


def real_env(
    config: Mapping[str, Any], render_mode: str | None = None
) -> gymnasium.Env[Any, Any] | None:
    """The task that a file's metadata names, with its step limit; None if none here is the same.

    Args:
      config: of the task, plain values with a `name`.
      render_mode: as of `gymnasium.make`.

    Raises:
      ConfigError: for an option that the task does not have here, or Gymnasium cannot make it.
    """
    name = str(config.get("name"))
    if name not in (*GYMNASIUM_IDS, *MAPS):
        return None
    # Gymnasium takes more options, such as the path of a model: what a file says is read as
    # everywhere, by the fields that the task has here.
    spec = registry.configure("env", config)
    options = serialize.to_plain(spec)
    if options.pop("backend", "mujoco") not in GYMNASIUM_BACKENDS:
        return None
    max_steps = spec.facts.max_steps
    if name in MAPS:
        return TimeLimit(GridWorld(name, **options), max_steps)
    return make_gymnasium(GYMNASIUM_IDS[name], max_steps, render_mode=render_mode, **options)


def real_task(header: Header, needs_starts: bool) -> RealTask:
    """What an SE takes from the task that its file is of: from the file itself, if that will do.

    Args:
      header: of the file.
      needs_starts: whether its episodes begin where the real task's do.

    Raises:
      ConfigError: if it is one that must be given.
    """
    if not needs_starts:
        return RealTask.of_interface(header.interface)
    config = header.config["env"]
    if (env := real_env(config)) is not None:
        return RealTask.of_env(env)
    gymnax_id = str(config.get("name")).removeprefix(PREFIX)
    if gymnax_id != config.get("name") and gymnax_id in gymnasium.registry:
        return RealTask.of_gymnasium(gymnax_id, registry.configure("env", config).max_steps)
    raise unknown_task(config, "sejax.gym.make(source, task=sejax.gym.RealTask(...))")


def unknown_task(config: Mapping[str, Any], fix: str) -> ConfigError:
    """Error for a task that only the caller can say."""
    named = ", ".join(f"{key}={value}" for key, value in config.items() if key != "name")
    name = shortened(str(config.get("name")) + (f" ({named})" if named else ""))
    return ConfigError(
        f"task must be given for {name}, because Gymnasium knows no environment that is the same; "
        f"got none. Known: {', '.join([*GYMNASIUM_IDS, *MAPS])}. Set {fix}, or to an id of "
        f"Gymnasium."
    )


# --- spaces --------------------------------------------------------------------------------------


def _space(plain: Mapping[str, Any]) -> spaces.Space[Any]:
    """A space of `sejax.Task.interface`."""
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
    is_index = isinstance(space, spaces.Discrete) and space.start == 0
    is_vector = isinstance(space, spaces.Box) and len(space.shape) == 1
    require(
        is_index or is_vector,
        name,
        "be a Box of vectors or a Discrete from 0",
        "networks take vectors",
        space,
        f"{name} to what `sejax.Task` has",
    )
    return num_categories(space) or int(space.shape[0])  # type: ignore[index]
