"""How well each single SE of a set trains agents: violins of the test returns, the best SE first.

Source: paper, appendix "Evaluation of Individual SE Models" for CartPole and for Acrobot: 40 SEs,
1000 agents with drawn hyperparameters on each, 10 test episodes.

Agents are trained as in se_performance; with its `out` folder, those that it trained on the same
SEs are used again.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

import sejax
from sejax.errors import ConfigError
from sejax.experiments import figures, se_agents
from sejax.experiments.experiment import Experiment
from sejax.experiments.se_agents import SeAgents
from sejax.experiments.settings import setting
from sejax.experiments.tables import as_texts, publish
from sejax.experiments.worlds import return_columns


@dataclass(frozen=True, kw_only=True)
class SeModels(SeAgents):
    name = "se_models"
    files = "models_"

    ses: str | None = setting(
        None, quick="cartpole", about="file of SEs, from se_feasibility, or a shipped name"
    )


def compute(settings: SeModels) -> pd.DataFrame:
    """Trains what is missing; a row for each agent."""
    ses = load(settings)
    tables = []
    for kind in settings.agents:
        world = se_agents.se_world(settings, ses, kind)
        places = {group.name: place for place, group in enumerate(world.groups)}
        rows = se_agents.train(settings, world)
        tables.append(rows.assign(se=rows["group"].map(places)))
    return pd.concat(tables, ignore_index=True)


def load(settings: SeModels) -> Any:
    """The SEs that are tested."""
    if settings.ses is None:
        raise ConfigError("ses must be given, because agents are trained on its SEs; got none. "
                          "Set ses=results/se_feasibility/cartpole/ses.safetensors.")  # fmt: skip
    return sejax.load_set(settings.ses, option="ses", kind="se").first(settings.num_ses)


def summarise(agents: pd.DataFrame, solved_reward: float) -> pd.DataFrame:
    """One row for each kind of agent and SE, the best SE of each kind first."""
    grouped = agents.groupby(["kind", "se"], sort=False)
    summary = grouped["test_return"].agg(
        return_mean="mean",
        return_std=lambda x: x.std(ddof=0),
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
        "agents that solve the task": "{solved:.0%}",
        "training steps": "{train_steps:,.0f}",
    }
    summary = summarise(rows, task.solved_reward)
    kinds = {str(kind): mine for kind, mine in rows.groupby("kind", sort=False)}
    figures.violins(kinds, return_columns(rows), task.name, task.solved_reward,
                    settings.folder / "models.png")  # fmt: skip
    note = (
        f"Return: mean ± std over {rows['agent'].nunique()} agents with drawn hyperparameters and "
        f"{len(return_columns(rows))} test episodes each. The paper has 1000 agents on each of 40 "
        f"SEs and shows violins only, no numbers.{correlations_text(summary)}"
    )
    title = f"Single SEs of {task.name} (solved at {task.solved_reward:g})"
    return publish(settings, title, as_texts(summary, columns), summary, note)


def correlations_text(summary: pd.DataFrame) -> str:
    """A sentence on the rank correlations; nothing for fewer than three SEs or two kinds."""
    if summary["se"].nunique() < 3:
        return ""
    matrix = rank_correlations(summary)
    kinds = list(matrix)
    texts = [f"{a} and {b} {matrix.loc[a, b]:.2f}" for i, a in enumerate(kinds)
             for b in kinds[i + 1 :] if np.isfinite(matrix.loc[a, b])]  # fmt: skip
    return f" Rank correlation of the SEs' mean returns: {', '.join(texts)}." if texts else ""


EXPERIMENT = Experiment(settings=SeModels, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
