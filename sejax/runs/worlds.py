"""Which agents an evaluation trains, where, and how long."""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

from sejax import envs
from sejax.agents.base import AgentConfig
from sejax.ops.files import as_file_name
from sejax.options import registry, require
from sejax.proxies import header, hub
from sejax.proxies.io import Proxy, load_proxy, training_of
from sejax.runs.config import EvaluateConfig
from sejax.training import TrainingConfig


class World(NamedTuple):
    """Where agents train, and how long each of them by its key."""

    env: Any
    params: Any
    trainings: dict[str, TrainingConfig]


class Setup(NamedTuple):
    """Where agents train and are tested.

    Attributes:
      task: the real task, on which all are tested.
      worlds: by name, the first one first in tables.
      out_dir: where the files go.
    """

    task: envs.Task
    worlds: dict[str, World]
    out_dir: Path


def real_setup(config: EvaluateConfig) -> Setup:
    """Agents on the real task alone."""
    require(config.env, "env", "must be given with proxy=real. Set env=cartpole.")
    task = envs.make(str(config.env))
    for key in config.agents:
        config.require_fit(key, task, task.name)
    trainings = dict.fromkeys(config.agents, config.real_training)
    worlds = {"the real task": World(task.env, task.params, trainings)}
    folder = Path(config.out_dir or f"runs/evaluate-{as_file_name(task.name)}")
    return Setup(task, worlds, folder)


def proxy_setup(config: EvaluateConfig) -> Setup:
    """Agents on a proxy, and on its real task beside them."""
    proxy = loaded(config)
    env, task = proxy.env, proxy.task
    real_training, trainings = _real_training(config, proxy), {}
    for key, agent in config.agents.items():
        config.require_fit(key, task, task.name)
        group, training = "real_training", real_training
        if config.training_from == "config":
            group, training = "training", config.training
        elif not env.is_real:  # else agents train and stop as on the real task
            training = _as_learned(proxy, config, agent)
        config.require_learning(key, group, training, env.config, task)
        trainings[key] = training
    worlds = {"the proxy": World(env, proxy.params, trainings)}
    if config.baseline:
        trainings = dict.fromkeys(trainings, real_training)
        worlds["the real task"] = World(task.env, task.params, trainings)
    beside = proxy.path.parent
    if beside == header.PRETRAINED_DIR or hub.is_address(config.proxy):
        name = as_file_name(config.proxy.removeprefix(hub.SCHEME))
        beside = Path("runs", f"evaluate-{name}")
    folder = Path(config.out_dir or beside)
    return Setup(task, worlds, folder)


def loaded(config: EvaluateConfig) -> Proxy:
    """The proxy; modules are imported if the command line names them, never because a file does.

    Raises:
      ConfigError: if it cannot be loaded, or `env` is not its task.
    """
    path = header.find(config.proxy, "proxy", also=("real",))
    stored = header.read(path, "proxy").header.config
    task = proxy_config = None
    if config.env is not None and not registry.is_registered("env", config.env):
        fields = stored["env"] if stored["env"].get("name") == config.env else {}
        task = envs.make_from(registry.configure("env", {**fields, "name": config.env}))
    if config.proxy_kind is not None:
        fields = {**stored["proxy"], "name": config.proxy_kind}
        proxy_config = registry.configure("proxy", fields)
    proxy = load_proxy(path, task, proxy_config, "proxy")
    name = proxy.task.name
    is_same = config.env in (None, name, proxy.config["env"].get("name"))
    require(is_same, "env", f"must be the proxy's own task; got {config.env}. Set env={name}.")
    return proxy


def _as_learned(proxy: Proxy, config: EvaluateConfig, agent: AgentConfig) -> TrainingConfig:
    """How long agents train on an SE, which its file says."""
    message = "must be config for an SE whose file does not say how long agents train. Set "
    fix = "training_from=config training.max_steps=2000 training.max_episodes=2000."
    require("training" in proxy.config, "training_from", message + fix)
    test_episodes = config.real_training.test_episodes
    return dataclasses.replace(training_of(proxy, agent), test_episodes=test_episodes)


def _real_training(config: EvaluateConfig, proxy: Proxy) -> TrainingConfig:
    """How agents train on real dynamics; those of an RN's run take its limit as they did there."""
    as_learned = config.agent_hparams == "as_learned" and "training" in proxy.config
    if not (as_learned and proxy.env.is_real):
        return config.real_training
    is_terminal = training_of(proxy).time_limit_is_terminal
    default = TrainingConfig().time_limit_is_terminal
    is_same = config.real_training.time_limit_is_terminal in (default, is_terminal)
    message = "must be as the proxy's agents learned. Leave it out, or set agent_hparams=default."
    require(is_same, "real_training.time_limit_is_terminal", message)
    return dataclasses.replace(config.real_training, time_limit_is_terminal=is_terminal)
