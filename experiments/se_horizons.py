"""How long the episodes of an SE should be, and whether it should learn where they begin.

From the contextual bandit, whose episodes end after one step, to the task's limit, with the task's
initial states and with learned ones: what they reach within equal CPU seconds, what it takes, and
what fresh agents of other families learn on the best SE. Episodes of several steps end as `ends`
says, in all of these ways one after the other; the figure shows the first.

Source: the paper's SE (the task's limit and initial states) and that of Liesen et al., "Discovering
Minimal Reinforcement Learning Environments" (2024), a bandit with learned ones.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from experiments import budgets, family_runs, figures, proxy_runs
from experiments.experiment import Experiment
from experiments.family_runs import FamilyRuns
from experiments.pieces import stack, unstack
from experiments.settings import each_of, setting
from experiments.statistics import bootstrap_interval
from experiments.tables import as_texts, publish
from experiments.worlds import HPARAMS
from sejax import envs
from sejax.options import positive
from sejax.proxies.configs import DONE_MODES, INITIAL_STATES

COLORS = {"real": figures.REAL, "learned": figures.VARIED}
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
class SeHorizons(FamilyRuns):
    name = "se_horizons"

    horizons: tuple[int | None, ...] = setting(
        (1, 2, 5, 20, None),
        quick=(1, None),
        about="steps of an SE's episodes; null: the task's limit",
    )
    starts: tuple[str, ...] = setting(
        ("real", "learned"), each_of(INITIAL_STATES), about="initial states of the SEs"
    )
    ends: tuple[str, ...] = setting(
        ("threshold",),
        each_of(DONE_MODES),
        about="how episodes of several steps end; the figure shows the first",
    )
    agents: tuple[str, ...] = setting(("ddqn",), about="families that SEs are learned with")
    tested: tuple[str, ...] = setting(
        ("dueling_ddqn", "ppo", "td3_discrete"),
        quick=("dueling_ddqn",),
        about="families that the best SE of each kind is tested with",
    )

    tested_hparams: tuple[str, ...] = setting(
        ("default",), each_of(HPARAMS), about="their hyperparameters; the first are shown"
    )
    cpu_budget_s: float | None = setting(
        60.0, positive("it is time"), quick=4.0, about="CPU seconds of a run, without compilation"
    )

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
    configs = {
        kind: [
            settings.config_with(names, every, kind.words)
            for names in (settings.agents, *([x] for x in settings.tested))
        ]
        for kind in settings.kinds
    }
    curves, agents = [], []
    for kind, (learner, *testers) in configs.items():
        curve, ses = family_runs.learn(settings, kind.name, learner)
        curves.append(curve.assign(**kind._asdict()))
        agents += [
            family_runs.evaluate(settings, kind.name, ses.ranked(1), tester).assign(
                **kind._asdict()
            )
            for tester in testers
        ]
    return stack({"curves": pd.concat(curves), "agents": pd.concat(agents)})


def summarise_runs(
    curves: pd.DataFrame, budget_s: float | None, solved_reward: float
) -> pd.DataFrame:
    """What each run reached before its budget was spent, and what it took to solve the task.

    A run that did not solve it took inf generations and CPU seconds; `stays_solved` is the share of
    the generations after the first solved one whose incumbent is solved, nan if there are none.
    """
    rows = []
    for values, whole in curves.groupby([*BY, "seed"], sort=False):
        curve = budgets.within(whole, budget_s).reset_index(drop=True)
        to_solve = proxy_runs.generations_to_solve(curve, solved_reward)
        is_solved = np.isfinite(to_solve)
        later = curve["incumbent_mean"][curve["generation"] >= to_solve]
        rows.append(
            dict(zip([*BY, "seed"], values, strict=True))
            | {
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
        )
    return pd.DataFrame(rows)


def summarise(runs: pd.DataFrame, transfer: pd.DataFrame) -> pd.DataFrame:
    """A row for each kind of SE, with a column for the mean return of each tested family."""
    rows = []
    for values, mine in runs.groupby(BY, sort=False):
        low, high = bootstrap_interval(mine["best"])
        rows.append(
            dict(zip(BY, values, strict=True))
            | {
                "runs": len(mine),
                "solved": int(np.isfinite(mine["to_solve"]).sum()),
                "best": mine["best"].mean(),
                "best_low": low,
                "best_high": high,
                "to_solve": mine["to_solve"].median(),
                "cpu_s_to_solve": mine["cpu_s_to_solve"].median(),
                "stays_solved": mine["stays_solved"].mean(),
                **mine[["generations", "cpu_s", "train_steps", "env_steps"]].mean(),
            }
        )
    transferred = transfer[transfer["hparams"] == transfer["hparams"].iloc[0]]
    means = transferred.pivot(index=BY, columns="kind", values="test_return_mean").add_prefix("on_")
    return pd.DataFrame(rows).join(means, on=BY)


def make_table(summary: pd.DataFrame) -> pd.DataFrame:
    """The summary as texts."""
    tested = {name.removeprefix("on_"): name for name in summary if name.startswith("on_")}

    return as_texts(
        summary,
        {
            "steps": "{horizon}",
            "starts": "{starts}",
            "end": "{end}",
            "best incumbent": "{best:.1f} [{best_low:.1f}, {best_high:.1f}]",
            "runs solved": "{solved} of {runs}",
            "generations to solve": lambda row: _finite(row.to_solve, 0),
            "CPU s to solve": lambda row: _finite(row.cpu_s_to_solve, 1),
            "stay solved": lambda row: f"{row.stays_solved:.0%}" if row.solved else "-",
            "generations": "{generations:.0f}",
            "CPU s each": "{cpu_s:.2f}",
            "steps of an agent": "{train_steps:,.0f}",
            "real steps": "{env_steps:,.0f}",
            **{
                f"tested: {figures.AGENT_NAMES.get(kind, kind)}": f"{{{column}:.1f}}"
                for kind, column in tested.items()
            },
        },
    )


def findings(runs: pd.DataFrame, summary: pd.DataFrame, end: str) -> str:
    """Sentences on what was measured; horizons and starts are compared where SEs end like this."""
    texts = []
    shown = summary[summary["end"].isin([NO_END, end])]
    for starts, mine in shown.groupby("starts", sort=False):
        each = [
            f"{row.horizon}: {row.best:.1f}, {row.solved} of {row.runs}, "
            f"{_finite(row.cpu_s_to_solve, 0)}"
            for row in mine.itertuples()
        ]
        texts.append(
            f"With {starts} starts (horizon: best incumbent, runs solved, median CPU s to "
            f"solve): {'; '.join(each)}."
        )
        if len(mine) > 1:
            texts.append(_compared(runs, mine.iloc[0], mine.iloc[-1], "horizon"))
    for _, mine in shown.groupby("horizon", sort=False):
        if len(mine) > 1:
            texts.append(_compared(runs, mine.iloc[0], mine.iloc[-1], "starts"))
    of_ends = summary[summary["end"] != NO_END].groupby("end", sort=False)
    if of_ends.ngroups > 1:
        means = of_ends.agg({"best": "mean", "solved": "sum", "runs": "sum"})
        each = [
            f"{row.Index} {row.best:.1f} ({row.solved} of {row.runs} runs solved)"
            for row in means.itertuples()
        ]
        texts.append(f"Ends of several steps, over horizons and starts: {', '.join(each)}.")
    return " ".join(texts)


def _compared(runs: pd.DataFrame, a: pd.Series, b: pd.Series, what: str) -> str:
    """The difference between two kinds of SE that differ in this, over pairs of equal seeds."""
    bests = runs.set_index([*BY, "seed"])["best"]
    differences = bests.loc[tuple(a[BY])] - bests.loc[tuple(b[BY])]
    low, high = bootstrap_interval(differences)
    tested = [name for name in a.index if name.startswith("on_")]
    same = f"starts {a['starts']}" if what == "horizon" else f"horizon {a['horizon']}"
    return (
        f"With {same}, {what} {a[what]} less {what} {b[what]}: {differences.mean():+.1f} "
        f"[{low:.1f}, {high:.1f}] in the best incumbent; the tested families reach "
        f"{a[tested].mean():.1f} and {b[tested].mean():.1f}."
    )


def _finite(value: float, digits: int) -> str:
    return f"{value:,.{digits}f}" if np.isfinite(value) else "-"


def report(settings: SeHorizons, rows: pd.DataFrame) -> pd.DataFrame:
    task = envs.make(settings.env)
    rows = rows.astype({"horizon": str})
    runs = summarise_runs(unstack(rows, "curves"), settings.cpu_budget_s, task.solved_reward)
    transfer = family_runs.summarise(
        unstack(rows, "agents"), [*BY, "hparams", "kind"], task.solved_reward
    )
    summary = summarise(runs, transfer)
    draw(task, runs, summary, settings.ends[0], settings.folder / "horizons.png")
    note = (
        f"SEs learned with {' + '.join(settings.agents)}, {settings.runs} runs of "
        f"{settings.cpu_budget_s:g} CPU s each (generations that began before these were spent; "
        "compilation is not counted). Best incumbent: mean over runs with a bootstrap 95% interval "
        "that draws runs; of each run it is a maximum of noisy means, one for each generation, and "
        f"hence too high. Solved: an incumbent mean of {task.solved_reward:g}; generations and "
        "CPU s until then are medians, - if half of the runs did not solve it; stay solved: share "
        "of the later generations, over the runs that did. Real steps are those of the whole run. "
        f"Tested: mean return of {settings.num_agents} fresh agents with "
        f"{settings.tested_hparams[0]} hyperparameters on the SE with the best score of each "
        f"kind. {findings(runs, summary, settings.ends[0])}"
    )
    title = f"Horizons and starts of SEs of {task.name}, at equal cost"
    return publish(settings, title, make_table(summary), summary, note)


def draw(task: Any, runs: pd.DataFrame, summary: pd.DataFrame, end: str, path: Any) -> None:
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
            places = mine["horizon"].map(horizons.index) + shift
            errors = np.abs(mine[["best_low", "best_high"]].to_numpy().T - mine["best"].to_numpy())
            left.errorbar(
                places,
                mine["best"],
                yerr=errors,
                fmt="o-",
                ms=5,
                capsize=3,
                color=color,
                label=f"{starts} starts",
            )
            left.plot(
                places,
                mine[tested].mean(axis=1),
                "D:",
                ms=4,
                color=color,
                mfc="none",
                label=f"{starts} starts, tested families",
            )
            own = runs[runs["end"].isin(ends) & (runs["starts"] == starts)]
            solved = np.isfinite(own["cpu_s_to_solve"])
            x = own["horizon"].map(horizons.index) + shift
            right.plot(x[solved], own["cpu_s_to_solve"][solved], "o", ms=5, color=color, alpha=0.7)
            right.plot(x[~solved], own["cpu_s_in_all"][~solved], "x", ms=6, color=color, alpha=0.7)
        left.axhline(
            task.solved_reward,
            color=figures.SOLVED,
            ls="--",
            lw=1.2,
            label=f"solved ({task.solved_reward:g})",
        )
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
