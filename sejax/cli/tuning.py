"""Tuning an agent on SEs that rank: many configurations train there, the best on the real task.

A configuration costs milliseconds on such SEs. So all are drawn first and ranked at once, and no
study is needed. What costs something is kept: trainings on the real task go on where they stopped.
"""

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import filelock
import numpy as np
import pandas as pd

from sejax import landscapes
from sejax.agents.base import AgentConfig
from sejax.cli import config as configuration
from sejax.cli import runtime, search_results
from sejax.cli.config import REAL_TRAINING, EvaluateConfig
from sejax.cli.kinds import Kind, kind_of, stored, train
from sejax.cli.search_config import DEFAULT, Search
from sejax.cli.worlds import load
from sejax.landscapes import PREFIX, Landscape
from sejax.ops import gaussian_process
from sejax.ops.files import require_writable, write_text
from sejax.options import as_text, listed, registry, require, shortened
from sejax.options.plain import flatten, to_plain
from sejax.proxies.header import agents_of
from sejax.proxies.io import ProxySet, load_set
from sejax.ranking import mean_rank, reached_on, require_same_options, scaled, training_on
from sejax.training import training_of

COMMAND = "sejax.evaluate"  # that repeats the best configuration, on the real task
TRAININGS = "verified.csv"  # a landscape of those on the real task


@dataclass(frozen=True, kw_only=True)
class Setup:
    """What is tuned, and where.

    Attributes:
      search: of an agent on SEs that rank.
      config: of its fixed overrides.
      ses: that rank.
      kind: of agent, with the configurations that are drawn for trainings on the real task.
      agent: as it trains on the SEs, with room for all configurations.
      steps: of a training on the real task.
      measured: further configurations, with what they reach there.
    """

    search: Search
    config: EvaluateConfig
    ses: ProxySet
    kind: Kind
    agent: AgentConfig
    steps: int
    measured: Landscape | None

    @property
    def env_words(self) -> list[str]:
        """Overrides that make the real task."""
        return _words("env", self.ses.config["env"], self.config.env)


def tune(search: Search, say: Callable[[str], None]) -> tuple[Search, list[str]]:
    """Ranks configurations on the SEs, verifies the best and writes what was found.

    Returns:
      A search whose fixed overrides are those of `COMMAND`, and the overrides of the best settings.

    Raises:
      ConfigError: for SEs, an agent, a space or a landscape that do not fit each other, before
        anything is compiled; or for a folder of another search.
      OSError: if a file cannot be written.
    """
    setup = setup_of(search)
    require_writable("search_dir", search.folder)
    with filelock.FileLock(search.folder / "verification.lock"):
        before = stored(
            search.folder / TRAININGS, _card(setup), "search_dir", "Set search_dir=FOLDER, new."
        )
        say(f"{search.config.trials:,} configurations of {setup.kind.name}: {listed(search.space)}")
        table = ranked(setup, say)
        write_text(search.folder / "trials.csv", table.to_csv(index=False))
        if search.num_verified:
            table = verified(setup, table, before, say)
    found, best = repeated(setup), _settings(setup, int(table["trial"].iloc[0]))
    search_results.write_best(best, found, COMMAND)
    return found, best


def setup_of(search: Search) -> Setup:
    """What a search tunes, checked.

    Raises:
      ConfigError: as `tune`.
    """
    own, tuner = search.config, search.tuner or {}
    config = configuration.evaluate_config([DEFAULT, *search.fixed])
    ses, steps = load(config, load_set), int(tuner["steps"])
    training, name = training_of(ses), registry.name_of("agent", config.agent)
    require(
        search.space,
        "space",
        "must have fields that are not fixed; got none. Leave out one of the agent's overrides.",
    )
    require(
        own.landscape is None or find_spec("sklearn") is not None,
        "landscape",
        f"must be left out without scikit-learn; got {shortened(own.landscape)}. Install it with "
        "pip install 'sejax[search]'.",
    )
    require(own.trials > 1, "trials", "must be at least 2 to be ranked; got 1. Set trials=1000.")
    given = [word for word in search.fixed if word.startswith(PREFIX)]
    base = [
        *("preset=ranking", "objective=max_reward", f"seed={config.seed}", f"agent={name}"),
        *_words("env", ses.config["env"], config.env),
        *(f"{x}={as_text(getattr(config, x))}" for x in ("devices", "num_parallel")),
    ]
    learned = agents_of(ses.config).get(name, {})
    if learned.get("name") == name:  # which is ranked as it was learned with
        base += _words("agent", registry.describe("agent", registry.configure("agent", learned)))
        limits = {x: getattr(training, x) for x in ("stop_rule", "max_steps", "max_episodes")}
        base += [f"training.{x}={as_text(value)}" for x, value in limits.items()]
    kind = kind_of(
        name,
        [*base, *given],
        search.space,
        configs=own.trials,
        steps=steps,
        seed=own.sampler_seed,
        stream=f"search {name}",  # no agent of a landscape has the same keys
        exact={word.partition("=")[0] for word in given},
    )
    return Setup(
        search=search,
        config=config,
        ses=ses,
        kind=kind,
        agent=_on_ses(kind, ses, steps),
        steps=steps,
        measured=_measured(search, kind, ses.task.name, steps),
    )


def _words(group: str, values: Any, name: str | None = None) -> list[str]:
    """Overrides of a choice with its fields; a name of the command line's in the file's place."""
    own = {field: x for field, x in flatten(dict(values)).items() if field != "name"}
    fields = [f"{group}.{field}={as_text(x)}" for field, x in own.items()]
    return [f"{group}={name or values['name']}", *fields]


def _on_ses(kind: Kind, ses: ProxySet, steps: int) -> AgentConfig:
    """The agent as it trains on SEs: options that count steps are as large a part of those."""
    agent, training = kind.config.agent, training_on(ses, kind.name)
    factor = (training.max_steps or steps) / steps
    values = {x: scaled(type(agent), x, value, factor) for x, value in to_plain(agent).items()}
    short: AgentConfig = registry.configure("agent", {**values, "name": kind.name})
    if ses.env.config.reaches_step_limit:
        limits = ses.env.max_steps, ses.task.max_steps
        configuration.require_learning("training", training, short, *limits)
    return short


def _measured(search: Search, kind: Kind, task: str, steps: int) -> Landscape | None:
    """The landscape of the search.

    Raises:
      ConfigError: if it is of another task, agent, space or training.
    """
    field, path = "landscape", search.config.landscape
    if path is None:
        return None
    found = landscapes.read(path, field)
    agents = ", ".join(found)
    require(kind.name in found, field, f"must be of {kind.name}; got one of {agents}.")
    landscape = found[kind.name]
    for what, own, got in (
        ("be of", task, landscape.task),
        ("have trainings of as many steps as the SE's,", steps, landscape.steps),
        ("vary what is searched,", sorted(kind.values), sorted(landscape.values)),
    ):
        message = f"must {what} {shortened(own)}; got {shortened(got)}. Measure such a landscape."
        require(own == got, field, message)
    require_same_options(kind.config.agent, landscape, steps)
    return landscape


# --- ranks ---------------------------------------------------------------------------------------


def ranked(setup: Setup, say: Callable[[str], None]) -> pd.DataFrame:
    """The configurations, the best first.

    Returns:
      Columns `trial`, its number; `rank`, from 1; `score`, its mean rank on the SEs in [0, 1], 1
      for the best; with a landscape `predicted`, its return there; and what it sets.
    """
    search, measured, values = setup.search, setup.measured, setup.kind.values
    size = search.config.trials
    if measured is not None:
        values = {name: np.concatenate([x, measured.values[name]]) for name, x in values.items()}
    started = time.process_time()
    reached = reached_on(
        setup.ses,
        setup.agent,
        values,
        training=training_on(setup.ses, setup.kind.name),
        num_seeds=search.config.seeds,
        seed=setup.config.seed,
        devices=setup.config.devices,
        num_parallel=setup.config.num_parallel,
    )
    say(
        f"SEs that rank: {len(setup.ses)}, with {np.sum(reached.train_steps, dtype=np.int64):,} "
        f"steps there, none on the real task, and {time.process_time() - started:.0f} CPU s, "
        "with compiling."
    )
    scores = mean_rank(reached)
    columns = {"score": scores[:size]}
    if measured is not None:
        quantiles = [
            [search.space[f"{PREFIX}{name}"].quantile_of(x) for x in own.tolist()]
            for name, own in values.items()
        ]
        x = np.column_stack([*quantiles, scores])
        columns["predicted"] = gaussian_process.predict(x[size:], measured.mean_returns, x[:size])
    columns |= {f"{PREFIX}{name}": own for name, own in setup.kind.values.items()}
    order = "score" if measured is None else "predicted"
    table = pd.DataFrame(columns).sort_values(order, ascending=False, kind="stable")
    table.insert(0, "rank", np.arange(1, size + 1))
    return table.reset_index(names="trial")


# --- the real task -------------------------------------------------------------------------------


def verified(
    setup: Setup, table: pd.DataFrame, before: pd.DataFrame, say: Callable[[str], None]
) -> pd.DataFrame:
    """Trains fresh agents with the best configurations on the real task.

    Writes every training to `TRAININGS`, and a row for each configuration to `verification.csv`.

    Args:
      setup: of the search.
      table: of `ranked`.
      before: trainings that are done.
      say: prints.

    Returns:
      Those rows, the best first: `real_return` and `real_std` over the seeds, nan if one of their
      agents diverged; `real_steps` and `cpu_s` of all of them, tests included; `trial`, `rank`,
      `score`, and `settings`.
    """
    search, kind = setup.search, setup.kind
    best, num_seeds = table.head(search.num_verified), search.config.fresh_seeds
    wanted = [(trial, seed) for trial in best["trial"] for seed in range(num_seeds)]
    have = set(zip(before["config"], before["seed"], strict=True))
    places = [place for place in wanted if place not in have]
    say(f"The best {len(best)} train on the real task: {len(places)} of {len(wanted)} trainings.")
    done = before
    for rows in train(kind, places, setup.steps, REAL_TRAINING.test_episodes):
        done = pd.concat([done, rows], ignore_index=True) if len(done) else rows
        landscapes.write(
            search.folder / TRAININGS, _card(setup), done.sort_values(["config", "seed"])
        )
    rows = [_row(setup, own._asdict(), done) for own in best.itertuples()]
    found = pd.DataFrame(rows).sort_values("real_return", ascending=False, kind="stable")
    write_text(search.folder / "verification.csv", found.to_csv(index=False))
    search_results.print_verified(found, search)
    steps, cpu_s = found["real_steps"].sum(), found["cpu_s"].sum()
    say(f"The verification took {steps:,} real steps and {cpu_s:.1f} CPU s.")
    return found


def _row(setup: Setup, own: dict[str, Any], done: pd.DataFrame) -> dict[str, Any]:
    """What a configuration reaches on the real task."""
    mine = done[(done["config"] == own["trial"]) & (done["seed"] < setup.search.config.fresh_seeds)]
    returns = mine["return"].to_numpy(float)
    return {
        "real_return": returns.mean(),
        "real_std": returns.std(),
        "real_steps": int(mine["real_steps"].sum()),
        "cpu_s": float(mine["cpu_s"].sum()),
        **{name: own[name] for name in ("trial", "rank", "score")},
        "settings": " ".join([*repeated(setup).fixed, *_settings(setup, own["trial"])]),
    }


def _card(setup: Setup) -> dict[str, Any]:
    """What `TRAININGS` says of its trainings."""
    kind = setup.kind
    return {
        "task": setup.ses.task.name,
        "env": registry.describe("env", kind.config.env),
        "steps": setup.steps,
        "test_episodes": REAL_TRAINING.test_episodes,
        "seed": setup.config.seed,
        "sampler_seed": setup.search.config.sampler_seed,
        "agents": {kind.name: to_plain(kind.config.agent)},
        "space": {kind.name: {field: x.text for field, x in kind.space.items()}},
        "versions": runtime.versions(),
    }


def _settings(setup: Setup, trial: int) -> list[str]:
    """The overrides of a configuration."""
    values = setup.kind.values.items()
    return [f"{PREFIX}{name}={as_text(x[trial].item())}" for name, x in values]


def repeated(setup: Setup) -> Search:
    """The search, with what `COMMAND` needs beside a configuration in the place of its overrides.

    The command trains agents on the real task as the verification does.
    """
    agent, steps = setup.kind.config.agent, setup.steps
    default = to_plain(type(agent)())
    options = {
        name: value
        for name, value in to_plain(agent).items()
        if value != default[name] and name not in setup.kind.values
    }
    fixed = (
        *("proxy=real", setup.env_words[0], f"agent={setup.kind.name}"),
        *(f"{PREFIX}{name}={as_text(value)}" for name, value in options.items()),
        *("real_training.stop_rule=never", f"real_training.max_steps={steps}"),
        f"real_training.max_episodes={steps}",
    )
    own = dataclasses.replace(setup.search.config, search_dir=str(setup.search.folder))
    return dataclasses.replace(setup.search, config=own, fixed=fixed)
