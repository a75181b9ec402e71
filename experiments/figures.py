"""Pictures that the experiments share."""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.ticker import MaxNLocator
from PIL import Image

from experiments.statistics import performance_profile
from sejax.ops.files import atomic_path

# Okabe and Ito's palette, which those with any kind of colour blindness can tell apart.
REAL, VARIED, FIXED, BEST, SOLVED = "#0072B2", "#E69F00", "#009E73", "#000000", "#B03A73"
TUNED = "#56B4E9"
AGENT_NAMES = {
    "ddqn": "DDQN",
    "dueling_ddqn": "Dueling DDQN",
    "td3": "TD3",
    "td3_discrete": "discrete TD3",
    "ppo": "PPO",
    "sac": "SAC",
    "dqn": "DQN",
    "q_learning": "Q-learning",
    "sarsa": "SARSA",
}
LEGEND_COLUMN = 1.4  # inches that a label with its line takes
STYLE: Any = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
}


def learning_curves(curves: pd.DataFrame, solved_reward: float, path: Path) -> None:
    """Draws each run's incumbent mean as a thin line, and their mean with one std.

    The curves have the columns of `metrics.csv`; the task's threshold is a line.

    Source: paper, figure "Multiple NES runs of Alg. 1".
    """
    lines = curves.pivot(index="generation", columns="seed", values="incumbent_mean")
    lines = lines.ffill()  # a run that stopped when it solved the task stays where it was
    iterations = lines.index.to_numpy() + 1
    mean, std = lines.mean(axis=1), lines.std(axis=1, ddof=0)
    with panels(path, 1, 1, (6, 3.6)) as (_, axes):
        axis = axes[0, 0]
        for index, seed in enumerate(lines.columns):
            axis.plot(
                iterations,
                lines[seed],
                color=REAL,
                lw=0.7,
                alpha=0.5,
                label=None if index else f"NES run ({lines.shape[1]} in all)",
            )
        axis.fill_between(
            iterations,
            mean - std,
            mean + std,
            color=REAL,
            alpha=0.15,
            lw=0,
            label="mean ± std of the runs",
        )
        axis.plot(iterations, mean, color=REAL, lw=2.4)
        axis.axhline(
            solved_reward, color=SOLVED, ls="--", lw=1.2, label=f"solved ({solved_reward:g})"
        )
        axis.set(
            xlabel="NES outer iteration",
            xlim=(1, max(iterations[-1], 2)),
            ylabel="mean return of the incumbent's\nagents on the real task",
        )
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        axis.legend(fontsize=9, loc="best")


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


def histogram(axis: Any, values: Any, alpha: float, lw: float, label: str = "", **how: Any) -> None:
    """Draws how often values are met, on a logarithmic scale."""
    axis.hist(values, histtype="stepfilled", alpha=alpha, **how)
    axis.hist(values, histtype="step", lw=lw, label=label, **how)
    axis.set_yscale("log")


def bars(axis: Any, groups: list[tuple[str, np.ndarray]], below: Sequence[str]) -> None:
    """Draws means as bars with their std, and a text below each; groups are (colour, values)."""
    for index, (color, values) in enumerate(groups):
        mean, std = values.mean(), values.std()
        axis.bar(index, mean, color=color, alpha=0.85, width=0.7)
        errors = [[min(std, mean)], [std]]
        axis.errorbar(index, mean, yerr=errors, color="#7a7a7a", capsize=3, lw=1.2)
    axis.set_xticks(range(len(groups)), below, fontsize=8)
    axis.set_ylim(bottom=0)
    axis.ticklabel_format(axis="y", style="plain")
    axis.yaxis.set_major_formatter(lambda x, _: f"{x / 1000:g}k" if x >= 1000 else f"{x:g}")


def band(axis: Any, grid: Any, values: Any, ends: Any, color: str, **line: Any) -> None:
    """Draws the mean of `values [agent, points]` where all are known, with its `ends(values)`."""
    known = ~np.isnan(values).any(axis=0)
    axis.plot(grid[known], values[:, known].mean(axis=0), color=color, **line)
    axis.fill_between(grid[known], *ends(values[:, known]), color=color, alpha=0.2, lw=0)


def profile(
    axis: Any, strata: Sequence[Any], low: float, high: float, color: str, label: str
) -> None:
    """Draws the share of runs with more than each score in [low, high], and its 95% interval."""
    grid = np.linspace(low, high, 200)
    shares, *ends = performance_profile(*strata, thresholds=grid)
    axis.plot(grid, shares, color=color, lw=1.8, label=label)
    axis.fill_between(grid, *ends, color=color, alpha=0.2, lw=0)
    axis.set(xlim=(low, high), ylim=(0, 1.02))


def legend_above(figure: Any, axis: Any, columns: int = 4, fontsize: int | None = 9) -> None:
    """Puts the legend of one panel above all, in so many columns, if the figure is wide enough."""
    handles, labels = axis.get_legend_handles_labels()
    room = max(1, int(figure.get_figwidth() / LEGEND_COLUMN))
    figure.legend(
        handles,
        labels,
        ncols=min(len(labels), columns, room),
        loc="outside upper center",
        fontsize=fontsize,
    )


@contextlib.contextmanager
def panels(
    path: Path, lines: int, columns: int, size: tuple[float, float], **options: Any
) -> Iterator[tuple[Any, Any]]:
    """A figure, its size in inches, and its axes `[lines, columns]`; written when all is drawn."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(
            lines, columns, figsize=size, squeeze=False, layout="constrained", **options
        )
        yield figure, axes
        with atomic_path(path) as temporary:
            figure.savefig(temporary, dpi=200)
            with Image.open(temporary) as picture:  # in 256 colours: a third of the bytes
                few = picture.convert("RGB").quantize(256, dither=Image.Dither.NONE)
            few.save(temporary, format="png", optimize=True)
        plt.close(figure)
