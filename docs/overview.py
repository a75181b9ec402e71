"""Draws the pictures of README and of What an SE teaches, of stored rows.

    python -m docs.overview

`docs/overview.png`: the two loops, and what agents learn on the SE of Acrobot and on the task. Five
seeds of each Stable-Baselines3 agent with RL Zoo's hyperparameters (`results/stock_agents/`), and
twenty of the tuned PPO of `results/break_even/`.

`docs/costs.png`: what SEs of CartPole cost and teach (`results/null_baselines/`), the table of
README.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from experiments import null_baselines
from experiments.common.curves import on_grid

ROOT = Path(__file__).parents[1]
BLUE, GREY, ORANGE = "#2166ac", "#8c8c8c", "#d95f02"
GRID = np.arange(1000, 20_001, 1000)
SOURCES = {"by_hand": "controller by hand", "agent": "one {}", "best_of_four": "best of four {}s"}
MARKERS = {  # label, mark, height, fill
    "ddqn": ("DDQN", "o", 0.12, BLUE),
    "td3_discrete": ("discrete TD3", "^", -0.12, "white"),
}
STYLES = {"a2c": "-", "ppo": "--"}
BOXES = {
    "es": (0.5, 0.87, "evolution strategy\nperturbs the weights"),
    "se": (0.83, 0.56, "SE\na small network:\nstate, action → reward"),
    "agent": (0.68, 0.14, "agent\ntrains on the SE alone"),
    "task": (0.2, 0.14, "real task\ntests the agent"),
    "score": (0.17, 0.56, "score\nthe agent's return"),
}
ARROWS = [("es", "se"), ("se", "agent"), ("agent", "task"), ("task", "score"), ("score", "es")]


def draw_loops(axes: Axes) -> None:
    """The bilevel loop: boxes and arrows between them."""
    patches = {}
    for name, (x, y, text) in BOXES.items():
        color = BLUE if name in ("se", "agent") else "#444444"
        label = axes.text(x, y, text, ha="center", va="center", fontsize=9, color=color)
        label.set_bbox({"boxstyle": "round,pad=0.55", "facecolor": "white", "edgecolor": color})
        label.draw(axes.figure.canvas.get_renderer())
        patches[name] = label.get_bbox_patch()
    for start, end in ARROWS:
        style = {"arrowstyle": "-|>", "mutation_scale": 14, "color": "#444444", "shrinkA": 3}
        box: FancyBboxPatch = patches[start]
        arrow = FancyArrowPatch(
            BOXES[start][:2], BOXES[end][:2], patchA=box, patchB=patches[end], shrinkB=3, **style
        )
        axes.add_patch(arrow)
    note = "a generation:\nhundreds of agents,\none compiled program"
    axes.text(0.49, 0.42, note, ha="center", va="center", style="italic", color=GREY)
    axes.set(xlim=(0, 1), ylim=(0, 1), title="How an SE is learned")
    axes.axis("off")


def draw_agents(axes: Axes) -> None:
    """Returns on Acrobot by training steps, trained on the SE and on the task."""
    rows = pd.read_csv(ROOT / "results/stock_agents/rows.csv").query("task == 'acrobot'")
    # 5,000 steps are between 2,500 and 6,000 of the other trainings.
    on_se = rows.query("world != 'the real task' and steps != 5000")
    on_task = rows.query("world == 'the real task' and total_steps > 20_000 and steps <= 20_000")
    for rows, color, world in ((on_se, BLUE, "the SE"), (on_task, GREY, "the task")):
        for agent, line in STYLES.items():
            means = rows[rows["agent"] == agent].groupby("steps")["mean_return"].mean()
            label = f"{agent.upper()} on {world}"
            axes.plot(means.index, means, line, color=color, linewidth=1.8, label=label)
    rows = pd.read_csv(ROOT / "results/break_even/rows.csv.xz")
    tuned = on_grid(rows[(rows["table"] == "curves") & (rows["proxy"] == "acrobot")], GRID)
    axes.plot(GRID, tuned.mean(axis=0), color=ORANGE, linewidth=1.8, label="tuned PPO on the task")
    axes.axhline(-100, color="black", linewidth=0.6)
    axes.text(20_500, -104, "solved", ha="left", va="center", fontsize=8)
    axes.set(
        xlabel="training steps (blue: on the SE)",
        ylabel="return on the real Acrobot",
        xlim=(0, 20_500),
    )
    axes.set_xticks(range(0, 20_001, 5000))
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.set_title("Agents trained on the SE, or on Acrobot")
    axes.legend(frameon=False, fontsize=8, loc="center right", bbox_to_anchor=(1, 0.6))
    axes.spines[["top", "right"]].set_visible(False)


def draw_costs(costs: Axes, scores: Axes) -> None:
    """What SEs of CartPole cost, the cheapest on top, and what agents learn on them."""
    folders = {"cartpole-noise": SOURCES, "cartpole": {"evolved": "evolved (ships)"}}
    returns: dict[tuple[float, str], dict[str, float]] = {}  # by the SE's real steps and name
    for folder, sources in folders.items():
        rows = pd.read_csv(ROOT / f"results/null_baselines/{folder}/rows.csv.xz")
        summary = null_baselines.summarise(null_baselines.NullBaselines(), rows)
        for row in summary[summary["hparams"] == "default"].itertuples():
            if row.source in sources and row.kind in MARKERS:
                name = sources[row.source].format(row.teacher.upper())
                returns.setdefault((row.real_steps, name), {})[row.kind] = row.test_return_mean
    ses = sorted(returns, reverse=True)
    steps, names = zip(*ses, strict=True)
    bars = costs.barh(names, steps, height=0.5, color=GREY)
    costs.bar_label(bars, labels=[f"{x:,.0f}" for x in steps], padding=4, fontsize=9)
    costs.set(xscale="log", xlim=(1e3, 1e9), xlabel="real steps to make it")
    costs.set_xticks([1e3, 1e5, 1e7])
    costs.set_title("An SE of CartPole")
    for kind, (label, mark, shift, fill) in MARKERS.items():
        heights = [i + shift for i, se in enumerate(ses) if kind in returns[se]]
        means = [returns[se][kind] for se in ses if kind in returns[se]]
        scores.plot(means, heights, mark, color=BLUE, mfc=fill, ms=7, label=label, clip_on=False)
    scores.axvline(195, color="black", linestyle="--", linewidth=0.8)
    scores.text(193, len(ses) - 0.6, "solved", ha="right", va="center", fontsize=9)
    scores.set(xlim=(0, 200), ylim=(-0.5, len(ses) - 0.4), xlabel="return on the real CartPole")
    scores.set_title("Agents that trained on it")
    scores.legend(frameon=False, loc="center left")
    for axes in (costs, scores):
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(axis="y", length=0)


figure, (loops, agents) = plt.subplots(1, 2, figsize=(9.2, 3.7), layout="constrained")
figure.get_layout_engine().set(wspace=0.08)
draw_loops(loops)
draw_agents(agents)
figure.savefig(ROOT / "docs/overview.png", dpi=130)
figure, (costs, scores) = plt.subplots(1, 2, sharey=True, figsize=(8.2, 3), layout="constrained")
draw_costs(costs, scores)
figure.savefig(ROOT / "docs/costs.png", dpi=130)
