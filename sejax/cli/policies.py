"""Policies that `python -m sejax.distill` is given: agents, files, and functions."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sejax.agents import make_agent
from sejax.cli import config as configuration
from sejax.distillation.policy_copy import Actor, acting
from sejax.envs.base import Task
from sejax.options import ConfigError, registry, require, shortened, told
from sejax.proxies.exact import Layer
from sejax.training import TrainingConfig, make_trainer

FIX = "Set policy=sac, ppo:FILE.zip (Stable-Baselines3), FILE.npz or module:function."


class Given(NamedTuple):
    """A policy.

    Attributes:
      act: what it does.
      layers: the same, if it is of the exact form already; None if it must be copied.
      real_steps: that making it took here.
      cpu_s: likewise.
    """

    act: Actor
    layers: Sequence[Layer] | None = None
    real_steps: int = 0
    cpu_s: float = 0.0


def policy_of(text: str, task: Task, env_words: Sequence[str], steps: int, seed: int) -> Given:
    """The policy that an override names.

    Args:
      text: the name of an agent, which trains on the task itself; `ALGORITHM:FILE.zip`, a model of
        Stable-Baselines3; `FILE.npz` with `kernel_0` `[out, in]`, `bias_0` and so on, affine maps
        with ReLUs between; or `module:function`, of observations `[state, obs_dim]` to actions.
      task: the real task.
      env_words: overrides that make it.
      steps: of an agent's training.
      seed: likewise.

    Raises:
      ConfigError: for anything else.
    """
    if text.endswith(".zip"):
        return Given(_of_sb3(text, task))
    if text.endswith(".npz"):
        layers = _of_file(text)
        return Given(acting(task, layers), layers)
    if ":" in text:
        return Given(_of_function(text))
    if text in registry.names("agent"):
        return _of_agent(text, task, env_words, steps, seed)
    raise ConfigError(f"policy must be an agent, a file or a function; got {text}. {FIX}", "policy")


def _of_agent(name: str, task: Task, env_words: Sequence[str], steps: int, seed: int) -> Given:
    config = configuration.config([*env_words, f"agent={name}"])
    agent = make_agent(config.agent, task)
    training = TrainingConfig(
        max_steps=steps, max_episodes=steps, stop_rule="never", time_limit_is_terminal=False
    )
    train = jax.jit(make_trainer(agent, task.env, training))
    started = time.process_time()
    state = jax.block_until_ready(train(jax.random.key(seed), task.params)).agent_state

    @jax.jit
    def act(obs: Any) -> Any:
        key = jax.random.key(0)  # greedy: without effect
        actions = jax.vmap(lambda one: agent.act(key, state, one, explore=False))(obs)
        return jax.vmap(agent.env_action)(actions)

    cpu_s = time.process_time() - started
    return Given(lambda obs: np.asarray(act(jnp.asarray(obs))), None, steps, cpu_s)


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
