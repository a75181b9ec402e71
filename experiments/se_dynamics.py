"""Which SEs are environments in earnest, and what does that cost beside a bandit?

Kinds of SEs that may teach through their dynamics are learned with the same agents and strategy,
beside the bandit of `preset=best`: with soft ends, which are handed over as a discount; with the
same as probabilities (`bernoulli`); with ends at a threshold, which no episode of `shortest` has
before a tenth of the task's step limit; and with ten steps an episode at most. With ends at a
threshold, SEs are learned from two, three and four algorithms at once too. The best SE of each run
then trains fresh agents of several kinds, and takes the myopia test (`se_myopia`): what agents of
the alphabetically first algorithm that it was learned with learn on it with smaller discounts.

All agents are sejax's. Those of others do not see the discount that soft ends are handed over as.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import sejax
from experiments import se_myopia
from experiments.common import agents, figures, runs, tables
from experiments.common.agents import Condition, Group
from experiments.common.experiment import Experiment, setting
from experiments.common.runs import RunSettings
from experiments.common.shards import stack, unstack
from sejax import Task, envs
from sejax.ops.scores import reaches
from sejax.options import Count
from sejax.runs.chunks import Chunks

# On Pendulum, preset=best has a reward whose best action is known.
WHOLE = ("proxy.initial_state=real", "proxy.horizon=null", "proxy.reward_form=network")
# How many algorithms an SE is learned from, by kind: the first of these that fit its actions.
MIXTURES = {"two": 2, "three": 3, "four": 4}
ALGORITHMS = {True: ("ddqn", "ppo", "sac", "td3_discrete"), False: ("td3", "sac", "ppo")}
# Overrides of the runs, by kind; `tenth` of the task's step limit.
KINDS: dict[str, tuple[str, ...]] = {
    "bandit": (),
    "soft": (*WHOLE, "proxy.done=soft"),
    "threshold": (*WHOLE, "proxy.done=threshold"),
    "bernoulli": (*WHOLE, "proxy.done=bernoulli"),
    "shortest": (*WHOLE, "proxy.done=threshold", "proxy.min_steps={tenth}"),
    "ten_steps": (*WHOLE, "proxy.horizon=10", "proxy.done=threshold"),
    **{name: (*WHOLE, "proxy.done=threshold", f"agents={{{name}}}") for name in MIXTURES},
}
NAMES = {  # as people write them
    "bandit": "one step",
    "soft": "the paper's kind",
    "threshold": "terminations at a threshold",
    "bernoulli": "random terminations",
    "shortest": "threshold, no short episodes",
    "ten_steps": "ten steps",
    "two": "threshold, two algorithms",
    "three": "threshold, three algorithms",
    "four": "threshold, four algorithms",
}


@dataclass(frozen=True, kw_only=True)
class SeDynamics(RunSettings):
    """Settings of this experiment.

    Attributes:
      generations: outer iterations
      kinds: of SEs
      runs: NES runs of each kind
      max_steps: of an agent, but on bandits
      students: kinds of agents; all that fit
      num_agents: of each kind and discount on each SE
      test_episodes: of each agent
    """

    name = "se_dynamics"
    quick_run = runs.QUICK

    generations: Count | None = setting(40, quick=3)
    kinds: tuple[str, ...] = setting(tuple(KINDS), KINDS, quick=("bandit", "threshold"))
    runs: Count = setting(10, quick=2)
    max_steps: Count = setting(4000, quick=1000)
    students: tuple[str, ...] = setting((), agents.KINDS)
    num_agents: Count = setting(10, quick=5)
    test_episodes: Count = setting(10)

    def agent_of(self, student: str) -> Any:
        """The configuration of a kind of students."""
        return sejax.config([f"env={self.env}", f"agent={student}"]).agent

    def config_of(self, kind: str) -> Any:
        """The configuration of the NES runs of a kind."""
        task = envs.make(self.env)
        algorithms = ALGORITHMS[task.num_actions is not None]
        lists = {name: f"[{','.join(algorithms[:count])}]" for name, count in MIXTURES.items()}
        words = [word.format(tenth=task.max_steps // 10, **lists) for word in KINDS[kind]]
        if kind != "bandit":
            steps = self.max_steps
            words += [f"training.max_steps={steps}", f"training.max_episodes={steps}"]
        return self.learn_config(words)


def compute(settings: SeDynamics) -> pd.DataFrame:
    """Learns and trains what is missing; rows of NES runs and of agents."""
    task = envs.make(settings.env)
    tuned = agents.tuned_agent(settings.env, agents.usual_kind(task))
    students = {x: settings.agent_of(x) for x in agents.kinds_of_students(settings)}
    configs = {kind: settings.config_of(kind) for kind in settings.kinds}
    curves, tests = [], [se_myopia.untrained(settings, task, tuned)]
    for kind, config in configs.items():
        chunks = Chunks(config)
        folder = settings.work_folder / "runs" / kind
        for run in runs.configs_of(config, settings.runs, folder):
            own = {"kind": kind, "seed": run.seed}
            curves.append(runs.learn([run], chunks=chunks)[list(CURVE)].assign(**own))
            tests.append(test(settings, kind, run, chunks.bilevel.proxy, students).assign(**own))
    return stack({"curves": pd.concat(curves), "agents": pd.concat(tests)})


CURVE = ("generation", "incumbent_mean", "population_mean", "env_steps_total", "cpu_s")
TESTS = ("group", "agent", "student", "discount", "test_return", "train_steps", "train_episodes")


def test(
    settings: SeDynamics, kind: str, config: Any, env: Any, students: Mapping[str, Any]
) -> pd.DataFrame:
    """Agents on the best SE of a run, a row each: those of each kind, and with each discount.

    Args:
      settings: of the experiment.
      kind: of the SE.
      config: of the run.
      env: the SE, which the runs of a kind share with all compiled programs.
      students: configurations of agents, by their kind.
    """
    se = sejax.load_proxy(Path(config.run_dir))
    group = Group.of(f"seed{config.seed}", se)
    own = dataclasses.replace(settings, seed=config.seed)  # agents on other SEs have other seeds

    def condition(name: str, agent: Any) -> Condition:
        return Condition(
            name=f"{kind}-{name}",
            env=env,
            task=env.task,
            groups=(group,),
            agent=agent,
            training=agents.training_as_learned(se, agent, settings.test_episodes),
            settings={"proxy": se.config["proxy"]},
        )

    tables = []
    for student, agent in students.items():
        rows = agents.train_groups(condition(student, agent), own, settings.num_agents)
        tables.append(rows.assign(student=student))
    learner = next(iter(se.learned_agents().values()))
    tables.append(se_myopia.train_with_discounts(own, condition("discount-", learner)))
    settings.shards.made_with |= own.shards.made_with
    rows = agents.worst_for_diverged(pd.concat(tables, ignore_index=True), kind)  # of all students
    return rows.reindex(columns=list(TESTS))


def summarise(curves: pd.DataFrame, agents: pd.DataFrame, solved_reward: float) -> pd.DataFrame:
    """A row for each kind of SE, with columns for each kind of student and each discount."""
    each = runs.summarise(curves, ["kind", "seed"], solved_reward)
    is_untrained = agents["group"] == se_myopia.UNTRAINED
    floor = agents[is_untrained]["test_return"].mean()
    agents = agents[~is_untrained]

    def statistics(mine: pd.DataFrame) -> dict[str, Any]:
        kind = mine["kind"].iloc[0]
        tested = agents[agents["kind"] == kind]
        sighted = tested[tested["discount"].notna()]
        judged = se_myopia.verdicts(sighted.assign(group=sighted["seed"]), floor, solved_reward)
        far = sighted[sighted["discount"] == sighted["discount"].max()]
        of_ses = far.groupby("seed")["test_return"].mean()
        costs = ["generations_to_solve", "steps_to_solve", "cpu_s_to_solve"]
        columns: dict[str, Any] = {
            "runs": len(mine),
            "first_solved": int(np.isfinite(mine["generations_to_solve"]).sum()),
            "solved": int(reaches(of_ses, solved_reward).sum()),
            **mine[costs].median(),
            **mine[["cpu_s", "steps"]].mean(),
            "episode_steps": far["train_steps"].sum() / far["train_episodes"].clip(lower=1).sum(),
            "untrained": floor,
            **{x: int((judged["verdict"] == x).sum()) for x in se_myopia.KINDS},
        }
        for student, at in tested.dropna(subset="student").groupby("student", sort=False):
            columns |= tables.mean_columns(at["test_return"], f"on_{student}", at["seed"])
        for discount, at in sighted.groupby("discount"):
            name = se_myopia.column(discount)
            columns |= tables.mean_columns(at["test_return"], name, at["seed"])
        return columns

    return tables.summary_by(each, ["kind"], statistics)


def report(settings: SeDynamics, rows: pd.DataFrame) -> pd.DataFrame:
    task = envs.make(settings.env)
    curves, agents = unstack(rows, "curves"), unstack(rows, "agents")
    summary = summarise(curves, agents, task.solved_reward)
    draw(task, curves, settings.folder / "curves.png")
    columns: dict[str, Any] = {
        "SE": lambda row: NAMES[row.kind],
        "real steps": lambda row: tables.steps_text(row.steps_to_solve),
        "verdicts": lambda row: ", ".join(
            f"{x} {count}" for x in se_myopia.KINDS if (count := getattr(row, x.replace(" ", "_")))
        ),
    }
    for discount in se_myopia.DISCOUNTS:
        columns[f"discount {discount:g}"] = tables.mean_text(se_myopia.column(discount), 1)
    columns |= {
        "steps of an episode": "{episode_steps:.1f}",
        "first solved": "{first_solved} of {runs}",
        "in generation": lambda row: tables.known_text(row.generations_to_solve, ",.0f") or "-",
        "CPU s": lambda row: tables.known_text(row.cpu_s_to_solve, ",.0f") or "-",
        "CPU s a generation": "{cpu_s:.2f}",
        "SEs that solve": "{solved} of {runs}",
    }
    for student in agents["student"].dropna().unique():
        columns[figures.agent_name(student)] = tables.mean_text(f"on_{student}", 1)
    summary = summary.rename(columns=lambda name: name.replace(" ", "_"))
    note = (
        f"NES runs of {settings.generations} generations; costs (without compilation) until the "
        f"first search mean of at least {task.solved_reward:g}: medians over runs, - if half of "
        f"them had none. The best SE of each run trains {settings.num_agents} fresh agents of each "
        "algorithm, and of the learning one with each discount, which also say which SEs solve the "
        f"task: mean return. {tables.interval_note('SEs')} Verdicts as in se_myopia."
    )
    title = f"SEs of {task.name} that may teach through their dynamics, and of one step"
    return tables.publish(settings, title, tables.as_texts(summary, columns), summary, note)


def draw(task: Task, curves: pd.DataFrame, path: Path) -> None:
    """Draws the NES runs of each kind."""
    kinds = list(curves.groupby("kind", sort=False))
    wide = min(len(kinds), 4)
    high = -(-len(kinds) // wide)
    with figures.panels(path, high, wide, (2.6 * wide, 0.4 + 2.2 * high), sharey=True) as (_, axes):
        for axis in axes.flat[len(kinds) :]:
            axis.remove()
        for axis, (kind, mine) in zip(axes.flat, kinds, strict=False):
            figures.runs(axis, mine, task.solved_reward)
            axis.set_title(NAMES[kind], fontsize=10)
        for axis in axes[:, 0]:
            axis.set_ylabel("search mean, return")


EXPERIMENT = Experiment(settings=SeDynamics, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
