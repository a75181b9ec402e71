"""How fast agents learn with learned rewards: test returns against training steps for each RN.

Source: paper, section "Experiments with Reward Networks" (figure with the average cumulative test
rewards, and the rows for default hyperparameters, varied ones and unseen agents), appendix
"HalfCheetah RNs Plots"; `reference_details.md` 7.3.

For each variant `--rns` RNs are learned, in `<out>/runs/<variant>/seed<N>`, and stored together in
`<out>/rns-<variant>.safetensors`. On each of them `--num-agents` agents are trained in each row,
and as many on the real task alone and with an exploration bonus. Episodes of training and of greedy
testing on the real task alternate, and nothing stops an agent early.

Differs: agents stop after the steps that the paper's figure shows, or its number of episodes.
"""

import argparse
import dataclasses
import functools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sejax.agents.configs import (
    EXPLORATION_CONFIGS,
    AgentConfig,
    DDQNConfig,
    DuelingDDQNConfig,
    ExplorationConfig,
    PPOConfig,
    QLearningConfig,
    SARSAConfig,
    TD3Config,
)
from sejax.configs import OBJECTIVES, RN_VARIANTS
from sejax.errors import require, unknown_name
from sejax.experiments import common, proxy_runs, return_curves

NAME = "rn_performance"
ROWS = {
    "default": "default hyperparameters",
    "varied": "varied hyperparameters",
    "transfer": "unseen agent",
}
QUICK = {"rns": 2, "num_agents": 4, "generations": 4, "max_steps": 1500}
QUICK_POPULATION = 8


@dataclass(frozen=True, kw_only=True)
class Study:
    """What the paper trains on the RNs of a task.

    Attributes:
      agent: of the rows with default and varied hyperparameters.
      transfer_agent: of the row with an unseen agent.
      bonuses: exploration bonuses that are compared on the real task.
      max_episodes: that the paper trains.
      max_steps: training steps that its figure shows.
      rns: number of RNs of each variant.
      num_agents: on each of them.
    """

    agent: AgentConfig
    transfer_agent: AgentConfig
    bonuses: tuple[str, ...] = ()
    max_episodes: int
    max_steps: int
    rns: int = 10
    num_agents: int = 10


# Paper, appendix "Reward Network Hyperparameters": the tables of default hyperparameters.
_CARTPOLE: dict[str, Any] = {
    "init_episodes": 1, "batch_size": 32, "learning_rate": 2.5e-4, "target_update_rate": 0.01,
    "epsilon_min": 0.1, "hidden_size": 64, "num_layers": 1, "buffer_size": 1_000_000,
}  # fmt: skip
STUDIES = {
    "cliff_walking": Study(
        agent=QLearningConfig(), transfer_agent=SARSAConfig(), bonuses=("count_based",),
        max_episodes=500, max_steps=5000,
    ),
    "cartpole": Study(
        agent=DDQNConfig(**_CARTPOLE), transfer_agent=DuelingDDQNConfig(**_CARTPOLE),
        bonuses=("icm",), max_episodes=1000, max_steps=50_000,
    ),
    "mountain_car_continuous": Study(
        agent=TD3Config(init_episodes=50, action_repeat=2),
        transfer_agent=PPOConfig(action_repeat=5), bonuses=("icm",),
        max_episodes=3000, max_steps=250_000,
    ),
}  # fmt: skip
LABELS = {
    "real": "real reward",
    "icm": "real reward + ICM",
    "count_based": "real reward + count-based",
    "additive_potential": r"$r + \gamma\Phi(s') - \Phi(s)$",
    "exclusive_potential": r"$\gamma\Phi(s') - \Phi(s)$",
    "additive_non_potential": r"$r + \Phi(s')$",
    "exclusive_non_potential": r"$\Phi(s')$",
}


@dataclass(frozen=True, kw_only=True)
class World:
    """What agents are trained in.

    Attributes:
      name: as in `LABELS`.
      env: gymnax environment.
      params: `EnvParams` of each group of agents.
      fingerprints: what tells the groups' worlds apart.
      exploration: bonus of the agents.
    """

    name: str
    env: Any
    params: tuple[Any, ...]
    fingerprints: tuple[str, ...]
    exploration: ExplorationConfig = field(default_factory=ExplorationConfig)


def main() -> None:
    """Runs the experiment as the command line says."""
    common.run_command(NAME, __doc__, add_options, run)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this experiment."""
    parser.add_argument("--env", default="cliff_walking", help=f"task: {', '.join(STUDIES)}")
    parser.add_argument("--variants", nargs="+", default=list(RN_VARIANTS), metavar="VARIANT",
                        help=", ".join(RN_VARIANTS))  # fmt: skip
    parser.add_argument("--rows", nargs="+", default=list(ROWS), metavar="ROW",
                        help=", ".join(ROWS))  # fmt: skip
    parser.add_argument("--objective", default="reward_threshold", help=", ".join(OBJECTIVES))
    parser.add_argument("--rns", type=int, help="RNs of each variant; 10")
    parser.add_argument("--generations", type=int, help="outer iterations; the preset's")
    parser.add_argument("--num-agents", type=int, help="on each RN, in each row; 10")
    parser.add_argument("--max-steps", type=int, help="training steps; as the paper's figure")
    parser.add_argument("--preset", default="best", help="of the NES runs: best, paper")


def fill_in(args: argparse.Namespace) -> None:
    """Sets the options that were not given, and checks all.

    Raises:
      ConfigError: for an unknown name or a number out of range.
    """
    if args.env not in STUDIES:
        raise unknown_name("--env", args.env, STUDIES)
    study = STUDIES[args.env]
    for name in ("rns", "num_agents", "generations", "max_steps"):
        if getattr(args, name) is None:
            setattr(args, name, QUICK[name] if args.quick else getattr(study, name, None))
    for option, names, known in (("--variants", args.variants, RN_VARIANTS),
                                 ("--rows", args.rows, ROWS)):  # fmt: skip
        for name in names:
            if name not in known:
                raise unknown_name(option, name, known)
    common.require_counts(args, "rns", "num_agents", "generations", "max_steps")
    require(args.objective in OBJECTIVES, "--objective", f"be one of {', '.join(OBJECTIVES)}",
            "RNs are learned by it", args.objective, "--objective=reward_threshold")  # fmt: skip


def run(args: argparse.Namespace) -> pd.DataFrame:
    """Computes what is missing, writes everything and returns the table.

    Raises:
      ConfigError: for settings that cannot work, or an output folder of other settings.
    """
    fill_in(args)
    pieces = common.Pieces(args.out / "pieces")
    for variant in args.variants:
        learn_rns(args, variant, pieces)
    worlds = make_worlds(args)
    tables = [
        train_all(args, row, world, pieces).assign(row=row, world=world.name)
        for row in args.rows
        for world in worlds
    ]
    return report(args, pd.concat(tables, ignore_index=True))


def rn_file(args: argparse.Namespace, variant: str) -> Path:
    """Where the RNs of a variant are stored."""
    return Path(args.out) / f"rns-{variant}.safetensors"


def learn_rns(args: argparse.Namespace, variant: str, pieces: common.Pieces) -> None:
    """Learns the RNs of a variant and stores them in one file."""
    import sejax

    overrides = [f"env={args.env}", "proxy=rn", f"preset={args.preset}",
                 f"proxy.variant={variant}", f"objective={args.objective}"]  # fmt: skip
    if args.generations is not None:
        overrides.append(f"generations={args.generations}")
    if args.quick:
        overrides.append(f"es.population_size={QUICK_POPULATION}")
    config = dataclasses.replace(sejax.config(overrides), devices=args.devices)
    configs = proxy_runs.configs_of_runs(config, args.seed, args.rns, args.out / "runs" / variant)
    proxy_runs.learn_all(configs, pieces, f"{variant}-")
    proxy_runs.collect(configs, rn_file(args, variant))


def make_worlds(args: argparse.Namespace) -> list[World]:
    """The real task, without and with bonuses, and the RNs of each variant."""
    from sejax import envs
    from sejax.experiments.proxy_sets import load_set

    task = envs.make(args.env)
    params, nothing = (task.params,) * args.rns, ("",) * args.rns
    bonuses = ("none", *STUDIES[args.env].bonuses)
    worlds = [
        World(name="real" if bonus == "none" else bonus, env=task.env, params=params,
              fingerprints=nothing, exploration=EXPLORATION_CONFIGS[bonus]())
        for bonus in bonuses
    ]  # fmt: skip
    for variant in args.variants:
        rns = load_set(rn_file(args, variant), "--out", "rn")
        indices = range(args.rns)
        worlds.append(World(name=variant, env=rns.env, params=tuple(map(rns.one, indices)),
                            fingerprints=tuple(map(rns.fingerprint, indices))))  # fmt: skip
    return worlds


def train_all(
    args: argparse.Namespace, row: str, world: World, pieces: common.Pieces
) -> pd.DataFrame:
    """Curves of a row's agents in a world; every group of agents is a piece."""
    study = STUDIES[args.env]
    agent = study.transfer_agent if row == "transfer" else study.agent
    tables = []
    for group in range(args.rns):
        settings = {"env": args.env, "agent": vars(agent), "row": row, "world": world.name,
                    "weights": world.fingerprints[group], "exploration": vars(world.exploration),
                    "num_agents": args.num_agents, "max_steps": args.max_steps,
                    "group": group, "seed": args.seed}  # fmt: skip
        curves = pieces.compute(
            f"{row}-{world.name}-{group:02d}", settings,
            functools.partial(train_group, args, agent, row, world, group),
        )  # fmt: skip
        tables.append(curves.assign(agent=curves["agent"] + group * args.num_agents, group=group))
    curves = pd.concat(tables, ignore_index=True)
    last = return_curves.last_returns(curves).mean()
    print(f"{row}, {world.name}: last test returns {last:.1f}", flush=True)
    return curves


def train_group(
    args: argparse.Namespace, agent: AgentConfig, row: str, world: World, group: int
) -> pd.DataFrame:
    """Curves of the agents on one RN, or of a group on the real task."""
    import jax

    from sejax import envs
    from sejax.configs import TrainingConfig

    task = envs.make(args.env)
    training = TrainingConfig(
        max_episodes=STUDIES[args.env].max_episodes, max_steps=args.max_steps, test_episodes=1,
        time_limit_is_terminal=True,
    )  # fmt: skip
    program = return_curves.make_program(
        agent, world.exploration, world.env, task, training,
        "varied" if row == "varied" else "default", args.devices,
    )  # fmt: skip
    key = jax.random.fold_in(jax.random.key(args.seed), group)
    keys = jax.random.split(key, args.num_agents)
    return return_curves.to_table(*jax.device_get(program(keys, world.params[group])))


def summarise(curves: pd.DataFrame, solved_reward: float, max_steps: int) -> pd.DataFrame:
    """One row for each row of the figure and world.

    An agent that did not solve the task counts `max_steps`. Intervals come from drawing groups
    (RNs) again, since agents of one RN have much in common.
    """
    out = []
    grid = np.linspace(max_steps / 200, max_steps, 200)
    for (row, world), mine in curves.groupby(["row", "world"], sort=False):
        agents = mine.groupby(["group", "agent"], sort=False)[["steps", "test_return"]]
        steps = agents.apply(return_curves.steps_to_solve, solved_reward=solved_reward)
        held = return_curves.on_grid(mine, grid, window=1)
        mean_return = pd.Series(np.nanmean(held, axis=1), index=steps.index)
        counted = steps.clip(upper=max_steps)
        low, high = common.bootstrap_interval(counted.groupby("group").mean())
        area_low, area_high = common.bootstrap_interval(mean_return.groupby("group").mean())
        out.append({
            "row": row, "world": world, "groups": mine["group"].nunique(), "agents": len(steps),
            "solved": float(np.isfinite(steps).mean()), "steps_to_solve": counted.mean(),
            "steps_low": low, "steps_high": high, "mean_return": mean_return.mean(),
            "return_low": area_low, "return_high": area_high,
            "last_return": return_curves.last_returns(mine).mean(),
        })  # fmt: skip
    return pd.DataFrame(out)


def make_table(summary: pd.DataFrame) -> pd.DataFrame:
    """The summary as texts."""
    bare = summary[summary["world"] == "real"].set_index("row")["steps_to_solve"]
    return pd.DataFrame([
        {
            "agents": ROWS[row.row],
            "trained with": row.world,
            "groups, agents": f"{row.groups}, {row.agents}",
            "steps to solve": f"{row.steps_to_solve:,.0f} "
                              f"[{row.steps_low:,.0f}, {row.steps_high:,.0f}]",
            "of the bare agent's": f"{row.steps_to_solve / bare[row.row]:.0%}"
            if row.row in bare else "",
            "solved": f"{row.solved:.0%}",
            "mean return over training": f"{row.mean_return:.1f} "
                                         f"[{row.return_low:.1f}, {row.return_high:.1f}]",
            "last tests": f"{row.last_return:.1f}",
        }
        for row in summary.itertuples()
    ])  # fmt: skip


def report(args: argparse.Namespace, curves: pd.DataFrame) -> pd.DataFrame:
    """Writes the CSV, the picture and the table, prints the table and returns it."""
    from sejax import envs
    from sejax.experiments import figures
    from sejax.files import write_text

    task = envs.make(args.env)
    summary = summarise(curves, task.solved_reward, args.max_steps)
    table = make_table(summary)
    write_text(args.out / "summary.csv", summary.to_csv(index=False))
    draw(curves, args, task.solved_reward, args.out / "performance.png")
    title = f"Agents trained with reward networks and tested on {args.env}"
    note = (
        f"{args.rns} RNs of each variant, learned by {args.objective}, with {args.num_agents} "
        f"agents each, and as many groups on the real task; up to {args.max_steps:,} training "
        "steps, one greedy test episode after each training episode. Steps to solve: until the "
        f"mean of {return_curves.WINDOW} tests in a row reaches {task.solved_reward:g}; an agent "
        "that never does counts all steps. In brackets bootstrap 95% intervals that draw groups. "
        "The paper shows curves and gives no numbers: on each of these tasks some variant learns "
        "faster than all agents without an RN, the additive ones most reliably."
    )
    command = figures.command(NAME, args, "env", "variants", "rows", "objective", "rns",
                              "generations", "num_agents", "max_steps", "preset")  # fmt: skip
    common.write_markdown(args.out / "table.md", title, command, table, note)
    figures.print_table(title, table)
    print(f"{args.out}: summary.csv, performance.png and table.md; the RNs are in "
          f"{args.out / 'rns-VARIANT.safetensors'}.")  # fmt: skip
    return table


def draw(curves: pd.DataFrame, args: argparse.Namespace, solved_reward: float, path: Path) -> None:
    """Draws a panel for each row: mean test return of each world with its standard error.

    Source: paper, figure "The average cumulative test rewards of agents when trained on different
    RN variants".
    """
    import matplotlib.pyplot as plt

    from sejax.experiments import figures

    colors = {
        "real": figures.BEST, "icm": "#7a7a7a", "count_based": "#7a7a7a",
        "additive_potential": figures.REAL, "exclusive_potential": "#56B4E9",
        "additive_non_potential": figures.VARIED, "exclusive_non_potential": figures.FIXED,
    }  # fmt: skip
    grid = np.linspace(args.max_steps / 200, args.max_steps, 200)
    with plt.rc_context(figures.STYLE):
        figure, axes = plt.subplots(
            1, len(args.rows), figsize=(0.6 + 4 * len(args.rows), 3.9), sharey=True,
            squeeze=False, layout="constrained",
        )  # fmt: skip
        for axis, row in zip(axes[0], args.rows, strict=True):
            mine = curves[curves["row"] == row]
            for world, world_curves in mine.groupby("world", sort=False):
                values = return_curves.on_grid(world_curves, grid, window=1)
                known = ~np.isnan(values).any(axis=0)
                mean = values[:, known].mean(axis=0)
                error = values[:, known].std(axis=0) / np.sqrt(len(values))
                color = colors[str(world)]
                style = "--" if world in ("icm", "count_based") else "-"
                axis.plot(grid[known], mean, color=color, ls=style, lw=1.6,
                          label=LABELS[str(world)])  # fmt: skip
                axis.fill_between(grid[known], mean - error, mean + error, color=color,
                                  alpha=0.2, lw=0)  # fmt: skip
            axis.axhline(solved_reward, color="#7a7a7a", ls=":", lw=1)
            study = STUDIES[args.env]
            agent = study.transfer_agent if row == "transfer" else study.agent
            name = figures.AGENT_NAMES[agent.name]
            axis.set_title(f"{name}, {ROWS[row]}", fontsize=10)
            axis.set_xlabel("training steps")
        axes[0, 0].set_ylabel(f"test return on {args.env}")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, ncols=min(len(labels), 4), loc="outside upper center",
                      fontsize=9)  # fmt: skip
        figures.write(figure, path)


if __name__ == "__main__":
    main()
