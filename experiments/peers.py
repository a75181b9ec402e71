"""Our SEs beside those of Liesen et al. (2024): the same students on both, like for like.

synthetic-gymnax has SEs of one step, as sejax has: the reward of an action in the state
`initial_state(z)`, of normal noise z. Agents of Stable-Baselines3, with the library's defaults and
with RL Zoo's settings, and agents of sejax, with default and with random hyperparameters, train on
their SEs and on those that ship here, and are tested on the real tasks. An agent of
Stable-Baselines3 is tested on the way (`benchmarks/stock_agents.py`, which needs `pip install
'sejax[bench]'`); one of sejax is trained for each number of steps anew, with the same keys. Their
SEs of MuJoCo's tasks are of another physics, and are left out.

Their weights are not stored here: `theirs` is a folder with the arrays of each checkpoint as
`cartpole.npz`, by names like `params/reward/Dense_0/kernel`.
"""

import importlib
import itertools
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from flax.traverse_util import unflatten_dict

import sejax
from experiments.common import agents, figures, tables
from experiments.common.agents import Condition, Group, shipped
from experiments.common.experiment import Experiment, Settings, setting
from experiments.common.shards import stack, unstack
from sejax import Task, envs
from sejax.ops.scores import reaches
from sejax.options import ConfigError, Count, require

BENCHMARKS = str(Path(__file__).parents[1] / "benchmarks")
STOCK = {True: ("ppo", "a2c", "dqn"), False: ("ppo", "a2c", "sac", "td3")}  # for discrete actions
STUDENTS = {
    "sb3_defaults": "SB3, defaults",
    "sb3_zoo": "SB3, RL Zoo's settings",
    "sejax_default": "sejax, defaults",
    "sejax_varied": "sejax, random hyperparameters",
}
SES = {"ours": figures.FIXED, "theirs": figures.REAL}
GROUP = 5  # agents of sejax that are computed together
ALL = "all"  # algorithms


class Published(NamedTuple):
    """What learning an SE of synthetic-gymnax took.

    Attributes:
      file: stem of the file of its weights.
      generations: of its configuration.
      trainings: of a generation, of 10,000 steps each, on the population; 64 more with each
        algorithm on the search mean are only logged, and left out.
      real_steps: of the 50 test episodes after a training, at most.
      cpu_s: of these trainings on one core: an estimate, of four trainings of each algorithm at the
        published weights that were timed in one batch, with their script and purerl at 2d0e75d.
    """

    file: str
    generations: int
    trainings: int
    real_steps: int
    cpu_s: float


# Source: synthetic_gymnax/checkpoints/*/config.yaml of https://github.com/keraJLi/synthetic-gymnax
# at 43e6479. The limit of MountainCar's episodes falls from 1,000 to 200 steps: 600 on average.
PUBLISHED = {
    "cartpole_v1": Published("cartpole", 300, 128, 50 * 500, 119),
    "acrobot": Published("acrobot", 100, 128, 50 * 500, 132),
    "mountain_car": Published("mountaincar", 1000, 128, 50 * 600, 127),
    "mountain_car_continuous": Published("continuous_mountaincar", 300, 128, 50 * 999, 269),
    "pendulum": Published("pendulum", 1000, 512, 50 * 200, 944),
}
# Steps before which agents have not learned once, by students, algorithm and task; 0 elsewhere.
BEFORE_LEARNING = {
    **{("sb3_defaults", "ppo", task): 2048 for task in PUBLISHED},
    **{("sb3_zoo", "ppo", task): 4096 for task in ("acrobot", "pendulum")},
    ("sb3_zoo", "td3", "pendulum"): 10_000,
}


@dataclass(frozen=True, kw_only=True)
class Peers(Settings):
    """Settings of this experiment.

    Attributes:
      theirs: folder of synthetic-gymnax's weights
      tasks: tasks of the SEs
      students: agents that learn on them
      num_groups: groups of five agents of each algorithm
      steps: of a training, after which agents are tested
      finished: Report what is finished, and train nothing.
    """

    name = "peers"

    theirs: str | None = setting(None)
    tasks: tuple[str, ...] = setting(tuple(PUBLISHED), PUBLISHED)
    students: tuple[str, ...] = setting(tuple(STUDENTS), STUDENTS)
    num_groups: Count = setting(4, quick=1)
    steps: tuple[int, ...] = setting((2000, 5000, 10_000), quick=(500,))
    finished: bool = setting(False)

    def is_wanted(self, shard: str) -> bool:
        """Whether a shard is to be read, or computed."""
        return not self.finished or self.shards.path(shard).exists()


def converted(path: Path, task: Task) -> tuple[Any, Any]:
    """The SE of synthetic-gymnax's weights as one of sejax: `(env, weights)`, equal up to rounding.

    sejax adds the noise z to the output of the network of initial states: units of relu(z) and
    relu(-z) take it off again.

    Raises:
      ConfigError: if there is no such file.
    """
    must = f"must be a folder with {path.name}; got {path.parent}. Set theirs=DIR."
    require(path.is_file(), "theirs", must)
    with np.load(path) as stored:
        theirs = {name.removeprefix("params/"): x for name, x in stored.items()}
    noise = np.eye(task.obs_dim)
    first, start = theirs["reward/Dense_0/kernel"], theirs["initial_state/Dense_0/kernel"]
    weights = {name: x.T for name, x in theirs.items() if name.startswith("reward")}
    weights |= {
        "reward/Dense_0/kernel": np.roll(first, task.action_dim, axis=0).T,  # actions come first
        "start/Dense_0/kernel": np.hstack([start, noise, -noise]).T,
        "start/Dense_0/bias": np.pad(theirs["initial_state/Dense_0/bias"], (0, 2 * len(noise))),
        "start/Dense_1/kernel": np.vstack(
            [theirs["initial_state/Dense_1/kernel"], -noise, noise]
        ).T,
        "start/Dense_1/bias": theirs["initial_state/Dense_1/bias"],
    }
    units = {"hidden_size": first.shape[1], "start_hidden_size": start.shape[1] + 2 * len(noise)}
    env = sejax.SyntheticConfig(activation="relu", **units).make(task)
    return env, unflatten_dict(weights, sep="/")


def compute(settings: Peers) -> pd.DataFrame:
    """Trains what is missing: a row for each agent and number of steps, and one for each task."""
    students, costs = [], []
    for name in settings.tasks:
        task, published = envs.make(name), PUBLISHED[name]
        file = settings.work_folder / f"{name}.safetensors"
        sejax.save(file, *converted(Path(settings.theirs or "", f"{published.file}.npz"), task))
        sources = dict(zip(SES, (name, str(file)), strict=True))
        for sort, (se, source) in itertools.product(settings.students, sources.items()):
            train = stock_students if sort.startswith("sb3") else our_students
            trained = train(settings, task, sort, se, source)
            students += [rows.assign(task=name, students=sort, se=se) for rows in trained]
        trainings, learned = published.generations * published.trainings, shipped(name).learning
        costs.append(
            {
                "task": name,
                "ours_se_steps": learned.train_steps,
                "ours_real_steps": learned.real_steps,
                "ours_cpu_hours": learned.cpu_s / 3600,
                "theirs_se_steps": trainings * 10_000,
                "theirs_real_steps": trainings * published.real_steps,
                "theirs_cpu_hours": published.generations * published.cpu_s / 3600,
            }
        )
    return stack({"students": pd.concat(students), "costs": pd.DataFrame(costs)})


def stock_students(
    settings: Peers, task: Task, sort: str, se: str, source: str
) -> Iterator[pd.DataFrame]:
    """Agents of Stable-Baselines3, a cached shard for each.

    Raises:
      ConfigError: without that library.
    """
    sys.path.append(BENCHMARKS)
    try:
        stock_agents = importlib.import_module("stock_agents")
    except ImportError as error:
        fix = "Type pip install 'sejax[bench]', or set students=[sejax_default,sejax_varied]."
        raise ConfigError("students", "must be installed", got=error, fix=fix) from error
    fingerprint = sejax.load_proxy(source).fingerprint
    seeds = range(settings.seed, settings.seed + GROUP * settings.num_groups)
    for seed, kind in itertools.product(seeds, STOCK[task.num_actions is not None]):
        agent = kind.upper() if sort == "sb3_defaults" else kind
        tests = max(settings.steps), 10, settings.steps
        training = stock_agents.Training(source, task.name, agent, seed, *tests)

        def train(training: Any = training) -> pd.DataFrame:
            table = pd.DataFrame(stock_agents.run(training), columns=stock_agents.COLUMNS)
            return table.rename(columns={"mean_return": "test_return"})[["steps", "test_return"]]

        shard = f"{task.name}-{se}-{sort}-{kind}-{seed}"
        if settings.is_wanted(shard):
            depends = training._asdict() | {"world": se, "fingerprint": fingerprint}
            yield settings.shards.compute(shard, depends, train).assign(kind=kind, seed=seed)


def our_students(
    settings: Peers, task: Task, sort: str, se: str, source: str
) -> Iterator[pd.DataFrame]:
    """Agents of sejax, a cached shard for each group and number of steps."""
    proxy = sejax.load_proxy(source)
    kinds = agents.CONTINUOUS if task.num_actions is None else agents.DISCRETE
    for kind, steps in itertools.product(kinds, settings.steps):
        name = f"{task.name}-{se}-{sort}-{kind}-{steps}"
        groups = [str(i) for i in range(settings.num_groups) if settings.is_wanted(f"{name}-{i}")]
        condition = Condition(
            name=name,
            env=proxy.env,
            task=task,
            groups=tuple(Group.of(group, proxy) for group in groups),
            agent=agents.agent_config(kind),
            training=sejax.TrainingConfig(max_steps=steps, max_episodes=steps),
            hparams=sort.removeprefix("sejax_"),
            settings={"se": se},
        )
        if groups:
            rows = agents.train_groups(condition, settings, GROUP)
            seeds = settings.seed + GROUP * rows["group"].astype(int) + rows["agent"]
            yield rows[["test_return"]].assign(seed=seeds, steps=steps, kind=kind)


MEASURES = ("mean", "median", "worst", "solved", "agents")
CELL = (
    "{SE_mean_N:,.1f} ({SE_median_N:,.1f}, {SE_worst_N:,.1f}; {SE_solved_N:.0%} of "
    "{SE_agents_N:.0f})"
)


def summarise(rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each task, sort of students and algorithm, and for all algorithms of a sort.

    Columns begin with whose SEs they are of, and end with the steps: `ours_mean_2000`.
    """
    students = unstack(rows, "students")
    by = ["students", "kind", "task"]
    is_on_both = students.groupby([*by, "seed", "steps"])["se"].transform("nunique") == len(SES)
    least = [BEFORE_LEARNING.get(cell, 0) for cell in students[by].itertuples(index=False)]
    students = students.assign(least=least)[is_on_both]
    of_all = students.groupby(["students", "task"])["least"].transform("max")
    students, all_kinds = (students[students["steps"] > x] for x in (students["least"], of_all))

    def statistics(mine: pd.DataFrame) -> dict[str, Any]:
        name = mine["task"].iloc[0]
        columns: dict[str, Any] = {"label": STUDENTS[mine["students"].iloc[0]]}
        for (se, steps), returns in mine.groupby(["se", "steps"])["test_return"]:
            solved = reaches(returns, envs.make(name).solved_reward).mean()
            values = returns.mean(), returns.median(), returns.min(), solved, len(returns)
            for measure, value in zip(MEASURES, values, strict=True):
                columns[f"{se}_{measure}_{steps:.0f}"] = value
        return columns

    both = pd.concat([all_kinds.assign(kind=ALL), students])
    return tables.summary_by(both, ["task", "students", "kind"], statistics)


def report(settings: Peers, rows: pd.DataFrame) -> pd.DataFrame:
    summary = summarise(rows)
    draw(settings, summary)
    columns: dict[str, Any] = {
        "task": "{task}",
        "students": "{label}",
        "algorithm": lambda row: row.kind if row.kind == ALL else figures.agent_name(row.kind),
    }
    for steps, se in itertools.product(settings.steps, SES):
        columns[f"{se}, {steps:,} steps"] = CELL.replace("SE", se).replace("N", str(steps))
    note = (
        "Mean returns of agents after so many steps on the SE, in ten episodes of the real task; "
        "median and worst agent, share that solves the task and number of agents. All: the agents "
        "of all algorithms together, once each has learned. Empty: before the first update."
    )
    title = "The same students on our SEs and on synthetic-gymnax's"
    table = tables.as_texts(summary, columns).replace("^nan.*", "", regex=True)
    return tables.publish(settings, title, table, summary, note)


def draw(settings: Peers, summary: pd.DataFrame) -> None:
    """Draws mean scores against steps on the SE, a panel for each task."""
    tasks = dict(list(summary[summary["kind"] == ALL].groupby("task", sort=False)))
    size = (1.0 + 2.4 * max(len(tasks), 4), 3.4)  # four columns of labels fit
    with figures.panels(settings.folder / "peers.png", 1, len(tasks), size) as (figure, axes):
        for axis, (name, sorts) in zip(axes[0], tasks.items(), strict=True):
            for row, (se, color) in itertools.product(sorts.itertuples(), SES.items()):
                means = [getattr(row, f"{se}_mean_{steps}", np.nan) for steps in settings.steps]
                style = dict(zip(STUDENTS, ("o-", "s--", "^:", "v-."), strict=True))[row.students]
                axis.plot(settings.steps, means, style, color=color, label=f"{row.label}: {se}")
            figures.threshold(axis, envs.make(name).solved_reward)
            axis.set(title=name, xlabel="steps on the SE")
        axes[0, 0].set_ylabel("mean score on the task")
        figures.legend_above(figure, axes[0, 0])


EXPERIMENT = Experiment(settings=Peers, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
