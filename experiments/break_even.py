"""From how many agents on does a shipped proxy pay for the real steps that learning it took?

With N agents, a proxy has paid when the real steps that its students save have reached those of
learning it:

    N* = real steps of learning / (real steps of an agent without it - real steps of a student)

- *students*: fresh agents of the first kind that the proxy was learned with. On an SE they train as
  long as in learning and take no real step; on an RN they train until the task is solved.
- *the same* agents on the real task, until it is solved.
- *tuned*: agents of the kind that is fastest there, of those of `preset=best`, whose settings were
  tuned on other seeds. Pilots, of yet other seeds, choose the kind. On an RN they train too.

Solved means that the last ten tests, or all if there are fewer, have reached the threshold on
average or, if students of an SE return less, their mean. Beside it stands what a bandit costs that
copies a policy (`experiments.null_baselines`, read when the table is made).
"""

import functools
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments import null_baselines
from experiments.common import curves, figures, tables
from experiments.common.experiment import Experiment
from experiments.common.proxy_users import BreakEven, compute, step_grid
from experiments.common.shards import read_rows, unstack
from experiments.common.statistics import difference_interval, worst_tenth

# What is compared: agents that use the proxy, and those that do not.
PAIRS = {
    "break_even": ("student", "tuned"),
    "break_even_same": ("student", "same"),
    "break_even_tuned": ("tuned_student", "tuned"),
}
ROLES = ("student", "same", "tuned_student", "tuned")
SHOWN = ("agent", "steps_mean", "reached", "return_mean", "return_worst_tenth")
COSTS = ("of", "task", "learning_steps", "learning_cpu_s")
NULLS_FOLDER = Path("results/null_baselines")  # of their rows, by task
NULLS = ("by_hand", "best_of_four")
NULL_MEASURES = ("real_steps", "test_return_mean", "cpu_s")
NULL_COLUMNS = ("source", "kind", "hparams", *NULL_MEASURES)
NEVER = float("inf")


# --- when it pays --------------------------------------------------------------------------------


def break_even(cost: float, without: Any, with_proxy: Any) -> tuple[float, float, float]:
    """Agents after which a proxy has paid, and the ends of a 95% interval; inf for never.

    It is Fieller's interval for a cost that is known: the ends of Welch's interval of what an agent
    saves, turned over.

    Args:
      cost: of learning the proxy.
      without: what each agent without it costs, `[n]`.
      with_proxy: what each student costs, `[m]`.
    """
    low, high = difference_interval(without, with_proxy)
    saved = np.array([np.mean(without) - np.mean(with_proxy), high, low])
    paid = np.where(saved > 0, cost / np.where(saved > 0, saved, 1.0), NEVER)
    return tuple(np.where(np.isnan(saved), np.nan, paid).tolist())


def paid_columns(name: str, *costs: Any) -> dict[str, float]:
    """`break_even` as columns."""
    return dict(zip((name, f"{name}_low", f"{name}_high"), break_even(*costs), strict=True))


def summarise(rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each proxy; names of columns begin with the sort of agents that they tell of."""
    costs = unstack(rows, "costs").set_index("proxy")

    def statistics(mine: pd.DataFrame) -> dict[str, Any]:
        sorts = dict(list(mine.groupby("role", sort=False)))
        cost: Any = costs.loc[mine["proxy"].iloc[0]]
        found: dict[str, Any] = {name: cost.get(name, np.nan) for name in COSTS}
        found |= mine.iloc[-1][["target", "most_steps"]]
        real = {role: real_steps(each, cost["of"]) for role, each in sorts.items()}
        for role in filter(sorts.__contains__, ROLES):
            found |= columns_of(sorts[role], real[role], role)
        for name, (user, other) in PAIRS.items():
            if user in sorts:
                found |= paid_columns(name, found["learning_steps"], real[other], real[user])
        cpu = {role: sorts[role].groupby("group")["cpu_s"].first() for role in PAIRS["break_even"]}
        cost = found["learning_cpu_s"]
        return found | paid_columns("break_even_cpu", cost, cpu["tuned"], cpu["student"])

    agents = unstack(rows, "agents")
    return tables.summary_by(agents[agents["role"] != "pilot"], ["proxy"], statistics)


def real_steps(agents: pd.DataFrame, of: str) -> pd.Series:
    """Training steps of each agent on the real task, tests left out: none for an SE's students."""
    is_free = of == "se" and agents["role"].iloc[0] == "student"
    return agents["train_steps"] * (not is_free)


def columns_of(agents: pd.DataFrame, real: pd.Series, role: str) -> dict[str, Any]:
    """What is told of one sort of agents."""
    returns, steps = agents["test_return"], agents["train_steps"]
    most, target = agents[["most_steps", "target"]].iloc[0]
    each = {
        "agent": agents["kind"].iloc[0],
        "num_agents": len(agents),
        **tables.mean_columns(steps, "steps"),
        "real_steps_mean": real.mean(),
        "reached": (steps < most).mean(),
        **tables.mean_columns(returns, "return"),
        "return_worst_tenth": worst_tenth(returns),
        "solved": (returns >= target).mean(),
        "cpu_s": agents["cpu_s"].mean(),
    }
    return {f"{role}_{name}": value for name, value in each.items()}


def with_nulls(summary: pd.DataFrame, folder: Path) -> pd.DataFrame:
    """The summary with columns of the bandits of `cheapest`; nan where none is known."""
    found = []
    for row in summary.itertuples():
        stored = stored_nulls(folder / str(row.task) / "rows.csv.xz")
        mine = stored[(stored["kind"] == row.student_agent) & (stored["hparams"] == "default")]
        own: dict[str, Any] = {}
        for source in NULLS:
            best = cheapest(mine[mine["source"] == source], row.target)
            own |= {f"{source}_{name}": best[name] for name in NULL_MEASURES}
            own[f"{source}_break_even"] = best["real_steps"] / row.tuned_real_steps_mean
        found.append(own)
    return pd.concat([summary, pd.DataFrame(found, index=summary.index)], axis=1)


def stored_nulls(path: Path) -> pd.DataFrame:
    """The summary of `experiments.null_baselines` for a task, by its rows; empty without these."""
    if not path.exists():
        return pd.DataFrame(columns=NULL_COLUMNS)
    settings = null_baselines.NullBaselines.of(env=path.parent.name)
    return null_baselines.summarise(settings, read_rows(path))


def cheapest(bandits: pd.DataFrame, target: Any) -> Any:
    """The bandit that costs least of those on which students reach the target.

    If they reach it on none, that on which they return most; nan where there is none.
    """
    good = bandits[bandits["test_return_mean"] >= target].sort_values("real_steps")
    order = good if len(good) else bandits.sort_values("test_return_mean", ascending=False)
    return order.iloc[0] if len(order) else dict.fromkeys(NULL_MEASURES, np.nan)


# --- table and figure ----------------------------------------------------------------------------


def agents_text(value: float, low: float, high: float) -> str:
    """A number of agents with its interval; `never` where nothing is saved."""
    if np.isnan(value):
        return ""
    if low == NEVER or (value == NEVER and np.isnan(low)):
        return "never"
    middle = "never" if value == NEVER else f"{value:,.0f}"
    end = "never" if high == NEVER else f"{high:,.0f}"
    return middle if np.isnan(low) else f"{middle} [{low:,.0f}, {end}]"


def make_table(summary: pd.DataFrame) -> pd.DataFrame:
    """The summary as texts."""
    return pd.DataFrame(
        {
            "proxy": row["proxy"],
            "real steps to learn it": tables.steps_text(row["learning_steps"]),
            "agents on it": users_text(row, "student"),
            "the same on the task": users_text(row, "same"),
            "tuned on the task": users_text(row, "tuned"),
            "tuned agents on it": users_text(row, "tuned_student"),
            "agents until it breaks even": paid_text(row, "break_even"),
            "compared with the same": paid_text(row, "break_even_same"),
            "by CPU seconds": paid_text(row, "break_even_cpu"),
            "an SE of a policy by hand": null_text(row, "by_hand"),
            "an SE of the best of four": null_text(row, "best_of_four"),
        }
        for row in summary.to_dict("records")
    )


def users_text(row: Mapping[Any, Any], role: str) -> str:
    """Steps and returns of one sort of agents; empty if there are none."""
    agent, steps, reached, mean, worst = (row.get(f"{role}_{x}", np.nan) for x in SHOWN)
    if pd.isna(agent):
        return ""
    share = "" if role == "student" and row["of"] == "se" else f", {reached:.0%}"
    return f"{figures.agent_name(agent)}: {steps:,.0f}{share}; {mean:,.1f} ({worst:,.1f})"


def paid_text(row: Mapping[Any, Any], name: str) -> str:
    """After how many agents it has paid; empty if it is not known."""
    return agents_text(*(row.get(f"{name}{end}", np.nan) for end in ("", "_low", "_high")))


def null_text(row: Mapping[Any, Any], source: str) -> str:
    """Cost and return of a bandit; empty if there is none."""
    steps, value, _ = (row[f"{source}_{x}"] for x in NULL_MEASURES)
    return "" if np.isnan(steps) else f"{steps:,.0f}; {value:,.1f}"


def report(settings: BreakEven, rows: pd.DataFrame) -> pd.DataFrame:
    summary = with_nulls(summarise(rows), NULLS_FOLDER)
    draw(settings, summary, unstack(rows, "curves"))
    most = summary["most_steps"].groupby(summary["task"]).first()
    limits = ", ".join(f"{name} {steps:,.0f}" for name, steps in most.items())
    note = (
        "Agents: mean training steps until they are stopped, the share that solves the task; "
        f"mean return after it (of the worst tenth). Limits: {limits}. Agents on an SE train as "
        "long as in learning, and take no real step. Tests count in learning the proxy, not in the "
        "agents' steps. In brackets Fieller's 95% interval over agents, of CPU seconds over five "
        "groups of them; never: nothing is saved. SEs of policies: real steps of one; return of "
        "agents on it, of the same algorithm."
    )
    title = "After how many agents a shipped SE or RN breaks even"
    return tables.publish(settings, title, make_table(summary), summary, note)


def draw(settings: BreakEven, summary: pd.DataFrame, learned: pd.DataFrame) -> None:
    """Draws returns against real steps that were spent, a panel for each proxy.

    Tuned agents on the task, and the students of the proxy and of a bandit at its cost.
    """
    columns = min(4, len(summary))
    lines = -(-len(summary) // columns)
    size = (1.0 + 3.0 * max(columns, 2), 1.0 + 2.6 * lines)
    path = settings.folder / "costs.png"
    with figures.panels(path, lines, columns, size) as (figure, axes):
        for axis, row in itertools.zip_longest(axes.flat, summary.itertuples()):
            if row is None:
                axis.set_axis_off()
                continue
            panel(axis, row, learned[learned["proxy"] == row.proxy])
        for line in axes:
            line[0].set_ylabel("return on the task")
        figures.legend_above(figure, axes[0, 0])


def panel(axis: Any, row: Any, learned: pd.DataFrame) -> None:
    """What one proxy costs, beside tuned agents; a band holds half of them."""
    grid = step_grid(row.most_steps)
    held = curves.on_grid(learned, grid)
    half = functools.partial(np.quantile, q=[0.25, 0.75], axis=0)
    figures.band(axis, grid, held, half, figures.TUNED, label="tuned agents")
    lowest = pd.DataFrame(held).mean().min()  # where any of them has a return
    how: dict[str, Any] = {"color": figures.FIXED, "ls": "", "ms": 7}
    cost = row.learning_steps
    axis.plot(cost, row.student_return_mean, "o", label="agents on the SE or RN", **how)
    how["color"] = figures.BEST
    known = row.best_of_four_real_steps, row.best_of_four_test_return_mean
    axis.plot(*known, "^", label="agents on the SE of a policy", **how)
    figures.threshold(axis, row.target, label="score to reach")
    axis.set(xscale="log", xlabel="real steps", title=row.proxy)
    axis.set_ylim(bottom=lowest - 0.05 * (row.target - lowest))


EXPERIMENT = Experiment(settings=BreakEven, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
