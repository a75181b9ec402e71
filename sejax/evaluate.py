"""`python -m sejax.evaluate`: train fresh agents on a stored proxy, test them on the real task."""

import dataclasses
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig

from sejax import plugins
from sejax.app import build, commands, compose, runtime
from sejax.app.build import EvaluateConfig
from sejax.errors import ConfigError


@hydra.main(config_path="conf", config_name="evaluate", version_base="1.3")
@commands.guarded
def main(cfg: DictConfig) -> float:
    """Evaluates as configured and returns the mean test return (for Hydra's sweepers)."""
    config = compose.evaluate_config_of(cfg)
    runtime.enable_compilation_cache()
    return evaluate(config)


def evaluate(config: EvaluateConfig) -> float:
    """Trains `num_agents` agents in each world, prints a table and writes CSV, JSON and PNG.

    Returns:
      The mean test return of the agents trained on the proxy (on the real task for `proxy=real`).

    Raises:
      ConfigError: for an unknown or damaged proxy, or a task that is not the proxy's.
    """
    import pandas as pd

    from sejax.app import plots
    from sejax.files import write_text

    study = _real_study(config) if config.proxy == "real" else _proxy_study(config)
    tables = {name: _train_and_test(config, study, name) for name in study.worlds}
    table = pd.concat([t.assign(world=name) for name, t in tables.items()])
    out_dir, solved_reward = study.out_dir, study.task.solved_reward
    out_dir.mkdir(parents=True, exist_ok=True)
    write_text(out_dir / "evaluation.csv", table.to_csv(index=False))
    plots.evaluation(tables, solved_reward, out_dir / "evaluation.png")
    summary = summarise(table)
    write_text(out_dir / "evaluation.json", summary.to_json(orient="index", indent=2))
    _print_table(summary, study, config)
    return float(next(iter(tables.values()))["test_return"].mean())


def summarise(table: Any) -> Any:
    """Mean and standard deviation of each column for each world, as a data frame."""
    columns = ["test_return", "train_steps", "train_episodes"]
    summary = table.groupby("world", sort=False)[columns].agg(["mean", "std"])
    summary.columns = [f"{name}_{statistic}" for name, statistic in summary.columns]
    grouped = table.groupby("world", sort=False)
    return summary.assign(num_agents=grouped.size(), num_nonfinite=grouped["nonfinite"].sum())


@dataclass(frozen=True, kw_only=True)
class Study:
    """Which agents train where.

    Attributes:
      task: the real task, on which all are tested.
      worlds: name to `(env, env_params, training)`.
      agent: configuration of the agents.
      exploration: likewise.
      out_dir: where the files go.
    """

    task: Any
    worlds: dict[str, tuple[Any, Any, Any]]
    agent: Any
    exploration: Any
    out_dir: Path


def _real_study(config: EvaluateConfig) -> Study:
    """Agents on the real task alone."""
    from sejax import agents, envs

    if config.env is None:
        raise ConfigError("env must be given with proxy=real, because the task cannot be read "
                          "from a proxy; got none. Set env=cartpole.")  # fmt: skip
    spec = plugins.configure("env", {"name": config.env})
    agents.require_fit(config.agent, config.exploration, envs.facts_of(spec), config.env)
    task = envs.make_from(spec)
    worlds = {"the real task": (task.env, task.params, config.real_training)}
    out_dir = Path(config.out_dir or Path("runs", f"evaluate-{_as_file_name(task.name)}"))
    return Study(task=task, worlds=worlds, agent=config.agent, exploration=config.exploration,
                 out_dir=out_dir)  # fmt: skip


def _proxy_study(config: EvaluateConfig) -> Study:
    """Agents on a proxy, and on its real task beside them."""
    from sejax import agents
    from sejax.proxies import files

    proxy = _load(config)
    task = proxy.task
    if config.env not in (None, task.name, proxy.config["env"].get("name")):
        raise ConfigError(f"env must be the proxy's own task, because agents trained on it are "
                          f"tested there; got {config.env} for a proxy of {task.name}. Set "
                          f"env={task.name}.")  # fmt: skip
    agent, exploration = config.agent, config.exploration
    if config.agent_hparams == "as_learned":
        agent, exploration = proxy.learned_with("agent"), proxy.learned_with("exploration")
    agents.require_fit(agent, exploration, task.facts, task.name)
    group, training = _training_on(proxy, config, agent)
    build.require_real_returns(group, training)
    if getattr(proxy.env.config, "may_never_end", False):
        build.require_learning(group, training, agent, task.max_steps)
    worlds = {"the proxy": (proxy.env, proxy.params, training)}
    if config.baseline:
        worlds["the real task"] = (task.env, task.params, config.real_training)
    shipped = proxy.path.parent == files.PRETRAINED_DIR
    beside = Path("runs", f"evaluate-{proxy.path.stem}") if shipped else proxy.path.parent
    return Study(task=task, worlds=worlds, agent=agent, exploration=exploration,
                 out_dir=Path(config.out_dir or beside))  # fmt: skip


def _load(config: EvaluateConfig) -> Any:
    """The proxy; modules are imported if the command line names them, never because a file does."""
    from sejax import envs
    from sejax.proxies import files

    path = files.find(config.proxy, "proxy", also=("real",))
    stored = files.read_config(path, "proxy")
    task = proxy = None
    if config.env is not None and not plugins.is_registered("env", config.env):
        fields = stored["env"] if stored["env"].get("name") == config.env else {}
        task = envs.make_from(plugins.configure("env", {**fields, "name": config.env}))
    if config.proxy_kind is not None:
        fields = {**stored["proxy"], "name": config.proxy_kind}
        proxy = plugins.configure("proxy", fields)
    return files.load_proxy(path, task, proxy, "proxy")


def _training_on(proxy: Any, config: EvaluateConfig, agent: Any) -> tuple[str, Any]:
    """How long agents train on the proxy, and the group of fields that says so."""
    from sejax.training import budget_for

    if config.training_from == "config":
        return "training", config.training
    if proxy.env.is_real or "training" not in proxy.config:
        # The dynamics are real: agents train and stop as on the real task.
        return "real_training", config.real_training
    is_known = plugins.is_registered("agent", str(proxy.config["agent"].get("name")))
    then = proxy.learned_with("agent") if is_known else None
    training = budget_for(proxy.learned_with("training"), agent, then, proxy.task.max_steps)
    test_episodes = config.real_training.test_episodes
    return "real_training", dataclasses.replace(training, test_episodes=test_episodes)


def _train_and_test(config: EvaluateConfig, study: Study, world: str) -> Any:
    import jax
    import pandas as pd

    from sejax.agents import make_agent
    from sejax.evaluation import evaluate_agents

    env, env_params, training = study.worlds[world]
    varied = config.agent_hparams == "varied"
    agent = make_agent(study.agent, study.task, study.exploration, varied)
    keys = jax.random.split(jax.random.key(config.seed), config.num_agents)
    started = time.time()
    outcome = evaluate_agents(
        agent, env, env_params, study.task, training, keys, config.lanes, config.devices
    )
    outcome = jax.device_get(outcome)
    drawn = jax.device_get(jax.vmap(agent.drawn_values)(keys))
    print(f"{world}: {config.num_agents} agents in {time.time() - started:.1f} s", flush=True)
    columns = {"agent": range(config.num_agents), "test_return": outcome.test_return,
               **vars(outcome), **drawn}  # fmt: skip
    del columns["test_returns"]
    return pd.DataFrame(columns)


def _print_table(summary: Any, study: Study, config: EvaluateConfig) -> None:
    from rich.console import Console
    from rich.table import Table

    name, solved_at = plugins.name_of("agent", study.agent), study.task.solved_reward
    solved = f" (solved at {solved_at:g})" if study.task.is_solvable else ""
    table = Table(title=f"{config.num_agents} fresh {name} agents, tested on "
                        f"{study.task.name}{solved}")  # fmt: skip
    for column in ("trained on", "return", "training steps", "training episodes"):
        table.add_column(column, justify="left" if column == "trained on" else "right")
    for world, row in summary.iterrows():
        table.add_row(
            str(world),
            _spread(row.test_return_mean, row.test_return_std, 1),
            _spread(row.train_steps_mean, row.train_steps_std, 0),
            _spread(row.train_episodes_mean, row.train_episodes_std, 1),
        )
    console = Console(highlight=False)
    console.print(table)
    diverged = int(summary["num_nonfinite"].sum())
    if diverged:
        console.print(f"{diverged} agents met a number that is not finite.")
    console.print(f"{study.out_dir}/evaluation.csv, .json and .png hold every agent.",
                  soft_wrap=True)  # fmt: skip


def _spread(mean: float, std: float, digits: int) -> str:
    """Mean and deviation; one agent has none."""
    return f"{mean:,.{digits}f}" + (f" ± {std:,.{digits}f}" if math.isfinite(std) else "")


def _as_file_name(name: str) -> str:
    return name.replace("/", "_").replace(":", "_")


if __name__ == "__main__":
    commands.start("evaluate", main)
