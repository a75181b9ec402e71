"""Which SEs are environments in earnest, and what does that cost beside a bandit?

Kinds of SEs that may teach through their dynamics are learned with the same agents and strategy,
beside the bandit of `preset=best`: with soft ends, which are handed over as a discount; with the
same as probabilities (`bernoulli`); with ends at a threshold, which no episode of `shortest` has
before a tenth of the task's step limit; and with ten steps an episode at most. The best SE of each
run then trains fresh agents of several kinds, and takes the myopia test (`se_myopia`): what agents
with smaller discounts learn on it.

All agents are sejax's. Those of others do not see the discount that soft ends are handed over as.

The next seed begins when all kinds have finished the one before. Rows, table and figure are written
again after each run.
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
from experiments.common import figures, runs, tables
from experiments.common.agents import (
    CONTINUOUS,
    DISCRETE,
    Condition,
    Group,
    kinds_of_students,
    train_groups,
    tuned_agent,
)
from experiments.common.experiment import Experiment, count, setting
from experiments.common.runs import RunSettings
from experiments.common.shards import stack, unstack, write_rows
from sejax import Task, envs
from sejax.options import each_of, positive
from sejax.runs import session

# On Pendulum, preset=best has a reward whose best action is known.
WHOLE = ("proxy.initial_state=real", "proxy.horizon=null", "proxy.reward_form=network")
# Overrides of the runs, by kind; `tenth` of the task's step limit.
KINDS: dict[str, tuple[str, ...]] = {
    "bandit": (),
    "soft": (*WHOLE, "proxy.done=soft"),
    "threshold": (*WHOLE, "proxy.done=threshold"),
    "bernoulli": (*WHOLE, "proxy.done=bernoulli"),
    "shortest": (*WHOLE, "proxy.done=threshold", "proxy.min_steps={tenth}"),
    "ten_steps": (*WHOLE, "proxy.horizon=10", "proxy.done=threshold"),
}
# On Pendulum, preset=best has agents explore as in a bandit: for a hundred episodes, of one step
# each, where no action is dear.
NOT_BANDIT = {
    ("pendulum", "td3"): (
        "agent.warmup_episodes=1",
        "agent.action_noise_std=0.1",
        "agent.policy_delay=2",
    ),
    ("pendulum", "sac"): ("agent.warmup_episodes=1",),
}


@dataclass(frozen=True, kw_only=True)
class SeDynamics(RunSettings):
    name = "se_dynamics"

    generations: int | None = count(40, quick=3, help="outer iterations")
    kinds: tuple[str, ...] = setting(tuple(KINDS), each_of(tuple(KINDS)), help="of SEs")
    runs: int = count(10, quick=2, help="NES runs of each kind")
    max_steps: int = count(4000, quick=1000, help="of an agent, but on bandits")
    students: tuple[str, ...] = setting(
        (),
        each_of(tuple(dict.fromkeys(DISCRETE + CONTINUOUS))),
        help="Kinds of agents; all that fit the task.",
    )
    num_agents: int = count(10, quick=5, help="of each kind and discount on each SE")
    test_episodes: int = count(10, help="of each agent")
    margin: float = setting(
        0.1,
        positive("a difference is never measured as 0", 1),
        help="Difference that counts as none, as in se_myopia.",
    )

    @property
    def tested(self) -> tuple[str, ...]:
        """The kinds of students."""
        return self.students or self._fitting

    @property
    def _fitting(self) -> tuple[str, ...]:
        return kinds_of_students(envs.make(self.env))

    @property
    def learner(self) -> str:
        """The kind of agent that SEs are learned with."""
        return self._fitting[0]

    def agent_words(self, kind: str, agent: str) -> tuple[str, ...]:
        """Overrides of a kind of agent on a kind of SE."""
        return () if kind == "bandit" else NOT_BANDIT.get((self.env, agent), ())

    def agent_of(self, kind: str, agent: str) -> Any:
        """The configuration of a student on a kind of SE."""
        words = self.agent_words(kind, agent)
        return sejax.config([f"env={self.env}", f"agent={agent}", *words]).agent

    def config_of(self, kind: str) -> Any:
        """The configuration of the NES runs of a kind."""
        tenth = envs.make(self.env).max_steps // 10
        words = [word.format(tenth=tenth) for word in KINDS[kind]]
        words += self.agent_words(kind, self.learner)
        if kind != "bandit":
            steps = self.max_steps
            words += [f"training.max_steps={steps}", f"training.max_episodes={steps}"]
        return self.learn_config([*(runs.QUICK if self.quick else ()), *words])


def compute(settings: SeDynamics) -> pd.DataFrame:
    """Learns and trains what is missing, and reports after each run."""
    task = envs.make(settings.env)
    learners = {kind: settings.config_of(kind) for kind in settings.kinds}
    students = {
        kind: {x: settings.agent_of(kind, x) for x in settings.tested} for kind in settings.kinds
    }
    chunks: dict[str, session.Chunks] = {}
    tuned = tuned_agent(settings.env, settings.learner)
    curves, agents = [], [se_myopia.untrained(settings, task, tuned)]
    rows = pd.DataFrame()
    for place in range(settings.runs):
        for kind, config in learners.items():
            if kind not in chunks:
                chunks[kind] = session.make_chunks(config)
            folder = settings.work_folder / "runs" / kind
            mine = runs.configs_of(config, settings.runs, folder)[place]
            curve = runs.learn([mine], chunks=chunks[kind])
            own = {"kind": kind, "seed": mine.seed}
            curves.append(curve[list(CURVE)].assign(**own))
            tests = test(settings, kind, mine, chunks[kind].learner.proxy, students[kind])
            agents.append(tests.assign(**own))
            rows = stack({"curves": pd.concat(curves), "agents": pd.concat(agents)})
            write_rows(settings.rows_file, rows)
            report(settings, rows)
    return rows


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
    name = f"seed{config.seed}"
    group = Group(name, se.params, se.fingerprint)
    own = dataclasses.replace(settings, seed=config.seed)  # agents on other SEs have other seeds

    def condition(name: str, agent: Any) -> Condition:
        training = dataclasses.replace(
            sejax.training_of(se, agent), test_episodes=settings.test_episodes
        )
        return Condition(
            name=name,
            env=env,
            task=env.task,
            groups=(group,),
            agent=agent,
            training=training,
            settings={"proxy": se.config["proxy"]},
        )

    found = []
    for student, agent in students.items():
        tested = condition(f"{kind}-{student}", agent)
        found.append(train_groups(tested, own, settings.num_agents).assign(student=student))
    (learner,) = se.learned_agents().values()
    sighted = condition(f"{kind}-discount-", learner)
    found.append(se_myopia.train_with_discounts(own, sighted))
    made_with = {f"{condition}-{name}": x for condition, x in own.shards.made_with.items()}
    settings.shards.made_with.update(made_with)
    return pd.concat(found, ignore_index=True).reindex(columns=list(TESTS))


def summarise_runs(curves: pd.DataFrame, solved_reward: float) -> pd.DataFrame:
    """What each run cost until its first incumbent that solves the task; inf if none does."""

    def statistics(curve: pd.DataFrame) -> dict[str, float]:
        to_solve = runs.generations_to_solve(curve, solved_reward)
        spent = curve[curve["generation"] < to_solve]
        is_solved = np.isfinite(to_solve)
        return {
            "generations_to_solve": to_solve,
            "steps_to_solve": spent["env_steps_total"].max() if is_solved else np.inf,
            "cpu_s_to_solve": spent["cpu_s"].sum() if is_solved else np.inf,
            "best": curve["incumbent_mean"].max(),
            "cpu_s": curve["cpu_s"].mean(),
            "steps": curve["env_steps_total"].max(),
        }

    return tables.summary_by(curves, ["kind", "seed"], statistics)


def summarise(
    curves: pd.DataFrame, agents: pd.DataFrame, solved_reward: float, margin: float
) -> pd.DataFrame:
    """A row for each kind of SE, with columns for each kind of student and each discount."""
    each = summarise_runs(curves, solved_reward)
    is_untrained = agents["group"] == se_myopia.UNTRAINED
    floor = agents[is_untrained]["test_return"].mean()
    agents = agents[~is_untrained]

    def statistics(mine: pd.DataFrame) -> dict[str, Any]:
        kind = mine["kind"].iloc[0]
        tested = agents[agents["kind"] == kind]
        sighted = tested[tested["discount"].notna()]
        judged = se_myopia.verdicts(
            sighted.assign(group=sighted["seed"]), floor, solved_reward, margin
        )
        far = sighted[sighted["discount"] == sighted["discount"].max()]
        of_ses = far.groupby("seed")["test_return"].mean()
        costs = ["generations_to_solve", "steps_to_solve", "cpu_s_to_solve"]
        columns: dict[str, Any] = {
            "runs": len(mine),
            "first_solved": int(np.isfinite(mine["generations_to_solve"]).sum()),
            "solved": int((of_ses >= solved_reward).sum()),
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
    summary = summarise(curves, agents, task.solved_reward, settings.margin)
    draw(task, curves, settings.folder / "curves.png")
    columns: dict[str, Any] = {
        "SE": lambda row: row.kind.replace("_", " "),
        "steps of an episode": "{episode_steps:.1f}",
        "first solved": "{first_solved} of {runs}",
        "in generation": lambda row: finite(row.generations_to_solve, 0),
        "real steps": lambda row: finite(row.steps_to_solve, 0),
        "CPU s": lambda row: finite(row.cpu_s_to_solve, 0),
        "CPU s a generation": "{cpu_s:.2f}",
        "SEs that solve": "{solved} of {runs}",
    }
    for student in agents["student"].dropna().unique():
        columns[figures.AGENT_NAMES[student]] = tables.mean_text(f"on_{student}", 1)
    for discount in se_myopia.DISCOUNTS:
        columns[f"discount {discount:g}"] = tables.mean_text(se_myopia.column(discount), 1)
    columns["verdicts"] = lambda row: ", ".join(
        f"{x} {count}" for x in se_myopia.KINDS if (count := getattr(row, x.replace(" ", "_")))
    )
    summary = summary.rename(columns=lambda name: name.replace(" ", "_"))
    note = (
        f"NES runs of {settings.generations} generations for each kind; real steps and CPU s (of "
        "the generations, without compilation) until the first incumbent mean of at least "
        f"{task.solved_reward:g}: medians over runs, - if half of them had none. The best SE of "
        f"each run trains {settings.num_agents} fresh agents of each kind with its default "
        "hyperparameters, and of the learning kind with each discount: mean return on "
        f"{task.name}. {tables.interval_note('SEs')} SEs that solve: those whose fresh agents "
        "of the learning kind reach that on average. Steps of an episode: of these agents' "
        "training. Verdicts of the SEs as in se_myopia."
    )
    title = f"SEs of {task.name} that may teach through their dynamics, beside a bandit"
    return tables.publish(settings, title, tables.as_texts(summary, columns), summary, note)


def finite(value: float, digits: int) -> str:
    """A number, - for inf."""
    return f"{value:,.{digits}f}" if np.isfinite(value) else "-"


def draw(task: Task, curves: pd.DataFrame, path: Path) -> None:
    """Draws each run's incumbent means as a thin line and their mean as a thick one, by kind."""
    kinds = list(curves.groupby("kind", sort=False))
    wide = min(len(kinds), 4)
    high = -(-len(kinds) // wide)
    with figures.panels(path, high, wide, (2.6 * wide, 0.4 + 2.2 * high), sharey=True) as (_, axes):
        for axis in axes.flat[len(kinds) :]:
            axis.remove()
        for axis, (kind, mine) in zip(axes.flat, kinds, strict=False):
            lines = mine.pivot(index="generation", columns="seed", values="incumbent_mean")
            places = lines.index + 1
            axis.plot(places, lines, color=figures.REAL, lw=0.7, alpha=0.6)
            axis.plot(places, lines.mean(axis=1), color=figures.REAL, lw=2.2)
            figures.threshold(axis, task.solved_reward)
            axis.set_title(kind.replace("_", " "), fontsize=10)
        for axis in axes[:, 0]:
            axis.set_ylabel("incumbent's mean return")
        for axis in axes.flat[max(0, len(kinds) - wide) : len(kinds)]:
            axis.set_xlabel("generation")


EXPERIMENT = Experiment(settings=SeDynamics, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
