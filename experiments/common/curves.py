"""Learning curves: test returns against training steps.

A curve is a table with a row for each training episode of an agent: `agent`, `steps` (training
steps at its end) and `test_return`, the mean of the greedy episodes after it on the real task.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd

from experiments.common.agents import Measure
from sejax import Agent, Task, TrainingConfig
from sejax.envs.environment import Environment
from sejax.evaluation import make_tested_trainer
from sejax.ops.scores import reaches

WINDOW = 10  # test episodes that a point of a smoothed curve is the mean of
DECIMALS = 2  # of stored test returns


def make_curve_run(
    agent: Agent, env: Environment, task: Task, training: TrainingConfig
) -> Callable[..., Any]:
    """Builds `run(key, env_params, active) -> (test returns, training steps)`, `[episode]` each.

    Entries after an agent's last episode are nan and 0.
    """

    def make_run(agent: Agent) -> Callable[..., Any]:
        train = make_tested_trainer(agent, env, task, training)

        def run(key: Any, env_params: Any, active: Any, hparams: Any) -> Any:
            result = train(key, env_params, hparams, active)
            return result.test_returns, result.episode_ends

        return run

    return agent.with_hparams(make_run)


def curve_rows(curves: tuple[np.ndarray, np.ndarray], drawn: Any = None) -> pd.DataFrame:
    """A row for each training episode, of test returns and training steps `[agent, episode]`."""
    tables = []
    for agent, (returns, ends) in enumerate(zip(*curves, strict=True)):
        count = int((ends > 0).sum())
        columns = {"steps": ends[:count], "test_return": returns[:count].astype(float)}
        tables.append(pd.DataFrame({"agent": agent} | columns))
    return pd.concat(tables, ignore_index=True)


def on_grid(curves: pd.DataFrame, grid: np.ndarray) -> np.ndarray:
    """Each agent's test return at the steps of a grid, `[agent, points]`.

    It is that of the last finished episode; nan before the first.
    """
    rows = []
    for _, curve in curves.groupby("agent")[["steps", "test_return"]]:
        place = np.searchsorted(curve["steps"].to_numpy(), grid, side="right") - 1
        rows.append(np.where(place >= 0, curve["test_return"].to_numpy()[place], np.nan))
    return np.stack(rows)


def steps_to_solve(curve: pd.DataFrame, solved_reward: float) -> float:
    """Training steps of an agent until `WINDOW` tests have a mean high enough; inf if never."""
    full = curve["test_return"].rolling(WINDOW).mean().to_numpy()
    solved = np.flatnonzero(reaches(full, solved_reward))
    return float(curve["steps"].iloc[solved[0]]) if len(solved) else np.inf


def thinned(curves: pd.DataFrame, grid: np.ndarray, solved_reward: float) -> pd.DataFrame:
    """What tables and figures need of curves: what they are at the steps of a grid.

    A row says from which step of the grid on the curve has this value, and `on_grid` gives the same
    of these rows, but for what the second decimal of returns leaves out. What needs all rows is in
    two more columns, the same in all rows of an agent: `steps_to_solve` and `last_return`, the mean
    of its last `WINDOW` test returns.
    """
    tables = []
    for _, curve in curves.groupby("agent", sort=False):
        place = np.searchsorted(curve["steps"], grid, side="right") - 1
        known = place >= 0
        held = curve.iloc[place[known]].assign(steps=grid[known])
        held = held if known.any() else curve.head(1)  # beyond the grid
        tables.append(held[held["test_return"] != held["test_return"].shift()])
    kept = pd.concat(tables, ignore_index=True)
    whole, agents = kept["steps"].astype(int), curves.groupby("agent")
    to_solve = agents[["steps", "test_return"]].apply(steps_to_solve, solved_reward=solved_reward)
    last = agents["test_return"].apply(lambda x: x.tail(WINDOW).mean())
    return kept.assign(
        steps=whole if (whole == kept["steps"]).all() else kept["steps"],
        test_return=kept["test_return"].round(DECIMALS),
        steps_to_solve=kept["agent"].map(to_solve),
        last_return=kept["agent"].map(last),
    )


CURVES = Measure(make_run=make_curve_run, to_table=curve_rows)
