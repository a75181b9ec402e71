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
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

import sejax
from experiments.common import figures, tables
from experiments.common.agents import CONTINUOUS, DISCRETE
from experiments.common.experiment import Experiment, Settings, count, setting
from experiments.common.shards import stack, unstack
from sejax import envs
from sejax.distillation import distilling
from sejax.distillation.config import read
from sejax.options import each_of

QUICK = (
    *("search.generations=4", "search.test_every=1", "search.num_directions=4"),
    *("search.num_top=2", "num_snapshots=2", "num_students=2", "training.max_steps=200"),
    *("training.max_episodes=200", "search.num_starts=2", "search.start_generations=2"),
)


@dataclass(frozen=True, kw_only=True)
class SeDistilled(Settings):
    name = "se_distilled"

    env: str = setting("halfcheetah", help="task")
    students: tuple[str, ...] = setting(
        (),
        each_of(tuple(dict.fromkeys(DISCRETE + CONTINUOUS))),
        help="Kinds of students; all that the task's preset has.",
    )
    num_seeds: int = count(3, quick=2, help="whole runs of the command")
    num_tested: int = count(10, quick=2, help="students of each kind on the SE that is kept")
    run: tuple[str, ...] = setting((), help="overrides of the command")

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of students."""
        discrete = envs.make(self.env).num_actions is not None
        return self.students or (DISCRETE if discrete else CONTINUOUS)

    def words(self, seed: int) -> list[str]:
        """The command's overrides for a seed."""
        return [
            *(f"env={self.env}", f"agents=[{','.join(self.kinds)}]", f"seed={seed}"),
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
    own, config = read(settings.words(seed))
    config = dataclasses.replace(config, devices=settings.devices)
    folder = settings.work_folder / f"seed{seed}"

    def run() -> pd.DataFrame:
        folder.mkdir(parents=True, exist_ok=True)
        started = time.process_time()
        distilling.distill(own, config, folder, shlex.join(settings.words(seed)))
        print(f"seed {seed}: {time.process_time() - started:.0f} CPU s", flush=True)
        names = ("search", "students")
        return stack({name: pd.read_csv(folder / f"{name}.csv") for name in names})

    return settings.shards.compute(f"seed{seed}", distilling.asked(own, config), run)


def summarise(rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each seed and kind of student."""
    searches, students = unstack(rows, "search"), unstack(rows, "students")
    found = []
    for seed, mine in students.groupby("seed"):
        search = searches[searches["seed"] == seed]
        tested = mine[mine["use"] == distilling.TEST]
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
        cells = {
            "seed": str(seed),
            "generation": f"{first['generation']:.0f}",
            "real steps": f"{first['real_steps']:,.0f}",
            "CPU s": f"{first['cpu_s']:,.0f}",
            "the policy itself": f"{first['policy_return']:,.1f}",
        }
        for row in mine.itertuples():
            name = figures.AGENT_NAMES[str(row.kind)]
            cells[name] = f"{row.mean:,.1f} ± {row.std:,.1f}, worst {row.worst:,.1f}"
        shown.append(cells)
    own, config = read(settings.words(settings.seed))
    search = own.search
    note = (
        f"Each row is a run of `python -m sejax.distill`: augmented random search of a linear "
        f"policy; {search.num_starts} searches begin with {search.start_generations} generations "
        f"each, the best goes on to generation {search.generations}; students train on SEs of "
        f"{own.num_snapshots} policies, and one SE is kept. Real steps and CPU seconds are those "
        "of the whole run: all searches, students and tests. A kind's column: mean, standard "
        f"deviation and worst of {settings.num_tested} students that took no part in choosing, "
        f"each after {config.training.max_steps:,} steps on the SE, by the mean of "
        f"{config.training.test_episodes} episodes on the real task."
    )
    title = f"SEs of {settings.env} made of a searched policy"
    return tables.publish(settings, title, pd.DataFrame(shown), summary, note)


def draw(settings: SeDistilled, rows: pd.DataFrame, path: Path) -> None:
    """Draws what the students of every policy reached against what the policy itself reaches."""
    students = unstack(rows, "students")
    chosen_by = students[students["use"] == distilling.CHOOSE]
    kinds, task = list(dict.fromkeys(students["agent"])), sejax.envs.make(settings.env)
    size = (0.6 + 2.6 * len(kinds), 2.9)
    with figures.panels(path, 1, len(kinds), size, sharex=True, sharey=True) as (_, axes):
        for axis, kind in zip(axes[0], kinds, strict=True):
            mine = chosen_by[chosen_by["agent"] == kind]
            ends = [mine["policy_return"].min(), mine["policy_return"].max()]
            axis.plot(ends, ends, color="0.7", lw=1, label="as good as the policy")
            axis.plot(mine["policy_return"], mine["test_return"], "o", ms=3, alpha=0.6,
                      color=figures.REAL, label="a student")  # fmt: skip
            if np.isfinite(task.solved_reward):
                axis.axhline(task.solved_reward, ls=":", lw=1, color=figures.SOLVED)
            axis.set_title(figures.AGENT_NAMES[kind], fontsize=10)
            axis.set_xlabel("return of the policy")
        axes[0, 0].set_ylabel("return of students")
        axes[0, 0].legend(fontsize=8)


EXPERIMENT = Experiment(settings=SeDistilled, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
