"""How every agent learns its task: test returns against training steps, over many seeds.

Source: paper, Algorithm 1, TrainAgent and EvaluateAgent, with the real task in the SE's place.

After each training episode an agent plays `test_episodes` greedy ones on the task, and nothing ends
its training but its limits. A study is an agent on a task; its hyperparameters are the paper's
where `STUDIES` names no others, or those that reward networks of the task are learned with; its
peers are what others report for the same task.
"""

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

import sejax
from experiments.common import curves, figures, tables
from experiments.common.agents import Condition, train_groups
from experiments.common.curves import CURVES, WINDOW
from experiments.common.experiment import Experiment, Settings, count, setting
from experiments.common.statistics import mean_interval, worst_tenth
from sejax.options import each_of, registry
from sejax.options.plain import to_plain
from sejax.training import TrainingConfig

QUICK_STEPS = 2000
SHORTEST_EPISODE = 8  # CartPole cannot be lost sooner

# RL Baselines3 Zoo, benchmark.md: the final return of one agent, with the steps it was trained for.
ZOO = "RL Baselines3 Zoo"
PAPER_DDQN = "16,888 steps to solve, agents with drawn hyperparameters (the paper)"


@dataclass(frozen=True)
class Study:
    """An agent on a task."""

    env: str
    agent: str
    max_steps: int  # of training
    peers: str  # what others report
    hparams: dict[str, Any] = field(default_factory=dict)  # others than the paper's

    def configuration(self) -> Any:
        """The paper's agent, which is the default but for PPO, with `hparams`."""
        cls = registry.find("agent", self.agent)
        return (sejax.PPOConfig.paper if cls is sejax.PPOConfig else cls)(**self.hparams)

    def changes(self) -> dict[str, Any]:
        """The hyperparameters that are not the paper's."""
        return self.hparams

    @property
    def label(self) -> str:
        """Its name in pictures."""
        return figures.AGENT_NAMES[self.agent] + "*" * bool(self.hparams)

    def training(self, quick: bool, test_episodes: int) -> TrainingConfig:
        """Episodes of training and of tests alternate until the step limit."""
        max_steps = min(self.max_steps, QUICK_STEPS) if quick else self.max_steps
        return TrainingConfig(
            max_episodes=max_steps // SHORTEST_EPISODE,
            max_steps=max_steps,
            stop_rule="never",
            tests_between=test_episodes,
            time_limit_is_terminal=False,  # as in the literature; the paper's code ends there
        )


@dataclass(frozen=True)
class PresetStudy(Study):
    """The agent that reward networks of a task are learned with, trained as there.

    Its hyperparameters and the limit of episodes are those of `preset=best`; `max_steps` is what so
    many episodes take if none ends early.
    """

    def configuration(self) -> Any:
        return self._preset().agent

    def changes(self) -> dict[str, Any]:
        papers = to_plain(super().configuration())
        ours = to_plain(self.configuration())
        return {name: value for name, value in ours.items() if value != papers[name]}

    def training(self, quick: bool, test_episodes: int) -> TrainingConfig:
        limits = super().training(quick, test_episodes)
        return dataclasses.replace(
            self._preset().training,
            max_steps=limits.max_steps,
            stop_rule="never",
            tests_between=test_episodes,
        )

    @property
    def label(self) -> str:
        return f"quick {figures.AGENT_NAMES[self.agent]}*"

    def _preset(self) -> Any:
        return sejax.config([f"env={self.env}", "proxy=rn", f"agent={self.agent}"])


def _ppo(**hparams: Any) -> dict[str, Any]:
    return {"activation": "tanh", **hparams}


_GREEDY_SARSA = {"discount": 1.0, "epsilon_init": 0.01, "epsilon_min": 0.0, "epsilon_decay": 0.9}
STUDIES = (
    Study("cartpole", "ddqn", 20_000, PAPER_DDQN),
    Study("cartpole", "dueling_ddqn", 20_000, "12,745 steps to solve, likewise"),
    Study("cartpole", "td3_discrete", 20_000, "17,875 steps and a return of 152, likewise"),
    Study(
        "cartpole",
        "ppo",
        100_000,
        f"500.0 of 500 on CartPole-v1 after 100,000 steps ({ZOO})",
        _ppo(learning_rate=1e-3, discount=0.98, update_episodes=4, epochs=20),
    ),
    Study(
        "pendulum",
        "td3",
        20_000,
        f"-151.9 after 20,000 steps ({ZOO})",
        {"learning_rate": 1e-3, "discount": 0.98, "warmup_episodes": 10},
    ),
    Study(
        "pendulum",
        "ppo",
        200_000,
        f"-172.2 after 100,000 steps ({ZOO})",
        _ppo(learning_rate=5e-4, discount=0.95, entropy_weight=0.0, init_action_std=1.0),
    ),
    Study("cliff_walking", "q_learning", 2_000, "optimal: -12"),
    Study("cliff_walking", "sarsa", 2_000, "optimal: -12"),
    Study("cliff_walking", "sarsa", 5_000, "optimal: -12", _GREEDY_SARSA),
    PresetStudy("pendulum", "td3", 20_000, f"-151.9 after 20,000 steps ({ZOO})"),
    PresetStudy("mountain_car_continuous", "td3", 99_900, f"93.5 after 300,000 steps ({ZOO})"),
    PresetStudy(
        "halfcheetah", "td3", 100_000, f"9,656 on HalfCheetah-v3 after 1,000,000 steps ({ZOO})"
    ),
)
ENVS = tuple(dict.fromkeys(study.env for study in STUDIES))


@dataclass(frozen=True, kw_only=True)
class AgentLearning(Settings):
    name = "agent_learning"

    envs: tuple[str, ...] = setting(ENVS, each_of(ENVS))  # tasks whose agents are trained
    num_agents: int = count(10, quick=2)  # seeds of each agent
    test_episodes: int = count(1)  # after each training episode


def compute(settings: AgentLearning) -> pd.DataFrame:
    """Trains what is missing; a row for each training episode of each agent and study."""
    parts = []
    for number, study in enumerate(STUDIES):
        if study.env not in settings.envs:
            continue
        training = study.training(settings.quick, settings.test_episodes)
        condition = Condition.real(
            sejax.envs.make(study.env),
            ["all"],
            name=f"{number:02d}-{study.env}-{study.agent}",
            agent=study.configuration(),
            training=training,
            is_single=True,
        )
        rows = train_groups(condition, settings, settings.num_agents, CURVES)
        parts.append(rows.drop(columns="group").assign(study=number, max_steps=training.max_steps))
    return pd.concat(parts, ignore_index=True)


def summarise(rows: pd.DataFrame) -> pd.DataFrame:
    """One row for each study."""

    def statistics(mine: pd.DataFrame) -> dict[str, Any]:
        study = STUDIES[int(mine["study"].iloc[0])]
        threshold = sejax.envs.make(study.env).solved_reward
        to_solve = curves.all_steps_to_solve(mine, threshold)
        last = curves.last_returns(mine)
        row = {
            "env": study.env,
            "agent": study.agent,
            "num_agents": len(last),
            "max_steps": mine["max_steps"].iloc[0],
            "made_steps": mine.groupby("agent")["steps"].max().mean(),
            "threshold": threshold,
            "num_solved": int(np.isfinite(to_solve).sum()),
            "num_solved_at_the_end": int((last >= threshold).sum()),
            "median_steps_to_solve": np.median(to_solve),
        }
        return row | tables.mean_columns(last, "last") | {"last_worst_tenth": worst_tenth(last)}

    return tables.summary_by(rows, ["study"], statistics)


def _changes(row: Any) -> str:
    return ", ".join(f"{name} {value}" for name, value in STUDIES[row.study].changes().items())


def _median_steps(row: Any) -> str:
    steps = row.median_steps_to_solve
    return f"{steps:,.0f}" if np.isfinite(steps) else "-"


COLUMNS: dict[str, Any] = {
    "task": "{env}",
    "agent": "{agent}",
    "other than the paper's": _changes,
    "solved": "{num_solved} of {num_agents} at {threshold:g}",
    "still at the end": "{num_solved_at_the_end}",
    "median steps to solve": _median_steps,
    "steps, at most": "{max_steps:,}",
    "made": "{made_steps:,.0f}",
    f"last {WINDOW} tests": tables.mean_text("last", 1),
    "worst tenth": "{last_worst_tenth:.1f}",
    "others": lambda row: STUDIES[row.study].peers,
}


def report(settings: AgentLearning, rows: pd.DataFrame) -> pd.DataFrame:
    draw(settings, rows)
    summary = summarise(rows)
    note = (
        f"{settings.num_agents} seeds of each; after each training episode "
        f"{settings.test_episodes} greedy test episode. Solved: the mean of {WINDOW} tests in a "
        f"row reaches the threshold; at the end: that of the last {WINDOW}. Made: mean steps until "
        f"the last episode that ended. The last {WINDOW} tests: mean over seeds. "
        f"{tables.interval_note('seeds')} CartPole is v0, of 200 steps.{tables.WORST_NOTE}"
    )
    title = "Agents that learn the real tasks"
    return tables.publish(settings, title, tables.as_texts(summary, COLUMNS), summary, note)


def draw(settings: AgentLearning, rows: pd.DataFrame, points: int = 100) -> None:
    """Draws a panel for each task: mean and 95% interval of each agent."""
    tasks = list(rows.groupby(rows["study"].map(lambda i: STUDIES[i].env), sort=False))
    palette = (figures.REAL, figures.VARIED, figures.FIXED, figures.SOLVED)
    columns = min(3, len(tasks))
    lines = -(-len(tasks) // columns)
    path = settings.folder / "learning_curves.png"
    with figures.panels(path, lines, columns, (4.6 * columns, 3.6 * lines)) as (_, axes):
        for axis in axes.ravel()[len(tasks) :]:
            axis.set_visible(False)
        for axis, (env, mine) in zip(axes.ravel(), tasks, strict=False):
            for color, (number, study_rows) in zip(palette, mine.groupby("study"), strict=False):
                last_step = study_rows["steps"].max()
                grid = np.geomspace(last_step / 200, last_step, points)
                values, label = curves.on_grid(study_rows, grid), STUDIES[int(number)].label
                figures.band(axis, grid, values, _intervals, color, lw=1.8, label=label)
            axis.axhline(sejax.envs.make(env).solved_reward, color="#7a7a7a", ls="--", lw=1)
            axis.set_title(env, fontsize=10)
            axis.set(xscale="log", xlabel="training steps (*: hyperparameters in the table)")
            axis.legend(fontsize=8, loc="best")
        for axis in axes[:, 0]:
            axis.set_ylabel(f"test return, mean of {WINDOW}")


def _intervals(values: np.ndarray) -> np.ndarray:
    """Ends of the means' intervals, `[2, points]`, of `[agent, points]`."""
    return np.transpose([mean_interval(each) for each in values.T])


EXPERIMENT = Experiment(settings=AgentLearning, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
