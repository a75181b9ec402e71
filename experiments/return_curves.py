"""Test returns against training steps: what the experiments draw learning curves from.

A curve is a table with a row for each training episode of an agent: `agent`, `steps` (training
steps at its end) and `test_return`, of the greedy episodes after it on the real task; see
`worlds.CURVES`.
"""

import numpy as np
import pandas as pd

WINDOW = 10  # test episodes that a point of a smoothed curve is the mean of


def on_grid(curves: pd.DataFrame, grid: np.ndarray, window: int = WINDOW) -> np.ndarray:
    """Each agent's mean of its last `window` test returns (of all, if fewer), `[agent, points]`.

    The value at a step of the grid is that of the last finished episode; nan before the first.
    """
    rows = []
    for _, curve in curves.groupby("agent"):
        place = np.searchsorted(curve["steps"], grid, side="right") - 1
        smoothed = curve["test_return"].rolling(window, min_periods=1).mean().to_numpy()
        rows.append(np.where(place >= 0, smoothed[place], np.nan))
    return np.stack(rows)


def steps_to_solve(curve: pd.DataFrame, solved_reward: float, window: int = WINDOW) -> float:
    """Training steps of an agent until `window` tests have a mean high enough; inf if never."""
    full = curve["test_return"].rolling(window).mean().to_numpy()
    solved = np.flatnonzero(full >= solved_reward)
    return float(curve["steps"].iloc[solved[0]]) if len(solved) else np.inf


def all_steps_to_solve(curves: pd.DataFrame, solved_reward: float) -> pd.Series:
    """The same of each agent, by agent."""
    columns = curves.groupby("agent")[["steps", "test_return"]]
    return columns.apply(steps_to_solve, solved_reward=solved_reward)


def last_returns(curves: pd.DataFrame, window: int = WINDOW) -> pd.Series:
    """Mean of each agent's last `window` test returns, by agent."""
    return curves.groupby("agent")["test_return"].apply(lambda x: x.tail(window).mean())
