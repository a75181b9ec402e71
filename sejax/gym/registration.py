"""From the name or the file of a proxy to environments."""

import re
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

from sejax.gym.reward import RewardNetwork
from sejax.gym.synthetic import SyntheticEnv, SyntheticVectorEnv, SyntheticWorld
from sejax.gym.tasks import Env, RealTask, make_gymnasium, real_env, se_task
from sejax.options import ConfigError, as_python, counts, registry, require, shortened
from sejax.proxies.header import Header, pretrained_names, read

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

Source = str | Path


def make(
    source: Source, task: RealTask | str | None = None, *, render_mode: str | None = None
) -> Env:
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
    header, world = _read(source, task, render_mode)
    name = re.sub(r"[^\w.:-]+", "-", header.task) or "proxy"  # as Gymnasium's ids must be
    kwargs = {"source": str(source), "task": task, "render_mode": render_mode}
    if world:
        env = SyntheticEnv(world)
        env.spec = _spec(name, **kwargs)
        return env
    fix = "sejax.gym.RewardNetwork(env, source)"
    must = f"must be an id of Gymnasium; got {shortened(task)}. Set {fix}."
    require(isinstance(task, str | None), "task", must)
    options = {"render_mode": render_mode}
    real = make_gymnasium(str(task), **options) if task else real_env(header, fix, **options)
    rewards = RewardNetwork(real, source)
    rewards._cached_spec = _spec(f"{name}-rn", **kwargs)  # it makes all of it
    return rewards


def make_vec(
    source: Source,
    num_envs: int = 1,
    task: RealTask | str | None = None,
    *,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    render_mode: str | None = None,
) -> VectorEnv[Any, Any, Any]:
    """Makes a stored proxy a Gymnasium vector environment.

    The environments of an SE are stepped by one pass through its networks. Those of an RN are
    environments of the real task, stepped one after the other.

    Args:
      source: as of `make`.
      num_envs: number of environments.
      task: as of `make`.
      autoreset_mode: what happens where an episode ends; see `SyntheticVectorEnv`.
      render_mode: as of `make`.

    Raises:
      ConfigError: as `make`, or for less than one environment.

    Example:
      >>> envs = make_vec("cartpole", num_envs=8)
      >>> obs, infos = envs.reset(seed=0)
      >>> obs.shape, envs.metadata["autoreset_mode"].value
      ((8, 4), 'NextStep')
    """
    num_envs = _count(num_envs)
    _, world = _read(source, task, render_mode)
    if world is None:
        env_fns = [partial(make, source, task, render_mode=render_mode)] * num_envs
        return SyncVectorEnv(env_fns, autoreset_mode=autoreset_mode)
    return SyntheticVectorEnv(world, num_envs, autoreset_mode)


def make_sb3(source: Source, num_envs: int = 1, task: RealTask | str | None = None) -> "VecEnv":
    """Makes a stored proxy a `VecEnv` of Stable-Baselines3.

    The environments of an SE are stepped by one pass through its networks. Those of an RN are
    environments of the real task in a `DummyVecEnv`.

    Args:
      source: as of `make`.
      num_envs: number of environments.
      task: as of `make`.

    Raises:
      ConfigError: as `make_vec`, or without Stable-Baselines3.
    """
    num_envs = _count(num_envs)
    try:
        from stable_baselines3.common.vec_env import DummyVecEnv

        from sejax.gym.sb3 import SyntheticVecEnv
    except ImportError as error:
        message = f"make_sb3 needs Stable-Baselines3; got {error}. Type pip install 'sejax[sb3]'."
        raise ConfigError(message) from error
    _, world = _read(source, task)
    if world is None:
        return DummyVecEnv([partial(make, source, task)] * num_envs)
    return SyntheticVecEnv(world, num_envs)


def register() -> list[str]:
    """Registers the shipped proxies as `sejax/<name>`; importing `sejax.gym` does it.

    Returns:
      The ids for `gymnasium.make` and `gymnasium.make_vec`, which import this package first: in the
      processes of vector environments too.

    Example:
      >>> register()[0], gymnasium.make("sejax.gym:sejax/acrobot").action_space
      ('sejax.gym:sejax/acrobot', Discrete(3))
    """
    for name in pretrained_names():
        gymnasium.registry.setdefault(f"sejax/{name}", _spec(name, source=name))
    return [f"sejax.gym:sejax/{name}" for name in pretrained_names()]


def _spec(name: str, **kwargs: Any) -> EnvSpec:
    """How Gymnasium makes it; with `max_episode_steps` it would add a second time limit."""
    many = "sejax.gym:make_vec"
    return EnvSpec(f"sejax/{name}", "sejax.gym:make", vector_entry_point=many, kwargs=kwargs)


def _count(num_envs: float) -> int:
    num_envs = as_python(num_envs)
    counts("each is an episode at a time")("num_envs", num_envs, 8)
    return int(num_envs)


def _read(
    source: Source, task: RealTask | str | None, render_mode: str | None = None
) -> tuple[Header, SyntheticWorld | None]:
    """The header of a file, and its SE; None if it is an RN.

    Raises:
      ConfigError: as `make`.
    """
    _, weights, header = read(source, kinds=("se", "rn"), single=True)
    if header.kind == "rn":
        return header, None
    must = f"must be None, as an SE has no picture; got {shortened(render_mode)}."
    require(render_mode in (None, "rgb_array"), "render_mode", must)
    config = registry.configure("proxy", header.config["proxy"])
    return header, SyntheticWorld(weights, config, se_task(header, config, task))
