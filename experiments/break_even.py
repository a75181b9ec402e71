"""From how many agents on does a shipped proxy pay for the real steps that learning it took?

With N agents, a proxy has paid when the real steps that its students save have reached those of
learning it:

    N* = real steps of learning / (real steps of an agent without it - real steps of a student)

- *students*: fresh agents of the first kind that the proxy was learned with. On an SE they train as
  long as in learning and take no real step; on an RN they train until the task is solved.
- *the same* agents on the real task, until it is solved.
- *tuned*: agents of the kind that is fastest there, of those of `preset=best`, whose settings were
  tuned on other seeds. Pilots, of yet other seeds, choose the kind. On an RN they train too.

Solved means that ten tests in a row have reached the threshold on average or, if students of an SE
return less, their mean. Beside it stands what a bandit costs that copies a policy
(`experiments.null_baselines`, read when the table is made).
"""

import dataclasses
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import sejax
from experiments.common import curves, figures, tables
from experiments.common.agents import (
    OUTCOMES,
    Condition,
    Group,
    train_groups,
    training_as_learned,
    tuned_agent,
)
from experiments.common.experiment import Experiment, Settings, count, setting
from experiments.common.shards import read_rows, stack, unstack
from experiments.common.statistics import difference_interval, worst_tenth
from sejax import Proxy, Task, TrainingConfig, options
from sejax.options import each_of, registry, require
from sejax.proxies.header import pretrained_names

NUM_GROUPS = 5  # of agents: the CPU seconds of a group are one value
COUNTS = (100, 20)  # agents of each sort, pilots of each kind
COUNTS_OF = {"halfcheetah": (20, 5)}
# Kinds of tuned agents: for discrete and continuous actions, and of tables.
DISCRETE, CONTINUOUS, TABLES = (
    ("ddqn", "ppo", "sac"),
    ("td3", "sac", "ppo"),
    ("q_learning", "sarsa"),
)
MOST_STEPS = {  # of an agent on the real task or an RN; 100,000 elsewhere
    "cliff_walking": 5_000,
    "acrobot": 50_000,
    "pendulum": 50_000,
    "mountain_car_continuous": 150_000,
    "halfcheetah": 150_000,
}
TIMED = dataclasses.replace(OUTCOMES, is_timed=True)
KEPT = ["group", "agent", "train_steps", "test_return", "nonfinite", "cpu_s"]
# What is compared: agents that use the proxy, and those that do not.
PAIRS = {
    "break_even": ("student", "tuned"),
    "break_even_same": ("student", "same"),
    "break_even_tuned": ("tuned_student", "tuned"),
}
ROLES = ("student", "same", "tuned_student", "tuned")
SHOWN = ("agent", "steps_mean", "reached", "return_mean", "return_worst_tenth")
COSTS = ("of", "task", "learning_steps", "learning_cpu_s")
NULLS = ("by_hand", "best_of_four")
NULL_COLUMNS = ("source", "kind", "hparams", "real_steps", "test_return_mean", "cpu_s")
RUNS = {  # of NES, whose curves are drawn
    "cartpole": "results/se_feasibility/cartpole-one-step",
    "acrobot": "results/se_feasibility/acrobot-one-step",
    "halfcheetah": "results/se_feasibility/halfcheetah",
}
NEVER = float("inf")
GRID_POINTS = 60


@dataclass(frozen=True, kw_only=True)
class BreakEven(Settings):
    name = "break_even"

    # Proxies that ship with sejax.
    proxies: tuple[str, ...] = setting(
        tuple(pretrained_names()), each_of(pretrained_names()), quick=("cliff_walking-rn",)
    )
    # Agents of each sort, in five groups; 100, on HalfCheetah 20.
    num_agents: int | None = count(None, NUM_GROUPS, quick=10)
    # Of each kind that may be the fastest, and of learning curves; 20, on HalfCheetah 5.
    num_pilots: int | None = count(None, quick=2)
    max_steps: int | None = count(None, quick=3000)  # of an agent with real steps; by the task
    test_episodes: int = count(10)  # of each agent
    nulls: str = setting("results/null_baselines")  # folder of their summaries, by task
    pilot_seed: int = setting(500, options.seed())  # first seed of the pilots
    seed: int = setting(1000, options.seed())  # first seed of all others

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.pilot_seed != self.seed,
            "pilot_seed",
            f"must be another one than seed={self.seed}, as the pilots choose a kind of agents; "
            f"got {self.pilot_seed}. Set pilot_seed={self.seed + 1}.",
        )

    def counts(self, task: Task) -> tuple[int, int]:
        """How many agents of each sort, and how many pilots."""
        agents, pilots = COUNTS_OF.get(task.name, COUNTS)
        return self.num_agents or agents, self.num_pilots or pilots

    def limit(self, task: Task) -> int:
        """Training steps of an agent at most."""
        return self.max_steps or MOST_STEPS.get(task.name, 100_000)


def compute(settings: BreakEven) -> pd.DataFrame:
    """A row for each agent, learning curves of tuned agents, and what learning the proxies took."""
    agents, drawn, costs = [], [], []
    for name in settings.proxies:
        study = Study(settings, sejax.load_proxy(name))
        agents += [rows.assign(proxy=name) for rows in study.agents()]
        kind = agents[-1]["kind"].iloc[0]
        drawn.append(study.curves(kind).assign(proxy=name))
        costs.append(costs_of(name))
    rows = {"agents": pd.concat(agents), "curves": pd.concat(drawn), "costs": pd.DataFrame(costs)}
    return stack(rows)


def costs_of(name: str) -> dict[str, Any]:
    """What the card says of a proxy's run; nan for what it leaves open."""
    (card,) = (card for card in sejax.pretrained() if card.name == name)
    learning: Any = card.learning
    real_steps, cpu_s = (learning.real_steps, learning.cpu_s) if learning else (None, None)
    costs = {"learning_steps": real_steps, "learning_cpu_s": cpu_s}
    return {"proxy": name, "of": card.kind, "task": card.task, **costs}


class Study:
    """The agents that a proxy is judged by.

    Attributes:
      target: return at which agents stop; for an SE known when its students have been tested.
    """

    def __init__(self, settings: BreakEven, proxy: Proxy):
        self.settings, self.proxy = settings, proxy
        self.task: Task = proxy.env.task
        self.num_agents, self.num_pilots = settings.counts(self.task)
        self.target = float(self.task.solved_reward)
        self.kind, self.agent = next(
            (registry.name_of("agent", agent), agent)
            for agent in proxy.learned_agents().values()
            if not agent.is_solved_for
        )

    def agents(self) -> Iterator[pd.DataFrame]:
        """A row for each agent; the last ones are tuned ones on the real task."""
        proxy, is_rn = self.proxy, self.proxy.env.is_real
        learned = {"exploration": proxy.learned_with("exploration")} if is_rn else {}
        training = self.until_solved(sejax.training_of(proxy).time_limit_is_terminal)
        if is_rn:
            students = self.train("student", self.agent, True, training, **learned)
        else:
            fixed = training_as_learned(proxy, self.agent, self.settings.test_episodes)
            students = self.train("student", self.agent, True, fixed)
            self.target = min(self.target, float(students["test_return"].mean()))
            training = self.until_solved()
        yield self.labelled(students, "student", self.kind)
        same = self.train("same", self.agent, False, training, **learned)
        yield self.labelled(same, "same", self.kind)

        pilots = {}
        seed, pilot_seed = self.settings.seed, self.settings.pilot_seed
        settings = dataclasses.replace(self.settings, seed=pilot_seed, pilot_seed=seed)
        for kind in kinds_for(self.task):
            agent = tuned_agent(self.task.name, kind)
            training = self.until_solved()
            rows = self.train(f"pilot-{kind}", agent, False, training, settings, self.num_pilots)
            yield self.labelled(rows, "pilot", kind)
            pilots[kind] = rows["train_steps"].mean()
        kind = min(pilots, key=pilots.__getitem__)
        for role in ("tuned_student", "tuned") if is_rn else ("tuned",):
            agent, on_proxy = tuned_agent(self.task.name, kind), role == "tuned_student"
            rows = self.train(role, agent, on_proxy, self.until_solved())
            yield self.labelled(rows, role, kind)

    def curves(self, kind: str) -> pd.DataFrame:
        """Learning curves of tuned agents on the real task, thinned."""
        training = dataclasses.replace(self.until_solved(), stop_rule="never")
        condition = self.condition("curves", tuned_agent(self.task.name, kind), False, training, 1)
        rows = train_groups(condition, self.settings, self.num_pilots, curves.CURVES)
        grid = step_grid(self.settings.limit(self.task))
        return curves.thinned(rows.drop(columns="group"), grid, self.target)

    def until_solved(self, is_terminal: bool = False) -> TrainingConfig:
        """Training that ends when ten tests, one after each episode, reach the target."""
        most = self.settings.limit(self.task)
        return TrainingConfig(
            max_steps=most,
            max_episodes=most,
            stop_rule="solved",
            tests_between=1,
            test_episodes=self.settings.test_episodes,
            time_limit_is_terminal=is_terminal,
        )

    def train(
        self,
        name: str,
        agent: Any,
        on_proxy: bool,
        training: TrainingConfig,
        settings: BreakEven | None = None,
        num_agents: int | None = None,
        **more: Any,
    ) -> pd.DataFrame:
        """Agents in groups, on the proxy or on the task; pilots are one group."""
        num_groups = 1 if num_agents else NUM_GROUPS
        condition = self.condition(name, agent, on_proxy, training, num_groups, **more)
        each = num_agents or self.num_agents // num_groups
        return train_groups(condition, settings or self.settings, each, TIMED)

    def condition(
        self,
        name: str,
        agent: Any,
        on_proxy: bool,
        training: TrainingConfig,
        num_groups: int,
        **more: Any,
    ) -> Condition:
        proxy = self.proxy
        params, weights = (proxy.params, proxy.fingerprint) if on_proxy else (self.task.params, "")
        return Condition(
            name=f"{proxy.path.stem}-{name}",
            env=proxy.env if on_proxy else self.task.env,
            task=self.stopping_task,
            groups=tuple(Group(str(i), params, weights) for i in range(num_groups)),
            agent=agent,
            training=training,
            settings={"target": self.target, "proxy": proxy.path.stem if on_proxy else ""},
            **more,
        )

    @property
    def stopping_task(self) -> Task:
        """The real task, solved at the target."""
        return dataclasses.replace(self.task, solved_reward=self.target)

    def labelled(self, rows: pd.DataFrame, role: str, kind: str) -> pd.DataFrame:
        """What is kept of rows, and whose they are."""
        own = {"role": role, "kind": kind, "target": self.target}
        return rows[KEPT].assign(**own, most_steps=self.settings.limit(self.task))


def kinds_for(task: Task) -> tuple[str, ...]:
    """The kinds of agents of which the fastest one is taken."""
    if task.num_states is not None:
        return TABLES
    return CONTINUOUS if task.num_actions is None else DISCRETE


def step_grid(most_steps: int) -> np.ndarray:
    """Training steps at which learning curves are drawn, evenly on a logarithmic axis."""
    return np.unique(np.geomspace(most_steps / 500, most_steps, GRID_POINTS).round())


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


def summarise(rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each proxy; names of columns begin with the sort of agents that they tell of."""
    costs = unstack(rows, "costs").set_index("proxy")

    def statistics(mine: pd.DataFrame) -> dict[str, Any]:
        sorts = dict(list(mine.groupby("role", sort=False)))
        cost: Any = costs.loc[mine["proxy"].iloc[0]]
        found: dict[str, Any] = {name: cost.get(name, np.nan) for name in COSTS}
        found |= mine.iloc[-1][["target", "most_steps"]]
        real = {role: real_steps(each, cost["of"]) for role, each in sorts.items()}
        for role in ROLES:
            if role in sorts:
                found |= columns_of(sorts[role], real[role], role)
        for name, (user, other) in PAIRS.items():
            if user in sorts:
                paid = break_even(found["learning_steps"], real[other], real[user])
                found |= dict(zip((name, f"{name}_low", f"{name}_high"), paid, strict=True))
        cpu = {role: sorts[role].groupby("group")["cpu_s"].first() for role in PAIRS["break_even"]}
        paid = break_even(found["learning_cpu_s"], cpu["tuned"], cpu["student"])
        names = ("break_even_cpu", "break_even_cpu_low", "break_even_cpu_high")
        return found | dict(zip(names, paid, strict=True))

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


def with_nulls(summary: pd.DataFrame, folder: str) -> pd.DataFrame:
    """The summary with columns of the cheapest bandits that copy a policy; nan where none is known.

    Of each source that is the one that costs least of those on which students reach the target, or
    on which they return most where they reach it on none.
    """
    found = []
    for row in summary.itertuples():
        path = Path(folder, str(row.task), "summary.csv")
        own: dict[str, Any] = {}
        stored = pd.read_csv(path) if path.exists() else pd.DataFrame(columns=NULL_COLUMNS)
        mine = stored[(stored["kind"] == row.student_agent) & (stored["hparams"] == "default")]
        for source in NULLS:
            ones = mine[mine["source"] == source]
            good = ones[ones["test_return_mean"] >= row.target]
            order = (
                good.sort_values("real_steps")
                if len(good)
                else ones.sort_values("test_return_mean", ascending=False)
            )
            best = dict.fromkeys(NULL_COLUMNS, np.nan) if ones.empty else order.iloc[0]
            own |= {f"{source}_{x}": best[x] for x in NULL_COLUMNS[-3:]}
            own[f"{source}_break_even"] = best["real_steps"] / row.tuned_real_steps_mean
        found.append(own)
    return pd.concat([summary, pd.DataFrame(found, index=summary.index)], axis=1)


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

    def paid(name: str) -> Any:
        def text(row: Any) -> str:
            ends = (getattr(row, f"{name}{end}", np.nan) for end in ("", "_low", "_high"))
            return agents_text(*ends)

        return text

    def agents(role: str) -> Any:
        def text(row: Any) -> str:
            mine = {x: getattr(row, f"{role}_{x}", np.nan) for x in SHOWN}
            if pd.isna(mine["agent"]):
                return ""
            kind = figures.AGENT_NAMES[str(mine["agent"])]
            share = "" if role == "student" and row.of == "se" else f", {mine['reached']:.0%}"
            return (
                f"{kind}: {mine['steps_mean']:,.0f}{share}; {mine['return_mean']:,.1f} "
                f"({mine['return_worst_tenth']:,.1f})"
            )

        return text

    def null(source: str) -> Any:
        def text(row: Any) -> str:
            steps, value = (getattr(row, f"{source}_{x}") for x in NULL_COLUMNS[-3:-1])
            return "" if np.isnan(steps) else f"{steps:,.0f}; {value:,.1f}"

        return text

    return tables.as_texts(
        summary,
        {
            "proxy": "{proxy}",
            "real steps to learn it": lambda row: number(row.learning_steps),
            "students": agents("student"),
            "the same on the task": agents("same"),
            "tuned on the task": agents("tuned"),
            "tuned students": agents("tuned_student"),
            "agents until it pays": paid("break_even"),
            "beside the same": paid("break_even_same"),
            "by CPU seconds": paid("break_even_cpu"),
            "a bandit by hand": null("by_hand"),
            "a bandit of the best of four": null("best_of_four"),
        },
    )


def number(value: float) -> str:
    """A count; empty if it is not known."""
    return "" if np.isnan(value) else f"{value:,.0f}"


def report(settings: BreakEven, rows: pd.DataFrame) -> pd.DataFrame:
    summary = with_nulls(summarise(rows), settings.nulls)
    draw(settings, summary, unstack(rows, "curves"))
    most = summary["most_steps"].groupby(summary["task"]).first()
    limits = ", ".join(f"{name} {steps:,.0f}" for name, steps in most.items())
    note = (
        "Agents: kind: mean training steps until ten tests in a row reach the threshold (or the "
        "mean of an SE's students, if that is lower), the share that got there; mean return after "
        "it, and that of the worst tenth in parentheses. An agent that never gets there counts the "
        f"steps after which it was stopped: {limits}. Students of an SE train as long as in "
        "learning, and take no real step. Tests of agents are left out on both sides, those of "
        "learning the proxy count. Agents until it pays: real steps of learning over what an agent "
        "saves beside a tuned one on the task, in brackets Fieller's 95% interval over agents (CPU "
        "seconds: over five groups of agents); never: nothing is saved. Tuned agents are of the "
        "kind of preset=best that pilots of other seeds found fastest; tuned students are these on "
        "the RN. Bandits copy a policy (`experiments.null_baselines`): real steps to make one; "
        "return of students of the same kind. `summary.csv` has std, intervals and counts."
    )
    title = "From how many agents on a shipped proxy pays"
    return tables.publish(settings, title, make_table(summary), summary, note)


def draw(settings: BreakEven, summary: pd.DataFrame, learned: pd.DataFrame) -> None:
    """Draws returns against real steps that were spent, a panel for each proxy.

    Tuned agents on the task, NES runs where they are stored, and the proxy's students at its cost.
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
        named = {
            label: handle
            for axis in axes.flat
            for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
        }
        figure.legend(named.values(), named, ncols=2, loc="outside upper center", fontsize=9)


def panel(axis: Any, row: Any, learned: pd.DataFrame) -> None:
    """What one proxy costs, beside tuned agents and NES runs; bands hold half of them."""
    grid = step_grid(row.most_steps)
    held = curves.on_grid(learned, grid, window=1)
    figures.band(axis, grid, held, quartiles, figures.TUNED, label="tuned agents")
    lowest = np.nanmean(held, axis=0).min()
    path = Path(RUNS.get(row.task, ""), "rows.csv.xz")
    if row.of == "se" and path.is_file():
        spent, scores = scores_of_runs(read_rows(path))
        label = "NES incumbents (in-sample)"
        figures.band(axis, spent, scores, quartiles, figures.VARIED, label=label)
    how: dict[str, Any] = {"color": figures.FIXED, "ls": "", "ms": 7}
    cost = row.learning_steps
    axis.plot(cost, row.student_return_mean, "o", label="students of the proxy", **how)
    how["color"] = figures.BEST
    known = row.best_of_four_real_steps, row.best_of_four_test_return_mean
    axis.plot(*known, "^", label="students of a bandit", **how)
    figures.threshold(axis, row.target)
    axis.set(xscale="log", xlabel="real steps", title=row.proxy)
    axis.set_ylim(bottom=lowest - 0.05 * (row.target - lowest))


def scores_of_runs(runs: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """Incumbents' scores of NES runs `[run, point]` at real steps spent `[point]`.

    A run that has ended keeps its last score, as it ends when the task is solved.
    """
    each = [mine for _, mine in runs.groupby("seed")]
    first = max(mine["env_steps_total"].min() for mine in each)
    grid = np.geomspace(first, runs["env_steps_total"].max(), GRID_POINTS)
    places = [np.searchsorted(mine["env_steps_total"], grid, side="right") - 1 for mine in each]
    scores = [
        mine["incumbent_mean"].to_numpy()[place] for mine, place in zip(each, places, strict=True)
    ]
    return grid, np.stack(scores)


def quartiles(values: np.ndarray) -> np.ndarray:
    """The middle half of values `[agent, point]`: `[2, point]`."""
    return np.quantile(values, [0.25, 0.75], axis=0)


EXPERIMENT = Experiment(settings=BreakEven, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
