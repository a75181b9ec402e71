"""Fresh agents on a stored proxy and on its real task, as in `sejax.evaluate` and `sejax.check`."""

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import jax
import pandas as pd

from sejax import agents, envs
from sejax.evaluation import evaluate_agents
from sejax.options import ConfigError, Count, registry, require
from sejax.options.plain import configure, flatten, merge, require_typed, to_plain
from sejax.proxies import header
from sejax.proxies.io import Proxy, load_proxy, training_of
from sejax.runs.command_config import CommandConfig
from sejax.runs.config import default_agent
from sejax.runs.words import Tree, agent_names, drop_other_choices
from sejax.training import TrainingConfig

# Training on the real task.
REAL_TRAINING = TrainingConfig(stop_rule="solved", max_steps=None, max_episodes=1000)
# Columns of the table: what they show, and with how many digits.
SHOWN = {
    "return": ("test_return", 1),
    "training steps": ("train_steps", 0),
    "training episodes": ("train_episodes", 1),
}


class World(NamedTuple):
    """An environment, its params, the real task of the tests, and training limits by agent key."""

    env: Any
    params: Any
    task: envs.Task
    trainings: dict[str, TrainingConfig]
    is_varied: bool = False  # whether hyperparameters are random for each agent


@dataclass(frozen=True, kw_only=True)
class FreshAgentsConfig(CommandConfig):
    """Which agents train on which proxy, and for how long.

    Attributes:
      proxy: a run directory, a safetensors file, or a shipped name (cartpole)
      env: the task, if proxy=real or if the proxy's task is your own
      proxy_kind: my_module:MyProxy, if the proxy's class is your own
      agent_hparams: as_learned: agents and exploration that the proxy was learned with, if no
        agent is named; default: the agent's; varied: drawn around the default for each agent.
      training_from: How long agents train on the proxy. proxy: on an SE as in the run that learned
        it, on a reward network as on the real task; config: as `training` says.
      real_training: Training on the real task. Its test_episodes hold on the proxy too, unless
        training_from=config. Agents as_learned keep the time_limit_is_terminal of the run.
    """

    folder_field = "out_dir"
    help_words = ("proxy=RUN_DIR",)

    proxy: str
    env: str | None = None
    proxy_kind: str | None = None
    agent_hparams: Literal["default", "varied", "as_learned"] = "default"
    training_from: Literal["proxy", "config"] = "proxy"
    num_agents: Count = 10
    out_dir: str | None = None
    real_training: TrainingConfig = REAL_TRAINING

    @classmethod
    def default_layers(cls, typed: Tree) -> dict[str, Tree]:
        """What agents take from the run that learned the proxy.

        If no word names an agent, all of the proxy's agents train, with their exploration and the
        run's `time_limit_is_terminal`; typed fields lie over theirs. A typed agent that the proxy
        was learned with has the proxy's hyperparameters. If the file has no agents, the task's
        default one trains.

        Raises:
          ConfigError: without a proxy; for a `training` that is not read; with
            `agent_hparams=as_learned`, if words name others, or if the file has none.
        """
        require("proxy" in typed, "proxy", "must be given", use="RUN_DIR, FILE or cartpole")
        # Defaults may stand there: `--print-config` writes them, and its file may come as a preset.
        printed = {"training": to_plain(TrainingConfig())}
        is_default = merge(printed, typed)["training"] == printed["training"]
        is_read = is_default or typed.get("training_from") == "config"
        require(is_read, "training", "must come with training_from=config, or be real_training.*.")
        stored = stored_header(str(typed["proxy"]))
        learned = learned_layer(stored.config) if stored else {}
        drop_other_choices(learned, typed, ["exploration"])
        names = agent_names(typed["agents"])
        asked = typed.get("agent_hparams")
        if asked == "as_learned" and stored:
            require(learned, "agent_hparams", "must be left out, as this proxy has no agents.")
            are_same = names in ({}, agent_names(learned["agents"]))
            fix = "Set agent_hparams=default."
            require(are_same, "agents", "must be the proxy's", got=", ".join(names), fix=fix)
        if learned and (asked == "as_learned" or (asked is None and not names)):
            return {"proxy": learned | {"agent_hparams": "as_learned"}}
        # Agents take the hyperparameters of the proxy's of their name; of several, of their key's.
        known = learned["agents"] if learned and asked is None else {}
        if not names:
            task = {"name": typed.get("env", "cartpole")}
            name = agents.default_for(stored.spec) if stored else default_agent(task)
            names = {name: name}
        of_agents: Tree = {}
        for key, name in names.items():
            same = {k: agent for k, agent in known.items() if agent["name"] == name}
            of_agents[key] = same.get(key) or next(iter(same.values()), {"name": name})
        return {"proxy": {"agents": of_agents}}


def stored_header(proxy: str) -> header.Header | None:
    """The header of a proxy's file; None for the real task, or if loading the file will raise."""
    with contextlib.suppress(ConfigError):
        if proxy != "real":
            return header.read(proxy, "proxy").header
    return None


def learned_layer(config: Mapping[str, Any]) -> Tree:
    """The layer of the agents that a proxy was learned with; empty if its file has none.

    Args:
      config: of the proxy's file.
    """
    if not config["agents"]:
        return {}
    explored = config.get("exploration", {"name": "none"})
    limit = flatten(config).get("training.time_limit_is_terminal", True)
    real_training = {"time_limit_is_terminal": limit}
    return {"agents": config["agents"], "exploration": explored, "real_training": real_training}


def worlds_of(config: FreshAgentsConfig) -> dict[str, World]:
    """Where agents train: on the proxy, and others on its real task; by names for tables.

    Raises:
      ConfigError: for an unknown or damaged proxy, a task that is not the proxy's, or agents that
        do not fit it.
    """
    is_given = config.proxy != "real" or config.env
    require(is_given, "env", "must be given with proxy=real. Set env=cartpole.")
    proxy = None if config.proxy == "real" else loaded(config)
    task = envs.make(str(config.env)) if proxy is None else proxy.task
    for key, agent in config.agents.items():
        agents.require_fit(agent, config.exploration, task, task.name, config.group_of(key))
    trainings = dict.fromkeys(config.agents, config.real_training)
    on_task = World(task.env, task.params, task, trainings, config.agent_hparams == "varied")
    if proxy is None:
        return {"the real task": on_task}
    if config.agent_hparams == "as_learned":
        on_task = on_task._replace(is_varied=proxy.config.get("agent_hparams") == "varied")
    trainings = {key: training_on(proxy, config, key) for key in config.agents}
    on_proxy = World(proxy.env, proxy.params, task, trainings, on_task.is_varied)
    return {"the proxy": on_proxy, "the real task": on_task}


def loaded(config: FreshAgentsConfig) -> Proxy:
    """Loads the proxy. Imports modules that the command line names, never those that a file names.

    Raises:
      ConfigError: if it cannot be loaded, or `env` is not its task.
    """
    path, _, learned = header.read(config.proxy, "proxy")
    stored = learned.config
    require_typed({group: {**stored[group], "name": ""} for group in ("env", "proxy")})
    task = proxy_config = None
    if config.env is not None and not registry.is_registered("env", config.env):
        fields = stored["env"] if stored["env"].get("name") == config.env else {}
        task = envs.make_from(configure("env", {**fields, "name": config.env}))
    if (name := config.proxy_kind) is not None:
        is_own = name == learned.kind or name not in registry.BUILT_IN["proxy"]
        require(is_own, "proxy_kind", "must be the proxy's class", got=name, use=learned.kind)
        proxy_config = configure("proxy", {**stored["proxy"], "name": name}, "proxy_kind")
    proxy = load_proxy(path, task, proxy_config, "proxy")
    stored_name = str(stored["env"].get("name"))
    is_by_hand = stored_name.endswith(header.BY_HAND)
    if is_by_hand and task is not None:
        print(f"{path.name} does not say how its task was made: {config.env} stands for it.")
    is_same = (is_by_hand and task) or config.env in (None, proxy.task.name, stored_name)
    use = "MODULE:NAME" if is_by_hand else stored_name
    require(is_same, "env", "must be the proxy's own task", got=config.env, use=use)
    return proxy


def training_on(proxy: Proxy, config: FreshAgentsConfig, key: str) -> TrainingConfig:
    """How long the agent of a key trains on a proxy; see `FreshAgentsConfig.training_from`.

    Raises:
      ConfigError: if the proxy's file does not say it, or the agent would learn nothing.
    """
    group, training = "training", config.training
    if config.training_from == "proxy" and proxy.env.has_real_dynamics:
        group, training = "real_training", config.real_training
    elif config.training_from == "proxy":
        use = "config training.max_steps=2000 training.max_episodes=2000"
        require("training" in proxy.config, "training_from", "must be config for this SE", use=use)
        test_episodes = config.real_training.test_episodes
        training = training_of(proxy, config.agents[key])
        training = replace(training, test_episodes=test_episodes)
    config.require_learning(key, group, training, proxy.env.config, proxy.task)
    return training


def train(config: FreshAgentsConfig, world: World, key: str) -> dict[str, Any]:
    """The results of fresh agents in a world: arrays `[agent]` by column of the table.

    Args:
      config: the settings.
      world: where they train and are tested.
      key: of the agent in `config.agents`.
    """
    env, env_params, task, trainings, is_varied = world
    agent = config.agent_for(key, task, is_varied)
    random_keys = jax.random.split(jax.random.key(config.seed), config.num_agents)
    counts = {"devices": config.devices, "num_parallel": config.num_parallel}
    training = trainings[key]
    outcome = evaluate_agents(agent, env, env_params, task, training, random_keys, **counts)
    outcome = jax.device_get(outcome)
    of_agents = {name: x for name, x in vars(outcome).items() if x.ndim == 1}  # one for each agent
    varied = jax.device_get(jax.vmap(agent.drawn_values)(random_keys))
    return {"test_return": outcome.test_return, **of_agents, **varied}


def summarise(table: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Mean and standard deviation of each column for each group.

    An agent that diverged counts with the worst return of all agents.
    """
    returns = table["test_return"].mask(table["nonfinite"] > 0)
    table = table.assign(test_return=returns.fillna(returns.min()))
    grouped = table.groupby(by, sort=False)
    summary = grouped[["test_return", "train_steps", "train_episodes"]].agg(["mean", "std"])
    summary.columns = [f"{name}_{statistic}" for name, statistic in summary.columns]
    return summary.assign(num_agents=grouped.size(), num_nonfinite=grouped["nonfinite"].sum())


def print_table(
    summary: pd.DataFrame, title: str, last: str, shown: Mapping[str, tuple[str, int]] = SHOWN
) -> None:
    """Prints what `summarise` returns, a row for each group, and a last line below."""
    columns: dict[str, list[str]] = {}
    for label, (name, digits) in shown.items():
        columns[label] = []
        for mean, std in zip(summary[f"{name}_mean"], summary[f"{name}_std"], strict=True):
            deviation = f" ± {std:,.{digits}f}" if math.isfinite(std) else ""  # one agent has none
            columns[label].append(f"{mean:,.{digits}f}{deviation}")
    table = pd.DataFrame(columns, summary.index).rename_axis([None] * summary.index.nlevels)
    print(f"{title}\n\n{table.rename_axis(columns='trained on').to_string(sparsify=False)}\n")
    if diverged := int(summary["num_nonfinite"].sum()):
        print(f"{diverged} agents met a number that is not finite.")
    print(last)
