"""What SEs made of a searched policy teach, and what they cost.

`python -m sejax.distill` searches a linear policy on rollouts alone, makes SEs of what it found on
the way, and keeps the one that teaches its students best. No agent is trained to learn it: such an
SE is its policy in disguise, and the baseline that evolved SEs must beat. Here the whole command
runs with several seeds, and fresh students of each kind, which took no part in choosing, say what
the chosen SE teaches. Costs are those of the whole run, discarded policies and their students
included.
"""

import dataclasses
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

import sejax
from experiments.common import agents, figures, tables
from experiments.common.experiment import Experiment, Settings, setting
from experiments.common.shards import stack, unstack
from sejax.distill import __main__ as distill
from sejax.options import Count

QUICK = (
    *("search.generations=4", "search.test_every=1", "search.num_directions=4"),
    *("search.num_top=2", "num_snapshots=2", "num_students=2", "training.max_steps=200"),
    *("training.max_episodes=200", "search.num_starts=2", "search.start_generations=2"),
)


@dataclass(frozen=True, kw_only=True)
class SeDistilled(Settings):
    """Settings of this experiment.

    Attributes:
      env: task
      students: Kinds of students; all that the task's preset has.
      num_seeds: whole runs of the command
      num_tested: students of each kind on the SE that is kept
      run: overrides of the command
    """

    name = "se_distilled"

    env: str = setting("halfcheetah")
    students: tuple[str, ...] = setting((), agents.KINDS)
    num_seeds: Count = setting(3, quick=2)
    num_tested: Count = setting(10, quick=2)
    run: tuple[str, ...] = setting(())

    def words(self, seed: int) -> list[str]:
        """The command's overrides for a seed."""
        kinds = ",".join(agents.kinds_of_students(self))
        return [
            *(f"env={self.env}", f"agents=[{kinds}]", f"seed={seed}"),
            *(f"num_tested={self.num_tested}", *(QUICK if self.quick else ()), *self.run),
        ]


def compute(settings: SeDistilled) -> pd.DataFrame:
    """Runs what is missing; rows of searches and of students."""
    searches, students = [], []
    for seed in range(settings.seed, settings.seed + settings.num_seeds):
        rows = one_run(settings, seed)
        searches.append(unstack(rows, "search").assign(seed=seed))
        students.append(unstack(rows, "students").assign(seed=seed))
    return stack({"search": pd.concat(searches), "students": pd.concat(students)})


def one_run(settings: SeDistilled, seed: int) -> pd.DataFrame:
    """Rows of the command with one seed, a cached shard."""
    config = distill.DistillConfig.of_words(settings.words(seed))
    folder = settings.work_folder / f"seed{seed}"
    config = dataclasses.replace(config, devices=settings.devices, run_dir=str(folder))

    def run() -> pd.DataFrame:
        folder.mkdir(parents=True, exist_ok=True)
        distill.distill(config, shlex.join(settings.words(seed)))
        names = ("search", "students")
        return stack({name: pd.read_csv(folder / f"{name}.csv") for name in names})

    counts = {name: x for name, x in config.plain().items() if name not in config.free}
    return settings.shards.compute(f"seed{seed}", counts, run)


def summarise(rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each seed and kind of student."""
    searches, students = unstack(rows, "search"), unstack(rows, "students")
    found = []
    for seed, mine in students.groupby("seed"):
        search = searches[searches["seed"] == seed]
        tested = mine[mine["use"] == distill.TEST]
        for kind, returns in tested.groupby("agent", sort=False)["test_return"]:
            each = returns.fillna(returns.min())
            found.append(
                {
                    "seed": seed,
                    "kind": kind,
                    "generation": int(tested["generation"].iloc[0]),
                    "policy_return": tested["policy_return"].iloc[0],
                    "mean": each.mean(),
                    "std": each.std(ddof=0),
                    "worst": each.min(),
                    "num_students": len(each),
                    "search_steps": search["real_steps"].sum(),
                    "search_cpu_s": search["cpu_s"].sum(),
                    "real_steps": search["real_steps"].sum() + mine["real_steps"].sum(),
                    "cpu_s": search["cpu_s"].sum() + mine["cpu_s"].sum(),
                    "student_cpu_s": tested[tested["agent"] == kind]["cpu_s"].mean(),
                }
            )
    return pd.DataFrame(found)


def report(settings: SeDistilled, rows: pd.DataFrame) -> pd.DataFrame:
    summary = summarise(rows)
    draw(settings, rows, settings.folder / "students.png")
    shown = []
    for seed, mine in summary.groupby("seed"):
        first = mine.iloc[0]
        costs = {
            "seed": str(seed),
            "generation": f"{first['generation']:.0f}",
            "real steps": f"{first['real_steps']:,.0f}",
            "CPU s": f"{first['cpu_s']:,.0f}",
            "the policy itself": f"{first['policy_return']:,.1f}",
        }
        cells = {
            figures.agent_name(str(x.kind)): f"{x.mean:,.1f} ± {x.std:,.1f}, worst {x.worst:,.1f}"
            for x in mine.itertuples()
        }
        shown.append(costs | cells)
    config = distill.DistillConfig.of_words(settings.words(settings.seed))
    search = config.search
    note = (
        f"Each row is a run of `python -m sejax.distill`: {search.num_starts} searches begin with "
        f"{search.start_generations} generations each, the best goes on to generation "
        f"{search.generations}; students train on SEs of {config.num_snapshots} policies, and one "
        "SE is kept. Costs are those of the whole run. A kind's column: mean, standard deviation "
        f"and worst of {settings.num_tested} students that took no part in choosing, each after "
        f"{config.training.max_steps:,} steps on the SE."
    )
    title = f"SEs of {settings.env} made of a searched policy"
    return tables.publish(settings, title, pd.DataFrame(shown), summary, note)


def draw(settings: SeDistilled, rows: pd.DataFrame, path: Path) -> None:
    """Draws what the students of every policy reached against what the policy itself reaches."""
    students = unstack(rows, "students")
    chosen_by = students[students["use"] == distill.CHOOSE]
    kinds, task = list(dict.fromkeys(students["agent"])), sejax.envs.make(settings.env)
    size = (0.6 + 2.6 * len(kinds), 2.9)
    with figures.panels(path, 1, len(kinds), size, sharex=True, sharey=True) as (_, axes):
        for axis, kind in zip(axes[0], kinds, strict=True):
            mine = chosen_by[chosen_by["agent"] == kind]
            ends = [mine["policy_return"].min(), mine["policy_return"].max()]
            axis.plot(ends, ends, color="0.7", lw=1, label="as good as the policy")
            dots: dict[str, Any] = {"ms": 3, "alpha": 0.6, "color": figures.REAL}
            axis.plot(mine["policy_return"], mine["test_return"], "o", label="a student", **dots)
            figures.threshold(axis, task.solved_reward)
            axis.set_title(figures.agent_name(kind), fontsize=10)
            axis.set_xlabel("return of the policy")
        axes[0, 0].set_ylabel("return of students")
        axes[0, 0].legend(fontsize=8)


EXPERIMENT = Experiment(settings=SeDistilled, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
