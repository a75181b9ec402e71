"""`python -m sejax.evaluate`: train fresh agents on a stored proxy, test them on the real task."""

import dataclasses
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sejax.cli import commands, compose, runtime
from sejax.cli import config as configuration
from sejax.cli.compose import named
from sejax.cli.config import AgentFamily, EvaluateConfig, families_of
from sejax.options import ConfigError, registry, require, shortened
from sejax.proxies import header, hub
from sejax.training import TrainingConfig, require_reachable, training_of

ABOUT = """Train fresh agents on a stored proxy, and on the real task beside them; test all there.

  python -m sejax.evaluate proxy=RUN_DIR num_agents=20
  python -m sejax.evaluate proxy=cartpole agents=[ddqn,ppo] agents.ppo.epochs=10

Writes evaluation.csv, .json and .png into out_dir.
"""


def main(overrides: Sequence[str]) -> None:
    """Evaluates each configuration that the overrides describe.

    Raises:
      ConfigError: for overrides that cannot be, or a proxy that cannot be loaded.
      OSError: if a file cannot be written.
    """
    configs = []
    for of_run in compose.expand(overrides):
        config = configuration.evaluate_config(of_run)
        own = compose.name_in_sweep(overrides, of_run, ("out_dir",))
        if own:  # or all runs of a sweep would have one folder
            folder = f"{config.out_dir}/{own}" if config.out_dir else f"runs/evaluate-{own}"
            config = dataclasses.replace(config, out_dir=folder)
        configs.append(config)
    runtime.configure_jax()
    for config in configs:
        evaluate(config)


def help_text(overrides: Sequence[str]) -> str:
    """What `--help` prints."""
    return f"{ABOUT}\n{compose.help_text(EvaluateConfig, overrides)}"


def evaluate(config: EvaluateConfig) -> float:
    """Trains `num_agents` agents in each world, prints a table and writes CSV, JSON and PNG.

    Returns:
      The mean test return of the agents trained on the proxy (on the real task for `proxy=real`).

    Raises:
      ConfigError: for an unknown or damaged proxy, a task that is not the proxy's, or a folder that
        cannot be written.
    """
    import pandas as pd

    from sejax.cli import plots
    from sejax.ops.files import require_writable, write_text

    study = _real_study(config) if config.proxy == "real" else proxy_study(config)
    out_dir, solved_reward = study.out_dir, study.task.solved_reward
    require_writable("out_dir", out_dir)  # before agents train for nothing
    tables = {
        (world, family.key): _train_and_test(config, study, world, family)
        for world in study.worlds
        for family in study.families
    }
    table = pd.concat([t.assign(world=world) for (world, _), t in tables.items()])
    summary = summarise(table, ["world", "agent"] if study.has_several else ["world"])
    _print_table(summary, study, config)
    write_text(out_dir / "evaluation.csv", table.to_csv(index=False))
    write_text(out_dir / "evaluation.json", _as_json(summary))
    plots.evaluation(tables, solved_reward, out_dir / "evaluation.png")
    first = table[table["world"] == next(iter(study.worlds))]
    return float(first["test_return"].mean())


def summarise(table: Any, by: list[str]) -> Any:
    """Mean and standard deviation of each column for each group, as a data frame.

    A test return that is not a number counts as the worst of all.
    """
    table = table.fillna({"test_return": table["test_return"].min()})
    grouped = table.groupby(by, sort=False)
    summary = grouped[["test_return", "train_steps", "train_episodes"]].agg(["mean", "std"])
    summary.columns = [f"{name}_{statistic}" for name, statistic in summary.columns]
    return summary.assign(num_agents=grouped.size(), num_nonfinite=grouped["nonfinite"].sum())


def _as_json(summary: Any) -> str:
    """An object for each world; with several agents, in it one for each of them."""
    if summary.index.nlevels == 1:
        return str(summary.to_json(orient="index", indent=2))
    worlds = summary.index.get_level_values("world").unique()
    nested = {world: json.loads(summary.loc[world].to_json(orient="index")) for world in worlds}
    return json.dumps(nested, indent=2)


@dataclass(frozen=True, kw_only=True)
class Study:
    """Which agents train where.

    Attributes:
      task: the real task, on which all are tested.
      worlds: name to `(env, env_params, training)`, how long each of the agents trains there by its
        key.
      families: the agents.
      exploration: of all of them.
      out_dir: where the files go.
    """

    task: Any
    worlds: dict[str, tuple[Any, Any, dict[str, TrainingConfig]]]
    families: tuple[AgentFamily, ...]
    exploration: Any
    out_dir: Path

    @property
    def has_several(self) -> bool:
        return len(self.families) > 1


def _real_study(config: EvaluateConfig) -> Study:
    """Agents on the real task alone."""
    from sejax import agents, envs

    if config.env is None:
        raise ConfigError(
            "env must be given with proxy=real, because the task cannot be read "
            "from a proxy; got none. Set env=cartpole."
        )
    spec = registry.configure("env", {"name": config.env})
    families = families_of(config)
    for family in families:
        with named(family.field):
            agents.require_fit(family.agent, config.exploration, envs.spec_of(spec), config.env)
    task = envs.make_from(spec)
    training = {family.key: config.real_training for family in families}
    worlds = {"the real task": (task.env, task.params, training)}
    out_dir = Path(config.out_dir or Path("runs", f"evaluate-{_as_file_name(task.name)}"))
    return Study(
        task=task, worlds=worlds, families=families, exploration=config.exploration, out_dir=out_dir
    )


def proxy_study(config: EvaluateConfig) -> Study:
    """Agents on a proxy, and on its real task beside them."""
    from sejax import agents

    proxy = _load(config)
    task = proxy.task
    if config.env not in (None, task.name, proxy.config["env"].get("name")):
        raise ConfigError(
            f"env must be the proxy's own task, because agents trained on it are "
            f"tested there; got {config.env} for a proxy of {task.name}. Set "
            f"env={task.name}."
        )
    families, exploration = families_of(config), config.exploration
    if config.agent_hparams == "as_learned":
        families = tuple(
            AgentFamily(key=key, field="agent", agent=agent)
            for key, agent in proxy.learned_agents().items()
        )
        exploration = proxy.learned_with("exploration")
    trainings = {}
    for family in families:
        with named(family.field):
            agents.require_fit(family.agent, exploration, task, task.name)
            group, training = _training_on(proxy, config, family.agent)
            configuration.require_real_returns(group, training)
            if not family.agent.is_solved_for:
                require_reachable(group, training, proxy.env.max_steps)
            if proxy.env.config.reaches_step_limit:
                configuration.require_learning(
                    group, training, family.agent, proxy.env.max_steps, task.max_steps
                )
        trainings[family.key] = training
    worlds = {"the proxy": (proxy.env, proxy.params, trainings)}
    if config.baseline:
        for family in families:
            require(
                not family.agent.is_solved_for,
                "baseline",
                f"must be false with {family.field}={family.key}, because only a one-step SE can "
                "be solved for; got true. Set baseline=false.",
            )
        real_training = dict.fromkeys(trainings, _real_training(config, proxy))
        worlds["the real task"] = (task.env, task.params, real_training)
    beside = proxy.path.parent
    if beside == header.PRETRAINED_DIR:
        beside = Path("runs", f"evaluate-{proxy.path.stem}")
    elif hub.is_address(config.proxy):
        beside = Path("runs", f"evaluate-{_as_file_name(config.proxy.removeprefix(hub.SCHEME))}")
    return Study(
        task=task,
        worlds=worlds,
        families=families,
        exploration=exploration,
        out_dir=Path(config.out_dir or beside),
    )


def _load(config: EvaluateConfig) -> Any:
    """The proxy; modules are imported if the command line names them, never because a file does."""
    from sejax import envs
    from sejax.proxies.io import load_proxy

    path = header.find(config.proxy, "proxy", also=("real",))
    stored = header.read_config(path, "proxy")
    task = proxy = None
    if config.env is not None and not registry.is_registered("env", config.env):
        fields = stored["env"] if stored["env"].get("name") == config.env else {}
        task = envs.make_from(registry.configure("env", {**fields, "name": config.env}))
    if config.proxy_kind is not None:
        fields = {**stored["proxy"], "name": config.proxy_kind}
        proxy = registry.configure("proxy", fields)
    return load_proxy(path, task, proxy, "proxy")


def _training_on(proxy: Any, config: EvaluateConfig, agent: Any) -> tuple[str, Any]:
    """How long agents train on the proxy, and the group of fields that says so."""
    if config.training_from == "config":
        return "training", config.training
    if proxy.env.is_real:  # agents train and stop as on the real task
        return "real_training", _real_training(config, proxy)
    require(
        "training" in proxy.config,
        "training_from",
        "must be config for an SE whose file does not say how long agents trained on it, because "
        f"tests on the real task must not stop them; got {shortened(config.training_from)}. Set "
        "training_from=config training.stop_rule=never training.max_steps=2000 "
        "training.max_episodes=2000.",
    )
    test_episodes = config.real_training.test_episodes
    training = dataclasses.replace(training_of(proxy, agent), test_episodes=test_episodes)
    return "real_training", training


def _real_training(config: EvaluateConfig, proxy: Any) -> TrainingConfig:
    """How agents train on real dynamics; those of an RN's run take its limit as they did there."""
    as_learned = config.agent_hparams == "as_learned" and "training" in proxy.config
    if not (as_learned and proxy.env.is_real):
        return config.real_training
    is_terminal = training_of(proxy).time_limit_is_terminal
    usual = TrainingConfig().time_limit_is_terminal
    require(
        config.real_training.time_limit_is_terminal in (usual, is_terminal),
        "real_training.time_limit_is_terminal",
        "must be left out with agent_hparams=as_learned, because the proxy says how its agents "
        "took the limit; got false. Set agent_hparams=default, or leave it out.",
    )
    return dataclasses.replace(config.real_training, time_limit_is_terminal=is_terminal)


def _train_and_test(config: EvaluateConfig, study: Study, world: str, family: AgentFamily) -> Any:
    """A row for each agent of a family, as a data frame."""
    import jax
    import numpy as np
    import pandas as pd

    from sejax.agents import make_agent
    from sejax.cli.progress import Tally
    from sejax.evaluation import evaluate_agents

    env, env_params, trainings = study.worlds[world]
    varied = config.agent_hparams == "varied"
    agent = make_agent(family.agent, study.task, study.exploration, varied)
    keys = jax.random.split(jax.random.key(config.seed), config.num_agents)
    who = f"{family.key} agents" if study.has_several else "agents"
    started = time.time()
    with Tally(config.num_agents, f"{who} on {world}") as tally:
        outcome = evaluate_agents(
            agent,
            env,
            env_params,
            study.task,
            trainings[family.key],
            keys,
            config.num_parallel,
            config.devices,
            tally.add if tally.is_live else None,
        )
        outcome = jax.device_get(outcome)
    drawn = jax.device_get(jax.vmap(agent.drawn_values)(keys))
    print(f"{world}: {config.num_agents} {who} in {time.time() - started:.1f} s", flush=True)
    numbers: dict[str, Any] = {"agent": range(config.num_agents)}
    if study.has_several:
        numbers = {"agent": family.key, "number": range(config.num_agents)}
    of_agents = {name: x for name, x in vars(outcome).items() if x.ndim == 1}  # not of episodes
    # The real task does not tell of numbers that are none.
    of_agents["nonfinite"] = of_agents["nonfinite"] | ~np.isfinite(outcome.test_return)
    return pd.DataFrame({**numbers, "test_return": outcome.test_return, **of_agents, **drawn})


def _print_table(summary: Any, study: Study, config: EvaluateConfig) -> None:
    from rich.console import Console
    from rich.table import Table

    from sejax.cli.report import spread

    agents = "agents of each family" if study.has_several else f"{study.families[0].key} agents"
    solved_at = study.task.solved_reward
    solved = f" (solved at {solved_at:g})" if study.task.is_solvable else ""
    table = Table(title=f"{config.num_agents} fresh {agents}, tested on {study.task.name}{solved}")
    labels = ["trained on", "agent"][: summary.index.nlevels]
    for column in (*labels, "return", "training steps", "training episodes"):
        table.add_column(column, justify="left" if column in labels else "right")
    for index, row in summary.iterrows():
        table.add_row(
            *([index] if len(labels) == 1 else index),
            spread(row.test_return_mean, row.test_return_std, 1),
            spread(row.train_steps_mean, row.train_steps_std, 0),
            spread(row.train_episodes_mean, row.train_episodes_std, 1),
        )
    console = Console(highlight=False)
    console.print(table)
    diverged = int(summary["num_nonfinite"].sum())
    if diverged:
        console.print(f"{diverged} agents met a number that is not finite.")
    console.print(
        f"{study.out_dir}/evaluation.csv, .json and .png hold every agent.", soft_wrap=True
    )


def _as_file_name(name: str) -> str:
    return name.replace("/", "_").replace(":", "_")


if __name__ == "__main__":
    commands.start(main, help_text)
