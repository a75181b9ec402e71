"""What makes a policy teachable: students on SEs of many policies, beside what predicts them.

A policy that earns more may be a worse teacher. Searches with several sizes of the emulated error
give policies of many kinds; of each one SE is made, on which fresh students of several kinds train.
Beside them stands what can be known of a policy without a student: its return, its return with a
random linear error in each episode, as of a student that learned it roughly, its return with noise
on each action, and how often its actions lie at their bounds. On the SE that teaches best, other
forms are compared: the reward's form and slope, the initial states, the number of steps.
"""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array
from scipy.stats import spearmanr

import sejax
from experiments.common import figures, tables
from experiments.common.agents import CONTINUOUS, DISCRETE
from experiments.common.experiment import Experiment, Settings, count, setting
from experiments.common.shards import stack, unstack
from sejax import envs
from sejax.cli import config as configuration
from sejax.cli import distilling
from sejax.cli.config import LearnConfig, members_of
from sejax.cli.distill_config import DistillConfig, read
from sejax.distillation import teaching
from sejax.distillation.policy_copy import Actor, acting, erring, visit
from sejax.distillation.teaching import Lesson
from sejax.envs.base import Task
from sejax.options import each_of
from sejax.options.plain import to_plain
from sejax.proxies.base import ProxyParams
from sejax.proxies.configs import SyntheticConfig
from sejax.proxies.exact import evaluate
from sejax.proxies.synthetic import BanditEnv, SyntheticState

QUICK = (
    *("search.generations=4", "search.test_every=1", "search.num_directions=4"),
    *("search.num_top=2", "num_snapshots=2", "training.max_steps=200"),
    *("training.max_episodes=200", "search.num_starts=2", "search.start_generations=2"),
)


class Form(NamedTuple):
    """How an SE is made of a policy, and how long students train on it."""

    slope: float = 1.0  # of the reward
    widen: float = 1.0  # spread of the initial states, in units of the visited ones'
    share: float = 1.0  # of the steps of a student
    reward: str = "distance"  # of continuous actions
    starts: str = "gaussian"  # or visited: those states; or uncorrelated: their numbers shuffled


FORMS = {
    "as it is": Form(),
    "quadratic reward": Form(reward="quadratic"),
    "starts that were visited": Form(starts="visited"),
    "uncorrelated starts": Form(starts="uncorrelated"),
    "slope 0.2": Form(slope=0.2),
    "slope 5": Form(slope=5.0),
    "starts 0.5 as wide": Form(widen=0.5),
    "starts 1.5 times as wide": Form(widen=1.5),
    "starts 3 times as wide": Form(widen=3.0),
    "a quarter of the steps": Form(share=0.25),
    "half of the steps": Form(share=0.5),
    "twice the steps": Form(share=2.0),
}


@dataclass(frozen=True, kw_only=True)
class SeTeachability(Settings):
    name = "se_teachability"

    env: str = setting("halfcheetah")  # task
    # Kinds of students; all that the task's preset has.
    students: tuple[str, ...] = setting((), each_of(tuple(dict.fromkeys(DISCRETE + CONTINUOUS))))
    # Emulated errors of the searches.
    searched_with: tuple[float, ...] = setting((0.0, 0.1, 0.3), quick=(0.1,))
    num_seeds: int = count(2, quick=1)  # searches with each
    num_students: int = count(4, quick=2)  # of each kind on each SE
    num_formed: int = count(8, quick=2)  # of each kind on each form of the best SE
    # Errors that a policy is tested with.
    errors: tuple[float, ...] = setting((0.0, 0.1, 0.2, 0.3), quick=(0.0, 0.3))
    # Noise on each action that a policy is tested with: Gaussian, in units of the action's bound;
    # of discrete actions the probability of a random one.
    noises: tuple[float, ...] = setting((0.1, 0.2, 0.4), quick=(0.2,))
    num_episodes: int = count(16, quick=2)  # of each such test
    run: tuple[str, ...] = setting(())  # overrides of sejax.distill

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of students."""
        discrete = envs.make(self.env).num_actions is not None
        return self.students or (DISCRETE if discrete else CONTINUOUS)

    def searches(self) -> Iterator[tuple[str, DistillConfig, LearnConfig]]:
        """Each search: its name, and what the command reads for it."""
        for error in self.searched_with:
            for seed in range(self.seed, self.seed + self.num_seeds):
                words = [
                    *(f"env={self.env}", f"agents=[{','.join(self.kinds)}]", f"seed={seed}"),
                    *(f"search.policy_error={error}", f"num_students={self.num_students}"),
                    *(QUICK if self.quick else ()),
                ]
                own, config = read([*words, *self.run])
                name = f"error{error:g}-seed{seed}"
                yield name, own, dataclasses.replace(config, devices=self.devices)


class VisitedStarts(BanditEnv):
    """A one-step SE whose episodes begin in given states, `[state, obs_dim]`."""

    def __init__(self, task: Task, config: SyntheticConfig, states: np.ndarray):
        super().__init__(task, config)
        self._states = jnp.asarray(states, jnp.float32)

    def reset_env(self, key: Array, params: ProxyParams) -> tuple[Array, SyntheticState]:
        state = SyntheticState(vector=jax.random.choice(key, self._states), time=jnp.int32(0))
        return self.get_obs(state), state


# --- computing -----------------------------------------------------------------------------------


def compute(settings: SeTeachability) -> pd.DataFrame:
    """Searches, tests and teaches what is missing."""
    policies, students, taught = [], [], {}
    for name, own, config in settings.searches():
        folder = settings.work_folder / name
        folder.mkdir(parents=True, exist_ok=True)
        lessons, _ = distilling.search(own, config, folder)
        made_with = {
            "own": to_plain(own),
            "config": configuration.plain(config) | {"devices": None},
        }
        tests = settings.values("errors", "noises", "num_episodes")

        def tested(lessons: Any = lessons, config: Any = config) -> pd.DataFrame:
            return pd.DataFrame([_tested(settings, config, lesson) for lesson in lessons])

        def learned(
            own: Any = own, config: Any = config, lessons: Any = lessons, folder: Path = folder
        ) -> pd.DataFrame:
            return distilling.students(own, config, lessons, distilling.CHOOSE, folder)

        columns = {"search": name, "searched_with": own.search.policy_error}
        rows = settings.shards.compute(f"policies-{name}", made_with | tests, tested)
        policies.append(rows.assign(**columns))
        rows = settings.shards.compute(f"students-{name}", made_with, learned)
        students.append(rows.assign(**columns))
        grades = teaching.grades(rows)
        best = {lesson.generation: lesson for lesson in lessons}[int(grades.idxmax())]
        taught[float(grades.max())] = (name, own, config, best)
    formed = _formed(settings, *taught[max(taught)])
    parts = {"policies": pd.concat(policies), "students": pd.concat(students), "forms": formed}
    return stack(parts)


def _tested(settings: SeTeachability, config: LearnConfig, lesson: Lesson) -> dict[str, float]:
    """What can be known of a policy without a student."""
    task, key = config.task(), jax.random.fold_in(distilling.keys_of(config)["record"], 0)
    found: dict[str, float] = {"generation": lesson.generation}
    for error in settings.errors:
        act = erring(task, lesson.layers, lesson.states, error, key, settings.num_episodes)
        seen = visit(task, act, key, settings.num_episodes)
        found[f"return_{error:g}"] = float(seen.returns.mean())
    for noise in settings.noises:
        act = noisy(task, acting(task, lesson.layers), noise, config.seed)
        seen = visit(task, act, key, settings.num_episodes)
        found[f"noise_{noise:g}"] = float(seen.returns.mean())
    outputs = evaluate(lesson.layers, lesson.states)
    is_continuous = task.num_actions is None
    found["saturated"] = float((np.abs(outputs) > task.max_action).mean()) if is_continuous else 0.0
    return found


def noisy(task: Task, act: Actor, size: float, seed: int) -> Actor:
    """A policy with noise on each action: Gaussian, or now and then a random action.

    Args:
      task: the real task.
      act: the policy.
      size: standard deviation in units of the action's bound; of discrete actions, how often.
      seed: of the noise.
    """
    rng = np.random.default_rng(seed)

    def noisy_act(obs: np.ndarray) -> np.ndarray:
        actions = act(obs)
        if task.num_actions is not None:
            others = rng.integers(task.num_actions, size=actions.shape)
            return np.where(rng.random(actions.shape) < size, others, actions)
        wrong = size * task.max_action * rng.standard_normal(actions.shape)
        return np.clip(actions + wrong, -task.max_action, task.max_action)

    return noisy_act


def _formed(
    settings: SeTeachability, name: str, own: DistillConfig, config: LearnConfig, lesson: Lesson
) -> pd.DataFrame:
    """Students on the forms of one policy's SE, a row each."""
    task, found = config.task(), []
    key = jax.random.fold_in(distilling.keys_of(config)[distilling.TEST], 1)
    keys = jax.random.split(key, settings.num_formed)
    most = config.training.max_steps
    assert most is not None
    rng = np.random.default_rng(config.seed)
    for label, form in FORMS.items():
        if form.reward != "distance" and task.num_actions is not None:
            continue
        shown = lesson
        if form.starts == "uncorrelated":
            shown = lesson._replace(states=rng.permuted(lesson.states, axis=0))
        env, weights = teaching.make_ses(
            task, [shown], form=form.reward, slope=form.slope, widen=form.widen
        )
        if form.starts == "visited":
            env = VisitedStarts(task, env.config, lesson.states)
        steps = int(most * form.share)
        training = dataclasses.replace(config.training, max_steps=steps, max_episodes=steps)
        made_with = {
            "own": to_plain(own),
            "config": configuration.plain(config) | {"devices": None},
        }
        made_with |= {"form": form._asdict(), "num": len(keys), "of": lesson.generation}

        def learned(env: Any = env, weights: Any = weights, training: Any = training) -> Any:
            rows = []
            for member in members_of(config):
                agent = sejax.make_agent(member.agent, task, config.exploration)
                outcome = teaching.teach(env, weights, agent, training, keys, config.devices)
                rows.append(teaching.as_rows(outcome, [lesson], member.key, "form"))
            return pd.concat(rows, ignore_index=True)

        file = f"form-{name}-{label.replace(' ', '_')}"
        found.append(settings.shards.compute(file, made_with, learned).assign(form=label))
    return pd.concat(found)


# --- the report ----------------------------------------------------------------------------------


def by_policy(rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each policy and kind of student, with what is known of the policy."""
    policies, students = unstack(rows, "policies"), unstack(rows, "students")
    each = students.assign(
        test_return=students["test_return"].fillna(students["test_return"].min())
    )
    grouped = each.groupby(["search", "generation", "agent"])["test_return"]
    taught = grouped.agg(["mean", "min"]).reset_index()
    return taught.merge(policies, on=["search", "generation"])


def summarise(settings: SeTeachability, rows: pd.DataFrame) -> pd.DataFrame:
    """How well each number of a policy ranks policies as their students do, by kind."""
    each = by_policy(rows)
    found = []
    for kind, mine in each.groupby("agent", sort=False):
        known = {f"return_{x:g}": f"return with an error of {x:g}" for x in settings.errors}
        known |= {f"noise_{x:g}": f"return with action noise of {x:g}" for x in settings.noises}
        known["saturated"] = "share of actions at their bounds"
        for column, label in known.items():
            varies = mine[column].nunique() > 1 and mine["mean"].nunique() > 1
            rho = {x: spearmanr(mine[column], mine[x])[0] if varies else np.nan
                   for x in ("mean", "min")}  # fmt: skip
            found.append(
                {"kind": kind, "known": label, "policies": len(mine),
                 "rho_mean": rho["mean"], "rho_worst": rho["min"]}
            )  # fmt: skip
    return pd.DataFrame(found)


def report(settings: SeTeachability, rows: pd.DataFrame) -> pd.DataFrame:
    summary = summarise(settings, rows)
    draw(settings, rows, settings.folder / "teachability.png")
    forms = unstack(rows, "forms")
    each = forms.groupby(["form", "agent"], sort=False)["test_return"].agg(["mean", "min"])
    shown = []
    for label, mine in each.groupby("form", sort=False):
        cells = {"the best SE": str(label)}
        for (_, kind), row in mine.iterrows():  # type: ignore[misc]
            cells[figures.AGENT_NAMES[kind]] = f"{row['mean']:,.0f}, worst {row['min']:,.0f}"
        shown.append(cells)
    texts = pd.DataFrame(shown)
    kinds = [figures.AGENT_NAMES[kind] for kind in summary["kind"].unique()]
    lines = ["| known of a policy | " + " | ".join(kinds) + " |"]
    lines.append("| --- " * (1 + len(kinds)) + "|")
    for known, mine in summary.groupby("known", sort=False):
        rhos = " | ".join("alike" if np.isnan(x) else f"{x:.2f}" for x in mine["rho_mean"])
        lines.append(f"| {known} | {rhos} |")
    note = (
        "Spearman's correlation of what is known of a policy with the mean return of the students "
        f"on its SE, over {summary['policies'].max()} policies of "
        f"{len(list(settings.searches()))} searches:\n\n"
        + "\n".join(lines)
        + "\n\n*alike*: all policies, or all their students, earned the same. "
        f"On each SE {settings.num_students} students of each kind trained; on each form of "
        f"the SE that taught best, {settings.num_formed}. An error is a random linear map of the "
        "observation in each episode; its size is the root mean square in units of the action's "
        "bound. Action noise is Gaussian in that unit; of discrete actions, the probability of a "
        "random one."
    )
    title = f"What makes policies of {settings.env} teachable"
    return tables.publish(settings, title, texts, summary, note)


def draw(settings: SeTeachability, rows: pd.DataFrame, path: Path) -> None:
    """Draws students' returns against the policy's own, and that with most error or noise."""
    each, kinds = by_policy(rows), settings.kinds
    error, noise = max(settings.errors), max(settings.noises)
    columns = [f"return_{settings.errors[0]:g}", f"return_{error:g}", f"noise_{noise:g}"]
    labels = ["return of the policy", f"with an error of {error:g}", f"with noise of {noise:g}"]
    size = (0.6 + 2.5 * len(kinds), 2.4 * len(columns))
    with figures.panels(path, len(columns), len(kinds), size, sharey=True) as (_, axes):
        for axis_row, column, label in zip(axes, columns, labels, strict=True):
            for axis, kind in zip(axis_row, kinds, strict=True):
                mine = each[each["agent"] == kind]
                ends = [mine[column].min(), mine[column].max()]
                axis.plot(ends, ends, color="0.75", lw=1)
                for searched_with, some in mine.groupby("searched_with"):
                    axis.plot(some[column], some["mean"], "o", ms=4, alpha=0.7,
                              label=f"searched with {searched_with:g}")  # fmt: skip
                axis.set_title(figures.AGENT_NAMES[kind], fontsize=10)
                axis.set_xlabel(label)
        for axis_row in axes:
            axis_row[0].set_ylabel("students' mean return")
        axes[0][0].legend(fontsize=7)


EXPERIMENT = Experiment(settings=SeTeachability, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
