"""Training agents with learned rewards, and their test returns against training steps.

The agents of a row of the paper's figure are trained in worlds: the real task, the real task with
an exploration bonus, and each of several RNs. Every group of agents is a piece that is computed
once.
"""

import argparse
import functools
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from sejax.agents.configs import AgentConfig, ExplorationConfig
from sejax.configs import EnvConfig, TrainingConfig
from sejax.experiments import common, return_curves, rn_studies
from sejax.validation import each_of

ROWS = {
    "default": "default hyperparameters",
    "varied": "varied hyperparameters",
    "transfer": "unseen agent",
}
GRID_POINTS = 200
WITHOUT_RN = ("real", "count_based", "icm")  # worlds whose groups of agents have nothing in common
LEAST_FOR_INTERVAL = 5  # independent values


@dataclass(frozen=True, kw_only=True)
class World:
    """What agents are trained in.

    Attributes:
      name: as in `rn_studies.LABELS`.
      env: gymnax environment.
      env_config: of the real task that agents are tested on.
      params: `EnvParams` of each group of agents.
      fingerprints: what tells the groups' worlds apart.
      exploration: bonus of the agents.
      settings: of the RNs; plain values.
    """

    name: str
    env: Any
    env_config: EnvConfig
    params: tuple[Any, ...]
    fingerprints: tuple[str, ...]
    exploration: ExplorationConfig = field(default_factory=ExplorationConfig)
    settings: dict[str, Any] = field(default_factory=dict)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options about the agents; with those of `rn_studies`."""
    rn_studies.add_options(parser)
    parser.add_argument("--rows", nargs="+", metavar="ROW", help="agents to train: default (the "
                        "paper's hyperparameters), varied (drawn for each agent), transfer (one "
                        "that the RNs never saw); all")  # fmt: skip
    parser.add_argument("--bonuses", nargs="+", metavar="BONUS", help="exploration bonuses on the "
                        "real task to compare with: count_based on cliff_walking, elsewhere icm; "
                        "or none")  # fmt: skip
    parser.add_argument("--bonus-groups", type=int, help="groups of agents with a bonus, which are "
                        "dear; as many as RNs are used")  # fmt: skip
    parser.add_argument("--rns", type=int, help="RNs of each variant that agents are trained on, "
                        "the best; 10, on halfcheetah 5")  # fmt: skip
    parser.add_argument("--num-agents", type=int, help="on each RN, in each row; 10, on "
                        "halfcheetah 5")  # fmt: skip
    parser.add_argument("--max-steps", type=int, help="training steps; as the paper's figure")


def fill_in(args: argparse.Namespace) -> None:
    """Sets the options that were not given, and checks all.

    Raises:
      ConfigError: for an unknown name or a number out of range.
    """
    rn_studies.fill_in(args)
    args.rows = args.rows or list(ROWS)
    each_of("--rows", args.rows, ROWS)
    bonuses = rn_studies.STUDIES[args.env].bonuses
    args.bonuses = list(bonuses) if args.bonuses is None else args.bonuses
    each_of("--bonuses", args.bonuses, (*bonuses, "none"))
    common.require_counts(args, "rns", "num_agents", "max_steps", "bonus_groups")
    args.rns = min(args.rns, args.learned)
    args.bonus_groups = None if args.bonuses == ["none"] else args.bonus_groups or args.rns


def agent_of(args: argparse.Namespace, row: str) -> AgentConfig:
    """The agent that is trained in a row."""
    study = rn_studies.STUDIES[args.env]
    return study.transfer_agent if row == "transfer" else study.agent


def real_worlds(args: argparse.Namespace) -> list[World]:
    """The real task, without and with the bonuses that are compared."""
    env_config = rn_studies.env_config(args)
    task = env_config.make()
    studied = rn_studies.STUDIES[args.env].bonuses
    worlds = {
        "real": (ExplorationConfig(), args.rns),
        **{name: (studied[name], args.bonus_groups) for name in studied if name in args.bonuses},
    }
    return [
        World(name=name, env=task.env, env_config=env_config, params=(task.params,) * groups,
              fingerprints=("",) * groups, exploration=bonus)
        for name, (bonus, groups) in worlds.items()
    ]  # fmt: skip


def rn_world(variant: str, rns: Any) -> World:
    """The RNs of a set, one for each group of agents."""
    indices = range(rns.size)
    return World(name=variant, env=rns.env, env_config=rns.config.env,
                 params=tuple(map(rns.one, indices)),
                 fingerprints=tuple(map(rns.fingerprint, indices)),
                 settings=vars(rns.config.proxy))  # fmt: skip


def train_all(
    args: argparse.Namespace, row: str, world: World, pieces: common.Pieces, prefix: str = ""
) -> pd.DataFrame:
    """Curves of a row's agents in a world, with the columns `row`, `world`, `group`.

    Args:
      args: with the options of `add_options`, filled in.
      row: one of `ROWS`.
      world: where they train.
      pieces: where finished groups of agents are kept.
      prefix: of the pieces' names, to tell worlds of one name apart.
    """
    agent = agent_of(args, row)
    training = TrainingConfig(
        max_episodes=rn_studies.STUDIES[args.env].max_episodes,
        max_steps=args.max_steps,
        test_episodes=1,
    )
    tables = []
    for group in range(len(world.params)):
        settings = {"env": vars(world.env_config), "agent": vars(agent), "row": row,
                    "world": world.name, "proxy": world.settings,
                    "weights": world.fingerprints[group], "exploration": vars(world.exploration),
                    "training": vars(training), "num_agents": args.num_agents, "group": group,
                    "seed": args.seed}  # fmt: skip
        curves = pieces.compute(
            f"{prefix}{row}-{world.name}-{group:02d}", settings,
            functools.partial(train_group, args, agent, row, world, training, group),
        )  # fmt: skip
        tables.append(curves.assign(agent=curves["agent"] + group * args.num_agents, group=group))
    curves = pd.concat(tables, ignore_index=True)
    last = return_curves.last_returns(curves).mean()
    print(f"{prefix}{row}, {world.name}: last test returns {last:.1f}", flush=True)
    return curves.assign(row=row, world=world.name)


def train_group(
    args: argparse.Namespace,
    agent: AgentConfig,
    row: str,
    world: World,
    training: TrainingConfig,
    group: int,
) -> pd.DataFrame:
    """Curves of the agents on one RN, or of a group on the real task."""
    import jax

    program = return_curves.make_program(
        agent, world.exploration, world.env, world.env_config.make(), training,
        "varied" if row == "varied" else "default", args.devices,
    )  # fmt: skip
    key = jax.random.fold_in(jax.random.key(args.seed), group)
    keys = jax.random.split(key, args.num_agents)
    return return_curves.to_table(*jax.device_get(program(keys, world.params[group])))


def by_row(args: argparse.Namespace, curves: pd.DataFrame) -> pd.DataFrame:
    """The curves, those of the figure's first row of agents first, else in the order they have."""
    return pd.concat([curves[curves["row"] == row] for row in args.rows], ignore_index=True)


def summarise(curves: pd.DataFrame, solved_reward: float, max_steps: int) -> pd.DataFrame:
    """One row for each row of the figure and world.

    An agent that did not solve the task counts `max_steps`. Intervals come from drawing RNs again,
    since agents of one RN have much in common, and agents where there are no RNs; of fewer than
    `LEAST_FOR_INTERVAL` there is none (nan).
    """
    out = []
    grid = step_grid(max_steps)
    for (row, world), mine in curves.groupby(["row", "world"], sort=False):
        agents = mine.groupby(["group", "agent"], sort=False)[["steps", "test_return"]]
        steps = agents.apply(return_curves.steps_to_solve, solved_reward=solved_reward)
        held = return_curves.on_grid(mine, grid, window=1)
        mean_return = pd.Series(np.nanmean(held, axis=1), index=steps.index)
        counted = steps.clip(upper=max_steps)
        low, high = interval(counted, str(world))
        area_low, area_high = interval(mean_return, str(world))
        out.append({
            "row": row, "world": world, "groups": mine["group"].nunique(), "agents": len(steps),
            "solved": float(np.isfinite(steps).mean()), "steps_to_solve": counted.mean(),
            "steps_low": low, "steps_high": high, "mean_return": mean_return.mean(),
            "return_low": area_low, "return_high": area_high,
            "last_return": return_curves.last_returns(mine).mean(),
        })  # fmt: skip
    return pd.DataFrame(out)


def interval(values: pd.Series, world: str) -> tuple[float, float]:
    """95% bootstrap interval of the mean over agents, indexed by their group."""
    independent = values if world in WITHOUT_RN else values.groupby("group").mean()
    if len(independent) < LEAST_FOR_INTERVAL:
        return np.nan, np.nan
    return common.bootstrap_interval(independent)


def step_grid(max_steps: int) -> np.ndarray:
    """Training steps at which curves are compared, `[GRID_POINTS]`."""
    return np.linspace(max_steps / GRID_POINTS, max_steps, GRID_POINTS)


def make_table(summary: pd.DataFrame) -> pd.DataFrame:
    """The summary as texts."""
    bare = summary[summary["world"] == "real"].set_index("row")["steps_to_solve"]
    return pd.DataFrame([
        {
            "agents": ROWS[row.row],
            "trained with": row.world,
            "groups, agents": f"{row.groups}, {row.agents}",
            "steps to solve": with_interval(row.steps_to_solve, row.steps_low, row.steps_high, 0),
            "of the bare agent's": f"{row.steps_to_solve / bare[row.row]:.0%}"
            if row.row in bare else "",
            "solved": f"{row.solved:.0%}",
            "mean return over training":
                with_interval(row.mean_return, row.return_low, row.return_high, 1),
            "last tests": f"{row.last_return:.1f}",
        }
        for row in summary.itertuples()
    ])  # fmt: skip


def with_interval(mean: float, low: float, high: float, digits: int) -> str:
    """A mean and its interval, if it has one."""
    brackets = f" [{low:,.{digits}f}, {high:,.{digits}f}]" if np.isfinite(low) else ""
    return f"{mean:,.{digits}f}{brackets}"


def panel(axis: Any, curves: pd.DataFrame, args: argparse.Namespace, solved_reward: float) -> None:
    """Draws one row's mean test return of each world with its standard error over all agents.

    Source: paper, figure "The average cumulative test rewards of agents when trained on different
    RN variants".
    """
    from sejax.experiments import figures

    colors = {
        "real": figures.BEST, "icm": "#7a7a7a", "count_based": "#7a7a7a",
        "additive_potential": figures.REAL, "exclusive_potential": "#56B4E9",
        "additive_non_potential": figures.VARIED, "exclusive_non_potential": figures.FIXED,
        "additive_weighted_info": figures.SOLVED, "exclusive_weighted_info": "#CC79A7",
    }  # fmt: skip
    grid = step_grid(args.max_steps)
    for world, mine in curves.groupby("world", sort=False):
        name = str(world)
        values = return_curves.on_grid(mine, grid, window=1)
        known = ~np.isnan(values).any(axis=0)
        mean = values[:, known].mean(axis=0)
        error = values[:, known].std(axis=0) / np.sqrt(len(values))
        color = colors[name.removesuffix(rn_studies.AUGMENTED)]
        dashed = name in WITHOUT_RN and name != "real"
        style = "--" if dashed else ":" if rn_studies.AUGMENTED in name else "-"
        axis.plot(grid[known], mean, color=color, ls=style, lw=1.6, label=rn_studies.label(name))
        axis.fill_between(grid[known], mean - error, mean + error, color=color, alpha=0.2, lw=0)
    axis.axhline(solved_reward, color="#7a7a7a", ls=":", lw=1)


def panel_title(args: argparse.Namespace, row: str) -> str:
    """Who is trained in a row."""
    from sejax.experiments import figures

    return f"{figures.AGENT_NAMES[agent_of(args, row).name]}, {ROWS[row]}"
