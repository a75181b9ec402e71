"""Policies that `python -m sejax.distill` is given: files and functions."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple
from zipfile import BadZipFile

import numpy as np

from sejax.distillation.policy_copy import Actor, acting
from sejax.envs.base import Task
from sejax.options import ConfigError, registry, require, shortened, told
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
        return Given(checked(_of_sb3(text, task), task))
    if text.endswith(".npz"):
        layers = _of_file(text)
        return Given(checked(acting(task, layers), task), layers)
    require(":" in text, "policy", f"must be a file or a function; got {shortened(text)}. {FIX}")
    return Given(checked(_of_function(text), task))


def checked(act: Actor, task: Task) -> Actor:
    """The policy, whose actions are looked at.

    Raises:
      ConfigError: where it is called, if it fails, or its actions are none of the task.
    """
    count = task.num_actions

    def wrapped(obs: np.ndarray) -> np.ndarray:
        shape = (len(obs),) if count is not None else (len(obs), task.action_dim)
        try:
            actions = np.asarray(act(obs), float)
        except Exception as error:
            raise ConfigError(
                f"policy must act in {task.name}; it raised {told(error)}.", "policy"
            ) from error
        holds = actions.shape == shape and np.isfinite(actions).all()
        if holds and count is not None:
            holds = bool(((actions >= 0) & (actions < count) & (actions % 1 == 0)).all())
        kind = "finite numbers" if count is None else f"whole numbers from 0 to {count - 1}"
        require(
            holds,
            "policy",
            f"must give {kind} of the shape {list(shape)}; got {list(actions.shape)}, such as "
            f"{shortened(actions.ravel()[:3], 40)}. Set another policy.",
        )
        return actions.astype(np.int32) if count is not None else actions

    return wrapped


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
    try:
        model = cls.load(path, device="cpu")  # type: ignore[union-attr]
    except Exception as error:  # whatever lacks where another algorithm looks for it
        raise ConfigError(
            f"policy must be a model that {name.upper()} saved; got {text} ({told(error)}). Set "
            "policy=ALGORITHM:FILE.zip, with the algorithm of the file.",
            "policy",
        ) from error
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
        require(
            count > 0, "policy", f"must hold kernel_0, bias_0 and so on; got {stored.files}. {FIX}"
        )
    except ConfigError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError, BadZipFile) as error:
        raise ConfigError(
            f"policy must be a file of kernel_0, bias_0 and so on; got {shortened(text)} "
            f"({told(error)}). {FIX}",
            "policy",
        ) from error
    return [(np.asarray(kernel, float), np.asarray(bias, float)) for kernel, bias in layers]


def _of_function(text: str) -> Actor:
    registry.require_path("policy", text)
    found = registry.imported("policy", text)
    require(
        callable(found),
        "policy",
        f"must be a function of observations; got {type(found).__name__}. {FIX}",
    )
    return lambda obs: np.asarray(found(obs))
