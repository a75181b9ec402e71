"""Learning many proxies, one NES run after the other or several at once.

Each run is that of `python -m sejax.run` with the same settings and seeds, by the same driver, in a
run directory of its own: one that was stopped goes on, and a finished one is kept.
"""

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import sejax
from experiments.settings import Settings, count, setting
from sejax.errors import require


@dataclass(frozen=True, kw_only=True)
class RunSettings(Settings):
    """Settings about the NES runs."""

    env: str = setting("cartpole", about="task: cartpole, acrobot, ...")
    generations: int | None = count(None, "generations", about="outer iterations; the preset's")
    preset: str = setting("best", about="of the NES runs: best, paper, for SEs paper_performance")
    run: tuple[str, ...] = setting((), about="overrides of the NES runs, or as below")

    def learn_config(self, words: Iterable[str]) -> Any:
        """The configuration of the NES runs with these overrides; later ones win."""
        words = [f"env={self.env}", f"preset={self.preset}", *words]
        if self.generations is not None:
            words.append(f"generations={self.generations}")
        config = sejax.config([*words, *self.run])
        return dataclasses.replace(config, devices=self.devices, seed=self.seed)


def configs_of_runs(config: Any, num_runs: int, folder: Path, at_once: int = 1) -> list[Any]:
    """Configurations of runs with `num_runs` seeds from `config.seed` on, in folders of their own.

    One program learns `at_once` of them.
    """
    configs = []
    for seed in range(config.seed, config.seed + num_runs, at_once):
        num_seeds = min(at_once, config.seed + num_runs - seed)
        name = f"seed{seed}" if num_seeds == 1 else f"seeds{seed}-{seed + num_seeds - 1}"
        configs.append(
            dataclasses.replace(config, seed=seed, num_seeds=num_seeds, run_dir=str(folder / name))
        )
    return configs


def run_to_end(config: Any, directory: Any, chunks: Any) -> pd.DataFrame:
    """Learns a run, or what is left of it, in its folder; its curve."""
    from sejax.cli import session

    session.run(config, directory, chunks)
    return pd.read_csv(directory.metrics)


def learn_all(
    configs: list[Any], option: str = "work", learn: Callable[..., pd.DataFrame] = run_to_end
) -> pd.DataFrame:
    """Curves of all runs, in rows with the columns of `metrics.csv`; learns what is not there.

    Args:
      configs: of the runs.
      option: that names the folder where they are, for messages.
      learn: `(config, directory, chunks) -> curve` of one run, as from `budgets.timed`.

    Raises:
      ConfigError: if a folder, below that which `option` names, holds a run of other settings or
        of more generations than are asked for, or is in use.
    """
    from sejax.cli import run_directory, session
    from sejax.cli.progress import Tally

    chunks = session.make_chunks(configs[0])
    curves = []
    with Tally(sum(config.num_seeds for config in configs), "NES runs") as tally:
        for config in configs:
            with run_directory.open_for(config, f"Set {option}=DIR.") as directory:
                curve = learn(config, directory, chunks)
            _require_no_more(config, curve)
            print(f"{config.run_dir}: {_said(curve, chunks.program.solved_score)}", flush=True)
            curves.append(curve)
            tally.add(config.num_seeds)
    return pd.concat(curves, ignore_index=True)


def _require_no_more(config: Any, curve: pd.DataFrame) -> None:
    there = int(curve["generation"].max()) + 1 if len(curve) else 0
    require(
        there <= config.generations,
        "generations",
        f"be at least {there}",
        f"a run in {config.run_dir} has so many, and its proxy is the best of all",
        config.generations,
        f"generations={there}, or another folder",
    )


def _said(curve: pd.DataFrame, solved_score: float | None) -> str:
    best = curve.groupby("seed")["best_so_far"].max()
    when = ""
    if solved_score is not None and len(best) == 1:
        solved = generations_to_solve(curve, solved_score)
        how = f"solved in generation {solved:.0f}" if np.isfinite(solved) else "not solved"
        when = f", {how} of {len(curve)}"
    return f"best {best.mean():.1f}{when}"


def collect(configs: list[Any], path: Path, before: Any = None) -> None:
    """Writes the best proxy of each seed into one file, after those of the set `before`."""
    from sejax.cli import build

    sources: list[Path] = []
    for config in configs:
        folder = Path(config.run_dir)
        seeds = range(config.seed, config.seed + config.num_seeds)
        several = [folder / "proxies" / f"seed{seed}.safetensors" for seed in seeds]
        sources += several if config.num_seeds > 1 else [folder]
    sets = [*([before] if before else []), *map(sejax.load_set, sources)]
    places = [(each, i) for each in sets for i in range(each.size)]
    sejax.save_set(
        path,
        sets[0].env,
        [each.one(i).weights for each, i in places],
        [each.records[i] for each, i in places],
        before.config if before else build.to_plain(configs[0]),
        sets[0].discount,
    )


def generations_to_solve(curve: pd.DataFrame, solved_reward: float) -> float:
    """Generations of a run until the first whose incumbent mean is high enough; inf if none is."""
    solved = curve["generation"][curve["incumbent_mean"] >= solved_reward]
    return float(solved.iloc[0]) + 1 if len(solved) else np.inf
