"""Which agents SEs teach, by the families of agents that they were learned with.

For each set of families some SEs are learned, and each of these trains fresh agents of all the
families in `tested`: a table of what they were learned with and tested with. Families that took no
part are marked; where a set lacks one of the families of the largest set, the two say what leaving
it out costs.

Source: the question is that of the paper's section "Transferability of SEs"; several families in
one search, as in Liesen et al., "Discovering Minimal Reinforcement Learning Environments" (2024).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from experiments import family_runs, figures
from experiments.experiment import Experiment
from experiments.family_runs import FamilyRuns, families_in, known_families
from experiments.pieces import stack, unstack
from experiments.settings import setting
from experiments.tables import brackets, iqm_note, iqm_text, publish
from sejax import envs
from sejax.errors import require

SETS = (
    "ddqn",
    "ppo",
    "td3_discrete",
    "ddqn+ppo",
    "ddqn+td3_discrete",
    "ppo+td3_discrete",
    "ddqn+ppo+td3_discrete",
)
LEFT_OUT = "°"  # after what families reach that took no part
IQM_AND_SOLVED = f"IQM {iqm_text('test_return')}; {{solved:.0%}}"


@dataclass(frozen=True, kw_only=True)
class SeFamilies(FamilyRuns):
    name = "se_families"

    sets: tuple[str, ...] = setting(
        SETS,
        quick=("ddqn", "ddqn+ppo"),
        about="families of agents that SEs are learned with, joined by +",
    )
    tested: tuple[str, ...] = setting(
        ("ddqn", "dueling_ddqn", "ppo", "td3_discrete", "sac"),
        quick=("ddqn", "dueling_ddqn"),
        about="families that they are tested with",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("sets", "tested"):
            require(
                getattr(self, name),
                name,
                "name a family",
                "agents learn or are tested",
                "none",
                f"{name}=[ddqn]",
            )


def compute(settings: SeFamilies) -> pd.DataFrame:
    """Learns and trains what is missing; rows of the runs' generations and of the tested agents."""
    every = [*known_families(settings.sets), *settings.tested]
    learners = {name: settings.config_with(families_in(name), every) for name in settings.sets}
    testers = [settings.config_with([kind], every) for kind in settings.tested]
    curves, agents = [], []
    for name, config in learners.items():
        curve, ses = family_runs.learn(settings, name, config)
        curves.append(curve.assign(learned_with=name))
        agents += [
            family_runs.evaluate(settings, name, ses, tester).assign(learned_with=name)
            for tester in testers
        ]
    return stack({"curves": pd.concat(curves), "agents": pd.concat(agents)})


def summarise(curves: pd.DataFrame, agents: pd.DataFrame, solved_reward: float) -> pd.DataFrame:
    """A row for each set, kind of hyperparameters and tested family, with what the set cost."""
    summary = family_runs.summarise(agents, ["learned_with", "hparams", "kind"], solved_reward)
    took_part = [row.kind in families_in(row.learned_with) for row in summary.itertuples()]
    runs = curves.groupby(["learned_with", "seed"])
    each = pd.DataFrame(
        {
            "cpu_s": runs["cpu_s"].sum(),
            "env_steps": runs["env_steps_total"].last(),
            "solved_runs": runs["incumbent_mean"].max() >= solved_reward,
        }
    )
    costs = each.groupby("learned_with").agg(
        {"cpu_s": "mean", "env_steps": "mean", "solved_runs": "mean"}
    )
    return summary.assign(took_part=took_part).join(costs, on="learned_with")


def make_table(summary: pd.DataFrame) -> pd.DataFrame:
    """A row for each set and kind of hyperparameters, a column for each tested family."""
    rows = []
    for (name, hparams), mine in summary.groupby(["learned_with", "hparams"], sort=False):
        set_ = mine.iloc[0]
        rows.append(
            {
                "learned with": shown(name),
                "CPU s a run": f"{set_['cpu_s']:,.0f}",
                "runs solved": f"{set_['solved_runs']:.0%}",
                "hyperparameters": hparams,
                **{shown(row.kind): cell(row) for row in mine.itertuples()},
            }
        )
    return pd.DataFrame(rows)


def cell(row: Any) -> str:
    """What a family reaches on a set."""
    mean = f"{row.test_return_mean:.1f}{brackets(row.test_return_low, row.test_return_high, 1)}"
    mark = "" if row.took_part else LEFT_OUT
    return f"{mean}; {IQM_AND_SOLVED.format_map(row._asdict())}{mark}"


def shown(name: str) -> str:
    """Families as people write them."""
    return " + ".join(figures.AGENT_NAMES.get(x, x) for x in families_in(name))


def left_out(summary: pd.DataFrame) -> pd.DataFrame:
    """What each family of the largest set reaches on that, and on the set of the others.

    Returns:
      Rows with `hparams`, `kind` and mean returns, `included` and `left_out`; none for sets that
      were not learned.
    """
    sets = {frozenset(families_in(name)): name for name in summary["learned_with"].unique()}
    largest = max(sets, key=len)
    means = summary.set_index(["learned_with", "hparams", "kind"])["test_return_mean"]
    rows = []
    for (name, hparams, kind), mean in means.items():  # type: ignore[misc]
        others = sets.get(largest - {kind})
        if name == sets[largest] and kind in largest and others is not None:
            rows.append(
                {
                    "hparams": hparams,
                    "kind": kind,
                    "included": mean,
                    "left_out": means[others, hparams, kind],
                }
            )
    return pd.DataFrame(rows)


def findings(summary: pd.DataFrame) -> str:
    """Sentences on what was measured."""
    texts = []
    for hparams, mine in summary.groupby("hparams", sort=False):
        means = mine.groupby("took_part")["test_return_mean"].mean()
        shares = {True: "on SEs that were learned with it", False: "on others"}
        apart = " and ".join(f"{means[x]:.1f} {where}" for x, where in shares.items() if x in means)
        texts.append(f"With {hparams} hyperparameters a family's mean return is {apart}.")
        sets = mine.groupby("learned_with", sort=False)
        worst, cost = sets["test_return_mean"].min(), sets["cpu_s"].first()
        best = worst.idxmax()
        others = worst.drop(best)
        if len(others):
            texts.append(
                f"The worst of the tested families reaches most, {worst[best]:.1f}, where SEs "
                f"were learned with {shown(str(best))}, for {cost[best]:,.0f} CPU s a run "
                f"({others.min():.1f} to {others.max():.1f} with other sets, for "
                f"{cost.drop(best).min():,.0f} to {cost.drop(best).max():,.0f})."
            )
    for row in left_out(summary).itertuples():
        texts.append(
            f"{shown(row.kind)} ({row.hparams}) reaches {row.left_out:.1f} where it alone is "
            f"left out, and {row.included:.1f} where it takes part."
        )
    return " ".join(texts)


def report(settings: SeFamilies, rows: pd.DataFrame) -> pd.DataFrame:
    task = envs.make(settings.env)
    summary = summarise(unstack(rows, "curves"), unstack(rows, "agents"), task.solved_reward)
    draw(summary, task, settings.folder / "families.png")
    first = summary.iloc[0]
    note = (
        f"{settings.runs} NES runs with each set of families; of each the best SE trains "
        f"{settings.num_agents} fresh agents of each family. Cells: mean return, with a bootstrap "
        "95% interval for at least five SEs, which it draws (agents, where there is one SE); "
        f"interquartile mean; share of the {first['num_agents']} agents that solve "
        f"the task ({task.solved_reward:g}); {LEFT_OUT} a family that took no part in learning. "
        "CPU s are those of the generations, "
        f"without compilation. {findings(summary)}{iqm_note('within each SE')}"
    )
    title = f"Agents tested on {task.name}, trained on SEs learned with other families of agents"
    return publish(settings, title, make_table(summary), summary, note)


def draw(summary: pd.DataFrame, task: Any, path: Any) -> None:
    """Draws mean returns as a map for each kind of hyperparameters, and what each set cost."""
    hparams = list(summary["hparams"].unique())
    cells = {
        name: mine.pivot(index="learned_with", columns="kind")
        for name, mine in summary.groupby("hparams")
    }
    sets, kinds = (list(summary[x].unique()) for x in ("learned_with", "kind"))
    low = summary["test_return_mean"].min()
    high = max(summary["test_return_mean"].max(), low + 1)
    size = (3.4 + (1.0 + 0.85 * len(kinds)) * len(hparams), 1.8 + 0.5 * len(sets))
    widths = [1.0 * len(kinds)] * len(hparams) + [2.0]
    with figures.panels(path, 1, len(hparams) + 1, size, width_ratios=widths) as (figure, axes):
        for axis, name in zip(axes[0], hparams, strict=False):
            of_sets = cells[name].reindex(sets)
            means = of_sets["test_return_mean"][kinds].to_numpy()
            parts = of_sets["took_part"][kinds].to_numpy()
            image = axis.imshow(means, vmin=low, vmax=high, cmap="viridis", aspect="auto")
            for (i, j), mean in np.ndenumerate(means):
                dark = mean < (low + high) / 2
                axis.text(
                    j,
                    i,
                    f"{mean:.0f}{'' if parts[i, j] else LEFT_OUT}",
                    ha="center",
                    va="center",
                    fontsize=9,
                    color="white" if dark else "black",
                )
            axis.set_xticks(
                range(len(kinds)), map(shown, kinds), rotation=35, ha="right", fontsize=8
            )
            axis.set_yticks(
                range(len(sets)), map(shown, sets) if axis is axes[0, 0] else [], fontsize=8
            )
            axis.set_title(f"{name} hyperparameters", fontsize=10)
        axes[0, 0].set_ylabel("SEs learned with")
        figure.colorbar(
            image, ax=list(axes[0, :-1]), shrink=0.8, label=f"mean return on {task.name}"
        )
        costs = summary.groupby("learned_with")["cpu_s"].first()[sets]
        axes[0, -1].barh(range(len(sets)), costs, color=figures.REAL, alpha=0.85)
        axes[0, -1].set(ylim=(len(sets) - 0.5, -0.5), xlabel="CPU s a run")
        axes[0, -1].set_yticks([])
        figure.supxlabel(f"agents tested with; {LEFT_OUT} took no part in learning", fontsize=9)


EXPERIMENT = Experiment(settings=SeFamilies, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
