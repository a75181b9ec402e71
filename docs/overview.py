"""Draws `docs/overview.png`, README's picture: the two loops, and what stock agents learn on an SE.

    python docs/overview.py

The right panel has the rows of `results/stock_agents/`: five seeds of each Stable-Baselines3 agent
with RL Zoo's hyperparameters, tested on Gymnasium's Acrobot.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

ROOT = Path(__file__).parents[1]
BLUE, GREY = "#2166ac", "#8c8c8c"
STYLES = {"a2c": "-", "ppo": "--", "dqn": ":"}
BOXES = {
    "es": (0.5, 0.87, "evolution strategy\nperturbs the weights"),
    "se": (0.83, 0.56, "SE\na small network:\nstate, action → reward"),
    "agent": (0.68, 0.14, "agent\ntrains on the SE alone"),
    "task": (0.2, 0.14, "real task\ntests the agent"),
    "score": (0.15, 0.56, "score\nthe agent's return"),
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
    for rows, color, place in ((on_se, BLUE, "the SE"), (on_task, GREY, "the task")):
        for agent, line in STYLES.items():
            means = rows[rows["agent"] == agent].groupby("steps")["mean_return"].mean()
            label = f"{agent.upper()} on {place}"
            axes.plot(means.index, means, line, color=color, linewidth=1.8, label=label)
    axes.axhline(-100, color="black", linewidth=0.6)
    axes.text(20_000, -107, "solved", ha="right", va="top", fontsize=8)
    axes.set(xlabel="training steps", ylabel="return on the real Acrobot", xlim=(0, 20_500))
    axes.set_xticks(range(0, 20_001, 5000))
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.set_title("Stable-Baselines3's agents on Acrobot")
    axes.legend(frameon=False, fontsize=8, loc="center right", bbox_to_anchor=(1, 0.62))
    axes.spines[["top", "right"]].set_visible(False)


figure, (loops, agents) = plt.subplots(1, 2, figsize=(9.2, 3.7), layout="constrained")
figure.get_layout_engine().set(wspace=0.08)
draw_loops(loops)
draw_agents(agents)
figure.savefig(ROOT / "docs/overview.png", dpi=130)
