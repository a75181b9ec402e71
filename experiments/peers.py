"""Our SEs beside those of Liesen et al. (2024): the same students on both, like for like.

synthetic-gymnax has SEs of one step, as sejax has: `reward([state, action])` in the state
`initial_state(z)`. Agents of Stable-Baselines3, with the library's defaults and with RL Zoo's
settings, and agents of sejax, with default and with random hyperparameters, train on their SEs and
on those that ship here, and are tested on the real tasks. An agent of Stable-Baselines3 is tested
on the way (`benchmarks/stock_agents.py`); one of sejax is trained for each number of steps anew,
with the same keys. Their SEs of MuJoCo's tasks are of another physics, and are left out.

Their weights are not here: `theirs` is a folder with a file for each task, `cartpole.npz`, of their
checkpoint's arrays by name, `params/reward/Dense_0/kernel`.
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
from experiments.common.experiment import Experiment, Settings, count, setting
from experiments.common.shards import stack, unstack
from sejax import Task, envs
from sejax.options import each_of, require

OURS, THEIRS = "ours", "theirs"
BENCHMARKS = str(Path(__file__).parents[1] / "benchmarks")
STOCK = {True: ("ppo", "a2c", "dqn"), False: ("ppo", "a2c", "sac", "td3")}  # for discrete actions
STUDENTS = {
    "sb3_defaults": "SB3, defaults",
    "sb3_zoo": "SB3, RL Zoo's settings",
    "sejax_default": "sejax, defaults",
    "sejax_varied": "sejax, random hyperparameters",
}
GROUP = 5  # agents that are computed together


class Published(NamedTuple):
    """What synthetic-gymnax says of an SE, and what a generation of it takes.

    Attributes:
      file: stem of the file of its weights.
      generations: `num_generations` in its configuration.
      trainings: of a generation, each of 10,000 steps: the population's, and 64 on its mean with
        each algorithm.
      real_steps: of the 50 test episodes after a training, at most.
      cpu_s: of a generation on one core, estimated; docs/studies/peers.md says how.
    """

    file: str
    generations: int
    trainings: int
    real_steps: int
    cpu_s: float = np.nan


# Source: synthetic_gymnax/checkpoints/*/config.yaml of https://github.com/keraJLi/synthetic-gymnax
# at 43e6479.
PUBLISHED = {
    "cartpole_v1": Published("cartpole", 300, 128 + 3 * 64, 50 * 500),
    "acrobot": Published("acrobot", 100, 128 + 3 * 64, 50 * 500),
    "mountain_car": Published(
        "mountaincar", 1000, 128 + 3 * 64, 50 * 600
    ),  # the mean of a schedule
    "mountain_car_continuous": Published("continuous_mountaincar", 300, 128 + 4 * 64, 50 * 999),
    "pendulum": Published("pendulum", 1000, 8 * 64 + 4 * 64, 50 * 200),
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
    tasks: tuple[str, ...] = setting(tuple(PUBLISHED), each_of(tuple(PUBLISHED)))
    students: tuple[str, ...] = setting(tuple(STUDENTS), each_of(tuple(STUDENTS)))
    num_groups: int = count(4, quick=1)
    steps: tuple[int, ...] = setting((2000, 5000, 10_000), quick=(500,))
    finished: bool = setting(False)


def converted(path: Path, task: Task) -> tuple[Any, Any]:
    """The SE of synthetic-gymnax's weights as one of sejax: `(env, weights)`, equal up to rounding.

    sejax adds the noise z to the output of the network of initial states: units of relu(z) and
    relu(-z) take it off again.

    Raises:
      ConfigError: if there is no such file.
    """
    require(path.is_file(), "theirs", f"must be a folder with {path.name}; got {path.parent}. "
            "Set theirs=DIR.")  # fmt: skip
    with np.load(path) as stored:
        theirs = {name.removeprefix("params/"): x for name, x in stored.items()}
    noise = np.eye(task.obs_dim)
    kernels = {
        "reward/Dense_0": np.roll(theirs["reward/Dense_0/kernel"], task.action_dim, axis=0),
        "reward/Dense_1": theirs["reward/Dense_1/kernel"],
        "start/Dense_0": np.hstack([theirs["initial_state/Dense_0/kernel"], noise, -noise]),
        "start/Dense_1": np.vstack([theirs["initial_state/Dense_1/kernel"], -noise, noise]),
    }
    biases = {
        "reward/Dense_0": theirs["reward/Dense_0/bias"],
        "reward/Dense_1": theirs["reward/Dense_1/bias"],
        "start/Dense_0": np.pad(theirs["initial_state/Dense_0/bias"], (0, 2 * len(noise))),
        "start/Dense_1": theirs["initial_state/Dense_1/bias"],
    }
    flat = {f"{layer}/kernel": kernel.T for layer, kernel in kernels.items()}
    flat |= {f"{layer}/bias": bias for layer, bias in biases.items()}
    env = sejax.SyntheticConfig(
        hidden_size=len(biases["reward/Dense_0"]),
        activation="relu",
        start_hidden_size=len(biases["start/Dense_0"]),
    ).make(task)
    return env, unflatten_dict(flat, sep="/")


def compute(settings: Peers) -> pd.DataFrame:
    """Trains what is missing: a row for each agent and number of steps; and what SEs cost."""
    require(settings.theirs, "theirs", "must be a folder; got none. Set theirs=DIR.")
    found = []
    for name in settings.tasks:
        task = envs.make(name)
        env, weights = converted(Path(str(settings.theirs), f"{PUBLISHED[name].file}.npz"), task)
        file = settings.work_folder / f"{name}.safetensors"
        sejax.save(file, env, weights)
        for students, (se, source) in itertools.product(
            settings.students, {OURS: name, THEIRS: str(file)}.items()
        ):
            train = stock_students if students.startswith("sb3") else our_students
            for rows in train(settings, task, students, se, source):
                found.append(rows.assign(task=name, students=students, se=se))
    costs = [costs_of(name, se) for name, se in itertools.product(settings.tasks, (OURS, THEIRS))]
    return stack({"agents": pd.concat(found), "costs": pd.DataFrame(costs)})


def costs_of(name: str, se: str) -> dict[str, Any]:
    """What learning an SE took."""
    if se == OURS:
        learning = shipped(name).learning
        steps, real, cpu_s = learning.train_steps, learning.real_steps, learning.cpu_s
    else:
        own = PUBLISHED[name]
        trainings = own.generations * own.trainings
        steps, real = trainings * 10_000, trainings * own.real_steps
        cpu_s = own.generations * own.cpu_s
    return {"task": name, "se": se, "se_steps": steps, "real_steps": real, "cpu_h": cpu_s / 3600}


def stock_students(
    settings: Peers, task: Task, students: str, se: str, source: str
) -> Iterator[pd.DataFrame]:
    """Agents of Stable-Baselines3, a cached shard for each."""
    sys.path.append(BENCHMARKS)
    stock_agents = importlib.import_module("stock_agents")
    seeds = range(settings.seed, settings.seed + GROUP * settings.num_groups)
    for seed, kind in itertools.product(seeds, STOCK[task.num_actions is not None]):
        agent = kind.upper() if students == "sb3_defaults" else kind
        tests = (max(settings.steps), 10, settings.steps)
        training = stock_agents.Training(source, task.name, agent, seed, *tests)

        def train(training: Any = training) -> pd.DataFrame:
            table = pd.DataFrame(stock_agents.run(training), columns=stock_agents.COLUMNS)
            return table.rename(columns={"mean_return": "test_return"})[["steps", "test_return"]]

        name = f"{task.name}-{se}-{students}-{kind}-{seed}"
        if not settings.finished or settings.shards.path(name).exists():
            depends = training._asdict() | {"world": se}
            yield settings.shards.compute(name, depends, train).assign(kind=kind, seed=seed)


def our_students(
    settings: Peers, task: Task, students: str, se: str, source: str
) -> Iterator[pd.DataFrame]:
    """Agents of sejax, a cached shard for each five and each number of steps."""
    proxy = sejax.load_proxy(source)
    kinds = agents.DISCRETE if task.num_actions is not None else agents.CONTINUOUS
    for kind, steps in itertools.product(kinds, settings.steps):
        name = f"{task.name}-{se}-{students}-{kind}-{steps}"
        groups = [str(i) for i in range(settings.num_groups)]
        if settings.finished:
            groups = [x for x in groups if settings.shards.path(f"{name}-{x}").exists()]
        condition = Condition(
            name=name,
            env=proxy.env,
            task=task,
            groups=tuple(Group.of(group, proxy) for group in groups),
            agent=agents.agent_config(kind),
            training=sejax.TrainingConfig(max_steps=steps, max_episodes=steps),
            hparams=students.removeprefix("sejax_"),
            settings={"se": se},
        )
        if groups:
            rows = agents.train_groups(condition, settings, GROUP)
            seeds = settings.seed + GROUP * rows["group"].astype(int) + rows["agent"]
            yield rows[["test_return"]].assign(seed=seeds, steps=steps, kind=kind)


def summarise(rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each task, sort of students and algorithm, and for all algorithms of a sort.

    Columns begin with whose SEs they are of, and end with the steps: `ours_mean_2000`.
    """
    students, costs = unstack(rows, "agents"), unstack(rows, "costs").set_index(["task", "se"])

    def statistics(mine: pd.DataFrame) -> dict[str, Any]:
        solved_reward = envs.make(mine["task"].iloc[0]).solved_reward
        columns: dict[str, Any] = {}
        for (se, steps), returns in mine.groupby(["se", "steps"])["test_return"]:
            measured = {
                "num": len(returns),
                "mean": returns.mean(),
                "median": returns.median(),
                "worst": returns.min(),
                "solved": (returns >= solved_reward).mean(),
            }
            columns |= {f"{se}_{name}_{steps:.0f}": value for name, value in measured.items()}
            columns |= {
                f"{se}_{name}": x for name, x in costs.loc[mine["task"].iloc[0], se].items()
            }
        return columns

    each = pd.concat([students.assign(kind=ALL), students])
    summary = tables.summary_by(each, ["task", "students", "kind"], statistics)
    return summary.sort_values(["task", "students"], kind="stable", key=in_order)


def in_order(column: pd.Series) -> pd.Series:
    """The places of tasks and of sorts of students in this page."""
    return column.map([*PUBLISHED, *STUDENTS].index)


def report(settings: Peers, rows: pd.DataFrame) -> pd.DataFrame:
    summary = summarise(rows)
    draw(settings, unstack(rows, "agents"))
    fewer, most = settings.steps[:-1], settings.steps[-1]
    columns: dict[str, Any] = {
        "task": "{task}",
        "students": lambda row: STUDENTS[row.students],
        "algorithm": lambda row: figures.agent_name(row.kind) if row.kind != ALL else ALL,
    }
    for se in (OURS, THEIRS):
        columns[f"{se}: agents"] = f"{{{se}_num_{most}:.0f}}"
        columns |= {f"mean after {steps:,}, {se}": f"{{{se}_mean_{steps}:,.1f}}" for steps in fewer}
        columns[f"mean after {most:,} (median, worst; solved), {se}"] = (
            f"{{{se}_mean_{most}:,.1f}} ({{{se}_median_{most}:,.1f}}, {{{se}_worst_{most}:,.1f}}; "
            f"{{{se}_solved_{most}:.0%}})"
        )
    table = tables.as_texts(summary, columns)
    note = (
        "Scores: mean return of ten episodes of the real task after so many steps on the SE, over "
        "agents. All: the agents of all algorithms together."
    )
    title = "The same students on our SEs and on synthetic-gymnax's"
    return tables.publish(settings, title, table, summary, note)


def draw(settings: Peers, students: pd.DataFrame) -> None:
    """Draws what every agent scores after most steps: a panel for each task."""
    last = students[students["steps"] == students["steps"].max()]
    names, colors = list(last["task"].unique()), {OURS: figures.FIXED, THEIRS: figures.REAL}
    size = (1.0 + 2.4 * len(names), 3.2)
    with figures.panels(settings.folder / "peers.png", 1, len(names), size) as (figure, axes):
        for axis, name in zip(axes[0], names, strict=True):
            here = last[last["task"] == name]
            for (side, (se, color)), (place, sort) in itertools.product(
                zip((-0.18, 0.18), colors.items(), strict=True), enumerate(STUDENTS)
            ):
                returns = here[(here["se"] == se) & (here["students"] == sort)]["test_return"]
                spread = place + side + np.linspace(-0.12, 0.12, len(returns))
                label = f"on {se}" if place == 0 else None
                axis.plot(spread, returns, "o", ms=2.5, alpha=0.5, color=color, label=label)
                if len(returns):
                    axis.hlines(returns.mean(), place + side - 0.15, place + side + 0.15, color)
            figures.threshold(axis, envs.make(name).solved_reward, "solved")
            shown = [
                text.replace(", ", "\n").replace(" hyper", "\nhyper") for text in STUDENTS.values()
            ]
            axis.set_xticks(range(len(STUDENTS)), shown, fontsize=7, rotation=40)
            axis.set_title(name, fontsize=10)
        axes[0, 0].set_ylabel("score of an agent")
        figures.legend_above(figure, axes[0, 0])


ALL = "all"
EXPERIMENT = Experiment(settings=Peers, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
