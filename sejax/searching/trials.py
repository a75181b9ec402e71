"""What a trial of a search computes: runs that learn a proxy, or agents that are tuned on one.

Both go on from the trial's folder, so that a trial may be computed up to one generation, and later
up to another, by any process.
"""

import contextlib
import dataclasses
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from sejax.agents import make_agent
from sejax.evaluation import make_evaluator, num_parallel_on_cpu
from sejax.objectives import Outcome
from sejax.ops.files import write_text
from sejax.ops.parallel import compiler_options, spread_over_devices
from sejax.options import require, shortened
from sejax.options.plain import flatten, to_plain
from sejax.proxies import header
from sejax.runs import config as configuration
from sejax.runs import session
from sejax.runs.config import EvaluateConfig, LearnConfig
from sejax.runs.programs import Programs, kept, static_of, structure_of
from sejax.runs.run_directory import open_for
from sejax.runs.worlds import proxy_setup
from sejax.searching.config import DEFAULT, Search

Config = TypeVar("Config", LearnConfig, EvaluateConfig)
T = TypeVar("T", list[dict[str, Any]], dict[str, float])

ROUNDS = "rounds.json"
WORLDS = {"the proxy": "proxy", "the real task": "real"}  # and what columns call them
HINT = "Set search_dir=FOLDER, a new one."


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How a trial has gone so far.

    Attributes:
      scores: `[generation, seed]`, nan where nothing finite came of it.
      cost: training steps of all agents.
      seconds: on the clock, compiling included.
      generations: that were computed, the mean over seeds: fewer than there are scores where runs
        have solved their task.
      is_over: whether all runs have solved it.
    """

    scores: np.ndarray
    cost: int
    seconds: float
    generations: float
    is_over: bool = False


def worth(progress: Progress, step: int, search: Search) -> dict[str, float]:
    """What a trial is worth after `step` generations: mean and worst of its seeds."""
    so_far = progress.scores[:step]
    match search.measure:
        case "best":
            of_seeds = np.fmax.reduce(so_far)
        case "mean":
            of_seeds = so_far.mean(axis=0)
        case _:
            of_seeds = so_far[-1]
    return {"mean": float(of_seeds.mean()), "worst": float(of_seeds.min())}


class Runner(Protocol[Config]):
    """What makes a trial of settings.

    Attributes:
      command: the module that repeats a trial.
    """

    command: str

    def config(self, overrides: Sequence[str]) -> Config:
        """The configuration of a trial.

        Raises:
          ConfigError: if it is none that can run.
        """

    def run(self, config: Config, folder: Path, generations: int) -> Progress:
        """Computes a trial up to a generation.

        Raises:
          ConfigError: if the folder is of other settings, or damaged.
          OSError: if a file cannot be written.
        """

    def verify(self, overrides: Sequence[str], folder: Path) -> dict[str, float]:
        """What settings are worth with seeds that no trial has had; goes on where it stopped."""

    def order(self, row: dict[str, float]) -> tuple[float, float]:
        """By which the best rows of `verify` come first."""


class Learning:
    """Learns a proxy in each trial; each of its seeds is a run directory."""

    command = "sejax.run"

    def __init__(self, search: Search):
        self._search = search
        self._programs = Programs()

    def config(self, overrides: Sequence[str]) -> LearnConfig:
        """See `Runner`."""
        own = f"generations={self._search.config.max_generations}", "checkpoint_every=1"
        return configuration.config([*self._search.fixed, *overrides, *own])

    def run(self, config: LearnConfig, folder: Path, generations: int) -> Progress:
        """See `Runner`."""
        return self._run(config, range(self._search.config.seeds), folder, generations)

    def verify(self, overrides: Sequence[str], folder: Path) -> dict[str, float]:
        """See `Runner`."""
        own, config = self._search.config, self.config(overrides)
        fresh = range(own.seeds, own.seeds + own.fresh_seeds)
        progress = self._run(config, fresh, folder, own.max_generations)
        return {
            **worth(progress, own.max_generations, self._search),
            "generations": progress.generations,
        }

    def order(self, row: dict[str, float]) -> tuple[float, float]:
        """By score, and of equal ones by generations; what is not finite comes last."""
        score = row[self._search.config.score]
        return (-score, row["generations"]) if math.isfinite(score) else (math.inf, 0.0)

    def _run(
        self,
        config: LearnConfig,
        seeds: Sequence[int],
        folder: Path,
        generations: int,
    ) -> Progress:
        """Runs with seeds that are counted from the configuration's own."""
        scores, cost, seconds, computed, ended = [], 0, 0.0, [], []
        for seed in seeds:
            one = dataclasses.replace(
                config,
                seed=config.seed + seed,
                generations=generations,
                run_dir=str(folder if len(seeds) == 1 else folder / f"seed{config.seed + seed}"),
            )
            chunks = self._programs.chunks(one)
            with open_for(one, HINT) as directory:
                ended.append(session.run(one, directory, chunks))
                rows = directory.rows
            own = [float(row["incumbent_mean"]) for row in rows]
            scores.append(own + own[-1:] * (generations - len(own)))  # solved: it keeps its score
            steps = sum(float(row["train_steps_mean"]) for row in rows)
            cost += round(steps * chunks.learner.strategy.num_evaluations)
            seconds += float(rows[-1]["wall_s"])
            computed.append(len(own))
        return Progress(
            scores=_finite(np.array(scores).T),
            cost=cost,
            seconds=seconds,
            generations=float(np.mean(computed)),
            is_over=all(how == "solved" for how in ended),
        )


class Tuning:
    """Trains agents on a proxy in each trial and tests them on the real task.

    A generation is a round of `seeds` fresh agents, whose returns are kept in `rounds.json`. The
    best settings train agents on the real task too, which alone shows what they are worth there.

    Args:
      search: of an agent.

    Raises:
      ConfigError: if the proxy is not to be found here, which is no fault of a trial's settings.
    """

    command = "sejax.evaluate"

    def __init__(self, search: Search):
        self._search = search
        self._default = configuration.evaluate_config([DEFAULT, *search.fixed])
        header.find(self._default.proxy, "proxy")
        self._compiled: dict[str, Any] = {}

    def config(self, overrides: Sequence[str]) -> EvaluateConfig:
        """See `Runner`; also refused are agents that would not learn on the proxy."""
        config = configuration.evaluate_config([DEFAULT, *self._search.fixed, *overrides])
        require(
            len(config.agents) == 1,
            "agent",
            "must be one where its settings are searched; got several. Set agent=ppo.",
        )
        require(
            config.agent_hparams == "default",
            "agent_hparams",
            f"must be default where settings are searched; got {config.agent_hparams}. Set "
            "agent_hparams=default.",
        )
        proxy_setup(config)  # which checks what is asked of the proxy
        return config

    def run(self, config: EvaluateConfig, folder: Path, generations: int) -> Progress:
        """See `Runner`."""
        settings = self._settings_of(config)
        rounds = _stored(folder / ROUNDS, settings, list[dict[str, Any]]())[:generations]
        while len(rounds) < generations:
            started = time.monotonic()
            outcome = self._outcome(config, "the proxy", len(rounds), self._search.config.seeds)
            rounds.append(
                {
                    "returns": outcome.test_return.tolist(),
                    "cost": int(np.sum(outcome.train_steps, dtype=np.int64)),
                    "seconds": time.monotonic() - started,
                }
            )
            _store(folder / ROUNDS, settings, rounds)
        return Progress(
            scores=_finite(np.array([each["returns"] for each in rounds], float)),
            cost=sum(each["cost"] for each in rounds),
            seconds=sum(each["seconds"] for each in rounds),
            generations=generations,
        )

    def verify(self, overrides: Sequence[str], folder: Path) -> dict[str, float]:
        """Returns and steps of `num_agents` fresh agents on the proxy and on the real task.

        With `baseline=false` none train on the real task.
        """
        config = self.config(overrides)
        path, settings = folder / "verified.json", self._settings_of(config)
        values = _stored(path, settings, dict[str, float]())
        if values:
            return values
        for world in proxy_setup(config).worlds:
            fresh, name = self._search.config.max_generations, WORLDS[world]
            outcome = self._outcome(config, world, fresh, config.num_agents)
            values[f"{name}_return"] = float(np.mean(outcome.test_return))
            values[f"{name}_std"] = float(np.std(outcome.test_return))
            values[f"{name}_steps"] = float(np.mean(outcome.train_steps))
        _store(path, settings, values)
        return values

    def order(self, row: dict[str, float]) -> tuple[float, float]:
        """By return, and of settings that solve the task by training steps."""
        where = "real" if self._default.baseline else "proxy"
        score = row[f"{where}_return"]
        if not math.isfinite(score):
            return math.inf, 0.0
        solved = float(proxy_setup(self._default).task.solved_reward)
        return -min(score, solved), row[f"{where}_steps"]

    def _settings_of(self, config: EvaluateConfig) -> str:
        """What a trial's rounds are of."""
        fields = flatten(configuration.plain(dataclasses.replace(config, out_dir=None)))
        return json.dumps({**fields, "seeds": self._search.config.seeds})

    def _outcome(
        self, config: EvaluateConfig, world: str, generation: int, num_agents: int
    ) -> Outcome:
        """The outcome of fresh agents in a world of `sejax.evaluate`, leaves `[agent]`, NumPy."""
        setup = proxy_setup(config)
        ((key, agent_config),) = setup.agents.items()
        agent = make_agent(agent_config, setup.task, setup.exploration)
        env, env_params, trainings = setup.worlds[world]
        training = trainings[key]

        def one(key: Array, hparams: Any) -> Outcome:
            tried = dataclasses.replace(agent, hparams=hparams)
            return make_evaluator(tried, env, setup.task, training)(key, env_params)

        def make() -> Callable[..., Outcome]:
            width = num_parallel_on_cpu(agent, training)
            spread = spread_over_devices(one, config.devices, config.num_parallel, width)
            return jax.jit(
                lambda keys, hparams: spread(
                    keys, jax.tree.map(lambda x: jnp.broadcast_to(x, keys.shape), hparams)
                ),
                compiler_options=compiler_options(),
            )

        key = json.dumps(
            [
                world,
                static_of(agent_config),
                static_of(setup.exploration),
                to_plain(training),
                structure_of(agent.hparams),
                num_agents,
            ]
        )
        rounds = kept(self._compiled, key, make)
        seed = jax.random.fold_in(jax.random.key(config.seed), generation)
        outcome: Outcome = jax.device_get(rounds(jax.random.split(seed, num_agents), agent.hparams))
        return outcome


def runner_of(search: Search) -> Learning | Tuning:
    """What makes the trials of a search."""
    return Tuning(search) if search.is_of_agent else Learning(search)


def _finite(scores: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(scores), scores, np.nan)


def _store(path: Path, settings: str, values: T) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps({"settings": settings, "values": values}))


def _stored(path: Path, settings: str, default: T) -> T:
    """The values that a file holds of these settings; the default if it is not there.

    Raises:
      ConfigError: if it is damaged, or of other settings.
    """
    if not path.exists():
        return default
    stored = None
    with contextlib.suppress(ValueError):
        stored = json.loads(path.read_text(encoding="utf-8"))
    match stored:
        case {"settings": found, "values": values}:
            is_own = found == settings and isinstance(values, type(default))
        case _:
            is_own = False
    require(
        is_own,
        "search_dir",
        f"must be of one study; got {shortened(path)}, which is damaged or of other settings. "
        f"{HINT}",
    )
    return values
