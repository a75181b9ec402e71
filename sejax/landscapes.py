"""Landscapes: configurations of an agent, and what they reach on a real task.

A landscape is one CSV file. Its first lines, which begin with `#`, are its card, in YAML: the task,
how long agents trained and were tested, the space that configurations were drawn from, and each
agent's options. Then there is a row for each training: `agent`, `config`, `seed`, what the
configuration sets (`agent.learning_rate`, ...), the mean `return` of the tests, and `nonfinite`, 1
if the training diverged. `python -m sejax.landscape` measures them.
"""

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

    def take(self, places: np.ndarray | slice) -> "Landscape":
        """The landscape of some configurations."""
        return Landscape(
            task=self.task,
            agent=self.agent,
            options=self.options,
            steps=self.steps,
            values={name: x[places] for name, x in self.values.items()},
            returns=self.returns[places],
        )


def read(path: Path | str, field: str = FIELD) -> dict[str, Landscape]:
    """The landscapes of a file by their agents.

    Raises:
      ConfigError: about `field`, for a file that cannot be read or holds no landscape; and for
        returns that are missing or no numbers, fewer than two configurations, or configurations
        that reach the same.
    """
    card, table = read_table(path, field)
    return {
        str(agent): _landscape(card, str(agent), rows, f"{field}", Path(path))
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


def _landscape(
    card: Mapping[str, Any], agent: str, rows: pd.DataFrame, field: str, path: Path
) -> Landscape:
    where = f"{shortened(path, 60)} with {shortened(agent, 20)}"
    again = "Run the command that measured it again."
    grid = rows.pivot_table(index="config", columns="seed", values="return", aggfunc="first")
    diverged = rows.pivot_table(index="config", columns="seed", values="nonfinite", aggfunc="first")
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
