"""Trials that tune an agent on a proxy: what they cost the real task is tests.

A generation is a round of `seeds` fresh agents, each trained on the proxy and tested on the real
task; a seed's score is its agent's return there. At the end the best settings train agents on the
real task, which alone says what they are worth there; with `baseline=false`, on the proxy alone.
"""

import dataclasses
import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sejax import serialize
from sejax.cli import build, compose
from sejax.cli.words import word
from sejax.errors import ConfigError, require
from sejax.ops.files import write_text
from sejax.proxies.header import find
from sejax.search.programs import kept, static_of, structure_of
from sejax.search.settings import Search
from sejax.search.trials import Follower, Progress
from sejax.serialize import differences, flatten

ROUNDS = "rounds.json"
WORLDS = {"the proxy": "proxy", "the real task": "real"}  # and what columns call them


class Tuning:
    """Trains agents on the proxy in each trial.

    Raises:
      ConfigError: if the proxy is not to be found here, which is no fault of a trial's settings.
    """

    command = "sejax.evaluate"

    def __init__(self, search: Search):
        self._search = search
        self._usual = compose.evaluate_config(search.fixed)
        find(self._usual.proxy, "proxy")
        self._compiled: dict[str, Any] = {}

    def config(self, words: Sequence[str], folder: Path | None = None) -> build.EvaluateConfig:
        """The configuration of a trial.

        Raises:
          ConfigError: if it is none that can run, or its agents would not learn on the proxy.
        """
        from sejax.evaluate import proxy_study

        where = [f"out_dir={word(str(folder))}"] if folder is not None else []
        config = compose.evaluate_config([*self._search.fixed, *words, *where])
        require(
            config.agents is None,
            "agent",
            "be one",
            "its settings are searched",
            "several",
            "agent=ppo",
        )
        require(
            config.agent_hparams == "default",
            "agent_hparams",
            "be default",
            "the trial's settings are those that are tried",
            config.agent_hparams,
            "agent_hparams=default",
        )
        proxy_study(config)  # which checks what is asked of the proxy
        return config

    def run(self, config: build.EvaluateConfig, follower: Follower, is_inherited: bool) -> Progress:
        """Runs a trial, or what is left of it; arguments and errors as of `Learning.run`."""
        path = Path(config.out_dir or ".") / ROUNDS
        settings, most = self._settings_of(config), self._search.config.max_generations
        try:
            rounds = _stored_rounds(path, settings)[:most]
        except ConfigError:
            if not is_inherited:
                raise
            rounds = []
        while len(rounds) < most:
            if rounds:
                follower.tell(_progress_of(rounds))
            started = time.time()
            outcome = self.outcome(config, "the proxy", len(rounds), self._search.config.seeds)
            rounds.append(
                {
                    "returns": outcome.test_return.tolist(),
                    "cost": int(np.sum(outcome.train_steps, dtype=np.int64)),
                    "seconds": time.time() - started,
                }
            )
            write_text(path, json.dumps({"settings": settings, "rounds": rounds}))
        return _progress_of(rounds)

    def _settings_of(self, config: build.EvaluateConfig) -> dict[str, Any]:
        """What a trial's rounds are of, by field, as it reads back from JSON."""
        fields = flatten(build.to_plain(dataclasses.replace(config, out_dir=None)))
        read_back: dict[str, Any] = json.loads(
            json.dumps({**fields, "seeds": self._search.config.seeds})
        )
        return read_back

    def outcome(
        self, config: build.EvaluateConfig, world: str, generation: int, num_agents: int
    ) -> Any:
        """The outcome of fresh agents in a world of `sejax.evaluate`, leaves `[agent]`, NumPy."""
        import jax

        from sejax.agents import make_agent
        from sejax.evaluate import proxy_study

        study = proxy_study(config)
        (family,) = study.families
        agent = make_agent(family.agent, study.task, study.exploration)
        training = study.worlds[world][2][family.key]
        key = json.dumps(
            [
                world,
                static_of(family.agent),
                static_of(study.exploration),
                serialize.to_plain(training),
                structure_of(agent.hparams),
                num_agents,
            ]
        )
        rounds = kept(
            self._compiled, key, lambda: _make_rounds(agent, study, world, training, config)
        )
        seed = jax.random.fold_in(jax.random.key(config.seed), generation)
        keys = jax.random.split(seed, num_agents)
        return jax.device_get(rounds(keys, agent.hparams))

    def solved_reward(self, config: build.EvaluateConfig) -> float:
        """The return at which the real task counts as solved; inf if nobody says."""
        from sejax.evaluate import proxy_study

        return float(proxy_study(config).task.solved_reward)

    def num_fresh(self) -> int:
        """How many agents `verify` trains in each world."""
        return self._usual.num_agents

    def verify(self, words: Sequence[str], number: int) -> dict[str, float]:
        """Returns and steps of agents trained with these settings, on the proxy and the real task.

        Agents are `num_agents` fresh ones in each, of keys that no trial has had; with
        `baseline=false` none train on the real task.

        Args:
          words: the settings.
          number: of their trial.
        """
        from sejax.evaluate import proxy_study

        config = self.config(words)
        values: dict[str, float] = {}
        for world in proxy_study(config).worlds:
            fresh, name = self._search.config.max_generations, WORLDS[world]
            outcome = self.outcome(config, world, fresh, config.num_agents)
            values[f"{name}_return"] = float(np.mean(outcome.test_return))
            values[f"{name}_std"] = float(np.std(outcome.test_return))
            values[f"{name}_steps"] = float(np.mean(outcome.train_steps))
        return values

    def order(self, row: dict[str, float]) -> tuple[float, float]:
        """By which the best rows of `verify` come first; of settings that solve, the quickest.

        Rows that are not finite come last.
        """
        where = "real" if self._usual.baseline else "proxy"
        score = row[f"{where}_return"]
        if not math.isfinite(score):
            return math.inf, 0.0
        return -min(score, self.solved_reward(self._usual)), row[f"{where}_steps"]


def _make_rounds(agent: Any, study: Any, world: str, training: Any, config: Any) -> Any:
    """`rounds(keys, hparams) -> Outcome`, compiled at its first call."""
    import jax
    import jax.numpy as jnp

    from sejax.evaluation import make_evaluator, num_parallel_on_cpu
    from sejax.ops.parallel import compiler_options, spread_over_devices

    env, env_params, _ = study.worlds[world]

    def one(key: Any, hparams: Any) -> Any:
        tried = dataclasses.replace(agent, hparams=hparams)
        return make_evaluator(tried, env, study.task, training)(key, env_params)

    spread = spread_over_devices(
        one, config.devices, config.num_parallel, num_parallel_on_cpu(agent, training)
    )

    def rounds(keys: Any, hparams: Any) -> Any:
        of_each = jax.tree.map(lambda x: jnp.broadcast_to(x, keys.shape), hparams)
        return spread(keys, of_each)

    return jax.jit(rounds, compiler_options=compiler_options())


def _stored_rounds(path: Path, settings: dict[str, Any]) -> list[dict[str, Any]]:
    """The rounds of an earlier session; none if there was none.

    Raises:
      ConfigError: if the file is not one that a trial writes, or is of a trial with other settings.
    """
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        there: dict[str, Any] = dict(stored["settings"])
        rounds: list[dict[str, Any]] = stored["rounds"]
        _progress_of(rounds) if rounds else None
    except FileNotFoundError:
        return []
    except (ValueError, TypeError, KeyError) as error:
        raise ConfigError(
            f"search_dir must keep the rounds of its trials, because a trial goes on from them; "
            f"got {path}, which cannot be read or does not say what settings it is of. Remove it; "
            f"its trial begins anew."
        ) from error
    differing = differences(there, settings, most=3)
    if differing:
        raise ConfigError(
            f"search_dir must be of one study, because a trial goes on from the rounds that it "
            f"finds there; {path} differs in {differing}. Set search_dir=FOLDER, a new one."
        )
    return rounds


def _progress_of(rounds: Sequence[dict[str, Any]]) -> Progress:
    scores = np.array([each["returns"] for each in rounds], float)
    return Progress(
        scores=np.where(np.isfinite(scores), scores, np.nan),
        cost=sum(each["cost"] for each in rounds),
        seconds=sum(each["seconds"] for each in rounds),
    )
