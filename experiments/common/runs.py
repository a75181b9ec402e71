"""NES runs that learn proxies, one after the other, and what their generations cost.

Each run is that of `python -m sejax.run` with the same configuration and seed, in a run directory
of its own: one that was stopped goes on, and a finished one is kept.
"""

import copy
import dataclasses
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import jax
import numpy as np
import pandas as pd

import sejax
from experiments.common.experiment import Settings, setting
from experiments.common.tables import summary_by
from sejax.ops.files import write_text
from sejax.ops.scores import reaches
from sejax.options import ConfigError, Count, require
from sejax.runs import run_directory, session
from sejax.runs.chunks import Chunks
from sejax.runs.config import LearnConfig

# With quick=true: a small SE and agents that learn enough to be seen moving.
QUICK = (
    "es.population_size=12",
    "es.num_incumbent_evals=8",
    "training.max_steps=1500",
    "proxy.hidden_size=32",
    "agent.hidden_size=32",
    "agent.batch_size=32",
    "agent.warmup_episodes=1",
)


@dataclass(frozen=True, kw_only=True)
class RunSettings(Settings):
    """Settings about the NES runs.

    Attributes:
      env: task: cartpole, acrobot, ...
      generations: outer iterations; the preset's
      preset: of the NES runs: best, paper, for SEs paper_performance
      run: overrides of the NES runs, or as below
    """

    quick_run: ClassVar[tuple[str, ...]] = ()  # overrides of the NES runs with quick=true

    env: str = setting("cartpole")
    generations: Count | None = setting(None)
    preset: str = setting("best")
    run: tuple[str, ...] = setting(())

    def learn_config(self, overrides: Iterable[str]) -> LearnConfig:
        """The configuration of the NES runs with these overrides; those of `run` win."""
        quick = self.quick_run if self.quick else ()
        words = [f"env={self.env}", f"preset={self.preset}", *quick, *overrides]
        if self.generations is not None:
            words.append(f"generations={self.generations}")
        config = sejax.config([*words, *self.run])
        return dataclasses.replace(config, devices=self.devices, seed=self.seed)


def configs_of(config: LearnConfig, num_runs: int, folder: Path) -> list[LearnConfig]:
    """Configurations of runs with the seeds from `config.seed` on, in folders of their own."""
    return [
        dataclasses.replace(config, seed=seed, run_dir=str(folder / f"seed{seed}"))
        for seed in range(config.seed, config.seed + num_runs)
    ]


def learn(
    configs: list[LearnConfig], option: str = "work", chunks: Chunks | None = None
) -> pd.DataFrame:
    """Learns the proxies of several runs that differ in the seed, or what is left of them.

    Args:
      configs: of the runs; see `configs_of`.
      option: the setting that names the folder, for messages.
      chunks: the compiled generations of these runs, if they were made before.

    Returns:
      The generations of all runs: the columns of `metrics.csv`, and their CPU seconds `cpu_s`.

    Raises:
      ConfigError: if a folder holds a run of other settings or of more generations, or is in use.
    """
    chunks = chunks or Chunks(configs[0])
    curves = []
    for config in configs:
        with run_directory.RunDirectory(config, option) as directory:
            path = directory.folder / "cpu_s.txt"
            session.run(config, directory, timed(chunks, path))
            curve = pd.DataFrame(directory.rows).apply(pd.to_numeric)
        there = int(curve["generation"].max()) + 1 if len(curve) else 0
        must = f"must be at least {there}, as the run in {config.run_dir} has so many"
        use = f"{there}, or another folder"
        require(there <= config.generations, "generations", must, got=config.generations, use=use)
        best = curve["best_so_far"].max()
        print(f"{config.run_dir}: {there} generations, best {best:.1f}", flush=True)
        curves.append(curve.assign(cpu_s=pd.Series(read_costs(path, len(curve)))))
    return pd.concat(curves, ignore_index=True)


def collect(configs: list[LearnConfig], path: Path, before: Any = None) -> None:
    """Writes the best proxy of each run into one file, after those of the set `before`."""
    sets = [*([before] if before else []), *(sejax.load_set(x.folder) for x in configs)]
    proxies = [proxy for each in sets for proxy in each]
    sejax.save_set(
        path,
        sets[0].env,
        [proxy.params.weights for proxy in proxies],
        [proxy.record for proxy in proxies],
        before.config if before else configs[0].plain(),
        sets[0].discount,
    )


def generations_to_solve(curve: pd.DataFrame, solved_reward: float) -> float:
    """Generations of a run until the first whose incumbent mean is high enough; inf if none is."""
    solved = curve["generation"][reaches(curve["incumbent_mean"], solved_reward)]
    return float(solved.iloc[0]) + 1 if len(solved) else np.inf


def summarise(curves: pd.DataFrame, by: Sequence[str], solved_reward: float) -> pd.DataFrame:
    """A row for each run, told apart by the columns `by`: how far it came, and what that took.

    What it took until the first incumbent that solves the task is inf for a run without one; CPU
    seconds are nan where the curves have none.
    """

    def statistics(curve: pd.DataFrame) -> dict[str, float]:
        to_solve = generations_to_solve(curve, solved_reward)
        costs = curve[["env_steps_total"]].assign(cpu_s=curve.get("cpu_s", np.nan))
        spent = costs[curve["generation"] < to_solve]
        is_solved = np.isfinite(to_solve)
        return {
            "generations": len(curve),
            "generations_to_solve": to_solve,
            "steps_to_solve": spent["env_steps_total"].max() if is_solved else np.inf,
            "cpu_s_to_solve": spent["cpu_s"].sum(skipna=False) if is_solved else np.inf,
            "best_incumbent_mean": curve["incumbent_mean"].max(),
            "last_incumbent_mean": curve["incumbent_mean"].iloc[-1],
            "steps": curve["env_steps_total"].max(),
            "cpu_s": costs["cpu_s"].mean(),
        }

    return summary_by(curves, by, statistics)


# --- what generations cost -----------------------------------------------------------------------


def timed(chunks: Chunks, path: Path) -> Chunks:
    """The same compiled generations, which write down their CPU seconds.

    CPU seconds are those of this process on all of its threads, while it computes a generation:
    compilation, files and figures are left out. Costs are written before the generation itself is;
    after a kill there may be one too many, which the run writes again as it goes on.
    """

    def advance(state: Any, length: int) -> tuple[Any, Any]:
        first = int(state.generation)
        known = read_costs(path, first)
        before = np.pad(known, (0, first - len(known)), constant_values=np.nan)
        started = time.process_time()
        result = jax.block_until_ready(chunks.advance(state, length))
        each = (time.process_time() - started) / length
        costs = np.concatenate([before, np.full(length, each)])
        write_text(path, "".join(f"{cost:.3f}\n" for cost in costs))
        return result

    writing = copy.copy(chunks)
    writing.advance = advance  # type: ignore[method-assign]
    return writing


def read_costs(path: Path, generations: int) -> np.ndarray:
    """CPU seconds of the first generations, `[generation]`; of fewer, if no more are known.

    Raises:
      ConfigError: if the file is damaged.
    """
    try:
        return np.array(path.read_text().split()[:generations], float)
    except FileNotFoundError:
        return np.array([])
    except ValueError as error:
        must = f"must hold whole files; {path} is damaged"
        raise ConfigError("work", must, use="DIR") from error
