"""Learning many proxies, one NES run after the other or several at once, saved as they go.

Each run is that of `python -m sejax.run` with the same settings and seeds, in a run directory of
its own; a run that was stopped goes on, and a finished one is kept.
"""

import dataclasses
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sejax.experiments import common


def configs_of_runs(config: Any, count: int, folder: Path, at_once: int = 1) -> list[Any]:
    """Configurations of runs with `count` seeds from `config.seed` on, in folders of their own.

    Args:
      config: of all.
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


def learn_all(configs: list[Any], pieces: common.Pieces, prefix: str = "") -> pd.DataFrame:
    """Curves of all runs, in rows with the columns of `metrics.csv`.

    Args:
      configs: from `configs_of_runs`; a run that is finished is not made again, one of fewer
        generations goes on if its checkpoint is still there.
      pieces: where the curves are kept, as `<prefix>` and the name of the run's folder.
      prefix: for runs of different settings in one folder.
    """
    from sejax.bilevel import make_program

    program = make_program(configs[0])
    step = make_step(program)
    curves = []
    for config in configs:
        name = prefix + Path(config.run_dir).name
        learn = functools.partial(learn_one, config, program, step)
        curve = pieces.compute(name, piece_settings(config), learn, length="generations")
        best = curve.groupby("seed")["best_so_far"].max().mean()
        when = ""
        if program.solved_score is not None and config.num_seeds == 1:
            solved = generations_to_solve(curve, program.solved_score)
            when = f"solved in generation {solved:.0f}" if np.isfinite(solved) else "not solved"
            when = f", {when} of {len(curve)}"
        print(f"{name}: best {best:.1f}{when}", flush=True)
        curves.append(curve)
    return pd.concat(curves, ignore_index=True)


def piece_settings(config: Any) -> dict[str, Any]:
    """What a run depends on, as `group.field`; not how it is computed or where it is written."""
    from sejax.configs import to_dict
    from sejax.run_directory import flatten

    return {name: value for name, value in flatten(to_dict(config)).items()
            if name not in ("run_dir", "devices", "lanes", "checkpoint_every")}  # fmt: skip


def make_step(program: Any) -> Callable[[Any], Any]:
    """Builds `step(state) -> (state, info)`: a generation, compiled once for a number of seeds.

    Left to `jax.jit` it would be compiled anew for the state's every placement on the devices: new,
    restored, or as the generation before returned it.
    """
    import jax

    @functools.cache
    def compiled(num_seeds: int) -> Any:
        state = jax.eval_shape(program.init, jax.random.split(jax.random.key(0), num_seeds))
        return jax.jit(program.generation, donate_argnums=0).lower(state).compile()

    return lambda state: compiled(state.generation.shape[0])(state)


def learn_one(config: Any, program: Any, step: Callable[..., Any]) -> pd.DataFrame:
    """One run of Algorithm 1, saved after each generation; goes on where it was stopped.

    Args:
      config: with the run's seeds and folder.
      program: from `bilevel.make_program`.
      step: from `make_step`; it uses up the state's buffers.

    Returns:
      The rows of the run's `metrics.csv`.

    Raises:
      ConfigError: for a folder with another run, or one that has lost its checkpoint.
    """
    import jax

    from sejax import checkpoints
    from sejax.run_directory import RunDirectory

    directory = RunDirectory.open(config)
    seeds = config.seed + jax.numpy.arange(config.num_seeds)
    state = jax.jit(program.init)(jax.vmap(jax.random.key)(seeds))
    state, generation, _ = checkpoints.restore_newest(directory.checkpoints, state)
    directory.go_on_from(generation)
    state = jax.tree.map(lambda x: x.copy(), state)  # own buffers, so that they can be donated
    started = time.time() - (float(directory.rows[-1]["wall_s"]) if directory.rows else 0.0)
    while generation < config.generations and not bool(state.finished.all()):
        state, info = step(state)
        generation += 1
        host_state, info = jax.device_get((state, info))
        directory.add_rows(jax.tree.map(lambda x: x[None], info), time.time() - started)
        directory.save_proxies(program, host_state)
        checkpoints.save(directory.checkpoints, generation, state)
    return pd.read_csv(directory.metrics)


def collect(configs: list[Any], path: Path, before: Any = None) -> None:
    """Writes the best proxy of each seed into one file.

    Args:
      configs: of the runs.
      path: the file.
      before: a `ProxySet` of the same settings and earlier seeds, which comes first.
    """
    from sejax.proxies import io as proxy_io
    from sejax.proxies.sets import save_set

    files = []
    for config in configs:
        folder = Path(config.run_dir)
        seeds = range(config.seed, config.seed + config.num_seeds)
        several = [folder / "proxies" / f"seed{seed}.safetensors" for seed in seeds]
        files += several if config.num_seeds > 1 else [folder]
    best = [proxy_io.load_proxy(file) for file in files]
    known = range(before.size) if before else ()
    save_set(
        path,
        before.config if before else configs[0],
        [before.one(i).weights for i in known] + [proxy.params.weights for proxy in best],
        [before.scores[i] for i in known] + [proxy.metadata["score"] for proxy in best],
        [before.generations[i] for i in known] + [proxy.metadata["generation"] for proxy in best],
        [before.seeds[i] for i in known] + [proxy.metadata["seed"] for proxy in best],
    )


def generations_to_solve(curve: pd.DataFrame, solved_reward: float) -> float:
    """Generations until the first whose incumbent mean reaches the threshold; inf if none does.

    Args:
      curve: one run, in the order of its generations.
      solved_reward: the threshold.
    """
    solved = curve["generation"][curve["incumbent_mean"] >= solved_reward]
    return float(solved.iloc[0]) + 1 if len(solved) else np.inf
