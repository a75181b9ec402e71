"""Test returns against training steps: what the experiments draw learning curves from.

After each training episode an agent plays greedy test episodes on the real task. A curve is a
table with a row for each training episode: `agent`, `steps` (training steps at its end) and
`test_return`.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd

WINDOW = 10  # test episodes that a point of a smoothed curve is the mean of


@functools.cache
def make_program(
    config: Any,
    exploration: Any,
    env: Any,
    task: Any,
    training: Any,
    agent_hparams: str = "default",
    devices: int | None = None,
) -> Callable[[Any, Any], Any]:
    """Builds `program(keys [agent], env_params) -> (test returns, steps)`, `[agent, episode]` each.

    The results after an agent's last episode are nan and 0. Nothing but the limits of `training`
    ends it; `training.test_episodes` are played after each episode.

    Args:
      config: of the agent.
      exploration: of its exploration bonus.
      env: gymnax environment to train in; what it needs comes as `env_params`.
      task: the real task.
      training: the limits.
      agent_hparams: "default", or "varied" for hyperparameters that are drawn for each agent.
      devices: None for all.
    """
    import dataclasses

    import jax
    import jax.numpy as jnp

    from sejax.agents.hparams import make_varied_agents
    from sejax.agents.registry import make_agent
    from sejax.evaluation import make_tested_trainer
    from sejax.parallel import spread_over_devices

    # A threshold that nobody reaches: tested after each episode, but never stopped.
    training = dataclasses.replace(training, stop_rule="solved", solved_by="test")

    def branch(agent: Any) -> Callable[..., Any]:
        train = make_tested_trainer(agent, env, task, training, jnp.inf, training.test_episodes)

        def curve(key: Any, env_params: Any, hparams: Any) -> Any:
            result = train(key, env_params, hparams)
            return result.returns, result.episode_ends

        return curve

    if agent_hparams == "varied":
        varied = make_varied_agents(config, task, exploration)
        one, cpu_lanes = varied.over_draws(branch), varied.agents[0].cpu_lanes
    else:
        agent = make_agent(config, task, exploration)
        only, cpu_lanes = branch(agent), agent.cpu_lanes

        def one(key: Any, env_params: Any) -> Any:
            return only(key, env_params, agent.hparams)

    def program(keys: Any, env_params: Any) -> Any:
        spread = spread_over_devices(lambda key: one(key, env_params), devices, cpu_lanes=cpu_lanes)
        return spread(keys)

    return jax.jit(program)


def to_table(returns: Any, steps: Any) -> pd.DataFrame:
    """The curves of all agents, from what a program returns."""
    curves = []
    for agent, (mine, ends) in enumerate(zip(np.asarray(returns), np.asarray(steps), strict=True)):
        count = int((ends > 0).sum())
        columns = {"steps": ends[:count], "test_return": mine[:count].astype(float)}
        curves.append(pd.DataFrame({"agent": agent} | columns))
    return pd.concat(curves, ignore_index=True)


def smoothed(curve: pd.DataFrame, window: int = WINDOW) -> np.ndarray:
    """Mean of the last `window` test returns (of all, if fewer) after each episode of an agent."""
    return curve["test_return"].rolling(window, min_periods=1).mean().to_numpy()


def on_grid(curves: pd.DataFrame, grid: np.ndarray, window: int = WINDOW) -> np.ndarray:
    """Each agent's smoothed test return at given training steps, `[agent, points]`.

    The value at a step is that of the last finished episode; nan before the first.
    """
    rows = []
    for _, curve in curves.groupby("agent"):
        place = np.searchsorted(curve["steps"], grid, side="right") - 1
        rows.append(np.where(place >= 0, smoothed(curve, window)[place], np.nan))
    return np.stack(rows)


def steps_to_solve(curve: pd.DataFrame, solved_reward: float, window: int = WINDOW) -> float:
    """Training steps until the mean of the last `window` tests is high enough; inf if it never is.

    Args:
      curve: of one agent, in order.
      solved_reward: the task's threshold.
      window: tests in a row.
    """
    full = curve["test_return"].rolling(window).mean().to_numpy()
    solved = np.flatnonzero(full >= solved_reward)
    return float(curve["steps"].iloc[solved[0]]) if len(solved) else np.inf


def last_returns(curves: pd.DataFrame, window: int = WINDOW) -> pd.Series:
    """Mean of each agent's last `window` test returns, by agent."""
    return curves.groupby("agent")["test_return"].apply(lambda x: x.tail(window).mean())
