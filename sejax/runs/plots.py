"""Pictures of runs and evaluations."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from sejax.ops.files import atomic_path

INCUMBENT, POPULATION, SOLVED, STEPS = "#1f5fa8", "#d9822b", "#3c8d40", "#6b4c9a"
AGENTS = ("#b8336a", "#2a9d8f", "#8d6a2f", "#7b5ea7", "#4d7c0f", "#0e7490", "#9f1239")


def learning_curve(
    rows: Sequence[Mapping[str, Any]], solved_score: float | None, path: Path, title: str
) -> None:
    """Draws `learning_curve.png`: scores above, agents' training steps below where they vary.

    Args:
      rows: rows of `metrics.csv`, as text or numbers.
      solved_score: the task's threshold, drawn as a line; None if scores are not returns.
      path: the picture.
      title: what was learned.
    """
    data = {name: np.array([row[name] for row in rows], float) for name in rows[0]}
    x, mean, std = data["generation"], data["incumbent_mean"], data["incumbent_std"]
    with plt.rc_context({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False}):
        steps = [x for name, x in data.items() if name.startswith("train_steps_mean")]
        heights = (2, 1) if any(map(_varies, steps)) else (2,)
        figure, axes = plt.subplots(
            len(heights),
            squeeze=False,
            figsize=(7, 1 + 1.5 * sum(heights)),
            sharex=True,
            height_ratios=heights,
            layout="constrained",
        )
        top, bottom = axes[0, 0], axes[-1, 0]
        label = "incumbent: mean and std over fresh agents"
        top.plot(x, mean, color=INCUMBENT, lw=2, marker="o", ms=4, label=label)
        top.fill_between(x, mean - std, mean + std, color=INCUMBENT, alpha=0.18, lw=0)
        top.plot(x, data["population_mean"], color=POPULATION, lw=1.3, label="population mean")
        top.plot(x, data["population_max"], color=POPULATION, lw=1, ls=":", label="population max")
        agents = [name for name in data if name.startswith("incumbent_mean_")]
        for name, color in zip(agents, itertools.cycle(AGENTS)):
            agent = name.removeprefix("incumbent_mean_")
            top.plot(x, data[name], color=color, lw=1.3, ls="-.", label=f"incumbent: {agent}")
            if bottom is not top:
                bottom.plot(x, data[f"train_steps_mean_{agent}"], color=color, lw=1, ls="-.")
        if solved_score is not None:
            label = f"solved ({solved_score:g})"
            top.axhline(solved_score, color=SOLVED, ls="--", lw=1.2, label=label)
        top.set_ylabel("score" if solved_score is None else "return on the real task")
        top.set_title(title)
        top.legend(frameon=False, fontsize=9, loc="best")
        bottom.set_xlabel("generation")
        if bottom is not top:
            bottom.plot(x, data["train_steps_mean"], color=STEPS, lw=1.8)
            bottom.set_ylabel("training steps\nof an agent")
            bottom.set_ylim(0, max(1.1 * np.nanmax(steps), 1.0))
        bottom.xaxis.get_major_locator().set_params(integer=True)
        _write(figure, path)


def evaluation(
    tables: Mapping[tuple[str, str], Mapping[str, Any]],
    solved_reward: float | None,
    path: Path,
    title: str,
) -> None:
    """Draws what agents trained in each world reached and, where it varies, what it took.

    A column for each world, in it one for each agent of several, each with its colour.

    Args:
      tables: by world and agent, columns `test_return`, `train_steps` and `train_episodes`, each
        with a number for each agent.
      solved_reward: the task's threshold; None or infinite if there is none.
      path: the picture.
      title: who was trained.
    """
    worlds, keys = (list(dict.fromkeys(names)) for names in zip(*tables, strict=True))
    width = len(keys) + (0.5 if len(keys) > 1 else 0)
    places = {(world, key): width * worlds.index(world) + keys.index(key) for world, key in tables}
    panels = {"test_return": "return on the real task"}
    for column in ("train_steps", "train_episodes"):
        if _varies(np.concatenate([table[column] for table in tables.values()])):
            panels[column] = column.replace("train_", "training ")
    rng = np.random.default_rng(0)
    with plt.rc_context({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False}):
        figure, axes = plt.subplots(
            1,
            len(panels),
            squeeze=False,
            figsize=(len(panels) * (3 + 0.8 * (len(keys) - 1)), 3.4),
            layout="constrained",
        )
        figure.suptitle(title, fontsize=11)
        for axis, (column, label) in zip(axes[0], panels.items(), strict=True):
            for (world, key), table in tables.items():
                index, values = places[world, key], np.asarray(table[column], float)
                color = (INCUMBENT, POPULATION)[worlds.index(world) % 2]
                if len(keys) > 1:
                    color = AGENTS[keys.index(key) % len(AGENTS)]
                jitter = index + rng.uniform(-0.15, 0.15, len(values))
                axis.plot(jitter, values, "o", ms=3.5, color=color, alpha=0.45, mew=0)
                axis.plot(
                    [index - 0.28, index + 0.28],
                    [values.mean()] * 2,
                    color=color,
                    lw=2.5,
                    label=key if world == worlds[0] else None,
                )
                axis.annotate(
                    f"{values.mean():,.1f}" if column == "test_return" else f"{values.mean():,.0f}",
                    (index + 0.3, values.mean()),
                    fontsize=9,
                    va="center",
                )
            middles = [np.mean([places[world, key] for key in keys]) for world in worlds]
            axis.set_xticks(middles, [f"trained on\n{world}" for world in worlds])
            axis.set_xlim(-0.6, max(places.values()) + 0.9)
            axis.set_title(label, fontsize=10)
            if column != "test_return":
                axis.set_ylim(bottom=0)
        if len(keys) > 1:
            axes[0, 0].legend(frameon=False, fontsize=9)
        if solved_reward is not None:
            axes[0, 0].axhline(solved_reward, color=SOLVED, ls="--", lw=1.2)
        _write(figure, path)


def _varies(numbers: np.ndarray) -> bool:
    return np.unique(numbers).size > 1


def _write(figure: Figure, path: Path) -> None:
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=150)
    plt.close(figure)
