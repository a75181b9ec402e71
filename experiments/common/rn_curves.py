"""Agents that train with learned rewards, and their test returns against training steps.

The agents of a row of the paper's figure are trained under several conditions: on the real task, on
the real task with an exploration bonus, and on each of several RNs. Stored rows call the condition
`world`.
"""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from experiments.common import agents, curves, figures, tables
from experiments.common.agents import Condition
from experiments.common.experiment import setting
from experiments.common.reward_networks import AUGMENTED, PAPER_ROWS, SHOWN, RnSettings, label
from experiments.common.statistics import worst_tenth
from sejax import ProxySet, TrainingConfig
from sejax.agents import AgentConfig
from sejax.options import Count, registry, require, require_known

ROWS = {  # agents that are trained: the rows of the paper's figure, and one of ours
    "default": "default hyperparameters",
    "varied": "random hyperparameters",
    "transfer": "held-out algorithm",
    "tuned": "tuned for few steps",
}
WITHOUT_RN = ("real", "count_based", "icm")  # conditions whose groups have nothing in common
GRID_POINTS = 200


@dataclass(frozen=True, kw_only=True)
class CurveSettings(RnSettings):
    """Settings about the agents.

    Attributes:
      rows: Agents to train: default (the paper's hyperparameters; on continuous tasks those of the
        quick agent that RNs are learned with), varied (drawn for each agent), transfer (one that
        the RNs never saw), tuned (on the real task for few steps: DDQN on cartpole, PPO on
        mountain_car_continuous).
      bonuses: Exploration bonuses on the real task to compare with: count_based on cliff_walking,
        elsewhere icm; or none.
      rns: RNs of each variant that agents are trained on, the best
      bonus_groups: groups of agents with a bonus; as many as RNs
      num_agents: on each RN, in each row
      max_steps: of training; as the paper's figure
    """

    rows: tuple[str, ...] = setting(PAPER_ROWS, ROWS)
    bonuses: tuple[str, ...] = setting(())
    rns: Count = setting(10, quick=2)
    bonus_groups: Count = setting(10)
    num_agents: Count = setting(10, quick=4)
    max_steps: Count = setting(5000, quick=1500)

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> dict[str, Any]:
        default = super().defaults(given)
        default["rns"] = min(default["rns"], given.get("learned", default["learned"]))
        return default | {"bonus_groups": given.get("rns", default["rns"])}

    def __post_init__(self) -> None:
        super().__post_init__()
        for row in self.rows:
            require_known("rows", row, self.study.rows)
        for bonus in self.bonuses:
            require_known("bonuses", bonus, (*self.study.bonuses, "none"))
        must = f"must be at most learned={self.learned}; got {self.rns}"
        require(self.rns <= self.learned, "rns", must, fix=f"Set learned={self.rns}.")

    def agent(self, row: str) -> AgentConfig:
        """The agent that is trained in a row."""
        if row == "transfer":
            return self.study.transfer_agent
        if row == "tuned" and self.study.tuned_agent:
            return self.study.tuned_agent
        return self.study.agent or self.learning_agent

    def training(self, row: str) -> TrainingConfig:
        """Episodes of training and of tests alternate until a limit.

        At the task's time limit tuned agents bootstrap, as they were tuned; the paper's do not.
        """
        return TrainingConfig(
            max_episodes=self.study.max_episodes,
            max_steps=self.max_steps,
            stop_rule="never",
            tests_between=1,
            time_limit_is_terminal=row != "tuned",
        )


def real_curves(settings: CurveSettings) -> Iterator[pd.DataFrame]:
    """Curves of all agents on the real task, without and with the bonuses that are compared."""
    make = functools.partial(Condition.real, settings.task)
    yield from curves_in(settings, "real", settings.rns, make)
    for name, bonus in settings.study.bonuses.items():
        if name in settings.bonuses:
            yield from curves_in(settings, name, settings.bonus_groups, make, exploration=bonus)


def rn_curves(
    settings: CurveSettings, variant: str, rns: ProxySet, prefix: str = ""
) -> Iterator[pd.DataFrame]:
    """Curves of all agents on the RNs of a set, of which each group of agents has one."""
    make = functools.partial(Condition.of_set, rns)
    return curves_in(settings, variant, len(rns), make, prefix)


def curves_in(
    settings: CurveSettings, name: str, groups: int, make: Any, prefix: str = "", **more: Any
) -> Iterator[pd.DataFrame]:
    """Those of each row, `curves.thinned`, with the columns `group`, `row` and `world`.

    `make(group names, ...)` makes a condition; the prefix tells apart conditions of one name.
    """
    for row in settings.rows:
        condition = make(
            [f"{i:02d}" for i in range(groups)],
            name=f"{prefix}{row}-{name}",
            agent=settings.agent(row),
            training=settings.training(row),
            hparams="varied" if row == "varied" else "default",
            **more,
        )
        rows = agents.train_groups(condition, settings, settings.num_agents, curves.CURVES)
        group = rows["group"].astype(int)
        number = rows["agent"] + group * settings.num_agents
        rows = rows.assign(agent=number, group=group, row=row, world=name)
        yield curves.thinned(rows, step_grid(settings.max_steps), settings.task.solved_reward)


def by_row(settings: CurveSettings, rows: pd.DataFrame) -> pd.DataFrame:
    """The curves, those of the figure's first row of agents first, else in the order they have."""
    return pd.concat([rows[rows["row"] == row] for row in settings.rows], ignore_index=True)


def summarise(rows: pd.DataFrame, max_steps: int) -> pd.DataFrame:
    """One row for each row of the figure and condition.

    An agent that did not solve the task counts `max_steps`. Intervals are of the means of the RNs,
    since agents of one RN have much in common, and of agents where there are no RNs; of fewer than
    five there is none (nan).
    """
    grid = step_grid(max_steps)
    counted: dict[Any, Any] = {}  # steps and group of each agent, by row and condition

    def statistics(mine: pd.DataFrame) -> dict[str, float]:
        row, world = mine[["row", "world"]].iloc[0]
        each = mine.groupby("agent").first()
        groups, to_solve = each["group"], each["steps_to_solve"]
        steps = to_solve.clip(upper=max_steps)
        held = curves.on_grid(mine, grid)
        mean_return = pd.Series(np.nanmean(held, axis=1), index=steps.index)
        labels = None if world in WITHOUT_RN else groups
        counted[row, world] = steps, groups
        return (
            {"groups": groups.nunique(), "agents": len(steps)}
            | {"solved": np.isfinite(to_solve).mean()}
            | tables.mean_columns(steps, "steps", labels)
            | tables.mean_columns(mean_return, "return", labels)
            | {"return_worst_tenth": worst_tenth(mean_return)}
            | {"steps_restricted_to": max_steps}
            | {"last_return": each["last_return"].mean()}
        )

    summary = tables.summary_by(rows, ["row", "world"], statistics)
    shares = [
        share_of_bare(*mine, *counted[row, "real"]) if (row, "real") in counted else np.nan
        for (row, _), mine in counted.items()
    ]
    return summary.assign(share_of_bare=shares)


def share_of_bare(
    steps: pd.Series, groups: pd.Series, bare_steps: pd.Series, bare_groups: pd.Series
) -> float:
    """Mean steps as a share of those of the groups of the same seeds on the real task.

    A bonus has fewer groups, and where hyperparameters are drawn the groups' draws differ.
    """
    return float(steps.mean() / bare_steps[bare_groups.isin(groups.unique())].mean())


def step_grid(max_steps: int) -> np.ndarray:
    """Training steps at which curves are compared, `[GRID_POINTS]`."""
    return np.linspace(max_steps / GRID_POINTS, max_steps, GRID_POINTS)


def make_table(summary: pd.DataFrame) -> pd.DataFrame:
    """The summary as texts."""

    most = summary["steps_restricted_to"].iloc[0]
    return tables.as_texts(
        summary,
        {
            "agents": lambda row: ROWS[row.row],
            "trained with": "{world}",
            "groups, agents": "{groups}, {agents}",
            "interval over": lambda row: tables.drawn_text(
                *((row.agents, "agents") if row.world in WITHOUT_RN else (row.groups, "RNs"))
            ),
            f"steps to solve, restricted to {most:,}": tables.mean_text("steps", 0),
            "share of those without an RN": lambda row: tables.known_text(row.share_of_bare, ".0%"),
            "solved": "{solved:.0%}",
            "mean return over training": tables.mean_text("return", 1),
            "worst tenth": "{return_worst_tenth:.1f}",
            "last tests": "{last_return:.1f}",
        },
    )


def common_note(settings: CurveSettings, solved_reward: float) -> str:
    """What a reader must know of every table made of these curves."""
    learned_with = " Default hyperparameters are those that the RNs were learned with."
    return (
        f"up to {settings.max_steps:,} training steps or {settings.study.max_episodes:,} episodes, "
        "one greedy test episode after each. Steps to solve: restricted mean, until the mean of "
        f"{curves.WINDOW} tests in a row reaches {solved_reward:g}; an agent that never "
        f"does counts {settings.max_steps:,}. Those without an RN are of as many groups, "
        "of the same seeds. Curves that end early go on as the last test. "
        f"{tables.interval_note('what its column names')}"
        f"{tables.WORST_NOTE}{'' if settings.study.agent else learned_with}"
    )


def draw(settings: Any, rows: dict[str, pd.DataFrame], height: float, name: str) -> None:
    """Draws a line of panels for each kind of curves, and in it a panel for each row of agents.

    The curves are named by their label on the left; the height is a panel's, in inches.
    """
    shape = len(rows), len(settings.rows)
    size = 0.8 + 3.8 * shape[1], 0.8 + height * shape[0]
    solved_reward, path = settings.task.solved_reward, settings.folder / name
    with figures.panels(path, *shape, size, sharex=True, sharey=True) as (figure, axes):
        for line, (label, mine) in zip(axes, rows.items(), strict=True):
            for axis, row in zip(line, settings.rows, strict=True):
                panel(axis, mine[mine["row"] == row], settings.max_steps, solved_reward)
            line[0].set_ylabel(label)
        for axis, row in zip(axes[0], settings.rows, strict=True):
            agent = figures.agent_name(registry.name_of("agent", settings.agent(row)))
            axis.set_title(f"{agent}, {ROWS[row]}", fontsize=10)
        for axis in axes[-1]:
            axis.set_xlabel("training steps")
        figures.legend_above(figure, axes[0, 0])


def panel(axis: Any, rows: pd.DataFrame, max_steps: int, solved_reward: float) -> None:
    """Draws the mean test return under each condition with its standard error over all agents.

    Source: paper, figure "The average cumulative test rewards of agents when trained on different
    RN variants".
    """
    grid = step_grid(max_steps)
    for world, mine in rows.groupby("world", sort=False):
        name = str(world)
        style = "--" if name in WITHOUT_RN[1:] else ":" if AUGMENTED in name else "-"
        color, _ = SHOWN[name.removesuffix(AUGMENTED)]
        held, line = curves.on_grid(mine, grid), {"ls": style, "lw": 1.6}
        figures.band(axis, grid, held, standard_errors, color, label=label(name), **line)
    axis.axhline(solved_reward, color="#7a7a7a", ls=":", lw=1)


def standard_errors(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the mean with its standard error, `[points]` each, of `[agent, points]`."""
    mean, error = values.mean(axis=0), values.std(axis=0) / np.sqrt(len(values))
    return mean - error, mean + error
