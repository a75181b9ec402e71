"""How every agent learns its task: test returns against training steps, over many seeds.

Source: paper, Algorithm 1, TrainAgent and EvaluateAgent, with the real task in the SE's place.

After each training episode an agent plays `--test-episodes` greedy ones on the task, and nothing
ends its training but the step limit. A study is an agent on a task; its hyperparameters are the
paper's where `STUDIES` names no others, and its peers are what others report for the same task.
"""

import argparse
import functools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sejax.agents.configs import AGENT_CONFIGS
from sejax.configs import TrainingConfig
from sejax.experiments import common, return_curves
from sejax.experiments.return_curves import WINDOW
from sejax.validation import each_of

NAME = "agent_learning"
QUICK_STEPS, QUICK_AGENTS = 2000, 2
SHORTEST_EPISODE = 8  # CartPole cannot be lost sooner

# RL Baselines3 Zoo, benchmark.md: the final return of one agent, with the steps it was trained for.
ZOO = "RL Baselines3 Zoo"
PAPER_DDQN = "16,888 steps to solve, agents with drawn hyperparameters (the paper)"


@dataclass(frozen=True, kw_only=True)
class Study:
    """An agent on a task.

    Attributes:
      env: name of the task.
      agent: name of the agent.
      max_steps: training steps.
      hparams: hyperparameters other than the agent's defaults, which are the paper's.
      peers: what others report.
    """

    env: str
    agent: str
    max_steps: int
    hparams: dict[str, Any] = field(default_factory=dict)
    peers: str = ""

    @property
    def name(self) -> str:
        return f"{self.env}-{self.agent}"


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


def main() -> None:
    """Runs the experiment as the command line says."""
    common.run_command(NAME, __doc__, add_options, run)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this experiment."""
    parser.add_argument("--envs", nargs="+", default=list(dict.fromkeys(s.env for s in STUDIES)),
                        metavar="TASK", help="tasks whose agents are trained; all")  # fmt: skip
    parser.add_argument("--num-agents", type=int, help="seeds of each agent; 10, quick 2")
    parser.add_argument("--test-episodes", type=int, default=1, help="after each training episode")


def run(args: argparse.Namespace) -> pd.DataFrame:
    """Trains what is missing, writes everything and returns the table.

    Raises:
      ConfigError: for an unknown task or numbers that cannot work.
    """
    if args.num_agents is None:
        args.num_agents = QUICK_AGENTS if args.quick else 10
    common.require_counts(args, "num_agents", "test_episodes")
    known = tuple(dict.fromkeys(study.env for study in STUDIES))
    each_of("--envs", args.envs, known)
    pieces = common.Pieces(args.out / "pieces")
    tables = []
    for number, study in enumerate(STUDIES):
        if study.env not in args.envs:
            continue
        max_steps = min(study.max_steps, QUICK_STEPS) if args.quick else study.max_steps
        config = AGENT_CONFIGS[study.agent](**study.hparams)
        training = TrainingConfig(
            max_episodes=max_steps // SHORTEST_EPISODE,
            max_steps=max_steps,
            test_episodes=args.test_episodes,
            time_limit_is_terminal=False,  # as in the literature; the paper's code ends there
        )
        settings = {"agent": vars(config), "env": study.env, "training": vars(training),
                    "num_agents": args.num_agents, "seed": args.seed}  # fmt: skip
        curves = pieces.compute(
            f"{number:02d}-{study.name}", settings,
            functools.partial(train, config, study.env, training, args),
        )  # fmt: skip
        last = return_curves.last_returns(curves).mean()
        print(f"{study.name}: last {WINDOW} test returns {last:.1f}", flush=True)
        tables.append(curves.assign(study=number, max_steps=max_steps))
    return report(args, pd.concat(tables, ignore_index=True))


def train(
    config: Any, env: str, training: TrainingConfig, args: argparse.Namespace
) -> pd.DataFrame:
    """Trains the agents of a study; a row for each training episode of each."""
    import jax

    from sejax import envs
    from sejax.agents.configs import ExplorationConfig

    task = envs.make(env)
    program = return_curves.make_program(config, ExplorationConfig(), task.env, task, training,
                                         devices=args.devices)  # fmt: skip
    keys = jax.random.split(jax.random.key(args.seed), args.num_agents)
    return return_curves.to_table(*jax.device_get(program(keys, task.params)))


def summarise(curves: pd.DataFrame) -> pd.DataFrame:
    """One row for each study."""
    from sejax import envs

    rows = []
    for number, mine in curves.groupby("study"):
        study = STUDIES[int(number)]
        threshold = envs.make(study.env).solved_reward
        to_solve = mine.groupby("agent")[["steps", "test_return"]].apply(
            return_curves.steps_to_solve, solved_reward=threshold
        )
        last = return_curves.last_returns(mine)
        low, high = common.bootstrap_interval(last)
        rows.append({
            "study": number, "env": study.env, "agent": study.agent,
            "num_agents": len(last), "max_steps": mine["max_steps"].iloc[0], "threshold": threshold,
            "num_solved": int(np.isfinite(to_solve).sum()),
            "median_steps_to_solve": common.median(to_solve),
            "last_return": last.mean(), "last_low": low, "last_high": high,
        })  # fmt: skip
    return pd.DataFrame(rows)


def make_table(summary: pd.DataFrame) -> pd.DataFrame:
    """The summary as texts, with what others report."""
    rows = []
    for row in summary.itertuples():
        study = STUDIES[row.study]
        changed = ", ".join(f"{name} {value}" for name, value in study.hparams.items())
        median = row.median_steps_to_solve
        rows.append({
            "task": row.env,
            "agent": row.agent,
            "other than the paper's": changed,
            "solved": f"{row.num_solved} of {row.num_agents} at {row.threshold:g}",
            "median steps to solve": f"{median:,.0f}" if np.isfinite(median) else "-",
            "steps": f"{row.max_steps:,}",
            f"last {WINDOW} tests": f"{row.last_return:.1f} "
                                    f"[{row.last_low:.1f}, {row.last_high:.1f}]",
            "others": study.peers,
        })  # fmt: skip
    return pd.DataFrame(rows)


def report(args: argparse.Namespace, curves: pd.DataFrame) -> pd.DataFrame:
    """Writes the CSV, the picture and the table, prints the table and returns it."""
    from sejax.experiments import figures
    from sejax.files import write_text

    summary = summarise(curves)
    table = make_table(summary)
    write_text(args.out / "summary.csv", summary.to_csv(index=False))
    draw(curves, args.out / "learning_curves.png")
    title = "Agents that learn the real tasks"
    note = (
        f"{args.num_agents} seeds of each; after each training episode {args.test_episodes} "
        f"greedy test episode. Solved: the mean of {WINDOW} tests in a row reaches the threshold "
        f"at some time. The last {WINDOW} tests: mean over seeds, bootstrap 95% interval. "
        "CartPole here is v0, of 200 steps."
    )
    command = figures.command(NAME, args, "envs", "num_agents", "test_episodes")
    common.write_markdown(args.out / "table.md", title, command, table, note)
    figures.print_table(title, table)
    print(f"{args.out}: learning_curves.png, summary.csv and table.md.")
    return table


def draw(curves: pd.DataFrame, path: Path, points: int = 100) -> None:
    """Draws a panel for each task: mean and 95% interval of each agent."""
    import matplotlib.pyplot as plt

    from sejax import envs
    from sejax.experiments import figures

    panels = list(curves.groupby(curves["study"].map(lambda i: STUDIES[i].env), sort=False))
    palette = (figures.REAL, figures.VARIED, figures.FIXED, figures.SOLVED)
    with plt.rc_context(figures.STYLE):
        columns = min(3, len(panels))
        lines = -(-len(panels) // columns)
        figure, axes = plt.subplots(lines, columns, figsize=(4.6 * columns, 3.6 * lines),
                                    squeeze=False, layout="constrained")  # fmt: skip
        for axis in axes.ravel()[len(panels) :]:
            axis.set_visible(False)
        for axis, (env, mine) in zip(axes.ravel(), panels, strict=False):
            for color, (number, study_curves) in zip(palette, mine.groupby("study"), strict=False):
                study = STUDIES[int(number)]
                last_step = study_curves["steps"].max()
                grid = np.geomspace(last_step / 200, last_step, points)
                values = return_curves.on_grid(study_curves, grid)
                known = ~np.isnan(values).any(axis=0)
                bounds = [common.bootstrap_interval(v) for v in values[:, known].T]
                low, high = np.transpose(bounds)
                label = figures.AGENT_NAMES.get(study.agent, study.agent)
                axis.plot(grid[known], values[:, known].mean(axis=0), color=color, lw=1.8,
                          label=f"{label}*" if study.hparams else label)  # fmt: skip
                axis.fill_between(grid[known], low, high, color=color, alpha=0.18, lw=0)
            axis.axhline(envs.make(env).solved_reward, color="#7a7a7a", ls="--", lw=1)
            axis.set_title(str(env), fontsize=10)
            axis.set_xscale("log")
            axis.set_xlabel("training steps (*: hyperparameters in the table)")
            axis.legend(fontsize=8, loc="best")
        for axis in axes[:, 0]:
            axis.set_ylabel(f"test return, mean of {WINDOW}")
        figures.write(figure, path)


if __name__ == "__main__":
    main()
