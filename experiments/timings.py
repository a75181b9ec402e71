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
from typing import Any

import jax
import numpy as np
import pandas as pd

import sejax
from experiments.common.experiment import Experiment, Settings, count, setting
from experiments.common.tables import as_texts, publish
from sejax.options import each_of
from sejax.runs import workers
from sejax.runs.runtime import available_cores

PAPER_CORES = 16


PAPER = {  # seconds for one outer iteration, by task and proxy
    "cliff_walking-rn": 10,
    "acrobot-se": 100,
    "cartpole-se": 100,
    "cartpole-rn": 100,
    "mountain_car_continuous-rn": 500,
    "halfcheetah-rn": 2000,
}
WITH_BOTH = ("acrobot-se", "cartpole-se", "mountain_car_continuous-rn")  # presets
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
    """Settings of this experiment.

    Attributes:
      rows: tasks and proxies
      generations: outer iterations to time
    """

    name = "timings"

    rows: tuple[str, ...] = setting(tuple(PAPER), each_of(PAPER))
    generations: int = count(2)


def compute(settings: Timings) -> pd.DataFrame:
    """Times what is missing; a row for each task, proxy and preset."""
    cores = settings.devices or available_cores()
    tables = []
    for name in settings.rows:
        for preset in ("paper", "best") if name in WITH_BOTH else ("best",):
            made_with = {"row": name, "preset": preset, "cores": cores}
            made_with |= settings.values("quick", "generations", "seed")
            run = functools.partial(time_generations, settings, name, preset)
            timed = settings.shards.compute(f"{name}-{preset}-{cores}", made_with, run)
            tables.append(timed.assign(row=name, preset=preset, cores=cores))
            print(f"{name}, {preset}: {timed['seconds'].iloc[0]:,.1f} s", flush=True)
    return pd.concat(tables, ignore_index=True)


def config_of(settings: Timings, row: str, preset: str) -> Any:
    """The configuration that is timed."""
    env, proxy = row.split("-")
    overrides = [f"env={env}", f"proxy={proxy}", f"preset={preset}"]
    if proxy == "rn":  # the paper does not say which variant; this one needs two potentials
        overrides.append("proxy.variant=additive_potential")
    if settings.quick:  # a table's agent has no warm-up
        overrides += QUICK[:-1] if env == "cliff_walking" else QUICK
    config = sejax.config(overrides)
    return dataclasses.replace(config, devices=settings.devices, seed=settings.seed)


def time_generations(settings: Timings, row: str, preset: str) -> pd.DataFrame:
    """Mean wall-clock of the first outer iterations, compiled before."""
    chunks = workers.make_chunks(config_of(settings, row, preset))
    chunks.compile(1)
    program = chunks.bilevel
    state = chunks.init(jax.random.key(settings.seed))
    idle = jax.tree.map(lambda x: x.copy(), dataclasses.replace(state, solved=~state.solved))
    jax.block_until_ready(chunks.advance(idle, 1))  # with nothing to do
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
        "task": lambda row: row.row.split("-")[0],
        "proxy": lambda row: row.row.split("-")[1].upper(),
        "settings": lambda row: SETTINGS[row.preset],
        f"paper, {PAPER_CORES} cores": lambda row: f"{PAPER[row.row]} s",
        f"sejax, {cores} cores": lambda row: f"{row.seconds:{_digits(row.seconds)}} s",
        "agents": "{agents}",
        "training steps": "{train_steps:,.0f}",
        "CPU µs for a training step": lambda row: f"{row.cpu_seconds / row.train_steps * 1e6:,.1f}",
    }
    note = (
        f"The first {settings.generations} iterations of a run, compiled before. All tests on the "
        "real task are in them. For RNs of Cliff Walking and CartPole our default has the paper's "
        "agents and sizes."
    )
    title = "Seconds for one outer iteration of NES"
    return publish(settings, title, as_texts(timed, columns), timed, note)


def _digits(seconds: float) -> str:
    return ",.0f" if seconds >= 10 else ".2g"


EXPERIMENT = Experiment(settings=Timings, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
