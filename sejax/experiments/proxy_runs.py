"""Learning many proxies, one NES run after the other or several at once.

Each run is that of `python -m sejax.run` with the same settings and seeds, by the same driver, in a
run directory of its own: one that was stopped goes on, and a finished one is kept.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd


def configs_of_runs(config: Any, count: int, folder: Path, at_once: int = 1) -> list[Any]:
    """Configurations of runs with `count` seeds from `config.seed` on, in folders of their own.

    Args:
      config: of all, a `LearnConfig`.
      count: seeds in all.
      folder: where the runs' folders go.
      at_once: seeds that one program learns.
    """
    configs = []
    for seed in range(config.seed, config.seed + count, at_once):
        num_seeds = min(at_once, config.seed + count - seed)
        name = f"seed{seed}" if num_seeds == 1 else f"seeds{seed}-{seed + num_seeds - 1}"
        configs.append(dataclasses.replace(
            config, seed=seed, num_seeds=num_seeds, run_dir=str(folder / name)
        ))  # fmt: skip
    return configs


def learn_all(configs: list[Any], option: str = "work") -> pd.DataFrame:
    """Curves of all runs, in rows with the columns of `metrics.csv`.

    Args:
      configs: from `configs_of_runs`; of what is there already only the rest is computed.
      option: the setting that names a folder above those of the runs, for messages.

    Raises:
      ConfigError: if a folder holds a run of other settings, or is in use.
    """
    from sejax.app import run_directory, session

    chunks = session.make_chunks(configs[0])
    curves = []
    for config in configs:
        with run_directory.open_for(config, f"Set {option}=DIR.") as directory:
            session.run(config, directory, chunks)
            curve = pd.read_csv(directory.metrics)
        print(f"{config.run_dir}: {_said(curve, chunks.program.solved_score)}", flush=True)
        curves.append(curve)
    return pd.concat(curves, ignore_index=True)


def _said(curve: pd.DataFrame, solved_score: float | None) -> str:
    best = curve.groupby("seed")["best_so_far"].max()
    text = f"best {best.mean():.1f}"
    if solved_score is None or len(best) > 1:
        return text
    solved = generations_to_solve(curve, solved_score)
    when = f"solved in generation {solved:.0f}" if np.isfinite(solved) else "not solved"
    return f"{text}, {when} of {len(curve)}"


def collect(configs: list[Any], path: Path, before: Any = None) -> None:
    """Writes the best proxy of each seed into one file.

    Args:
      configs: of the runs.
      path: the file.
      before: a `ProxySet` of the same settings and earlier seeds, which comes first.
    """
    import sejax
    from sejax.app import build

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
    """Generations until the first whose incumbent mean reaches the threshold; inf if none does.

    Args:
      curve: one run, in the order of its generations.
      solved_reward: the threshold.
    """
    solved = curve["generation"][curve["incumbent_mean"] >= solved_reward]
    return float(solved.iloc[0]) + 1 if len(solved) else np.inf
