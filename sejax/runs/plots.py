"""The pictures of a run and of a check."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from sejax.ops.files import atomic_path

INCUMBENT, POPULATION, SOLVED = "#1f5fa8", "#d9822b", "#3c8d40"
STYLE: dict[Any, Any] = {"font.size": 10, "axes.spines.top": False, "axes.spines.right": False}


def learning_curve(
    rows: Sequence[Mapping[str, Any]], solved_score: float | None, path: Path, title: str
) -> None:
    """Draws `learning_curve.png`.

    Args:
      rows: rows of `metrics.csv`, as text or numbers.
      solved_score: the task's threshold, drawn as a line; None if scores are not returns.
      path: the picture.
      title: what was learned.
    """
    data = {name: np.array([row[name] for row in rows], float) for name in rows[0]}
    x, mean, std = data["generation"], data["incumbent_mean"], data["incumbent_std"]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7, 4))
        axis = figure.subplots()
        label = "search mean: mean and std over fresh agents"
        axis.plot(x, mean, color=INCUMBENT, lw=2, marker="o", ms=4, label=label)
        axis.fill_between(x, mean - std, mean + std, color=INCUMBENT, alpha=0.18, lw=0)
        axis.plot(x, data["population_mean"], color=POPULATION, lw=1.3, label="population mean")
        axis.plot(x, data["population_max"], color=POPULATION, lw=1, ls=":", label="population max")
        for i, column in enumerate(name for name in data if name.startswith("incumbent_mean_")):
            label = f"search mean: {column.removeprefix('incumbent_mean_')}"
            axis.plot(x, data[column], color=f"C{i}", lw=1.3, ls="-.", label=label)
        if solved_score is not None:
            label = f"solved ({solved_score:g})"
            axis.axhline(solved_score, color=SOLVED, ls="--", lw=1.2, label=label)
        unit = "score" if solved_score is None else "return on the real task"
        axis.set(xlabel="generation", ylabel=unit, title=title)
        axis.legend(frameon=False, fontsize=9, loc="best")
        axis.locator_params(axis="x", integer=True)
        _write(figure, path)


def check(table: Any, solved_reward: float, path: Path, title: str) -> None:
    """Draws the agents' returns in each row of a check: a point for each agent, a bar for the mean.

    Args:
      table: a data frame with the columns `world`, `agent` and `test_return`.
      solved_reward: the task's threshold.
      path: the picture.
      title: what was checked, and the verdict.
    """
    rng = np.random.default_rng(0)
    rows = list(table["world"].unique())
    agents = list(table["agent"].unique())
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8, 1.5 + 0.8 * len(rows)))
        axis = figure.subplots()
        for y, row in enumerate(rows):
            parts = list(table[table["world"] == row].groupby("agent", sort=False)["test_return"])
            for i, (name, returns) in enumerate(parts):
                level = y + (i + 0.5) / len(parts) * 0.8 - 0.4
                spread = level + rng.uniform(-0.25, 0.25, len(returns)) / len(parts)
                color = f"C{agents.index(name)}"
                axis.plot(returns, spread, "o", ms=3, color=color, alpha=0.5, mew=0)
                axis.plot(returns.mean(), level, "|", ms=26 / len(parts), mew=2.5, color=color)
                axis.annotate(name, (1.01, level), xycoords=("axes fraction", "data"), fontsize=7)
        axis.axvline(solved_reward, color=SOLVED, ls="--", lw=1.2)
        axis.set_yticks(range(len(rows)), [f"trained on {row}" for row in rows])
        axis.invert_yaxis()
        axis.set(xlabel="return on the real task", title=title)
        _write(figure, path)


def _write(figure: Figure, path: Path) -> None:
    figure.set_layout_engine("constrained")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=150)
