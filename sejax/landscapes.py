"""Landscapes: configurations of an agent, and what they reach on a real task.

A landscape is one CSV file. Its first lines, which begin with `#`, are its card, in YAML: the task,
how long agents trained and were tested, the space that configurations were drawn from, and each
agent's options. Then there is a row for each training: `agent`, `config`, `seed`, what the
configuration sets (`agent.learning_rate`, ...), the mean `return` of the tests, and `nonfinite`, 1
if the training diverged. `python -m sejax.landscape` measures them.
"""

import csv
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from sejax.ops.files import write_text
from sejax.options import ConfigError, listed, require, shortened, told

KEYS = ["agent", "config", "seed"]
COLUMNS = [*KEYS, "return", "nonfinite"]
CARD = ("task", "steps", "test_episodes", "agents")  # what a card must have
PREFIX = "agent."  # of columns that a configuration sets
FIELD = "landscape"  # in messages


@dataclass(frozen=True, kw_only=True, eq=False)
class Landscape:
    """What configurations of one agent reach on a task.

    Attributes:
      task: name of the task.
      agent: name of the agent.
      options: the agent's, plain values; a configuration sets some of them anew.
      steps: training steps of each agent.
      values: by option, what each configuration sets, `[config]` float64.
      returns: mean test return of each training, `[config, seed]`; one that diverged has the lowest
        of the landscape.
    """

    task: str
    agent: str
    options: Mapping[str, Any]
    steps: int
    values: Mapping[str, np.ndarray]
    returns: np.ndarray

    @property
    def size(self) -> int:
        """Number of configurations."""
        return len(self.returns)

    @property
    def mean_returns(self) -> np.ndarray:
        """Over the seeds, `[config]`."""
        means: np.ndarray = self.returns.mean(axis=1)
        return means


def read(path: Path | str, field: str = FIELD) -> dict[str, Landscape]:
    """The landscapes of a file by their agents.

    Raises:
      ConfigError: about `field`, for a file that cannot be read or holds no landscape; and for
        returns that are missing or no numbers, fewer than two configurations, or configurations
        that reach the same.
    """
    card, table = read_table(path, field)
    return {
        str(agent): _landscape(card, str(agent), rows, field, Path(path))
        for agent, rows in table.groupby("agent", sort=False)
    }


def read_table(path: Path | str, field: str = FIELD) -> tuple[dict[str, Any], pd.DataFrame]:
    """The card and the rows of a file, which need not be complete.

    Raises:
      ConfigError: about `field`, for a file that cannot be read or holds no landscape.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
        lines = text.splitlines(keepends=True)
        is_card = [line.startswith("#") for line in lines]
        card = yaml.safe_load("".join(x[2:] for x, own in zip(lines, is_card, strict=True) if own))
        rows = "".join(x for x, own in zip(lines, is_card, strict=True) if not own)
        table = pd.read_csv(io.StringIO(rows))
    except (OSError, UnicodeDecodeError, yaml.YAMLError, ValueError) as error:
        raise ConfigError(
            f"{field} must be the CSV file of a landscape; got {shortened(path)} ({told(error)}). "
            "Measure one with python -m sejax.landscape.",
            field,
        ) from error
    lacks = [x for x in CARD if not isinstance(card, Mapping) or x not in card]
    lacks += [x for x in COLUMNS if x not in table]
    require(
        not lacks,
        field,
        f"must be the CSV file of a landscape; got {shortened(path)}, which lacks "
        f"{listed(lacks)}. Measure one with python -m sejax.landscape.",
    )
    return dict(card), table


def write(path: Path, card: Mapping[str, Any], table: pd.DataFrame) -> None:
    """Writes a landscape's file atomically."""
    text = yaml.safe_dump(dict(card), sort_keys=False, width=96)
    commented = "".join(f"# {line}\n" for line in text.splitlines())
    write_text(path, commented + table.to_csv(index=False))


# --- ARLBench -------------------------------------------------------------------------------------

# ARLBench's names of what sejax's agents take as arguments of a compiled program.
ARLBENCH = {
    "ppo": {
        "learning_rate": "learning_rate",
        "gae_lambda": "gae_lambda",
        "clip_eps": "clip_ratio",
        "ent_coef": "entropy_weight",
        "vf_coef": "value_weight",
    },
    "sac": {"learning_rate": "learning_rate", "tau": "tau"},
    "dqn": {"learning_rate": "learning_rate", "epsilon": "epsilon_min"},
}
ARLBENCH_TASKS = {
    "CartPole-v1": "cartpole_v1",
    "Acrobot-v1": "acrobot",
    "MountainCar-v0": "mountain_car",
    "MountainCarContinuous-v0": "mountain_car_continuous",
    "Pendulum-v1": "pendulum",
    "HalfCheetah-v4": "halfcheetah",
    "Hopper-v4": "hopper",
    "Ant-v4": "ant",
}
_PREFIX = "hp_config."  # of its columns


def from_arlbench(folder: Path | str, file: Path | str, steps: int | None = None) -> list[str]:
    """Writes a landscape that ARLBench measured as a file of sejax's.

    What its agents have and sejax's do not take as an argument is left out: configurations then
    differ in more than the file says.

    Args:
      folder: of one of its landscapes, such as `results/sobol/ppo_Hopper-v4` of a commit that has
        them (a44d4c64 of github.com/automl/arlbench), with a folder for each seed.
      file: that is written.
      steps: of the checkpoint whose returns count; None for the last.

    Returns:
      Its hyperparameters that are left out.

    Raises:
      ConfigError: for a folder that holds no such landscape, or no such checkpoint.
      OSError: if a file of the folder cannot be read.

    Source: Becktepe et al., "ARLBench: Flexible and Efficient Benchmarking for Hyperparameter
    Optimization in Reinforcement Learning" (2024).
    """
    folder = Path(folder)
    agent, _, task = folder.name.partition("_")
    require(
        agent in ARLBENCH and task in ARLBENCH_TASKS and folder.is_dir(),
        "folder",
        f"must be a folder AGENT_TASK of {listed(list(ARLBENCH))} and "
        f"{listed(list(ARLBENCH_TASKS))}; got {shortened(folder.name)}.",
    )
    names, tables, other = ARLBENCH[agent], [], set()
    seeds = sorted((x for x in folder.iterdir() if x.name.isdigit()), key=lambda x: int(x.name))
    for seed in seeds:
        with (seed / "runhistory.csv").open(encoding="utf-8") as history:
            rows = list(csv.DictReader(history))  # some have cells that no column is named for
        drawn = {x: x.removeprefix(_PREFIX) for x in rows[0] if str(x).startswith(_PREFIX)}
        other |= {name for name in drawn.values() if name not in names}
        for row in rows:
            curve = pd.read_csv(seed / row["run_id"] / "evaluation.csv")
            at = curve["steps"].iloc[-1] if steps is None else steps
            returns = curve.loc[curve["steps"] == at, "returns"]
            require(
                len(returns) == 1,
                "steps",
                f"must be one of {listed([f'{x:.0f}' for x in curve['steps']])}; got {at:g}.",
            )
            own: dict[str, object] = {
                f"{PREFIX}{names[x]}": float(row[c]) for c, x in drawn.items() if x in names
            }
            value = float(returns.iloc[0])
            bad = int(not math.isfinite(value))
            place: dict[str, object] = {
                "agent": agent,
                "config": int(row["run_id"]),
                "seed": int(seed.name),
            }
            tables.append({**place, **own, "nonfinite": bad, "return": value, "steps": int(at)})
    require(tables, "folder", f"must have a folder for each seed; got {shortened(folder)}.")
    table = pd.DataFrame(tables)
    card = {
        "task": ARLBENCH_TASKS[task],
        "steps": int(table["steps"].max()),
        "test_episodes": None,  # not told
        "agents": {agent: {}},
        "source": "ARLBench (BSD-3), results/sobol",
        "left_out": sorted(other),
    }
    write(Path(file), card, table.drop(columns="steps"))
    return sorted(other)


def _landscape(
    card: Mapping[str, Any], agent: str, rows: pd.DataFrame, field: str, path: Path
) -> Landscape:
    where = f"{shortened(path, 60)} with {shortened(agent, 20)}"
    again = "Run the command that measured it again."
    by_place = rows.drop_duplicates(KEYS).set_index(["config", "seed"])
    grid, diverged = by_place["return"].unstack(), by_place["nonfinite"].unstack()
    values = {
        name.removeprefix(PREFIX): rows.groupby("config")[name].first().to_numpy()
        for name in rows.columns
        if name.startswith(PREFIX) and rows[name].notna().any()
    }
    numeric = all(np.issubdtype(x.dtype, np.number) for x in (grid.to_numpy(), *values.values()))
    is_measured = numeric and np.isfinite(grid.where(diverged == 0, 0.0).to_numpy()).all()
    require(
        not rows.duplicated(KEYS).any() and len(rows) == grid.size and is_measured,
        field,
        f"must have a return for each configuration and seed; got {where}, where "
        f"{len(rows)} rows make {grid.shape[0]} configurations of {grid.shape[1]} seeds, or some "
        f"are no numbers. {again}",
    )
    returns = grid.to_numpy(float)
    finite = np.where(diverged.to_numpy() == 0, returns, math.inf)
    returns = np.where(np.isfinite(finite), finite, finite.min())
    require(
        len(returns) > 1 and values and np.isfinite(returns).all(),
        field,
        f"must have several configurations that train; got {where} with {len(returns)}. {again}",
    )
    require(
        np.ptp(returns.mean(axis=1)) > 0,
        field,
        f"must tell configurations apart; got {where}, where all reach {returns.mean():g}. Measure "
        "one with other steps, or in a wider space.",
    )
    return Landscape(
        task=str(card["task"]),
        agent=agent,
        options=dict(card["agents"].get(agent, {})),
        steps=int(card["steps"]),
        values={name: np.asarray(x, float) for name, x in values.items()},
        returns=returns,
    )
