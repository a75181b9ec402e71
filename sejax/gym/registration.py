"""From the name or the file of a proxy to environments."""

import re
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

from sejax import registry
from sejax.errors import ConfigError, as_python, require, whole
from sejax.gym.reward import RewardNetwork
from sejax.gym.source import Source, read
from sejax.gym.synthetic import SyntheticEnv, SyntheticWorld
from sejax.gym.tasks import (
    RealTask,
    is_close,
    make_gymnasium,
    real_env,
    real_task,
    unknown_task,
)
from sejax.gym.vector import SyntheticVectorEnv
from sejax.proxies.header import Header, pretrained_names

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

NAMESPACE = "sejax"  # of the ids


def make(
    source: Source, task: RealTask | str | None = None, *, render_mode: str | None = None
) -> gymnasium.Env[Any, Any]:
    """Makes a stored proxy a Gymnasium environment: an SE, or the real task with an RN's reward.

    Args:
      source: a run directory, a safetensors file of one proxy, or the name of one that ships with
        the package.
      task: the real task, or its id in Gymnasium; needed if it is none that sejax and Gymnasium
        both know. Episodes of an SE keep the step limit in its file. For an RN an id;
        `RewardNetwork` goes around any environment.
      render_mode: of an RN's real task, as of `gymnasium.make`; an SE has no pictures, and ignores
        rgb_array.

    Raises:
      ConfigError: if there is no such file, it is damaged, it holds several proxies or one that is
        JAX code, or its task is not known.

    Example:
      >>> make("acrobot").observation_space.shape
      (6,)
      >>> make("cartpole-rn").spec.id
      'sejax/cartpole-rn'
    """
    weights, header = read(source)
    env: SyntheticEnv | RewardNetwork
    name = re.sub(r"[^\w.:-]+", "-", header.task) or "proxy"  # as Gymnasium's ids must be
    if _is_rn(header):
        env, name = RewardNetwork(_real_env(header, task, render_mode), source), f"{name}-rn"
    else:
        _require_no_picture(render_mode)
        env = SyntheticEnv(_world(weights, header, task))
    options = {"source": str(source), "task": task, "render_mode": render_mode}
    env.spec = _spec(name, **{key: x for key, x in options.items() if x is not None})
    return env


def make_vec(
    source: Source,
    num_envs: int = 1,
    task: RealTask | str | None = None,
    *,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    render_mode: str | None = None,
) -> VectorEnv[Any, Any, Any]:
    """Makes a stored proxy a Gymnasium vector environment.

    All lanes of an SE are one pass through its networks. An RN's are environments of the real task
    one after the other, as Gymnasium has them.

    Args:
      source: as of `make`.
      num_envs: lanes.
      task: as of `make`.
      autoreset_mode: what happens where an episode ends; see `SyntheticVectorEnv`.
      render_mode: as of `make`.

    Raises:
      ConfigError: as `make`, or for less than one lane.

    Example:
      >>> envs = make_vec("cartpole", num_envs=8)
      >>> obs, infos = envs.reset(seed=0)
      >>> obs.shape, envs.metadata["autoreset_mode"].value
      ((8, 4), 'NextStep')
    """
    num_envs = _count(num_envs)
    weights, header = read(source)
    if _is_rn(header):
        env_fns = [partial(make, source, task, render_mode=render_mode)] * num_envs
        return SyncVectorEnv(env_fns, autoreset_mode=autoreset_mode)
    _require_no_picture(render_mode)
    return SyntheticVectorEnv(_world(weights, header, task), num_envs, autoreset_mode)


def make_sb3(source: Source, num_envs: int = 1, task: RealTask | str | None = None) -> "VecEnv":
    """Makes a stored proxy a `VecEnv` of Stable-Baselines3.

    All lanes of an SE are one pass through its networks. An RN's are environments of the real task
    in a `DummyVecEnv`.

    Args:
      source: as of `make`.
      num_envs: lanes.
      task: as of `make`.

    Raises:
      ConfigError: as `make_vec`, or without Stable-Baselines3.
    """
    num_envs = _count(num_envs)
    try:
        from stable_baselines3.common.vec_env import DummyVecEnv

        from sejax.gym.sb3 import SyntheticVecEnv
    except ImportError as error:
        raise ConfigError(
            f"make_sb3 needs Stable-Baselines3, because it makes one of its VecEnvs; got {error}. "
            f"Install it with pip install 'sejax[sb3]'."
        ) from error
    weights, header = read(source)
    if _is_rn(header):
        return DummyVecEnv([partial(make, source, task)] * num_envs)
    return SyntheticVecEnv(_world(weights, header, task), num_envs)


def register() -> list[str]:
    """Registers the shipped proxies as `sejax/<name>`; importing `sejax.gym` does it.

    Returns:
      The ids, for `gymnasium.make` and `gymnasium.make_vec`.

    Example:
      >>> register()[0], gymnasium.make("sejax/acrobot").action_space
      ('sejax/acrobot', Discrete(3))
    """
    specs = [_spec(name, source=name) for name in pretrained_names()]
    for spec in specs:
        gymnasium.registry.setdefault(spec.id, spec)
    return [spec.id for spec in specs]


def _spec(name: str, **kwargs: Any) -> EnvSpec:
    """How Gymnasium makes it; without `max_episode_steps`, a second time limit by a wrapper."""
    return EnvSpec(
        id=f"{NAMESPACE}/{name}",
        entry_point="sejax.gym:make",
        vector_entry_point="sejax.gym:make_vec",
        kwargs=kwargs,
    )


def _count(num_envs: Any) -> int:
    num_envs = as_python(num_envs)
    whole(1, "num_envs", num_envs, "each is an episode at a time", 8)
    return int(num_envs)


def _require_no_picture(render_mode: str | None) -> None:
    # Stable-Baselines3's make_vec_env asks for rgb_array, whether anybody will look or not.
    require(
        render_mode in (None, "rgb_array"),
        "render_mode",
        "be None for an SE",
        "its states have no picture",
        render_mode,
        "render_mode=None",
    )


def _is_rn(header: Header) -> bool:
    return header.kind == "rn"


def _world(
    weights: Mapping[str, np.ndarray], header: Header, task: RealTask | str | None
) -> SyntheticWorld:
    """What a file of an SE holds."""
    config = registry.configure("proxy", header.config["proxy"])
    limit = header.interface["max_steps"]
    if isinstance(task, str):
        task = RealTask.of_gymnasium(task, limit)
    require(
        task is None or isinstance(task, RealTask),
        "task",
        "be a sejax.gym.RealTask, or an id of Gymnasium",
        "an SE takes its spaces from there",
        type(task).__name__,
        "task=sejax.gym.RealTask.of_env(env)",
    )
    if task is None:
        task = real_task(header, needs_starts=config.needs_task)
    else:
        learned = RealTask.of_interface(header.interface).action_space
        require(
            is_close(task.action_space, learned),
            "task",
            f"have the actions that the SE was learned with, {learned}",
            "others mean something else to its networks",
            task.action_space,
            "task to one with these, as gymnasium.wrappers.RescaleAction "
            "makes of the real environment",
        )
    require(
        config.max_steps(task.max_steps) == config.max_steps(limit),
        "task",
        f"have the max_steps that the SE was learned with, {limit}",
        "its episodes end there",
        task.max_steps,
        f"task=dataclasses.replace(task, max_steps={limit})",
    )
    return SyntheticWorld(weights, config, task)


def _real_env(
    header: Header, task: RealTask | str | None, render_mode: str | None
) -> gymnasium.Env[Any, Any]:
    """The task of an RN."""
    require(
        not isinstance(task, RealTask),
        "task",
        "be an id of Gymnasium for a reward network",
        "its dynamics are the real task's",
        task,
        "sejax.gym.RewardNetwork(env, source)",
    )
    if isinstance(task, str):
        return make_gymnasium(task, render_mode=render_mode)
    env = real_env(header.config["env"], render_mode)
    if env is None:
        raise unknown_task(header.config["env"], "sejax.gym.RewardNetwork(env, source)")
    return env
