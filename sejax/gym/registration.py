"""From the name or the file of a proxy to environments."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

from sejax.gym.reward import RewardNetwork
from sejax.gym.synthetic import SyntheticGymEnv, SyntheticVectorEnv, SyntheticWorld
from sejax.gym.tasks import Env, RealTask, real_env, se_task
from sejax.options import Count, checked, require, require_known, require_package
from sejax.options.plain import configure
from sejax.proxies.header import Header, pretrained_files, read

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv


def make(
    source: str | Path, task: RealTask | str | None = None, *, render_mode: str | None = None
) -> Env:
    """Makes a stored proxy a Gymnasium environment: an SE, or the real task with an RN's reward.

    Args:
      source: a run directory, a safetensors file of one proxy, or the name of one that ships with
        the package.
      task: the real task, or its id in Gymnasium; needed by RNs, and by SEs that begin in states
        of the task, unless sejax and Gymnasium both know the task. Episodes of an SE keep the step
        limit in its file. An RN needs an id here; `RewardNetwork` wraps any environment.
      render_mode: for an RN's real task, as in `gymnasium.make`; an SE has no pictures, and ignores
        it.

    Raises:
      ConfigError: if the file is missing or damaged, if it holds several proxies or a proxy that is
        JAX code, or if its task is unknown.
      gymnasium.error.Error: for an id that Gymnasium does not know.

    Example:
      >>> make("acrobot").observation_space.shape
      (6,)
    """
    header, world = _read(source, task)
    if world:
        return SyntheticGymEnv(world)
    options: dict[str, Any] = {"render_mode": render_mode, "disable_env_checker": True}
    real = gymnasium.make(str(task), **options) if task else real_env(header, **options)
    return RewardNetwork(real, source)


def make_vec(
    source: str | Path,
    num_envs: int = 1,
    task: RealTask | str | None = None,
    *,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
) -> VectorEnv[Any, Any, Any]:
    """Makes a stored proxy a Gymnasium vector environment.

    The environments of an SE are stepped by one pass through its networks. Those of an RN are
    environments of the real task, stepped one after the other.

    Args:
      source: see `make`.
      num_envs: number of environments.
      task: see `make`.
      autoreset_mode: what happens when an episode ends; see `SyntheticVectorEnv`.

    Raises:
      ConfigError: as `make`, or for less than one environment.

    Example:
      >>> envs = make_vec("cartpole", num_envs=8)
      >>> obs, infos = envs.reset(seed=0)
      >>> obs.shape, envs.metadata["autoreset_mode"].value
      ((8, 4), 'NextStep')
    """
    _, world = _read(source, task)
    num_envs = checked(num_envs, Count, "num_envs", 8)
    if world is None:
        mode = str(getattr(autoreset_mode, "value", autoreset_mode))
        require_known("autoreset_mode", mode, [x.value for x in AutoresetMode])
        return SyncVectorEnv([partial(make, source, task)] * num_envs, autoreset_mode=mode)
    return SyntheticVectorEnv(world, num_envs, autoreset_mode)


def make_sb3(source: str | Path, num_envs: int = 1, task: RealTask | str | None = None) -> "VecEnv":
    """Makes a stored proxy a `VecEnv` of Stable-Baselines3.

    The environments of an SE are stepped by one pass through its networks. Those of an RN are
    environments of the real task in a `DummyVecEnv`.

    Args:
      source: see `make`.
      num_envs: number of environments.
      task: see `make`.

    Raises:
      ConfigError: as `make_vec`, or without Stable-Baselines3.
    """
    require_package("make_sb3", "stable_baselines3", "sb3")
    from stable_baselines3.common.vec_env import DummyVecEnv

    from sejax.gym.sb3 import SyntheticVecEnv

    _, world = _read(source, task)
    num_envs = checked(num_envs, Count, "num_envs", 8)
    if world is None:
        return DummyVecEnv([partial(make, source, task)] * num_envs)
    return SyntheticVecEnv(world, num_envs)


def register() -> list[str]:
    """Registers the shipped proxies as `sejax/<name>`; importing `sejax.gym` does it.

    Returns:
      The ids for `gymnasium.make` and `gymnasium.make_vec`. By these ids Gymnasium imports this
      package first, in the processes of vector environments too.

    Example:
      >>> register()[0], gymnasium.make("sejax.gym:sejax/acrobot").action_space
      ('sejax.gym:sejax/acrobot', Discrete(3))
    """
    for name, path in pretrained_files().items():
        # With `max_episode_steps` Gymnasium would add a second time limit.
        spec = gymnasium.envs.registration.EnvSpec(
            f"sejax/{name}",
            "sejax.gym:make",
            vector_entry_point="sejax.gym:make_vec",
            kwargs={"source": str(path)},
        )
        gymnasium.registry.setdefault(spec.id, spec)
    return [f"sejax.gym:sejax/{name}" for name in pretrained_files()]


def _read(source: str | Path, task: RealTask | str | None) -> tuple[Header, SyntheticWorld | None]:
    """The header of a file, and its SE, or None for an RN.

    Raises:
      ConfigError: as `make`.
    """
    _, weights, header = read(source, kinds=("se", "rn"), single=True)
    allowed: Any = str | None if header.kind == "rn" else RealTask | str | None
    rule = "must be an id of Gymnasium, or a RealTask for an SE"
    fix = "Set task=ID; RewardNetwork(env, source) wraps an environment."
    require(isinstance(task, allowed), "task", rule, got=task, fix=fix)
    if header.kind == "rn":
        return header, None
    config = configure("proxy", header.config["proxy"])
    return header, SyntheticWorld(weights, config, se_task(header, config, task))
