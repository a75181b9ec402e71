"""What a trial of a search computes: runs that learn a proxy, or agents that are tuned on one."""

import dataclasses
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from sejax.agents import make_agent
from sejax.evaluation import make_evaluator, num_parallel_on_cpu
from sejax.objectives import Outcome
from sejax.ops.parallel import compiler_options, spread_over_devices
from sejax.options import traced_options
from sejax.options.plain import flatten
from sejax.runs import config as configuration
from sejax.runs import session
from sejax.runs.config import EvaluateConfig, LearnConfig
from sejax.runs.run_directory import open_for
from sejax.runs.worlds import proxy_setup

HINT = "Set search_dir=FOLDER, a new one."
COLUMNS = {"the proxy": "proxy", "the real task": "real"}  # of the worlds of `sejax.evaluate`
_PROGRAMS: dict[str, Callable[..., Outcome]] = {}  # of agents that differ in traced numbers alone


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How a trial has gone so far.

    Attributes:
      scores: `[generation]`, what a trial is worth after each; nan where nothing finite came of it.
      train_steps: of all agents.
      generations: that were computed, the mean over seeds: fewer than there are scores where runs
        have solved their task.
      is_over: whether all runs have solved it.
    """

    scores: np.ndarray
    train_steps: int
    generations: float
    is_over: bool = False


# --- learning a proxy -----------------------------------------------------------------------------


def learning(config: LearnConfig, folder: Path, seeds: Sequence[int]) -> Callable[[int], Progress]:
    """Runs that learn proxies, a run directory each, by one executable.

    A score is the mean of incumbents over seeds. A run that has solved its task keeps its last one.

    Args:
      config: of the runs.
      folder: the run directory; of several, `seed0` and so on in it.
      seeds: counted from the configuration's own.

    Returns:
      A function that goes on up to a generation.
    """
    chunks = session.make_chunks(config)

    def run(generations: int) -> Progress:
        scores, train_steps, computed, ended = [], 0, [], []
        for seed in (config.seed + offset for offset in seeds):
            run_dir = str(folder if len(seeds) == 1 else folder / f"seed{seed}")
            one = dataclasses.replace(config, seed=seed, generations=generations, run_dir=run_dir)
            with open_for(one, HINT) as directory:
                ended.append(session.run(one, directory, chunks))
                rows = directory.rows
            own = [float(row["incumbent_mean"]) for row in rows]
            computed.append(len(own))
            scores.append(own + own[-1:] * (generations - len(own)))
            steps = sum(float(row["train_steps_mean"]) for row in rows)
            train_steps += round(steps * chunks.learner.strategy.num_evaluations)
        return Progress(
            scores=_finite(np.mean(scores, axis=0)),
            train_steps=train_steps,
            generations=float(np.mean(computed)),
            is_over=all(how == "solved" for how in ended),
        )

    return run


# --- tuning an agent on a proxy -------------------------------------------------------------------


def tuning(config: EvaluateConfig, seeds: int) -> Callable[[int], Progress]:
    """Rounds of fresh agents that train on a proxy and are tested on the real task.

    A score is the mean return of all rounds so far, which rewards learning early: the last one
    alone is the same for many settings. Nothing is stored, as a round takes a moment.

    Returns:
      A function that goes on up to a round.
    """
    rounds: list[Outcome] = []

    def run(generations: int) -> Progress:
        for number in range(len(rounds), generations):
            rounds.append(_train_and_test(config, "the proxy", number, seeds))
        returns = np.array([np.mean(outcome.test_return) for outcome in rounds])
        return Progress(
            scores=_finite(returns.cumsum() / np.arange(1, 1 + len(rounds))),
            train_steps=sum(int(np.sum(x.train_steps, dtype=np.int64)) for x in rounds),
            generations=generations,
        )

    return run


def tested(config: EvaluateConfig, number: int) -> dict[str, float]:
    """Returns and steps of `num_agents` fresh agents on the proxy, and as many on the real task.

    Returns:
      `verified`, the return on the real task (with `baseline=false` on the proxy) up to where it
      solves the task, `verified_cost`, training steps, and more of both.
    """
    setup, values = proxy_setup(config), dict[str, float]()
    for world in setup.worlds:
        outcome, column = _train_and_test(config, world, number, config.num_agents), COLUMNS[world]
        values[f"{column}_return"] = score = float(np.mean(outcome.test_return))
        values[f"{column}_std"] = float(np.std(outcome.test_return))
        values[f"{column}_steps"] = steps = float(np.mean(outcome.train_steps))
    return {
        "verified": min(score, float(setup.task.solved_reward)),
        "verified_cost": steps,
        **values,
    }


def _train_and_test(config: EvaluateConfig, world: str, number: int, num_agents: int) -> Outcome:
    """The outcome of fresh agents in a world of `sejax.evaluate`, leaves `[agent]`, NumPy.

    Configurations that differ in the agent's traced numbers alone share a program.
    """
    setup = proxy_setup(config)
    ((key, agent_config),) = setup.agents.items()
    agent = make_agent(agent_config, setup.task, setup.exploration)
    env, env_params, trainings = setup.worlds[world]
    training = trainings[key]

    def train(key: Array, hparams: Any) -> Outcome:
        trained = dataclasses.replace(agent, hparams=hparams)
        return make_evaluator(trained, env, setup.task, training)(key, env_params)

    def program(keys: Array, hparams: Any) -> Outcome:
        width = num_parallel_on_cpu(agent, training)
        spread = spread_over_devices(train, config.devices, config.num_parallel, width)
        outcome: Outcome = spread(
            keys, jax.tree.map(lambda x: jnp.broadcast_to(x, keys.shape), hparams)
        )
        return outcome

    numbers = {f"agent.{k}" for k, x in traced_options(agent_config).items() if x is not None}
    fields = flatten(configuration.plain(config)).items()
    shape = json.dumps([world, *(field for field in fields if field[0] not in numbers)])
    if shape not in _PROGRAMS:
        _PROGRAMS[shape] = jax.jit(program, compiler_options=compiler_options())
    seed = jax.random.fold_in(jax.random.key(config.seed), number)
    outcome: Outcome = jax.device_get(
        _PROGRAMS[shape](jax.random.split(seed, num_agents), agent.hparams)
    )
    return outcome


def _finite(scores: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(scores), scores, np.nan)
