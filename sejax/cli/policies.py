"""Policies that `python -m sejax.distill` is given: files and functions."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sejax.distillation.policy_copy import Actor, acting
from sejax.envs.base import Task
from sejax.options import ConfigError, require, shortened, told
from sejax.proxies.exact import Layer

FIX = "Set policy=ppo:FILE.zip (Stable-Baselines3), FILE.npz or module:function."


class Given(NamedTuple):
    """A policy.

    Attributes:
      act: what it does.
      layers: the same, if it is of the exact form already; None if it must be copied.
    """

    act: Actor
    layers: Sequence[Layer] | None = None


def policy_of(text: str, task: Task) -> Given:
    """The policy that an override names.

    Args:
      text: `ALGORITHM:FILE.zip`, a model of Stable-Baselines3; `FILE.npz` with `kernel_0`
        `[out, in]`, `bias_0` and so on, affine maps with ReLUs between; or `module:function`, of
        observations `[state, obs_dim]` to actions.
      task: the real task.

    Raises:
      ConfigError: for anything else.
    """
    if text.endswith(".zip"):
        return Given(_of_sb3(text, task))
    if text.endswith(".npz"):
        layers = _of_file(text)
        return Given(acting(task, layers), layers)
    require(":" in text, "policy", f"must be a file or a function; got {shortened(text)}. {FIX}")
    return Given(_of_function(text))


def _of_sb3(text: str, task: Task) -> Actor:
    name, _, path = text.partition(":")
    must = f"must name an algorithm and a file; got {shortened(text)}. Set policy=ppo:FILE.zip."
    require(Path(path).is_file(), "policy", must)
    try:
        import stable_baselines3
    except ImportError as error:
        raise ConfigError(
            f"policy must be no model of Stable-Baselines3 without it; got {text}. Install it with "
            "pip install 'sejax[sb3]'.",
            "policy",
        ) from error
    cls = getattr(stable_baselines3, name.upper(), None)
    require(cls is not None, "policy", must)
    model = cls.load(path, device="cpu")  # type: ignore[union-attr]
    size, wanted = model.observation_space.shape, (task.obs_dim,)
    require(
        size == wanted,
        "policy",
        f"must act on observations of the shape {wanted}; got {size}. Set another file.",
    )
    bound = getattr(model.action_space, "high", np.ones(1))
    # A task whose bounds are not alike everywhere is scaled to [-1, 1].
    factor = 1.0 if task.num_actions is not None else task.max_action / np.asarray(bound, float)
    return lambda obs: model.predict(obs, deterministic=True)[0] * factor


def _of_file(text: str) -> list[Layer]:
    try:
        stored = np.load(text, allow_pickle=False)
        count = sum(name.startswith("kernel_") for name in stored.files)
        layers = [(stored[f"kernel_{i}"], stored[f"bias_{i}"]) for i in range(count)]
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(
            f"policy must be a file of kernel_0, bias_0 and so on; got {shortened(text)} "
            f"({told(error)}). {FIX}",
            "policy",
        ) from error
    return [(np.asarray(kernel, float), np.asarray(bias, float)) for kernel, bias in layers]


def _of_function(text: str) -> Actor:
    import importlib

    module, _, name = text.partition(":")
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"policy must be a function that can be imported; got {shortened(text)} "
            f"({told(error)}). {FIX}",
            "policy",
        ) from error
    require(
        callable(found),
        "policy",
        f"must be a function of observations; got {type(found).__name__}. {FIX}",
    )
    return lambda obs: np.asarray(found(obs))
