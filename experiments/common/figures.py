"""Parts of figures that the experiments share."""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from PIL import Image

from sejax.ops.files import atomic_path

# Okabe and Ito's palette, which those with any kind of colour blindness can tell apart.
REAL, VARIED, FIXED, BEST, SOLVED = "#0072B2", "#E69F00", "#009E73", "#000000", "#B03A73"
TUNED = "#56B4E9"
AGENT_NAMES = {"dueling_ddqn": "Dueling DDQN", "td3_discrete": "discrete TD3"}
AGENT_NAMES |= {"q_learning": "Q-learning"}  # of the others the letters are capital
DPI = 120
STYLE: Any = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
}


def agent_name(kind: str) -> str:
    """A kind of agents as people write it."""
    return AGENT_NAMES.get(kind, kind.upper())


def density(values: Any, grid: Any, low: float, high: float) -> np.ndarray:
    r"""Gaussian kernel density estimate of values in [low, high], per unit of the values.

    The bandwidth is Scott's, :math:`std \cdot n^{-1/5}`, and at least 1% of the interval, as
    returns may all be equal. Mass that a kernel would put outside the interval is reflected.
    """
    values, grid = np.asarray(values, float), np.asarray(grid, float)
    bandwidth = max(values.std() * values.size ** (-1 / 5), 0.01 * (high - low), 1e-9)
    centres, counts = np.unique(values, return_counts=True)  # returns are often the same few
    total = np.zeros_like(grid)
    for reflected in (centres, 2 * low - centres, 2 * high - centres):
        distances = (grid[:, None] - reflected) / bandwidth
        total += np.exp(-0.5 * distances**2) @ counts
    inside = (grid >= low) & (grid <= high)
    return np.where(inside, total / (values.size * bandwidth * np.sqrt(2 * np.pi)), 0.0)


def densities(axis: Any, groups: list[tuple[str, np.ndarray]], low: float, high: float) -> None:
    """Draws densities of returns in [low, high] with their means; groups are (colour, values)."""
    grid = np.linspace(low, high, 400)
    peak = 0.0
    for color, returns in groups:
        line = density(returns, grid, low, high)
        peak = max(peak, line.max())
        axis.plot(grid, line, color=color, lw=1.8)
        axis.fill_between(grid, line, color=color, alpha=0.12, lw=0)
        axis.axvline(returns.mean(), color=color, ls="--", lw=1.1)
    axis.set(yscale="log", ylim=(1e-4 * peak, 2 * peak), xlim=(low, high))


def bars(axis: Any, groups: list[tuple[str, np.ndarray]], below: Sequence[str]) -> None:
    """Draws means as bars with their std, and a text below each; groups are (colour, values)."""
    for index, (color, values) in enumerate(groups):
        mean, std = values.mean(), values.std()
        errors = {"yerr": [[min(std, mean)], [std]], "ecolor": "#7a7a7a", "capsize": 3}
        axis.bar(index, mean, color=color, alpha=0.85, width=0.7, **errors)
    axis.set_xticks(range(len(groups)), below, fontsize=8)
    axis.set_ylim(bottom=0)
    axis.yaxis.set_major_formatter(lambda x, _: f"{x / 1000:g}k" if x >= 1000 else f"{x:g}")


def band(axis: Any, grid: Any, values: Any, ends: Any, color: str, **line: Any) -> None:
    """Draws the mean of `values [agent, points]` where all are known, with its `ends(values)`."""
    known = ~np.isnan(values).any(axis=0)
    axis.plot(grid[known], values[:, known].mean(axis=0), color=color, **line)
    axis.fill_between(grid[known], *ends(values[:, known]), color=color, alpha=0.2, lw=0)


def threshold(axis: Any, solved_reward: float, label: str | None = None) -> None:
    """Draws the return at which the task is solved, a dashed line; none where it is not known."""
    if np.isfinite(solved_reward):
        axis.axhline(solved_reward, color=SOLVED, ls="--", lw=1.2, label=label)


def legend_above(figure: Any, axis: Any) -> None:
    """Puts the legend of one panel above all, in four columns, if the figure is wide enough."""
    handles, labels = axis.get_legend_handles_labels()
    columns = min(len(labels), 4, max(1, int(figure.get_figwidth() / 1.4)))  # inches of a label
    figure.legend(handles, labels, ncols=columns, loc="outside upper center", fontsize=9)


def runs(axis: Any, curves: pd.DataFrame, solved_reward: float) -> None:
    """Draws NES runs' incumbent means as thin lines, and their mean as a thick one with its std."""
    lines = curves.pivot(index="generation", columns="seed", values="incumbent_mean")
    lines = lines.ffill()  # a run that stopped when it solved the task stays where it was
    every, *others = axis.plot(lines.index + 1, lines, color=REAL, lw=0.7, alpha=0.6)
    every.set_label(f"NES run ({len(others) + 1} in all)")
    mean, std = lines.mean(axis=1), lines.std(axis=1, ddof=0)
    axis.plot(lines.index + 1, mean, color=REAL, lw=2.4, label="mean ± std of the runs")
    axis.fill_between(lines.index + 1, mean - std, mean + std, color=REAL, alpha=0.15, lw=0)
    threshold(axis, solved_reward, f"solved ({solved_reward:g})")
    axis.set(xlabel="generation", xlim=(1, max(lines.index[-1] + 1, 2)))


@contextlib.contextmanager
def panels(
    path: Path, lines: int, columns: int, size: tuple[float, float], **options: Any
) -> Iterator[tuple[Any, Any]]:
    """A figure, its size in inches, and its axes `[lines, columns]`; written when all is drawn."""
    options |= {"figsize": size, "squeeze": False, "layout": "constrained"}
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(lines, columns, **options)
        yield figure, axes
        save(figure, path)
        plt.close(figure)


def save(figure: Any, path: Path) -> None:
    """Writes a figure as PNG in 256 colours: a third of the bytes."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=DPI)
        with Image.open(temporary) as picture:
            few = picture.convert("RGB").quantize(256, dither=Image.Dither.NONE)
        few.save(temporary, format="png", optimize=True)
