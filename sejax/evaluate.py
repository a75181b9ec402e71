"""`python -m sejax.evaluate`: train fresh agents on a stored proxy, test them on the real task."""

import dataclasses
import math
import sys
import time
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig

from sejax import commands
from sejax.configs import (
    EvaluateConfig,
    evaluate_from_hydra,
    require_fit,
    require_learning,
    require_real_returns,
)
from sejax.errors import ConfigError


@hydra.main(config_path="conf/evaluate", config_name="evaluate", version_base="1.3")
@commands.task
def main(cfg: DictConfig) -> float:
    """Evaluates as configured and returns the mean test return (for Hydra's sweepers)."""
    config = evaluate_from_hydra(cfg)
    from sejax.runtime import configure_xla, enable_compilation_cache

    if "jax" not in sys.modules:  # a sweep's second job finds it running
        configure_xla(config.devices)
        enable_compilation_cache()
    return evaluate(config)


def evaluate(config: EvaluateConfig) -> float:
    """Trains `num_agents` agents in each world, prints a table and writes CSV, JSON and PNG.

    Returns:
      The mean test return of the agents trained on the proxy (on the real task for `proxy=real`).

    Raises:
      ConfigError: for an unknown or damaged proxy, or a task that is not the proxy's.
    """
    import pandas as pd

    from sejax import plots
    from sejax.files import write_text

    task, worlds, agent, exploration, out_dir = _prepare(config)
    tables = {
        name: _train_and_test(config, agent, exploration, task, name, *world)
        for name, world in worlds.items()
    }
    table = pd.concat([t.assign(world=name) for name, t in tables.items()])
    out_dir.mkdir(parents=True, exist_ok=True)
    write_text(out_dir / "evaluation.csv", table.to_csv(index=False))
    plots.evaluation(tables, task.solved_reward, out_dir / "evaluation.png")
    summary = summarise(table)
    write_text(out_dir / "evaluation.json", summary.to_json(orient="index", indent=2))
    _print_table(summary, task, config, agent.name, out_dir)
    return float(next(iter(tables.values()))["test_return"].mean())


def summarise(table: Any) -> Any:
    """Mean and standard deviation of each column for each world, as a data frame."""
    columns = ["test_return", "train_steps", "train_episodes"]
    summary = table.groupby("world", sort=False)[columns].agg(["mean", "std"])
    summary.columns = [f"{name}_{statistic}" for name, statistic in summary.columns]
    grouped = table.groupby("world", sort=False)
    return summary.assign(num_agents=grouped.size(), num_nonfinite=grouped["nonfinite"].sum())


def _prepare(config: EvaluateConfig) -> tuple[Any, dict[str, Any], Any, Any, Path]:
    """The task, the worlds to train in, the agent, its exploration, and the output folder."""
    from sejax import envs
    from sejax.evaluation import training_as_learned
    from sejax.proxies import io as proxy_io

    if config.proxy == "real":
        if config.env is None:
            raise ConfigError("env must be given with proxy=real, because the task cannot be read "
                              "from a proxy; got none. Set env=cartpole.")  # fmt: skip
        require_fit(config.agent, config.exploration, config.env)
        task = envs.make(config.env)
        worlds = {"the real task": (task.env, task.params, config.real_training)}
        out_dir = Path(config.out_dir or f"runs/evaluate-{task.name}")
        return task, worlds, config.agent, config.exploration, out_dir
    proxy = proxy_io.load_proxy(config.proxy)
    task = proxy.task
    if config.env not in (None, task.name):
        raise ConfigError(f"env must be the proxy's own task, because agents trained on it are "
                          f"tested there; got {config.env} for a proxy of {task.name}. Set "
                          f"env={task.name}.")  # fmt: skip
    agent, exploration = config.agent, config.exploration
    if config.agent_hparams == "nes":
        agent, exploration = proxy.config.agent, proxy.config.exploration
    require_fit(agent, exploration, task.name)
    is_se = proxy.config.proxy.name == "se"
    if config.training_from == "config":
        training, group = config.training, "training"
    else:
        # An RN's dynamics are real: its agents train and stop as on the real task.
        training, group = config.real_training, "real_training"
        if is_se:
            training = dataclasses.replace(training_as_learned(proxy, agent),
                                           test_episodes=training.test_episodes)  # fmt: skip
    require_real_returns(group, training)
    if is_se and proxy.config.proxy.done == "soft":
        require_learning(group, training, agent, task.name)
    worlds = {"the proxy": (proxy.env, proxy.params, training)}
    if config.baseline:
        worlds["the real task"] = (task.env, task.params, config.real_training)
    shipped = proxy.path.parent == proxy_io.PRETRAINED_DIR
    beside = Path(f"runs/evaluate-{proxy.path.stem}") if shipped else proxy.path.parent
    return task, worlds, agent, exploration, Path(config.out_dir or beside)


def _train_and_test(
    config: EvaluateConfig, agent: Any, exploration: Any, task: Any, world: str, env: Any,
    env_params: Any, training: Any,
) -> Any:  # fmt: skip
    import jax
    import pandas as pd

    from sejax.agents.hparams import drawing_key, make_varied_agents
    from sejax.agents.registry import make_agent
    from sejax.evaluation import evaluate_agents

    varied = config.agent_hparams == "varied"
    make = make_varied_agents if varied else make_agent
    agents: Any = make(agent, task, exploration)
    keys = jax.random.split(jax.random.key(config.seed), config.num_agents)
    started = time.time()
    outcome = evaluate_agents(
        agents, env, env_params, task, training, keys, config.lanes, config.devices
    )
    outcome = jax.device_get(outcome)
    drawn = jax.vmap(lambda key: agents.draw(drawing_key(key)))(keys) if varied else {}
    print(f"{world}: {config.num_agents} agents in {time.time() - started:.1f} s", flush=True)
    columns = {"agent": range(config.num_agents), "test_return": outcome.test_return,
               **vars(outcome), **jax.device_get(drawn)}  # fmt: skip
    del columns["test_returns"]
    return pd.DataFrame(columns)


def _print_table(
    summary: Any, task: Any, config: EvaluateConfig, agent_name: str, out_dir: Path
) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"{config.num_agents} fresh {agent_name} agents, tested on "
                        f"{task.name} (solved at {task.solved_reward:g})")  # fmt: skip
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
    console.print(f"{out_dir}/evaluation.csv, .json and .png hold every agent.", soft_wrap=True)


def _spread(mean: float, std: float, digits: int) -> str:
    """Mean and deviation; one agent has none."""
    return f"{mean:,.{digits}f}" + (f" ± {std:,.{digits}f}" if math.isfinite(std) else "")


if __name__ == "__main__":
    commands.start(main)
