"""What does as well as an evolved SE: bandits that copy a policy, and what each of them costs.

A one-step SE is a contextual bandit, so that its reward is a policy. Here agents train on bandits
that copy a policy, beside the SE that ships with sejax:

- `by_hand`: a controller in one line, no step of the real task;
- `agent`: an agent that trained on the real task for few steps;
- `episodes`: ten test episodes of that agent, and no other state (behaviour cloning's data);
- `search`: a linear policy found by augmented random search, with at most the steps of the SE;
- `evolved`: the shipped SE.

Each is tested with the same students, and the policy that is copied is tested itself. Costs stand
beside returns: real steps (tests included) and CPU seconds of making the proxy. Of the agents the
best of each four is shown too, by its own tests, at the cost of four.
"""

import functools
import hashlib
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

import sejax
from experiments.common import agents, bandits, figures, tables
from experiments.common.agents import Condition, Group, shipped
from experiments.common.experiment import Experiment, Settings, setting
from experiments.common.shards import stack, unstack
from experiments.common.statistics import worst_tenth
from sejax import envs
from sejax.ops.scores import reaches
from sejax.options import Count, Positive

HPARAMS = ("varied", "default")
SOURCES = ("by_hand", "agent", "episodes", "search", "evolved")
# Two kinds of teachers for each task, and their real steps: guesses, made on other
# seeds. How well a teacher has learned stands in the table.
TEACHERS: dict[str, dict[str, int]] = {
    "cartpole": {"ppo": 5_000, "ddqn": 8_000},
    "cartpole_v1": {"ppo": 10_000, "ddqn": 15_000},
    "acrobot": {"ppo": 8_000, "ddqn": 10_000},
    "mountain_car": {"ddqn": 40_000, "sac": 40_000},
    "mountain_car_continuous": {"td3": 32_000, "ppo": 32_000},
    "pendulum": {"td3": 8_000, "sac": 8_000},
    "halfcheetah": {"td3": 50_000, "sac": 50_000},
}
COSTS = ("real_steps", "cpu_s", "policy_return")  # of a proxy, and what its policy reaches
STUDENT_STEPS = {"pendulum": 10_000, "halfcheetah": 10_000}  # 2,000 elsewhere


@dataclass(frozen=True, kw_only=True)
class NullBaselines(Settings):
    """Settings of this experiment.

    Attributes:
      env: the task
      sources: what makes the proxies
      students: kinds of agents; all that fit the task
      hparams: Hyperparameters of the students; varied: drawn for each.
      policies: of each source and kind of teacher
      num_agents: of each kind on each proxy
      num_evolved: agents of each kind on the shipped SE
      steps: of a student; 2,000, more on hard tasks
      shares: Students with default hyperparameters also train for these shares of the steps.
      teacher_steps: of a teacher; by the task
      search_steps: Real steps of a search, at most; those of the shipped SE.
      num_states: of a table
      states: States of a table. visited: half of them, half drawn around these; noise: as those in
        which episodes of the task's SEs begin. Those of `episodes` are visited ones.
      widen: spread of those around visited states
    """

    name = "null_baselines"

    env: str = setting("cartpole", tuple(TEACHERS))
    sources: tuple[str, ...] = setting(SOURCES, SOURCES)
    students: tuple[str, ...] = setting(())
    hparams: tuple[str, ...] = setting(HPARAMS, HPARAMS, quick=("default",))
    policies: Count = setting(12, quick=2)
    num_agents: Count = setting(5, quick=2)
    num_evolved: Count = setting(20, quick=2)
    steps: Count | None = setting(None, quick=500)
    shares: tuple[float, ...] = setting((0.125, 0.25, 0.5), quick=(0.5,))
    teacher_steps: Count | None = setting(None, quick=500)
    search_steps: Count | None = setting(None, quick=5_000)
    num_states: Count = setting(1024)
    states: str = setting("visited", ("visited", "noise"))
    widen: Positive = setting(1.5)

    @property
    def task(self) -> envs.Task:
        """The real task."""
        return envs.make(self.env)

    @property
    def spread(self) -> float:
        """Of a table's states around visited ones, for `bandits.copy`."""
        return np.inf if self.states == "noise" else self.widen

    @property
    def budgets(self) -> list[int]:
        """Steps of students, the most at last."""
        most = self.steps or STUDENT_STEPS.get(self.env, 2_000)
        return [*sorted(max(1, int(most * share)) for share in self.shares), most]

    @property
    def most_search_steps(self) -> int:
        """Real steps of a search: as many as the SE took that ships with sejax."""
        learning = getattr(shipped(self.env), "learning", None)
        return self.search_steps or (learning.real_steps if learning else 1_000_000)


def teachers(settings: NullBaselines, source: str) -> Iterator[tuple[str, Callable[[], Any]]]:
    """The policies that a source copies: the name of each, and what makes the teacher."""
    task = settings.task
    makes: dict[str, Callable[..., Any]] = {}  # teachers of a seed, by the beginning of their names
    if source == "by_hand" and settings.env in bandits.BY_HAND:
        makes["hand"] = functools.partial(bandits.by_hand, task)
    if source == "search":
        makes["ars"] = functools.partial(bandits.search_teacher, task, settings.most_search_steps)
    if source in ("agent", "episodes"):
        for kind, steps in TEACHERS[settings.env].items():
            config, steps = agents.tuned_agent(settings.env, kind), settings.teacher_steps or steps
            makes[kind] = functools.partial(bandits.trained, task, config, steps)
    seeds = range(settings.seed, settings.seed + settings.policies)
    for (name, make), seed in itertools.product(makes.items(), seeds):
        yield f"{name}-{seed:02d}", functools.partial(make, seed)


def make_table(settings: NullBaselines, source: str, name: str, make: Callable[[], Any]) -> Any:
    """The rows of one table, a cached shard: states `s0...`, actions `a0...`, and its costs."""
    names = ("seed", "num_states", "states", "widen", "teacher_steps")
    depends = settings.values(*names) | {"env": settings.env, "source": source, "name": name}
    if source == "search":
        depends["search_steps"] = settings.most_search_steps

    def compute() -> pd.DataFrame:
        widen = 0.0 if source == "episodes" else settings.spread
        copied = bandits.copy(settings.task, make(), settings.num_states, widen)
        actions = copied.actions.reshape(len(copied.actions), -1)
        columns = {f"s{i}": x for i, x in enumerate(copied.states.T)}
        columns |= {f"a{i}": x for i, x in enumerate(actions.T)}
        return pd.DataFrame(columns | {name: getattr(copied, name) for name in COSTS})

    return settings.shards.compute(f"table-{source}-{name}", depends, compute)


def as_group(env: bandits.PolicyBandit, name: str, rows: pd.DataFrame) -> Group:
    """The bandit that rows of `make_table` describe."""
    states = rows.filter(regex=r"^s\d").to_numpy(np.float32)
    actions = rows.filter(regex=r"^a\d").to_numpy(np.float32)
    if env.task.num_actions is not None:
        actions = actions[:, 0].astype(np.int32)
    digest = hashlib.sha256(states.tobytes() + actions.tobytes()).hexdigest()[:12]
    return Group(name, env.params({"states": states, "actions": actions}), digest)


def compute(settings: NullBaselines) -> pd.DataFrame:
    """Makes the proxies and trains students on them: `makers` and `students`."""
    bandit = bandits.PolicyBandit(settings.task)
    makers: list[dict[str, Any]] = []
    students = []
    for source in settings.sources:
        env: Any = bandit
        groups, num_agents = [], settings.num_agents
        for name, make in teachers(settings, source):
            rows = make_table(settings, source, name, make)
            groups.append(as_group(bandit, name, rows))
            makers.append({"source": source, "group": name, **rows.iloc[0][list(COSTS)]})
        if source == "evolved" and (card := shipped(settings.env)):
            proxy, num_agents = sejax.load_proxy(settings.env), settings.num_evolved
            env, groups = proxy.env, [Group.of("shipped", proxy)]
            costs = {name: getattr(card.learning, name, np.nan) for name in COSTS}
            makers.append({"source": source, "group": "shipped", **costs})
        if groups:
            students.append(train_students(settings, source, env, groups, num_agents))
    return stack({"makers": pd.DataFrame(makers), "students": pd.concat(students)})


def train_students(
    settings: NullBaselines, source: str, env: Any, groups: list[Group], num_agents: int
) -> pd.DataFrame:
    """Agents of each kind on each proxy of a source, a row for each agent and number of steps."""
    *fewer, most = settings.budgets
    budgets = [("default", steps) for steps in fewer if "default" in settings.hparams]
    budgets += [(hparams, most) for hparams in settings.hparams]
    found = []
    for kind, (hparams, steps) in itertools.product(agents.kinds_of_students(settings), budgets):
        condition = Condition(
            name=f"{source}-{kind}-{hparams}-{steps}",
            env=env,
            task=settings.task,
            groups=tuple(groups),
            agent=sejax.config([f"env={settings.env}", f"agent={kind}"]).agent,
            training=sejax.TrainingConfig(max_steps=steps, max_episodes=steps, stop_rule="never"),
            hparams=hparams,
            settings={"source": source},
        )
        rows = agents.train_groups(condition, settings, num_agents)
        found.append(rows.assign(source=source, kind=kind, hparams=hparams, steps=steps))
    return pd.concat(found, ignore_index=True)


def best_of_four(made: pd.DataFrame) -> pd.DataFrame:
    """Of each four agents the one whose own tests were best, at the cost of all four.

    Args:
      made: a row for each proxy, of all sources.

    Returns:
      Further rows, of the source `best_of_four`.
    """
    found = []
    for _, mine in made[made["source"] == "agent"].groupby("teacher", sort=False):
        for first in range(0, len(mine) - 3, 4):
            four = mine.iloc[first : first + 4]
            best = four.loc[four["policy_return"].idxmax()]
            costs = four[["real_steps", "cpu_s"]].sum()
            found.append({**best, **costs, "source": "best_of_four"})
    return pd.DataFrame(found, columns=made.columns)


def summarise(settings: NullBaselines, rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each source, teacher, kind of student and of hyperparameters."""
    made, students = unstack(rows, "makers"), unstack(rows, "students")
    made = made.reindex(columns=["source", "group", *COSTS])  # of SEs alone no policy's return
    made["teacher"] = made["group"].str.partition("-")[0]
    chosen = best_of_four(made)
    best = students[(students["source"] == "agent") & students["group"].isin(chosen["group"])]
    made = pd.concat([made, chosen], ignore_index=True)
    students = pd.concat([students, best.assign(source="best_of_four")])
    students = students.merge(made[["source", "group", "teacher"]], on=["source", "group"])
    costs = made.groupby(["source", "teacher"])[list(COSTS)].mean()
    most, solved_reward = settings.budgets[-1], settings.task.solved_reward

    def statistics(mine: pd.DataFrame) -> dict[str, float]:
        last = mine[mine["steps"] == most]
        returns = last["test_return"]
        solves = mine["steps"].where(reaches(mine["test_return"], solved_reward), np.inf)
        steps = solves.groupby([mine["group"], mine["agent"]]).min().median()  # of equal seeds
        return tables.mean_columns(returns, "test_return", last["group"]) | {
            "median": returns.median(),
            "worst_tenth": worst_tenth(returns),
            "worst": returns.min(),
            "solved": reaches(returns, solved_reward).mean(),
            "median_steps_until_solved": steps if settings.shares else np.nan,
            "num_proxies": last["group"].nunique(),
            "num_agents": len(last),
        }

    students = students.sort_values("source", key=lambda x: x.map(list(NAMES).index), kind="stable")
    by = ["source", "teacher", "kind", "hparams"]
    return tables.summary_by(students, by, statistics).join(costs, on=["source", "teacher"])


NAMES = {
    "by_hand": "by hand",
    "agent": "one agent",
    "best_of_four": "best of four",
    "episodes": "ten episodes",
    "search": "random search",
    "evolved": "evolved SE",
}


def report(settings: NullBaselines, rows: pd.DataFrame) -> pd.DataFrame:
    summary = summarise(settings, rows)
    shown = []
    by = ["source", "teacher", "hparams"]
    for (source, teacher, hparams), mine in summary.groupby(by, sort=False):
        first = mine.iloc[0]
        cells = {
            figures.agent_name(str(row.kind)): f"{row.test_return_mean:,.1f} ({row.solved:.0%})"
            for row in mine.itertuples()
        }
        costs = {
            "SE of": label(source, teacher),
            "real steps": tables.steps_text(first["real_steps"]),
            "CPU s": f"{first['cpu_s']:,.2f}" if first["cpu_s"] >= 0.01 else "< 0.01",
            "the policy itself": tables.known_text(first["policy_return"], ",.1f"),
            "hyperparameters": "random" if hparams == "varied" else hparams,
        }
        shown.append(costs | cells)
    table = pd.DataFrame(shown)
    note = (
        f"Cells: mean return of fresh agents after {settings.budgets[-1]:,} steps on the SE (share "
        f"that solves the task, {settings.task.solved_reward:g}). Real steps of making one SE have "
        "tests in them, CPU seconds of SEs of policies neither tests nor compilation. Costs of the "
        "best of four are those of all four."
    )
    spread = {np.inf: " in wide states", 0.5: " in narrow states"}.get(settings.spread, "")
    title = f"What does as well{spread} as an SE on {settings.env}"
    return tables.publish(settings, title, table, summary, note)


def label(source: str, teacher: str) -> str:
    """A source as people write it, with its kind of teacher."""
    if source == "evolved":
        return f"{NAMES[source]} ({teacher})"
    is_taught = source in ("agent", "best_of_four", "episodes")
    return NAMES[source] + (f": {figures.agent_name(teacher)}" if is_taught else "")


EXPERIMENT = Experiment(settings=NullBaselines, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
