"""Which agents SEs teach, by the agent mixtures that they were learned with.

For each mixture some SEs are learned, and each of these trains fresh agents of all the kinds in
`tested`: a table of what they were learned with and tested with. Kinds that took no part are
marked.

Source: the question is that of the paper's section "Transferability of SEs"; several kinds of
agents in one search, as in Liesen et al., "Discovering Minimal Reinforcement Learning Environments"
(2024).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.common import figures, runs, tables
from experiments.common.experiment import Experiment, setting
from experiments.common.runs import MixtureRuns, kinds_in
from experiments.common.shards import stack, unstack
from sejax import Task, envs
from sejax.options import require

SETS = (
    "ddqn",
    "ppo",
    "td3_discrete",
    "ddqn+ppo",
    "ddqn+td3_discrete",
    "ppo+td3_discrete",
    "ddqn+ppo+td3_discrete",
)
TESTED = ("ddqn", "dueling_ddqn", "ppo", "td3_discrete", "sac")
LEFT_OUT = "°"  # after the return of a kind that took no part


@dataclass(frozen=True, kw_only=True)
class SeFamilies(MixtureRuns):
    name = "se_families"

    # Agent mixtures that SEs are learned with.
    sets: tuple[str, ...] = setting(SETS, quick=("ddqn", "ddqn+ppo"))
    # Kinds of agents that they are tested with.
    tested: tuple[str, ...] = setting(TESTED, quick=TESTED[:2])

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, value in self.values("sets", "tested").items():
            require(value, name, f"must name an agent; got none. Set {name}=[ddqn].")


def compute(settings: SeFamilies) -> pd.DataFrame:
    """Learns and trains what is missing; rows of the runs' generations and of the tested agents."""
    every = [*(kind for name in settings.sets for kind in kinds_in(name)), *settings.tested]
    learners = {name: settings.config_with(kinds_in(name), every) for name in settings.sets}
    testers = [settings.config_with([kind], every) for kind in settings.tested]
    curves, agents = [], []
    for name, config in learners.items():
        curve, ses = settings.learn(name, config)
        tested = [settings.evaluate(name, ses, tester) for tester in testers]
        curves.append(curve.assign(learned_with=name))
        agents.append(pd.concat(tested).assign(learned_with=name))
    return stack({"curves": pd.concat(curves), "agents": pd.concat(agents)})


def summarise(curves: pd.DataFrame, agents: pd.DataFrame, solved_reward: float) -> pd.DataFrame:
    """A row for each mixture, kind of hyperparameters and tested kind of agent, with its cost."""
    summary = runs.summarise_tests(agents, ["learned_with", "hparams", "kind"], solved_reward)
    took_part = [row.kind in kinds_in(row.learned_with) for row in summary.itertuples()]
    each = curves.groupby(["learned_with", "seed"]).agg(
        cpu_s=("cpu_s", "sum"),
        env_steps=("env_steps_total", "last"),
        best=("incumbent_mean", "max"),
    )
    each["solved_runs"] = each.pop("best") >= solved_reward
    costs = each.groupby("learned_with").mean()
    return summary.assign(took_part=took_part).join(costs, on="learned_with")


def make_table(summary: pd.DataFrame) -> pd.DataFrame:
    """A row for each mixture and kind of hyperparameters, a column for each tested kind."""
    rows = []
    for (name, hparams), mine in summary.groupby(["learned_with", "hparams"], sort=False):
        rows.append(
            {
                "learned with": shown(name),
                "CPU s a run": f"{mine['cpu_s'].iloc[0]:,.0f}",
                "runs solved": f"{mine['solved_runs'].iloc[0]:.0%}",
                "hyperparameters": hparams,
                **{shown(row.kind): cell(row) for row in mine.itertuples()},
            }
        )
    return pd.DataFrame(rows)


def cell(row: Any) -> str:
    """What a kind of agent reaches on the SEs of a mixture."""
    mark = "" if row.took_part else LEFT_OUT
    mean = tables.mean_text("test_return", 1)(row)
    return f"{mean}; worst tenth {row.test_return_worst_tenth:.1f}; {row.solved:.0%}{mark}"


def shown(name: str) -> str:
    """A mixture as people write it."""
    return " + ".join(figures.AGENT_NAMES.get(x, x) for x in kinds_in(name))


def report(settings: SeFamilies, rows: pd.DataFrame) -> pd.DataFrame:
    task = envs.make(settings.env)
    summary = summarise(unstack(rows, "curves"), unstack(rows, "agents"), task.solved_reward)
    draw(summary, task, settings.folder / "families.png")
    note = (
        f"{settings.runs} NES runs with each mixture; the best SE of each trains "
        f"{settings.num_agents} fresh agents of each kind. Cells: mean return; "
        f"mean of the worst tenth; share of the {summary['num_agents'].iloc[0]} agents that solve "
        f"the task ({task.solved_reward:g}); {LEFT_OUT} a kind that took no part in learning. CPU "
        "s: of the generations, without compilation. "
        f"{tables.interval_note('SEs, agents where there is one SE')}"
    )
    title = f"Agents tested on {task.name}, trained on SEs learned with other mixtures of agents"
    return tables.publish(settings, title, make_table(summary), summary, note)


def draw(summary: pd.DataFrame, task: Task, path: Path) -> None:
    """Draws mean returns as a map for each kind of hyperparameters, and what each mixture cost."""
    hparams, sets, kinds = (list(summary[x].unique()) for x in ("hparams", "learned_with", "kind"))
    low = summary["test_return_mean"].min()
    high = max(summary["test_return_mean"].max(), low + 1)
    size = (3.4 + (1.0 + 0.85 * len(kinds)) * len(hparams), 1.8 + 0.5 * len(sets))
    widths = [1.0 * len(kinds)] * len(hparams) + [2.0]
    with figures.panels(path, 1, len(hparams) + 1, size, width_ratios=widths) as (figure, axes):
        for axis, name in zip(axes[0], hparams, strict=False):
            cells = summary[summary["hparams"] == name].pivot(index="learned_with", columns="kind")
            means = cells["test_return_mean"].loc[sets, kinds].to_numpy()
            parts = cells["took_part"].loc[sets, kinds].to_numpy()
            image = axis.imshow(means, vmin=low, vmax=high, cmap="viridis", aspect="auto")
            for (i, j), mean in np.ndenumerate(means):
                text = f"{mean:.0f}{'' if parts[i, j] else LEFT_OUT}"
                figures.cell_text(axis, j, i, text, is_dark=mean < (low + high) / 2, fontsize=9)
            turned: Any = {"rotation": 35, "ha": "right", "fontsize": 8}
            axis.set_xticks(range(len(kinds)), map(shown, kinds), **turned)
            names = map(shown, sets) if axis is axes[0, 0] else []
            axis.set_yticks(range(len(sets)), names, fontsize=8)
            axis.set_title(f"{name} hyperparameters", fontsize=10)
        axes[0, 0].set_ylabel("SEs learned with")
        label = f"mean return on {task.name}"
        figure.colorbar(image, ax=list(axes[0, :-1]), shrink=0.8, label=label)
        costs = summary.groupby("learned_with")["cpu_s"].first()[sets]
        axes[0, -1].barh(range(len(sets)), costs, color=figures.REAL, alpha=0.85)
        axes[0, -1].set(ylim=(len(sets) - 0.5, -0.5), xlabel="CPU s a run")
        axes[0, -1].set_yticks([])
        figure.supxlabel(f"agents tested with; {LEFT_OUT} took no part in learning", fontsize=9)


EXPERIMENT = Experiment(settings=SeFamilies, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
