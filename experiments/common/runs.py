"""NES runs that learn proxies, one after the other, and what their generations cost.

Each run is that of `python -m sejax.run` with the same configuration and seed, in a run directory
of its own: one that was stopped goes on, and a finished one is kept.
"""

import dataclasses
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd

import sejax
from experiments.common.experiment import Settings, count, setting
from sejax.ops.files import write_text
from sejax.options import ConfigError, require
from sejax.runs import config as configuration
from sejax.runs import run_directory, session
from sejax.runs.progress import Tally

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
    """Settings about the NES runs."""

    env: str = setting("cartpole", help="task: cartpole, acrobot, ...")
    generations: int | None = count(None, help="outer iterations; the preset's")
    preset: str = setting("best", help="of the NES runs: best, paper, for SEs paper_performance")
    run: tuple[str, ...] = setting((), help="overrides of the NES runs, or as below")

    def learn_config(self, overrides: Iterable[str]) -> Any:
        """The configuration of the NES runs with these overrides; those of `run` win."""
        words = [f"env={self.env}", f"preset={self.preset}", *overrides]
        if self.generations is not None:
            words.append(f"generations={self.generations}")
        config = sejax.config([*words, *self.run])
        return dataclasses.replace(config, devices=self.devices, seed=self.seed)


def configs_of(config: Any, num_runs: int, folder: Path) -> list[Any]:
    """Configurations of runs with the seeds from `config.seed` on, in folders of their own."""
    return [
        dataclasses.replace(config, seed=seed, num_seeds=1, run_dir=str(folder / f"seed{seed}"))
        for seed in range(config.seed, config.seed + num_runs)
    ]


def learn(
    configs: list[Any],
    option: str = "work",
    chunks: session.Chunks | None = None,
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
    chunks = chunks or session.make_chunks(configs[0])
    curves = []
    with Tally(len(configs), "NES runs") as tally:
        for config in configs:
            with run_directory.open_for(config, f"Set {option}=DIR.") as directory:
                curve = _learn_one(config, directory, chunks)
            _require_no_more(config, curve)
            print(f"{config.run_dir}: {_log(curve, chunks.learner.solved_score)}", flush=True)
            curves.append(curve)
            tally.add()
    return pd.concat(curves, ignore_index=True)


def _learn_one(config: Any, directory: Any, chunks: session.Chunks) -> pd.DataFrame:
    path = directory.path / "cpu_s.txt"
    session.run(config, directory, TimedChunks(chunks, path))
    curve = pd.DataFrame(directory.rows).apply(pd.to_numeric)  # those of the verified checkpoint
    return curve.assign(cpu_s=pd.Series(read_costs(path, len(curve))))


def _require_no_more(config: Any, curve: pd.DataFrame) -> None:
    there = int(curve["generation"].max()) + 1 if len(curve) else 0
    require(
        there <= config.generations,
        "generations",
        f"must be at least {there}, as the run in {config.run_dir} has so many; got "
        f"{config.generations}. Set generations={there}, or another folder.",
    )


def _log(curve: pd.DataFrame, solved_score: float | None) -> str:
    best = f"best {curve['best_so_far'].max():.1f}"
    if solved_score is None:
        return best
    solved = generations_to_solve(curve, solved_score)
    first = f"{solved:.0f}" if np.isfinite(solved) else "none"
    return f"{best}, first passage of the threshold in generation {first} of {len(curve)}"


def collect(configs: list[Any], path: Path, before: Any = None) -> None:
    """Writes the best proxy of each run into one file, after those of the set `before`."""
    sets = [*([before] if before else []), *(sejax.load_set(Path(x.run_dir)) for x in configs)]
    proxies = [proxy for each in sets for proxy in each]
    sejax.save_set(
        path,
        sets[0].env,
        [proxy.params.weights for proxy in proxies],
        [proxy.record for proxy in proxies],
        before.config if before else configuration.plain(configs[0]),
        sets[0].discount,
    )


def generations_to_solve(curve: pd.DataFrame, solved_reward: float) -> float:
    """Generations of a run until the first whose incumbent mean is high enough; inf if none is."""
    solved = curve["generation"][curve["incumbent_mean"] >= solved_reward]
    return float(solved.iloc[0]) + 1 if len(solved) else np.inf


# --- what generations cost -----------------------------------------------------------------------


class TimedChunks(session.Chunks):
    """Compiled generations that write down their CPU seconds.

    CPU seconds are those of this process on all of its threads, while it computes a generation:
    compilation, files and figures are left out. Costs are written before the generation itself is;
    after a kill there may be one too many, which the run writes again as it goes on.
    """

    def __init__(self, chunks: session.Chunks, path: Path):
        super().__init__(chunks.learner)
        self._compiled = chunks._compiled  # shared by all runs
        self._path = path

    def advance(self, state: Any, length: int) -> tuple[Any, Any]:
        """Runs `length` generations."""
        before = read_costs(self._path, int(state.generation))
        started = time.process_time()
        result = jax.block_until_ready(super().advance(state, length))
        each = (time.process_time() - started) / length
        costs = np.concatenate([before, np.full(length, each)])
        write_text(self._path, "".join(f"{cost:.3f}\n" for cost in costs))
        return result


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
        raise ConfigError(
            f"work must hold whole files; {path} is damaged. Set work=DIR.", "work"
        ) from error
