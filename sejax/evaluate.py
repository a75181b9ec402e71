"""Train fresh agents on a stored proxy, and on the real task beside them; test all there.

Without agent=NAME they are those that the proxy was learned with.

  python -m sejax.evaluate proxy=RUN_DIR num_agents=20
  python -m sejax.evaluate proxy=cartpole agents=[ddqn,ppo] agents.ppo.epochs=10

Writes evaluation.csv, .json and .png into out_dir. --print-config prints the configuration alone.
"""

import json
import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import pandas as pd
from rich.console import Console
from rich.table import Table

from sejax.agents import make_agent
from sejax.envs import Task
from sejax.evaluation import evaluate_agents
from sejax.ops.files import require_writable, write_text
from sejax.runs import commands, compose, plots, runtime
from sejax.runs import config as configuration
from sejax.runs.config import EvaluateConfig
from sejax.runs.worlds import Setup, World, proxy_setup, real_setup

# Columns of the table: what they show, and with how many digits.
SHOWN = {
    "return": ("test_return", 1),
    "training steps": ("train_steps", 0),
    "training episodes": ("train_episodes", 1),
}


def main(overrides: Sequence[str]) -> None:
    """Evaluates each configuration that the overrides describe.

    Raises:
      ConfigError: for overrides that cannot be, or a proxy that cannot be loaded.
      OSError: if a file cannot be written.
    """
    configs = configs_of(overrides)
    runtime.configure_jax()
    for config in configs:
        evaluate(config)


def help_text(overrides: Sequence[str]) -> str:
    """What `--help` prints."""
    return f"{__doc__}\n{configuration.help_text(EvaluateConfig, overrides)}"


def configs_of(overrides: Sequence[str]) -> list[EvaluateConfig]:
    """The configurations that the overrides describe, with folders of their own."""
    make = configuration.evaluate_config
    return compose.swept(overrides, make, "out_dir", lambda _, name: f"runs/evaluate-{name}")


def evaluate(config: EvaluateConfig) -> float:
    """Trains `num_agents` agents in each world, prints a table and writes CSV, JSON and PNG.

    Returns:
      The mean test return of the agents trained on the proxy (on the real task for `proxy=real`).

    Raises:
      ConfigError: for an unknown or damaged proxy, a task that is not the proxy's, or a folder that
        cannot be written.
    """
    setup = real_setup(config) if config.proxy == "real" else proxy_setup(config)
    out_dir = setup.out_dir
    require_writable("out_dir", out_dir)  # before agents train for nothing
    tables = {
        (world, key): _train_and_test(config, setup, world, key)
        for world in setup.worlds
        for key in config.agents
    }
    table = pd.concat([t.assign(world=world) for (world, _), t in tables.items()])
    summary = summarise(table, ["world", "agent"] if len(config.agents) > 1 else ["world"])
    (key, *others), task = config.agents, setup.task
    who = "agents of each kind" if others else f"{key} agents"
    solved = f" (solved at {task.solved_reward:g})" if task.is_solvable else ""
    title = f"{config.num_agents} fresh {who}, tested on {task.name}{solved}"
    print_table(summary, title, f"{out_dir}/evaluation.csv, .json and .png hold every agent.")
    write_text(out_dir / "evaluation.csv", table.to_csv(index=False))
    write_text(out_dir / "evaluation.json", _as_json(summary))
    title = f"fresh {' + '.join(config.agents)} agents on {setup.task.name}"
    plots.evaluation(tables, setup.task.solved_reward, out_dir / "evaluation.png", title)
    first = table[table["world"] == next(iter(setup.worlds))]
    return float(first["test_return"].mean())


def _train_and_test(config: EvaluateConfig, setup: Setup, world: str, key: str) -> pd.DataFrame:
    """A row for each agent of a kind."""
    who = f"{key} agents" if len(config.agents) > 1 else "agents"
    started = time.time()
    print(f"training {config.num_agents:,} {who} on {world} ...", flush=True)
    columns = train(config, setup.task, setup.worlds[world], key)
    print(f"{world}: {config.num_agents} {who} in {time.time() - started:.1f} s", flush=True)
    numbers: dict[str, Any] = {"agent": range(config.num_agents)}
    if len(config.agents) > 1:
        numbers = {"agent": key, "number": range(config.num_agents)}
    return pd.DataFrame({**numbers, **columns})


def train(config: EvaluateConfig, task: Task, world: World, key: str) -> dict[str, Any]:
    """What fresh agents of a kind reach in a world, arrays `[agent]` by the table's columns."""
    env, env_params, trainings = world
    is_varied = config.agent_hparams == "varied"
    agent = make_agent(config.agents[key], task, config.exploration, is_varied)
    keys = jax.random.split(jax.random.key(config.seed), config.num_agents)
    how = trainings[key], keys, config.num_parallel, config.devices
    outcome = jax.device_get(evaluate_agents(agent, env, env_params, task, *how))
    of_agents = {name: x for name, x in vars(outcome).items() if x.ndim == 1}  # not of episodes
    varied = jax.device_get(jax.vmap(agent.drawn_values)(keys))
    return {"test_return": outcome.test_return, **of_agents, **varied}


def summarise(table: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Mean and standard deviation of each column for each group.

    A test return that is not a number counts as the worst of all.
    """
    table = table.fillna({"test_return": table["test_return"].min()})
    grouped = table.groupby(by, sort=False)
    summary = grouped[["test_return", "train_steps", "train_episodes"]].agg(["mean", "std"])
    summary.columns = [f"{name}_{statistic}" for name, statistic in summary.columns]
    return summary.assign(num_agents=grouped.size(), num_nonfinite=grouped["nonfinite"].sum())


def _as_json(summary: pd.DataFrame) -> str:
    """An object for each world; with several agents, in it one for each of them."""
    if summary.index.nlevels == 1:
        return str(summary.to_json(orient="index", indent=2))
    worlds = summary.index.unique("world")
    nested = {world: json.loads(summary.loc[world].to_json(orient="index")) for world in worlds}
    return json.dumps(nested, indent=2)


def spread(mean: float, std: float, digits: int) -> str:
    """Mean and deviation as text; one agent has no deviation."""
    return f"{mean:,.{digits}f}" + (f" ± {std:,.{digits}f}" if math.isfinite(std) else "")


def print_table(
    summary: pd.DataFrame, title: str, last: str, shown: Mapping[str, tuple[str, int]] = SHOWN
) -> None:
    """Prints what `summarise` returns, a row for each group, and a last line below."""
    labels = ["trained on", "agent"][: summary.index.nlevels]
    table = Table(title=title)
    for column in (*labels, *shown):
        table.add_column(column, justify="left" if column in labels else "right")
    for index, row in summary.iterrows():
        numbers = (spread(row[f"{x}_mean"], row[f"{x}_std"], n) for x, n in shown.values())
        table.add_row(*([index] if len(labels) == 1 else index), *numbers)
    console = Console(highlight=False)
    console.print(table)
    diverged = int(summary["num_nonfinite"].sum())
    if diverged:
        console.print(f"{diverged} agents met a number that is not finite.")
    console.print(last, soft_wrap=True)


if __name__ == "__main__":
    commands.start(main, help_text, configs_of)
