"""Seconds for an outer iteration of NES on every task, beside the paper's.

Source: paper, appendix "Computational Complexity for Training Synthetic Environments and Reward
Networks" (table "Approximate timings for one NES outer loop").

The first outer iterations of a run are timed, once compiled, with our default and, where that has
other agents, with the paper's settings too; not on HalfCheetah, where an iteration of these takes
an hour. Most of their agents are far from solving the task and train for as long as they may.
How long later ones take differs by run.
"""

import dataclasses
import functools
import time
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
import pandas as pd

import sejax
from experiments.common.experiment import Experiment, Settings, count, setting
from experiments.common.tables import as_texts, publish
from sejax.options import each_of
from sejax.runs import session
from sejax.runs.runtime import available_cores

PAPER_CORES = 16


class Row(NamedTuple):
    """A cell of the paper's table: `seconds` for one outer iteration."""

    env: str
    proxy: str
    seconds: float
    presets: tuple[str, ...] = ("best",)


_BOTH = ("paper", "best")
ROWS = {
    "cliff_walking-rn": Row("cliff_walking", "rn", 10),
    "acrobot-se": Row("acrobot", "se", 100, _BOTH),
    "cartpole-se": Row("cartpole", "se", 100, _BOTH),
    "cartpole-rn": Row("cartpole", "rn", 100),
    "mountain_car_continuous-rn": Row("mountain_car_continuous", "rn", 500, _BOTH),
    "halfcheetah-rn": Row("halfcheetah", "rn", 2000),
}
# Agents, episodes and batches that take seconds.
QUICK = [
    "es.population_size=2",
    "es.num_incumbent_evals=2",
    "training.max_episodes=4",
    "agent.warmup_episodes=1",
]
SETTINGS = {"paper": "the paper's", "best": "our default"}


@dataclass(frozen=True, kw_only=True)
class Timings(Settings):
    name = "timings"

    rows: tuple[str, ...] = setting(tuple(ROWS), each_of(ROWS), help="tasks and proxies")
    generations: int = count(2, help="outer iterations to time")


def compute(settings: Timings) -> pd.DataFrame:
    """Times what is missing; a row for each task, proxy and preset."""
    cores = settings.devices or available_cores()
    tables = []
    for name in settings.rows:
        row = ROWS[name]
        for preset in row.presets:
            made_with = {"row": name, "preset": preset, "cores": cores}
            made_with |= settings.values("quick", "generations", "seed")
            run = functools.partial(time_generations, settings, row, preset)
            timed = settings.shards.compute(f"{name}-{preset}-{cores}", made_with, run)
            tables.append(timed.assign(row=name, preset=preset, cores=cores))
            print(f"{name}, {preset}: {timed['seconds'].iloc[0]:,.1f} s", flush=True)
    return pd.concat(tables, ignore_index=True)


def config_of(settings: Timings, row: Row, preset: str) -> Any:
    """The configuration that is timed."""
    overrides = [f"env={row.env}", f"proxy={row.proxy}", f"preset={preset}"]
    if row.proxy == "rn":  # the paper does not say which variant; this one needs two potentials
        overrides.append("proxy.variant=additive_potential")
    if settings.quick:  # a table's agent has no warm-up
        overrides += QUICK[:-1] if row.env == "cliff_walking" else QUICK
    config = sejax.config(overrides)
    return dataclasses.replace(config, devices=settings.devices, seed=settings.seed)


def time_generations(settings: Timings, row: Row, preset: str) -> pd.DataFrame:
    """Mean wall-clock of the first outer iterations, compiled before."""
    chunks = session.make_chunks(config_of(settings, row, preset))
    program = chunks.learner
    state = chunks.init(jax.random.key(settings.seed))
    idle = jax.tree.map(lambda x: x.copy(), dataclasses.replace(state, solved=~state.solved))
    jax.block_until_ready(chunks.advance(idle, 1))  # compiled, and run with nothing to do
    wall, cpu, steps = [], [], []
    for _ in range(settings.generations):
        started, cpu_started = time.perf_counter(), time.process_time()
        state, info = jax.block_until_ready(chunks.advance(state, 1))
        wall.append(time.perf_counter() - started)
        cpu.append(time.process_time() - cpu_started)
        steps.append(int(jax.device_get(info).train_steps.sum()))
    means = {"seconds": np.mean(wall), "cpu_seconds": np.mean(cpu), "train_steps": np.mean(steps)}
    return pd.DataFrame([means | {"agents": program.strategy.num_evaluations}])


def report(settings: Timings, timed: pd.DataFrame) -> pd.DataFrame:
    cores = int(timed["cores"].iloc[0])
    columns: dict[str, Any] = {
        "task": lambda row: ROWS[row.row].env,
        "proxy": lambda row: ROWS[row.row].proxy.upper(),
        "settings": lambda row: SETTINGS[row.preset],
        f"paper, {PAPER_CORES} cores": lambda row: f"{ROWS[row.row].seconds:g} s",
        f"sejax, {cores} cores": lambda row: f"{row.seconds:{_digits(row.seconds)}} s",
        "agents": "{agents}",
        "training steps": "{train_steps:,.0f}",
        "CPU µs for a training step": lambda row: f"{row.cpu_seconds / row.train_steps * 1e6:,.1f}",
    }
    note = (
        f"The first {settings.generations} iterations of a run, compiled before. All tests on the "
        "real task are in them. For RNs of Cliff Walking and CartPole our default has the paper's "
        "agents and sizes. "
    )
    if settings.quick:
        note += "quick=true: few agents, short trainings, not to be compared with the paper's. "
    title = "Seconds for one outer iteration of NES"
    return publish(settings, title, as_texts(timed, columns), timed, note.strip())


def _digits(seconds: float) -> str:
    return ",.0f" if seconds >= 10 else ".2g"


EXPERIMENT = Experiment(settings=Timings, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
