"""Which agents an evaluation trains, where, and how long."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from sejax import agents, envs
from sejax.agents.base import AgentConfig
from sejax.ops.files import as_file_name
from sejax.options import ConfigError, registry, require, shortened
from sejax.proxies import header, hub
from sejax.proxies.io import Proxy, ProxySet, load_proxy, training_of
from sejax.runs import config as configuration
from sejax.runs.compose import errors_of
from sejax.runs.config import EvaluateConfig
from sejax.training import TrainingConfig, require_reachable

Loaded = TypeVar("Loaded", Proxy, ProxySet)


class World(NamedTuple):
    """Where agents train, and how long each of them by its key."""

    env: Any
    params: Any
    trainings: dict[str, TrainingConfig]


@dataclass(frozen=True, kw_only=True)
class Setup:
    """Which agents train where.

    Attributes:
      task: the real task, on which all are tested.
      worlds: by name, the first one first in tables.
      agents: by their keys.
      exploration: of all of them.
      out_dir: where the files go.
    """

    task: envs.Task
    worlds: dict[str, World]
    agents: dict[str, AgentConfig]
    exploration: Any
    out_dir: Path

    @property
    def has_several(self) -> bool:
        return len(self.agents) > 1


def real_setup(config: EvaluateConfig) -> Setup:
    """Agents on the real task alone."""
    if config.env is None:
        raise ConfigError("env must be given with proxy=real. Set env=cartpole.", "env")
    task = envs.make(config.env)
    for key, agent in config.agents.items():
        with errors_of("agent", config.field_of(key)):
            agents.require_fit(agent, config.exploration, task, task.name)
    trainings = dict.fromkeys(config.agents, config.real_training)
    return Setup(
        task=task,
        worlds={"the real task": World(task.env, task.params, trainings)},
        agents=config.agents,
        exploration=config.exploration,
        out_dir=Path(config.out_dir or Path("runs", f"evaluate-{as_file_name(task.name)}")),
    )


def proxy_setup(config: EvaluateConfig) -> Setup:
    """Agents on a proxy, and on its real task beside them."""
    proxy = load(config, load_proxy)
    env, task = proxy.env, proxy.task
    trainings = {}
    for key, agent in config.agents.items():
        with errors_of("agent", config.field_of(key)):
            agents.require_fit(agent, config.exploration, task, task.name)
            group, training = _training_on(proxy, config, agent)
            configuration.require_real_returns(group, training)
            require_reachable(group, training, env.max_steps)
            if env.config.reaches_step_limit:
                configuration.require_learning(
                    group, training, agent, env.max_steps, task.max_steps
                )
        trainings[key] = training
    worlds = {"the proxy": World(env, proxy.params, trainings)}
    if config.baseline:
        real_trainings = dict.fromkeys(trainings, _real_training(config, proxy))
        worlds["the real task"] = World(task.env, task.params, real_trainings)
    beside = proxy.path.parent
    if beside == header.PRETRAINED_DIR:
        beside = Path("runs", f"evaluate-{proxy.path.stem}")
    elif hub.is_address(config.proxy):
        beside = Path("runs", f"evaluate-{as_file_name(config.proxy.removeprefix(hub.SCHEME))}")
    return Setup(
        task=task,
        worlds=worlds,
        agents=config.agents,
        exploration=config.exploration,
        out_dir=Path(config.out_dir or beside),
    )


def load(config: EvaluateConfig, using: Callable[..., Loaded]) -> Loaded:
    """The proxy, or the set; modules are imported if the command line names them, never because a
    file does.

    Args:
      config: that names it.
      using: `load_proxy` or `load_set`.

    Raises:
      ConfigError: if it cannot be loaded, or `env` is not its task.
    """
    path = header.find(config.proxy, "proxy", also=("real",))
    stored = header.read_config(path, "proxy")
    task = proxy = None
    if config.env is not None and not registry.is_registered("env", config.env):
        fields = stored["env"] if stored["env"].get("name") == config.env else {}
        task = envs.make_from(registry.configure("env", {**fields, "name": config.env}))
    if config.proxy_kind is not None:
        fields = {**stored["proxy"], "name": config.proxy_kind}
        proxy = registry.configure("proxy", fields)
    loaded = using(path, task, proxy, "proxy")
    name = loaded.task.name
    require(
        config.env in (None, name, loaded.config["env"].get("name")),
        "env",
        f"must be the proxy's own task; got {config.env} for a proxy of {name}. Set env={name}.",
    )
    return loaded


def _training_on(
    proxy: Proxy, config: EvaluateConfig, agent: AgentConfig
) -> tuple[str, TrainingConfig]:
    """The group of fields that says how long agents train on the proxy, and how long that is."""
    if config.training_from == "config":
        return "training", config.training
    if proxy.env.is_real:  # agents train and stop as on the real task
        return "real_training", _real_training(config, proxy)
    require(
        "training" in proxy.config,
        "training_from",
        "must be config for an SE whose file does not say how long agents trained on it; got "
        f"{shortened(config.training_from)}. Set training_from=config training.stop_rule=never "
        "training.max_steps=2000 training.max_episodes=2000.",
    )
    test_episodes = config.real_training.test_episodes
    training = dataclasses.replace(training_of(proxy, agent), test_episodes=test_episodes)
    return "real_training", training


def _real_training(config: EvaluateConfig, proxy: Proxy) -> TrainingConfig:
    """How agents train on real dynamics; those of an RN's run take its limit as they did there."""
    as_learned = config.agent_hparams == "as_learned" and "training" in proxy.config
    if not (as_learned and proxy.env.is_real):
        return config.real_training
    is_terminal = training_of(proxy).time_limit_is_terminal
    default = TrainingConfig().time_limit_is_terminal
    require(
        config.real_training.time_limit_is_terminal in (default, is_terminal),
        "real_training.time_limit_is_terminal",
        f"must be what the proxy's agents learned with; got {not default}. Leave it out, or set "
        "agent_hparams=default.",
    )
    return dataclasses.replace(config.real_training, time_limit_is_terminal=is_terminal)
