"""How long the episodes of an SE should be, and whether it should learn where they begin.

From the contextual bandit, whose episodes end after one step, to the task's limit, with the task's
initial states and with learned ones: what they reach within equal CPU seconds, what it takes, and
what fresh agents of other kinds learn on the best SE. Episodes of several steps end as `ends` says,
in all of these ways one after the other; the figure shows the first.

Source: the paper's SE (the task's limit and initial states) and that of Liesen et al., "Discovering
Minimal Reinforcement Learning Environments" (2024), a bandit with learned ones.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from experiments.common import figures, runs
from experiments.common.agents import HPARAMS
from experiments.common.experiment import Experiment, setting
from experiments.common.runs import MixtureRuns
from experiments.common.shards import stack, unstack
from experiments.common.statistics import mean_interval
from experiments.common.tables import (
    as_texts,
    brackets,
    interval_note,
    mean_columns,
    mean_text,
    publish,
    summary_by,
)
from sejax import Task, envs
from sejax.options import each_of, positive
from sejax.proxies.configs import DONE_MODES, INITIAL_STATES

COLORS = {"real": figures.REAL, "learned": figures.VARIED}
TESTED = ("dueling_ddqn", "ppo", "td3_discrete")
NO_END = "-"  # of SEs whose episodes are one step


class Kind(NamedTuple):
    """A kind of SE; also the columns that tell them apart in tables."""

    horizon: str  # steps, or "limit"
    starts: str
    end: str

    @property
    def name(self) -> str:
        """In the names of files."""
        return "-".join([self.horizon, self.starts, *([] if self.end == NO_END else [self.end])])

    @property
    def words(self) -> list[str]:
        """Overrides of the NES runs."""
        end = [] if self.end == NO_END else [f"proxy.done={self.end}"]
        horizon = "null" if self.horizon == "limit" else self.horizon
        return [f"proxy.horizon={horizon}", f"proxy.initial_state={self.starts}", *end]


BY = list(Kind._fields)


@dataclass(frozen=True, kw_only=True)
class SeHorizons(MixtureRuns):
    name = "se_horizons"

    # Steps of an SE's episodes; null: the task's.
    horizons: tuple[int | None, ...] = setting((1, 2, 5, 20, None), quick=(1, None))
    # Initial states of the SEs.
    starts: tuple[str, ...] = setting(("real", "learned"), each_of(INITIAL_STATES))
    # How episodes of several steps end; the figure shows the first.
    ends: tuple[str, ...] = setting(("threshold",), each_of(DONE_MODES))
    agents: tuple[str, ...] = setting(("ddqn",))  # that SEs are learned with
    # Kinds of agents that the best SE of each kind is tested with.
    tested: tuple[str, ...] = setting(TESTED, quick=TESTED[:1])
    # Their hyperparameters; the first are shown.
    tested_hparams: tuple[str, ...] = setting(("default",), each_of(HPARAMS))
    # CPU seconds of a run, without compilation.
    cpu_budget_s: float | None = setting(60.0, positive("it is time"), quick=4.0)

    @property
    def kinds(self) -> list[Kind]:
        """What is compared; a single step has one kind of end."""
        kinds = [
            Kind(str(horizon or "limit"), starts, NO_END if horizon == 1 else end)
            for end in self.ends
            for horizon in self.horizons
            for starts in self.starts
        ]
        return list(dict.fromkeys(kinds))


def compute(settings: SeHorizons) -> pd.DataFrame:
    """Learns and trains what is missing; rows of the runs' generations and of the tested agents."""
    every = [*settings.agents, *settings.tested]
    mixtures = [settings.agents, *([kind] for kind in settings.tested)]
    configs = {
        kind: [settings.config_with(names, every, kind.words) for names in mixtures]
        for kind in settings.kinds
    }
    curves, agents = [], []
    for kind, (learner, *testers) in configs.items():
        curve, ses = settings.learn(kind.name, learner)
        tested = [settings.evaluate(kind.name, ses.ranked(1), tester) for tester in testers]
        curves.append(curve.assign(**kind._asdict()))
        agents.append(pd.concat(tested).assign(**kind._asdict()))
    return stack({"curves": pd.concat(curves), "agents": pd.concat(agents)})


def summarise_runs(
    curves: pd.DataFrame, budget_s: float | None, solved_reward: float
) -> pd.DataFrame:
    """What each run reached before its budget was spent, and what it took to solve the task.

    A run that did not solve it took inf generations and CPU seconds; `stays_solved` is the share of
    the generations after the first solved one whose incumbent is solved, nan if there are none.
    """

    def statistics(whole: pd.DataFrame) -> dict[str, float]:
        curve = runs.within(whole, budget_s).reset_index(drop=True)
        to_solve = runs.generations_to_solve(curve, solved_reward)
        is_solved = np.isfinite(to_solve)
        later = curve["incumbent_mean"][curve["generation"] >= to_solve]
        return {
            "generations": len(curve),
            "best": curve["incumbent_mean"].max(),
            "to_solve": to_solve,
            "cpu_s_to_solve": curve["cpu_s"].cumsum()[to_solve - 1] if is_solved else np.inf,
            "stays_solved": (later >= solved_reward).mean(),
            "cpu_s": curve["cpu_s"].mean(),
            "cpu_s_in_all": curve["cpu_s"].sum(),
            "train_steps": curve["train_steps_mean"].mean(),
            "env_steps": curve["env_steps_total"].iloc[-1],
        }

    return summary_by(curves, [*BY, "seed"], statistics)


def summarise(each: pd.DataFrame, transfer: pd.DataFrame) -> pd.DataFrame:
    """A row for each kind of SE, with a column for the mean return of each tested kind of agent."""
    means = ["stays_solved", "generations", "cpu_s", "train_steps", "env_steps"]

    def statistics(mine: pd.DataFrame) -> dict[str, float]:
        return (
            {"runs": len(mine), "solved": int(np.isfinite(mine["to_solve"]).sum())}
            | mean_columns(mine["best"], "best")
            | dict(mine[["to_solve", "cpu_s_to_solve"]].median())
            | dict(mine[means].mean())
        )

    transferred = transfer[transfer["hparams"] == transfer["hparams"].iloc[0]]
    returns = transferred.pivot(index=BY, columns="kind", values="test_return_mean")
    return summary_by(each, BY, statistics).join(returns.add_prefix("on_"), on=BY)


def make_table(summary: pd.DataFrame) -> pd.DataFrame:
    """The summary as texts."""
    columns: dict[str, Any] = {
        "steps": "{horizon}",
        "starts": "{starts}",
        "end": "{end}",
        "best incumbent": mean_text("best", 1),
        "runs solved": "{solved} of {runs}",
        "generations to solve": lambda row: _finite(row.to_solve, 0),
        "CPU s to solve": lambda row: _finite(row.cpu_s_to_solve, 1),
        "stay solved": lambda row: f"{row.stays_solved:.0%}" if row.solved else "-",
        "generations": "{generations:.0f}",
        "CPU s each": "{cpu_s:.2f}",
        "steps of an agent": "{train_steps:,.0f}",
        "real steps": "{env_steps:,.0f}",
    }
    for name in (name for name in summary if name.startswith("on_")):
        kind = name.removeprefix("on_")
        columns[f"tested: {figures.AGENT_NAMES.get(kind, kind)}"] = f"{{{name}:.1f}}"
    return as_texts(summary, columns)


def differences(each: pd.DataFrame, summary: pd.DataFrame, end: str) -> str:
    """Best incumbents of two kinds of SE, one less the other, over pairs of equal seeds.

    Compared are the shortest and the longest horizon of equal starts, and the starts of equal
    horizons, of SEs that end like this.
    """
    bests, texts = each.set_index([*BY, "seed"])["best"].sort_index(), []
    shown = summary[summary["end"].isin([NO_END, end])]
    for same in ("starts", "horizon"):
        for _, mine in shown.groupby(same, sort=False):
            first, last = (Kind(*mine[BY].iloc[place]) for place in (0, -1))
            if first != last:
                less = bests.loc[first] - bests.loc[last]
                ends = brackets(*mean_interval(less), 1)
                texts.append(f"{first.name} less {last.name}: {less.mean():+.1f}{ends}")
    return "; ".join(texts)


def _finite(value: float, digits: int) -> str:
    return f"{value:,.{digits}f}" if np.isfinite(value) else "-"


def report(settings: SeHorizons, rows: pd.DataFrame) -> pd.DataFrame:
    task = envs.make(settings.env)
    rows = rows.astype({"horizon": str})
    each = summarise_runs(unstack(rows, "curves"), settings.cpu_budget_s, task.solved_reward)
    by = [*BY, "hparams", "kind"]
    summary = summarise(each, runs.summarise_tests(unstack(rows, "agents"), by, task.solved_reward))
    draw(task, each, summary, settings.ends[0], settings.folder / "horizons.png")
    note = (
        f"SEs learned with {' + '.join(settings.agents)}, {settings.runs} runs of "
        f"{settings.cpu_budget_s:g} CPU s each (generations that began before these were spent, "
        f"without compilation). Best incumbent: mean over runs. {interval_note('runs')} Of each "
        "run it is a maximum of noisy means and hence too high. Solved: an incumbent mean of "
        f"{task.solved_reward:g}; generations and CPU s until then are medians, - if half of the "
        "runs did not solve it; stay solved: share of the later generations. Real steps: of the "
        f"whole run. Tested: mean return of {settings.num_agents} fresh agents with "
        f"{settings.tested_hparams[0]} hyperparameters on the SE with the best score of each kind. "
        f"Best incumbents in pairs of seeds: {differences(each, summary, settings.ends[0])}."
    )
    title = f"Horizons and starts of SEs of {task.name}, at equal cost"
    return publish(settings, title, make_table(summary), summary, note)


def draw(task: Task, each: pd.DataFrame, summary: pd.DataFrame, end: str, path: Path) -> None:
    """Draws returns against horizons of SEs that end like this, and CPU seconds to solve the task.

    A cross is a run that has not solved it, where its budget was spent.
    """
    ends = [NO_END, end]
    horizons = list(summary["horizon"].unique())
    tested = [name for name in summary if name.startswith("on_")]
    shown = summary[summary["end"].isin(ends)].groupby("starts", sort=False)
    with figures.panels(path, 1, 2, (9, 3.6)) as (figure, axes):
        left, right = axes[0]
        for index, (starts, mine) in enumerate(shown):
            color, shift = COLORS[str(starts)], 0.12 * (index - 0.5)
            places, best = mine["horizon"].map(horizons.index) + shift, mine["best_mean"]
            errors = np.abs(mine[["best_low", "best_high"]].to_numpy().T - best.to_numpy())
            line: Any = {"fmt": "o-", "ms": 5, "capsize": 3, "color": color}
            left.errorbar(places, best, yerr=errors, label=f"{starts} starts", **line)
            means, label = mine[tested].mean(axis=1), f"{starts} starts, tested agents"
            left.plot(places, means, "D:", ms=4, color=color, mfc="none", label=label)
            own = each[each["end"].isin(ends) & (each["starts"] == starts)]
            solved = np.isfinite(own["cpu_s_to_solve"])
            x = own["horizon"].map(horizons.index) + shift
            right.plot(x[solved], own["cpu_s_to_solve"][solved], "o", ms=5, color=color, alpha=0.7)
            right.plot(x[~solved], own["cpu_s_in_all"][~solved], "x", ms=6, color=color, alpha=0.7)
        figures.threshold(left, task.solved_reward, f"solved ({task.solved_reward:g})")
        left.set(ylabel=f"mean return on {task.name}")
        right.set(ylabel="CPU s to solve (x: not solved)")
        right.set_ylim(bottom=0)
        for axis in (left, right):
            axis.set_xticks(range(len(horizons)), horizons)
            axis.set(xlim=(-0.5, len(horizons) - 0.5), xlabel="steps of an SE's episodes")
        figures.legend_above(figure, left, columns=3)


EXPERIMENT = Experiment(settings=SeHorizons, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
