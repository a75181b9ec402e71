"""How every agent learns its task: test returns against training steps, over many seeds.

Source: paper, Algorithm 1, TrainAgent and EvaluateAgent, with the real task in the SE's place.

After each training episode an agent plays `test_episodes` greedy ones on the task, and nothing ends
its training but the step limit. A study is an agent on a task; its hyperparameters are the paper's
where `STUDIES` names no others, and its peers are what others report for the same task.
"""

import functools
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
import pandas as pd

import sejax
from sejax import plugins
from sejax.experiments import figures, return_curves, worlds
from sejax.experiments.experiment import Experiment
from sejax.experiments.return_curves import WINDOW
from sejax.experiments.settings import Settings, each_of, setting
from sejax.experiments.tables import bootstrap_interval, publish
from sejax.options import counts
from sejax.training import TrainingConfig

QUICK_STEPS = 2000
SHORTEST_EPISODE = 8  # CartPole cannot be lost sooner

# RL Baselines3 Zoo, benchmark.md: the final return of one agent, with the steps it was trained for.
ZOO = "RL Baselines3 Zoo"
PAPER_DDQN = "16,888 steps to solve, agents with drawn hyperparameters (the paper)"


@dataclass(frozen=True, kw_only=True)
class Study:
    """An agent on a task."""

    env: str
    agent: str
    max_steps: int  # of training
    hparams: dict[str, Any] = field(default_factory=dict)  # others than the paper's, the defaults
    peers: str = ""  # what others report

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


STUDIES = (
    Study(env="cartpole", agent="ddqn", max_steps=20_000, peers=PAPER_DDQN),
    Study(env="cartpole", agent="dueling_ddqn", max_steps=20_000, peers="12,745 steps to solve, "
          "likewise"),
    Study(env="cartpole", agent="td3_discrete", max_steps=20_000, peers="17,875 steps and a return "
          "of 152, likewise"),
    Study(env="cartpole", agent="ppo", max_steps=100_000,
          hparams={"activation": "tanh", "learning_rate": 1e-3, "discount": 0.98,
                   "update_episodes": 4, "epochs": 20},
          peers=f"500.0 of 500 on CartPole-v1 after 100,000 steps ({ZOO})"),
    Study(env="pendulum", agent="td3", max_steps=20_000,
          hparams={"learning_rate": 1e-3, "discount": 0.98, "init_episodes": 10},
          peers=f"-151.9 after 20,000 steps ({ZOO})"),
    Study(env="pendulum", agent="ppo", max_steps=200_000,
          hparams={"activation": "tanh", "learning_rate": 5e-4, "discount": 0.95,
                   "entropy_weight": 0.0, "init_action_std": 1.0},
          peers=f"-172.2 after 100,000 steps ({ZOO})"),
    Study(env="cliff_walking", agent="q_learning", max_steps=2_000, peers="optimal: -12"),
    Study(env="cliff_walking", agent="sarsa", max_steps=2_000, peers="optimal: -12"),
    Study(env="cliff_walking", agent="sarsa", max_steps=5_000,
          hparams={"discount": 1.0, "epsilon_init": 0.01, "epsilon_min": 0.0,
                   "epsilon_decay": 0.9}, peers="optimal: -12"),
)  # fmt: skip
ENVS = tuple(dict.fromkeys(study.env for study in STUDIES))


@dataclass(frozen=True, kw_only=True)
class AgentLearning(Settings):
    """What the experiment is told."""

    name = "agent_learning"

    envs: tuple[str, ...] = setting(ENVS, each_of(ENVS), about="tasks whose agents are trained")
    num_agents: int = setting(10, counts("it counts agents"), quick=2, about="seeds of each agent")
    test_episodes: int = setting(1, counts("it counts episodes"), about="after each training "
                                 "episode")  # fmt: skip


def compute(settings: AgentLearning) -> pd.DataFrame:
    """Trains what is missing; a row for each training episode of each agent and study."""
    tables = []
    for number, study in enumerate(STUDIES):
        if study.env not in settings.envs:
            continue
        task = sejax.envs.make(study.env)
        training = study.training(settings.quick, settings.test_episodes)
        world = worlds.World(
            name=f"{number:02d}-{study.env}-{study.agent}",
            env=task.env,
            task=task,
            groups=(worlds.Group("all", task.params),),
            agent=plugins.configure("agent", {"name": study.agent, **study.hparams}),
            training=training,
        )
        made_with = world.settings_of(world.groups[0])
        made_with |= {"num_agents": settings.num_agents, "seed": settings.seed}
        train_all = functools.partial(train, settings, world)
        curves = settings.pieces.compute(world.name, made_with, train_all)
        print(f"{world.name}: {worlds.CURVES.say(curves)}", flush=True)
        tables.append(curves.assign(study=number, max_steps=training.max_steps))
    return pd.concat(tables, ignore_index=True)


def train(settings: AgentLearning, world: worlds.World) -> pd.DataFrame:
    """Curves of a study's agents, whose keys are split from the seed's own: no group is first."""
    program = worlds.make_program(worlds.CURVES, world.agent, world.exploration, world.hparams,
                                  world.env, world.task, world.training,
                                  settings.devices)  # fmt: skip
    keys = jax.random.split(jax.random.key(settings.seed), settings.num_agents)
    params = jax.tree.map(lambda x: np.stack([x]), world.groups[0].params)
    curves, drawn = jax.device_get(program(keys, params, np.ones(settings.num_agents, bool)))
    return worlds.CURVES.to_table(curves, drawn)


def summarise(curves: pd.DataFrame) -> pd.DataFrame:
    """One row for each study."""
    rows = []
    for number, mine in curves.groupby("study"):
        study = STUDIES[int(number)]
        threshold = sejax.envs.make(study.env).solved_reward
        to_solve = return_curves.all_steps_to_solve(mine, threshold)
        last = return_curves.last_returns(mine)
        low, high = bootstrap_interval(last)
        rows.append({
            "study": number, "env": study.env, "agent": study.agent,
            "num_agents": len(last), "max_steps": mine["max_steps"].iloc[0], "threshold": threshold,
            "num_solved": int(np.isfinite(to_solve).sum()),
            "median_steps_to_solve": np.median(to_solve),
            "last_return": last.mean(), "last_low": low, "last_high": high,
        })  # fmt: skip
    return pd.DataFrame(rows)


def make_table(summary: pd.DataFrame) -> pd.DataFrame:
    """The summary as texts, with what others report."""
    rows = []
    for row in summary.itertuples():
        study = STUDIES[row.study]
        median = row.median_steps_to_solve
        rows.append({
            "task": row.env,
            "agent": row.agent,
            "other than the paper's": ", ".join(f"{k} {v}" for k, v in study.hparams.items()),
            "solved": f"{row.num_solved} of {row.num_agents} at {row.threshold:g}",
            "median steps to solve": f"{median:,.0f}" if np.isfinite(median) else "-",
            "steps": f"{row.max_steps:,}",
            f"last {WINDOW} tests": f"{row.last_return:.1f} "
                                    f"[{row.last_low:.1f}, {row.last_high:.1f}]",
            "others": study.peers,
        })  # fmt: skip
    return pd.DataFrame(rows)


def report(settings: AgentLearning, curves: pd.DataFrame) -> pd.DataFrame:
    """Writes the summary, the picture and the table, and returns the table."""
    draw(settings, curves)
    summary = summarise(curves)
    note = (
        f"{settings.num_agents} seeds of each; after each training episode "
        f"{settings.test_episodes} greedy test episode. Solved: the mean of {WINDOW} tests in a "
        f"row reaches the threshold at some time. The last {WINDOW} tests: mean over seeds, "
        "bootstrap 95% interval. CartPole here is v0, of 200 steps."
    )
    title = "Agents that learn the real tasks"
    return publish(settings, title, make_table(summary), summary, note)


def draw(settings: AgentLearning, curves: pd.DataFrame, points: int = 100) -> None:
    """Draws a panel for each task: mean and 95% interval of each agent."""
    tasks = list(curves.groupby(curves["study"].map(lambda i: STUDIES[i].env), sort=False))
    palette = (figures.REAL, figures.VARIED, figures.FIXED, figures.SOLVED)
    columns = min(3, len(tasks))
    lines = -(-len(tasks) // columns)
    path = settings.folder / "learning_curves.png"
    with figures.panels(path, lines, columns, (4.6 * columns, 3.6 * lines)) as (_, axes):
        for axis in axes.ravel()[len(tasks) :]:
            axis.set_visible(False)
        for axis, (env, mine) in zip(axes.ravel(), tasks, strict=False):
            for color, (number, study_curves) in zip(palette, mine.groupby("study"), strict=False):
                study = STUDIES[int(number)]
                last_step = study_curves["steps"].max()
                grid = np.geomspace(last_step / 200, last_step, points)
                values = return_curves.on_grid(study_curves, grid)
                known = ~np.isnan(values).any(axis=0)
                low, high = np.transpose([bootstrap_interval(v) for v in values[:, known].T])
                label = figures.AGENT_NAMES[study.agent] + "*" * bool(study.hparams)
                figures.band(axis, grid[known], values[:, known].mean(axis=0), low, high, color,
                             lw=1.8, label=label)  # fmt: skip
            axis.axhline(sejax.envs.make(env).solved_reward, color="#7a7a7a", ls="--", lw=1)
            axis.set_title(env, fontsize=10)
            axis.set(xscale="log", xlabel="training steps (*: hyperparameters in the table)")
            axis.legend(fontsize=8, loc="best")
        for axis in axes[:, 0]:
            axis.set_ylabel(f"test return, mean of {WINDOW}")


EXPERIMENT = Experiment(settings=AgentLearning, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
