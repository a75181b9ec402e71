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

from sejax.files import atomic_path

# Okabe and Ito's palette, which those with any kind of colour blindness can tell apart.
REAL, VARIED, FIXED, BEST, SOLVED = "#0072B2", "#E69F00", "#009E73", "#000000", "#B03A73"
AGENT_NAMES = {"ddqn": "DDQN", "dueling_ddqn": "Dueling DDQN", "td3": "TD3",
               "td3_discrete": "discrete TD3", "ppo": "PPO", "q_learning": "Q-learning",
               "sarsa": "SARSA"}  # fmt: skip
STYLE: Any = {"font.size": 10, "axes.spines.top": False, "axes.spines.right": False,
         "legend.frameon": False}  # fmt: skip


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
            axis.plot(iterations, lines[seed], color=REAL, lw=0.7, alpha=0.5,
                      label=None if index else f"NES run ({lines.shape[1]} in all)")  # fmt: skip
        axis.fill_between(iterations, mean - std, mean + std, color=REAL, alpha=0.15, lw=0,
                          label="mean ± std of the runs")  # fmt: skip
        axis.plot(iterations, mean, color=REAL, lw=2.4)
        axis.axhline(solved_reward, color=SOLVED, ls="--", lw=1.2,
                     label=f"solved ({solved_reward:g})")  # fmt: skip
        axis.set(xlabel="NES outer iteration", xlim=(1, max(iterations[-1], 2)),
                 ylabel="mean return of the incumbent's\nagents on the real task")  # fmt: skip
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        axis.legend(fontsize=9, loc="best")


def density(values: Any, grid: Any, low: float, high: float) -> np.ndarray:
    r"""Gaussian kernel density estimate of values in [low, high], per unit of the values.

    The bandwidth is Scott's, :math:`std \\cdot n^{-1/5}`, and at least 1% of the interval, as
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


def densities(
    axis: Any, groups: dict[str, tuple[str, np.ndarray]], low: float, high: float
) -> None:
    """Draws densities of returns in [low, high] with their means; see `bars` for the groups."""
    grid = np.linspace(low, high, 400)
    peak = 0.0
    for color, returns in groups.values():
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


def bars(axis: Any, groups: dict[str, tuple[str, np.ndarray]], below: Sequence[str]) -> None:
    """Draws means as bars with their std; `groups` are label to (colour, values)."""
    for index, (color, values) in enumerate(groups.values()):
        mean, std = values.mean(), values.std()
        axis.bar(index, mean, color=color, alpha=0.85, width=0.7)
        errors = [[min(std, mean)], [std]]
        axis.errorbar(index, mean, yerr=errors, color="#7a7a7a", capsize=3, lw=1.2)
    axis.set_xticks(range(len(groups)), below, fontsize=8)
    axis.set_ylim(bottom=0)
    axis.ticklabel_format(axis="y", style="plain")
    axis.yaxis.set_major_formatter(lambda x, _: f"{x / 1000:g}k" if x >= 1000 else f"{x:g}")


def performance(
    columns: dict[str, dict[str, tuple[str, pd.DataFrame]]],
    returns: list[str],
    task: str,
    path: Path,
) -> None:
    """Draws a column for each kind of agent: densities of returns, bars of steps and episodes.

    `columns` are kind to setting to (colour, agents), `returns` the agents' columns with the return
    of one test episode.
    """
    every = [agents[returns] for mine in columns.values() for _, agents in mine.values()]
    low = min(x.min(axis=None) for x in every)
    high = max(low + 1, *(x.max(axis=None) for x in every))
    size = (1.2 + 3.6 * len(columns), 8)
    with panels(path, 3, len(columns), size, height_ratios=(1.5, 1, 1)) as (figure, axes):
        for column, (kind, settings) in enumerate(columns.items()):
            top, *lower = axes[:, column]

            def of(names: Any, mine: Any = settings) -> dict[str, tuple[str, np.ndarray]]:
                return {label: (color, agents[names].to_numpy(float).ravel())
                        for label, (color, agents) in mine.items()}  # fmt: skip

            densities(top, of(returns), low, high)
            top.set(title=AGENT_NAMES.get(kind, kind), xlabel=f"return of a test episode on {task}")
            below = [f"{values.mean():.1f}" for _, values in of(returns).values()]
            for axis, name in zip(lower, ("train_steps", "train_episodes"), strict=True):
                bars(axis, of(name), below)
                axis.set_xlabel("mean return")
        for axis, label in zip(axes[:, 0], ("density (log scale)", "training steps",
                                            "training episodes"), strict=True):  # fmt: skip
            axis.set_ylabel(label)
        longest = max(columns.values(), key=len)
        handles = [plt.Line2D([], [], color=color, lw=3) for color, _ in longest.values()]
        # Side by side the labels are as wide as two columns.
        figure.legend(handles, [f"train: {label}" for label in longest],
                      ncols=len(longest) if len(columns) > 1 else 1,
                      loc="outside upper center")  # fmt: skip


def violins(
    kinds: dict[str, pd.DataFrame], returns: list[str], task: str, solved_reward: float, path: Path
) -> None:
    """Draws a violin of the returns for each SE, the best first, in a row for each kind of agent.

    Agents have a column `se`, and columns `returns` with the return of one test episode.

    Source: paper, appendix "Evaluation of Individual SE Models".
    """
    num_ses = max(agents["se"].nunique() for agents in kinds.values())
    size = (max(5.0, 1.8 + 0.35 * num_ses), 0.6 + 2.6 * len(kinds))
    with panels(path, len(kinds), 1, size) as (figure, axes):
        for axis, (kind, agents) in zip(axes[:, 0], kinds.items(), strict=True):
            pooled = {se: mine[returns].to_numpy().ravel() for se, mine in agents.groupby("se")}
            order = sorted(pooled, key=lambda se: -pooled[se].mean())
            parts = axis.violinplot([pooled[se] for se in order], widths=0.85, showextrema=False)
            for body in parts["bodies"]:
                body.set(facecolor=REAL, edgecolor=REAL, alpha=0.45)
            means = [pooled[se].mean() for se in order]
            axis.plot(range(1, len(order) + 1), means, "D", ms=4, color=BEST, ls="none")
            axis.axhline(solved_reward, color=SOLVED, ls="--", lw=1.2)
            axis.set_xlim(0.4, len(order) + 0.6)
            axis.set_xticks(range(1, len(order) + 1), [f"{se}" for se in order], fontsize=8)
            axis.set_title(AGENT_NAMES.get(kind, kind), fontsize=10)
            axis.set_ylabel(f"test return\non {task}")
        axes[-1, 0].set_xlabel("SE, by its place in the set; diamonds: means")
        figure.legend([plt.Line2D([], [], color=SOLVED, ls="--")], [f"solved ({solved_reward:g})"],
                      loc="outside upper right", fontsize=9)  # fmt: skip


def band(axis: Any, x: Any, mean: Any, low: Any, high: Any, color: str, **line: Any) -> None:
    """Draws a line with what it may be off by."""
    axis.plot(x, mean, color=color, **line)
    axis.fill_between(x, low, high, color=color, alpha=0.2, lw=0)


def legend_above(figure: Any, axis: Any, columns: int = 4) -> None:
    """Puts the legend of one panel above all."""
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, ncols=min(len(labels), columns), loc="outside upper center",
                  fontsize=9)  # fmt: skip


@contextlib.contextmanager
def panels(
    path: Path, lines: int, columns: int, size: tuple[float, float], **options: Any
) -> Iterator[tuple[Any, Any]]:
    """A figure, its size in inches, and its axes `[lines, columns]`; written when all is drawn."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(lines, columns, figsize=size, squeeze=False,
                                    layout="constrained", **options)  # fmt: skip
        yield figure, axes
        with atomic_path(path) as temporary:
            figure.savefig(temporary, dpi=200)
            with Image.open(temporary) as picture:  # in 256 colours: a third of the bytes
                few = picture.convert("RGB").quantize(256, dither=Image.Dither.NONE)
            few.save(temporary, format="png", optimize=True)
        plt.close(figure)
