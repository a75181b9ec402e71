"""Train fresh agents on a stored proxy, and others on the real task; test all on the real task.

By default they are the agents that the proxy was learned with; agent=NAME takes another one.

  python -m sejax.evaluate proxy=RUN_DIR num_agents=20
  python -m sejax.evaluate proxy=cartpole 'agents=[ddqn,ppo]' agents.ppo.epochs=10

Writes evaluation.csv and .json into out_dir. --print-config prints the configuration alone.
"""

import functools
import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from sejax.ops.files import as_file_name, require_writable, write_text
from sejax.options import require
from sejax.proxies import header, hub
from sejax.runs import commands, fresh_agents
from sejax.runs.fresh_agents import FreshAgentsConfig, World


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig(FreshAgentsConfig):
    """What `sejax.evaluate` takes.

    Attributes:
      proxy: a run directory, a safetensors file, a shipped name (cartpole), or real
      baseline: whether as many agents train on the real task, for comparison
      out_dir: null: beside the proxy; of a sweep, and if the proxy has no folder,
        runs/evaluate-<proxy>
    """

    named_by = ("proxy",)

    baseline: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, idle in (("agent_hparams", "as_learned"), ("training_from", "config")):
            is_idle = self.proxy == "real" and getattr(self, name) == idle
            require(not is_idle, name, "must be left out with proxy=real", got=idle)

    @property
    def default_folder(self) -> str:
        """The folder of sweeps, of a shipped proxy or one of the Hub, and on the real task."""
        name = f"real-{self.env}" if self.proxy == "real" else self.proxy.removeprefix(hub.SCHEME)
        return f"runs/evaluate-{as_file_name(name)}"

    @property
    def folder(self) -> Path:
        """`out_dir`; by default that of the proxy, if it has one."""
        if self.out_dir or self.proxy == "real" or self.proxy.startswith(hub.SCHEME):
            return super().folder
        beside = header.find(self.proxy, "proxy").parent
        return super().folder if beside == header.PRETRAINED_DIR else beside


def main(overrides: Sequence[str]) -> None:
    """Evaluates each configuration that the overrides describe.

    Raises:
      ConfigError: for invalid overrides, or a proxy that cannot be loaded.
      OSError: if a file cannot be written.
    """
    for config in EvaluateConfig.of_sweep(overrides):
        evaluate(config)


help_text = functools.partial(commands.help_of, EvaluateConfig, __doc__)


def evaluate(config: EvaluateConfig) -> float:
    """Trains `num_agents` agents in each world, prints a table and writes CSV and JSON.

    Returns:
      The mean test return of the agents trained on the proxy (on the real task for `proxy=real`).

    Raises:
      ConfigError: for an unknown or damaged proxy, a task that is not the proxy's, or a folder that
        cannot be written.
    """
    worlds = fresh_agents.worlds_of(config)
    out_dir = config.folder
    if not config.baseline:
        worlds = dict([*worlds.items()][:1])
    require_writable("out_dir", out_dir)  # before agents train for nothing
    pairs = itertools.product(worlds, config.agents)
    table = pd.concat([_train_and_test(config, x, worlds[x], key) for x, key in pairs])
    summary = fresh_agents.summarise(table, ["world", "agent"])
    key, *others = config.agents
    name, world = next(iter(worlds.items()))
    who = "agents of each algorithm" if others else f"{key} agents"
    solved = f" (solved at {world.task.solved_reward:g})" if world.task.is_solvable else ""
    title = f"{config.num_agents} fresh {who}, tested on {world.task.name}{solved}"
    shown = summary if others else summary.droplevel("agent")
    fresh_agents.print_table(shown, title, f"{out_dir}/evaluation.csv holds every agent.")
    write_text(out_dir / "evaluation.csv", table.to_csv(index=False))
    by_world = {x: json.loads(summary.loc[x].to_json(orient="index")) for x in worlds}
    write_text(out_dir / "evaluation.json", json.dumps(by_world, indent=2))
    return float(summary["test_return_mean"].loc[name].mean())


def _train_and_test(config: EvaluateConfig, name: str, world: World, key: str) -> pd.DataFrame:
    """A row for each agent of an algorithm, whose key is `agent`."""
    who = f"{key} agents" if len(config.agents) > 1 else "agents"
    print(f"training {config.num_agents:,} {who} on {name} ...", flush=True)
    columns = fresh_agents.train(config, world, key) | {"world": name}
    return pd.DataFrame({"agent": key, "number": range(config.num_agents), **columns})


if __name__ == "__main__":
    commands.start(main, help_text, EvaluateConfig.of_sweep, resumes=False)
