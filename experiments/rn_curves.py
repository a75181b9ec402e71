"""Training agents with learned rewards, and their test returns against training steps.

The agents of a row of the paper's figure are trained in worlds: the real task, the real task with
an exploration bonus, and each of several RNs.
"""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from experiments import figures, return_curves, rn_studies, tables, worlds
from experiments.rn_studies import RnSettings
from experiments.settings import count, each_of, setting
from experiments.tables import as_texts, iqm_columns, iqm_note, iqm_text
from experiments.worlds import World
from sejax import errors
from sejax.errors import require
from sejax.options import counts
from sejax.registry import name_of
from sejax.training import TrainingConfig

ROWS = {
    "default": "default hyperparameters",
    "varied": "varied hyperparameters",
    "transfer": "unseen agent",
    "tuned": "tuned for few steps",
}
GRID_POINTS = 200
WITHOUT_RN = ("real", "count_based", "icm")  # worlds whose groups of agents have nothing in common


@dataclass(frozen=True, kw_only=True)
class CurveSettings(RnSettings):
    """Settings about the agents."""

    rows: tuple[str, ...] = setting(
        rn_studies.ROWS,
        each_of(ROWS),
        about="agents to train: default (the paper's hyperparameters; on continuous tasks those of "
        "the quick agent that RNs are learned with), varied (drawn for each agent), transfer (one "
        "that the RNs never saw), tuned (on the real task for few steps: DDQN on cartpole, PPO on "
        "mountain_car_continuous)",
    )
    bonuses: tuple[str, ...] = setting(
        (),
        about="exploration bonuses on the real task to compare "
        "with: count_based on cliff_walking, elsewhere icm; or "
        "none",
    )
    rns: int = count(10, "RNs", about="RNs of each variant that agents are trained on, the best")
    bonus_groups: int = count(
        10, "groups", about="groups of agents with a bonus, which are dear; as many as RNs are used"
    )
    num_agents: int = count(10, "agents", about="on each RN, in each row")
    max_steps: int = setting(
        5000, counts("an agent must train"), about="training steps; as the paper's figure"
    )

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> dict[str, Any]:
        usual = super().defaults(given)
        usual["rns"] = min(usual["rns"], given.get("learned", usual["learned"]))
        return usual | {"bonus_groups": given.get("rns", usual["rns"])}

    def __post_init__(self) -> None:
        super().__post_init__()
        errors.each_of("rows", self.rows, self.study.rows)
        errors.each_of("bonuses", self.bonuses, (*self.study.bonuses, "none"))
        require(
            self.rns <= self.learned,
            "rns",
            f"be at most {self.learned}",
            "so many are learned",
            self.rns,
            f"learned={self.rns}",
        )

    def agent(self, row: str) -> Any:
        """The agent that is trained in a row."""
        if row == "transfer":
            return self.study.transfer_agent
        if row == "tuned" and self.study.tuned_agent:
            return self.study.tuned_agent()
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
    make = functools.partial(World.real, settings.task)
    yield from curves_in(settings, "real", settings.rns, make)
    for name, bonus in settings.study.bonuses.items():
        if name in settings.bonuses:
            yield from curves_in(settings, name, settings.bonus_groups, make, exploration=bonus)


def rn_curves(settings: CurveSettings, variant: str, rns: Any, prefix: str = "") -> Any:
    """Curves of all agents on the RNs of a set, of which each group of agents has one."""
    make = functools.partial(World.of_set, rns)
    return curves_in(settings, variant, rns.size, make, prefix)


def curves_in(
    settings: CurveSettings, name: str, groups: int, make: Any, prefix: str = "", **more: Any
) -> Iterator[pd.DataFrame]:
    """Those of each row, with the columns `group`, `row` and `world`.

    `make(group names, ...)` makes a world; the prefix tells apart the pieces of worlds of one name.
    """
    for row in settings.rows:
        world = make(
            [f"{i:02d}" for i in range(groups)],
            name=f"{prefix}{row}-{name}",
            agent=settings.agent(row),
            training=settings.training(row),
            hparams="varied" if row == "varied" else "default",
            **more,
        )
        curves = worlds.train_groups(world, settings, settings.num_agents, worlds.CURVES)
        group = curves["group"].astype(int)
        number = curves["agent"] + group * settings.num_agents
        yield curves.assign(agent=number, group=group, row=row, world=name)


def by_row(settings: CurveSettings, curves: pd.DataFrame) -> pd.DataFrame:
    """The curves, those of the figure's first row of agents first, else in the order they have."""
    return pd.concat([curves[curves["row"] == row] for row in settings.rows], ignore_index=True)


def require_rows(settings: CurveSettings, curves: pd.DataFrame) -> None:
    """Checks that rows which are there are of as many groups as a table's text will say.

    Raises:
      ConfigError: if they are not, as where other settings made them.
    """
    there, asked = list(curves["row"].drop_duplicates()), list(settings.rows)
    require(
        sorted(there) == sorted(asked),
        "rows",
        f"be {', '.join(there)}",
        f"these are in {settings.rows_file}",
        ", ".join(asked),
        f"rows=[{','.join(there)}], or from_rows=false",
    )
    for (_, world), mine in curves.groupby(["row", "world"], sort=False):
        agents = mine["agent"].nunique() // mine["group"].nunique()
        require(
            agents == settings.num_agents,
            "num_agents",
            f"be {agents}",
            f"{settings.rows_file} has so many in a group",
            settings.num_agents,
            f"num_agents={agents}, or from_rows=false",
        )
        name = "bonus_groups" if world in settings.study.bonuses else "rns"
        there, asked = mine["group"].nunique(), getattr(settings, name)
        require(
            there == asked,
            name,
            f"be {there}",
            f"{settings.rows_file} has so many groups of {world}",
            asked,
            f"{name}={there}, or from_rows=false",
        )


def summarise(curves: pd.DataFrame, solved_reward: float, max_steps: int) -> pd.DataFrame:
    """One row for each row of the figure and world.

    An agent that did not solve the task counts `max_steps`. Intervals come from drawing RNs again,
    since agents of one RN have much in common, and agents where there are no RNs; of fewer than
    five there is none (nan).
    """
    out = []
    grid = step_grid(max_steps)
    solved: dict[Any, Any] = {}  # steps and group of each agent, by row and world
    for (row, world), mine in curves.groupby(["row", "world"], sort=False):
        groups = mine.groupby("agent")["group"].first()
        steps = return_curves.all_steps_to_solve(mine, solved_reward)
        held = return_curves.on_grid(mine, grid, window=1)
        mean_return = pd.Series(np.nanmean(held, axis=1), index=steps.index)
        counted = steps.clip(upper=max_steps)
        solved[row, world] = counted, groups
        out.append(
            {
                "row": row,
                "world": world,
                "groups": groups.nunique(),
                "agents": len(steps),
                "solved": float(np.isfinite(steps).mean()),
                "steps_to_solve": counted.mean(),
                **interval(counted, groups, str(world), "steps"),
                "mean_return": mean_return.mean(),
                **interval(mean_return, groups, str(world), "return"),
                **iqm_columns(mean_return, "return", None if world in WITHOUT_RN else groups),
                "last_return": return_curves.last_returns(mine).mean(),
            }
        )
    shares = [
        share_of_bare(*mine, *solved[row, "real"]) if (row, "real") in solved else np.nan
        for (row, _), mine in solved.items()
    ]
    return pd.DataFrame(out).assign(share_of_bare=shares)


def share_of_bare(
    steps: pd.Series, groups: pd.Series, bare_steps: pd.Series, bare_groups: pd.Series
) -> float:
    """Mean steps as a share of those of the groups of the same seeds on the real task.

    A bonus has fewer groups, and where hyperparameters are drawn the groups' draws differ.
    """
    return float(steps.mean() / bare_steps[bare_groups.isin(groups.unique())].mean())


def interval(values: pd.Series, groups: pd.Series, world: str, name: str) -> dict[str, float]:
    """95% bootstrap interval of the mean over agents, of which each has a group."""
    low, high = tables.interval(values if world in WITHOUT_RN else values.groupby(groups).mean())
    return {f"{name}_low": low, f"{name}_high": high}


def step_grid(max_steps: int) -> np.ndarray:
    """Training steps at which curves are compared, `[GRID_POINTS]`."""
    return np.linspace(max_steps / GRID_POINTS, max_steps, GRID_POINTS)


def make_table(summary: pd.DataFrame) -> pd.DataFrame:
    """The summary as texts."""
    return as_texts(
        summary,
        {
            "agents": lambda row: ROWS[row.row],
            "trained with": "{world}",
            "groups, agents": "{groups}, {agents}",
            "steps to solve": lambda row: with_interval(
                row.steps_to_solve, row.steps_low, row.steps_high, 0
            ),
            "of the bare agent's": lambda row: (
                f"{row.share_of_bare:.0%}" if np.isfinite(row.share_of_bare) else ""
            ),
            "solved": "{solved:.0%}",
            "mean return over training": lambda row: with_interval(
                row.mean_return, row.return_low, row.return_high, 1
            ),
            "IQM": iqm_text("return"),
            "last tests": "{last_return:.1f}",
        },
    )


def with_interval(mean: float, low: float, high: float, digits: int) -> str:
    """A mean and its interval, if it has one."""
    return f"{mean:,.{digits}f}{tables.brackets(low, high, digits)}"


def common_note(settings: CurveSettings, solved_reward: float) -> str:
    """What is to be known of every table made of these curves."""
    return (
        f"up to {settings.max_steps:,} training steps or {settings.study.max_episodes:,} episodes, "
        "one greedy test episode after each. Steps to solve: until the mean of "
        f"{return_curves.WINDOW} tests in a row reaches {solved_reward:g}; an agent that never "
        f"does counts {settings.max_steps:,}. The share of the bare agent's is of as many groups, "
        "of the same seeds. Where episodes end before the steps do, a curve and its mean go on as "
        "the last test. In brackets bootstrap 95% intervals, for at least "
        f"five RNs: they draw RNs, and agents on the real task.{iqm_note('within each RN')}"
        + (
            ""
            if settings.study.agent
            else " Default hyperparameters are those of the agent that "
            "the RNs were learned with, not the paper's."
        )
    )


def draw(settings: Any, curves: dict[str, pd.DataFrame], height: float, name: str) -> None:
    """Draws a line of panels for each kind of curves, and in it a panel for each row of agents.

    The curves are named by their label on the left; the height is a panel's, in inches.
    """
    shape = len(curves), len(settings.rows)
    size = 0.8 + 3.8 * shape[1], 0.8 + height * shape[0]
    solved_reward, path = settings.task.solved_reward, settings.folder / name
    with figures.panels(path, *shape, size, sharex=True, sharey=True) as (figure, axes):
        for line, (label, mine) in zip(axes, curves.items(), strict=True):
            for axis, row in zip(line, settings.rows, strict=True):
                panel(axis, mine[mine["row"] == row], settings.max_steps, solved_reward)
            line[0].set_ylabel(label)
        for axis, row in zip(axes[0], settings.rows, strict=True):
            agent = figures.AGENT_NAMES[name_of("agent", settings.agent(row))]
            axis.set_title(f"{agent}, {ROWS[row]}", fontsize=10)
        for axis in axes[-1]:
            axis.set_xlabel("training steps")
        figures.legend_above(figure, axes[0, 0])


def panel(axis: Any, curves: pd.DataFrame, max_steps: int, solved_reward: float) -> None:
    """Draws one row's mean test return of each world with its standard error over all agents.

    Source: paper, figure "The average cumulative test rewards of agents when trained on different
    RN variants".
    """
    grid = step_grid(max_steps)
    for world, mine in curves.groupby("world", sort=False):
        name = str(world)
        dashed = name in WITHOUT_RN and name != "real"
        style = "--" if dashed else ":" if rn_studies.AUGMENTED in name else "-"
        color, _ = rn_studies.SHOWN[name.removesuffix(rn_studies.AUGMENTED)]
        figures.band(
            axis,
            grid,
            return_curves.on_grid(mine, grid, window=1),
            standard_errors,
            color,
            ls=style,
            lw=1.6,
            label=rn_studies.label(name),
        )
    axis.axhline(solved_reward, color="#7a7a7a", ls=":", lw=1)


def standard_errors(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the mean with its standard error, `[points]` each, of `[agent, points]`."""
    mean, error = values.mean(axis=0), values.std(axis=0) / np.sqrt(len(values))
    return mean - error, mean + error
