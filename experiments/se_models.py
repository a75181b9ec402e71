"""How well each single SE of a set trains agents: violins of the test returns, the best SE first.

Source: paper, appendix "Evaluation of Individual SE Models" for CartPole and for Acrobot: 40 SEs,
1000 agents with drawn hyperparameters on each, 10 test episodes. It shows violins, no numbers.

Agents are trained as in se_performance; with its `out` folder, those that it trained on the same
SEs are used again.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import sejax
from experiments.common import agents as groups
from experiments.common import figures, tables
from experiments.common.agents import SeAgents, return_columns
from experiments.common.experiment import Experiment, setting
from experiments.common.statistics import worst_tenth
from sejax import ProxySet, Task
from sejax.options import ConfigError


@dataclass(frozen=True, kw_only=True)
class SeModels(SeAgents):
    name = "se_models"
    files = "models_"

    ses: str | None = setting(None, quick="cartpole")  # file of SEs, or a shipped name


def compute(settings: SeModels) -> pd.DataFrame:
    """Trains what is missing; a row for each agent."""
    ses = load(settings)
    parts = []
    for kind in settings.agents:
        condition = groups.on_ses(settings, ses, kind)
        places = {group.name: place for place, group in enumerate(condition.groups)}
        rows = groups.train_kind(settings, condition)
        parts.append(rows.assign(se=rows["group"].map(places)))
    return pd.concat(parts, ignore_index=True)


def load(settings: SeModels) -> ProxySet:
    """The SEs that are tested."""
    if settings.ses is None:
        raise ConfigError(
            "ses must be given; got none. Set ses=results/se_feasibility/cartpole/ses.safetensors.",
            "ses",
        )
    return sejax.load_set(settings.ses, option="ses", kind="se")[: settings.num_ses]


def summarise(agents: pd.DataFrame, solved_reward: float) -> pd.DataFrame:
    """One row for each kind of agent and SE, the best SE of each kind first."""
    grouped = agents.groupby(["kind", "se"], sort=False)
    summary = grouped["test_return"].agg(
        return_mean="mean",
        return_std=lambda x: x.std(ddof=0),
        return_worst_tenth=worst_tenth,
        solved=lambda x: (x >= solved_reward).mean(),
    )
    summary["train_steps"] = grouped["train_steps"].mean()
    kinds = list(dict.fromkeys(agents["kind"]))
    rank = summary.reset_index().assign(order=lambda t: t["kind"].map(kinds.index))
    rank = rank.sort_values(["order", "return_mean"], ascending=[True, False], kind="stable")
    return rank.drop(columns="order").reset_index(drop=True)


def rank_correlations(summary: pd.DataFrame) -> pd.DataFrame:
    """Spearman's correlation of the SEs' mean returns between each two kinds of agents.

    It says whether an SE that suits one kind of agent suits another; nan where all SEs are equal.
    """
    means = summary.pivot(index="se", columns="kind", values="return_mean")
    return means[list(dict.fromkeys(summary["kind"]))].rank().corr()


def report(settings: SeModels, rows: pd.DataFrame) -> pd.DataFrame:
    ses = load(settings)
    task = ses.task
    columns: dict[str, Any] = {
        "agent": "{kind}",
        "SE": lambda row: row.se,
        "run's seed": lambda row: ses.seeds[row.se],
        "score when learned": lambda row: f"{ses.scores[row.se]:.1f}",
        "return": "{return_mean:.1f} ± {return_std:.1f}",
        "worst tenth": "{return_worst_tenth:.1f}",
        "agents that solve the task": "{solved:.0%}",
        "training steps": "{train_steps:,.0f}",
    }
    summary = summarise(rows, task.solved_reward)
    draw(task, rows, settings.folder / "models.png")
    note = (
        f"Return: mean ± std over {rows['agent'].nunique()} agents with drawn hyperparameters and "
        f"{len(return_columns(rows))} test episodes each."
        f"{correlations_text(summary)}{tables.WORST_NOTE}"
    )
    title = f"Single SEs of {task.name} (solved at {task.solved_reward:g})"
    return tables.publish(settings, title, tables.as_texts(summary, columns), summary, note)


def correlations_text(summary: pd.DataFrame) -> str:
    """A sentence on the rank correlations; nothing for fewer than three SEs or two kinds."""
    if summary["se"].nunique() < 3:
        return ""
    matrix = rank_correlations(summary)
    kinds = list(matrix)
    texts = [
        f"{a} and {b} {matrix.loc[a, b]:.2f}"
        for i, a in enumerate(kinds)
        for b in kinds[i + 1 :]
        if np.isfinite(matrix.loc[a, b])
    ]
    return f" Rank correlation of the SEs' mean returns: {', '.join(texts)}." if texts else ""


def draw(task: Task, agents: pd.DataFrame, path: Path) -> None:
    """Draws a violin of the returns for each SE, the best first, in a row for each kind of agent.

    Source: paper, appendix "Evaluation of Individual SE Models".
    """
    kinds = list(agents.groupby("kind", sort=False))
    num_ses = max(mine["se"].nunique() for _, mine in kinds)
    size = (max(5.0, 1.8 + 0.35 * num_ses), 0.6 + 2.6 * len(kinds))
    with figures.panels(path, len(kinds), 1, size) as (figure, axes):
        for axis, (kind, of_kind) in zip(axes[:, 0], kinds, strict=True):
            pooled = {
                se: mine[return_columns(mine)].to_numpy().ravel()
                for se, mine in of_kind.groupby("se")
            }
            order = sorted(pooled, key=lambda se: -pooled[se].mean())
            parts = axis.violinplot([pooled[se] for se in order], widths=0.85, showextrema=False)
            for body in parts["bodies"]:
                body.set(facecolor=figures.REAL, edgecolor=figures.REAL, alpha=0.45)
            places, means = range(1, len(order) + 1), [pooled[se].mean() for se in order]
            axis.plot(places, means, "D", ms=4, color=figures.BEST, ls="none")
            figures.threshold(axis, task.solved_reward)
            axis.set_xticks(places, order, fontsize=8)
            axis.set_title(figures.AGENT_NAMES.get(kind, kind), fontsize=10)
            axis.set(xlim=(0.4, len(order) + 0.6), ylabel=f"test return\non {task.name}")
        axes[-1, 0].set_xlabel("SE, by its place in the set; diamonds: means")
        line = plt.Line2D([], [], color=figures.SOLVED, ls="--")
        label = f"solved ({task.solved_reward:g})"
        figure.legend([line], [label], loc="outside upper right", fontsize=9)


EXPERIMENT = Experiment(settings=SeModels, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
