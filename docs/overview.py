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
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from experiments import null_baselines
from experiments.common.curves import on_grid

ROOT = Path(__file__).parents[1]
BLUE, GREY, ORANGE = "#2166ac", "#8c8c8c", "#d95f02"
GRID = np.arange(1000, 20_001, 1000)
SOURCES = {"by_hand": "controller by hand", "agent": "one {}", "best_of_four": "best of four {}"}
COLORS = {
    "controller by hand": "#009E73",
    "one PPO": "#56B4E9",
    "best of four PPO": "#0072B2",
    "one DDQN": "#E69F00",
    "best of four DDQN": "#B03A73",
    "the evolved SE that ships": "#000000",
}
MARKERS = {"ddqn": ("o", ""), "td3_discrete": ("^", "white")}
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
    axes.set_title("Agents on Acrobot")
    axes.legend(frameon=False, fontsize=8, loc="center right", bbox_to_anchor=(1, 0.6))
    axes.spines[["top", "right"]].set_visible(False)


def draw_costs(axes: Axes) -> None:
    """Scores on SEs of CartPole against the real steps that each SE took."""
    folders = {"cartpole-noise": SOURCES, "cartpole": {"evolved": "the evolved SE that ships"}}
    for folder, sources in folders.items():
        rows = pd.read_csv(ROOT / f"results/null_baselines/{folder}/rows.csv.xz")
        summary = null_baselines.summarise(null_baselines.NullBaselines(), rows)
        for row in summary[summary["hparams"] == "default"].itertuples():
            name = sources.get(row.source, "").format(row.teacher.upper())
            if name and row.kind in MARKERS:
                mark, fill = MARKERS[row.kind]
                spot = row.real_steps, row.test_return_mean
                axes.plot(*spot, mark, color=COLORS[name], mfc=fill or COLORS[name], ms=8)
    ses = [Line2D([], [], ls="", marker="s", color=x, label=name) for name, x in COLORS.items()]
    agents = [
        Line2D([], [], ls="", marker=mark, color="black", mfc=fill or "black", label=label)
        for label, (mark, fill) in zip(("DDQN", "discrete TD3"), MARKERS.values(), strict=True)
    ]
    axes.axhline(195, color="black", linestyle="--", linewidth=0.8)
    axes.text(4e7, 193, "solved", ha="right", va="top", fontsize=8)
    axes.set(xscale="log", xlim=(1e3, 5e7), ylim=(120, 205))
    axes.set(xlabel="real steps to make the SE", ylabel="return on the real CartPole")
    shared = {"frameon": False, "fontsize": 8, "title_fontsize": 8, "alignment": "left"}
    axes.add_artist(axes.legend(handles=agents, title="agents", loc=(0.45, 0.33), **shared))
    axes.legend(handles=ses, title="SEs", loc="lower right", **shared)
    axes.spines[["top", "right"]].set_visible(False)


figure, (loops, agents) = plt.subplots(1, 2, figsize=(9.2, 3.7), layout="constrained")
figure.get_layout_engine().set(wspace=0.08)
draw_loops(loops)
draw_agents(agents)
figure.savefig(ROOT / "docs/overview.png", dpi=130)
figure, costs = plt.subplots(figsize=(6.4, 3.4), layout="constrained")
draw_costs(costs)
figure.savefig(ROOT / "docs/costs.png", dpi=130)
