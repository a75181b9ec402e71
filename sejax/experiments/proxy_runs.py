"""Learning many proxies, one NES run after the other, each saved as it goes.

Each run is that of `python -m sejax.run` with the same settings and seed, in a run directory of its
own; a run that was stopped goes on, and a finished one is kept.
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


def configs_of_runs(config: Any, seed: int, count: int, folder: Path) -> list[Any]:
    """Configurations of runs with seeds `seed`, `seed + 1`, ... in folders of their own."""
    return [
        dataclasses.replace(config, seed=seed + i, run_dir=str(folder / f"seed{seed + i}"))
        for i in range(count)
    ]


def learn_all(configs: list[Any], pieces: common.Pieces, prefix: str = "") -> pd.DataFrame:
    """Curves of all runs, in rows with the columns of `metrics.csv`.

    Args:
      configs: from `configs_of_runs`; a run that is finished is not made again.
      pieces: where the curves are kept, as `<prefix>seed<N>`.
      prefix: for runs of different settings in one folder.
    """
    from sejax.bilevel import make_program

    program = make_program(configs[0])
    step = make_step(program)
    curves = []
    for config in configs:
        name = f"{prefix}seed{config.seed}"
        curve = pieces.compute(
            name, piece_settings(config), functools.partial(learn_one, config, program, step)
        )
        when = ""
        if program.solved_score is not None:
            solved = generations_to_solve(curve, program.solved_score)
            when = f"solved in generation {solved:.0f}" if np.isfinite(solved) else "not solved"
            when = f", {when} of {len(curve)}"
        print(f"{name}: best {curve['best_so_far'].max():.1f}{when}", flush=True)
        curves.append(curve)
    return pd.concat(curves, ignore_index=True)


def piece_settings(config: Any) -> dict[str, Any]:
    """What a run depends on, as `group.field`; not how it is computed or where it is written."""
    from sejax.configs import to_dict

    flat = pd.json_normalize(to_dict(config)).iloc[0].to_dict()
    return {name: value for name, value in flat.items()
            if name not in ("run_dir", "devices", "lanes", "checkpoint_every")}  # fmt: skip


def make_step(program: Any) -> Callable[[Any], Any]:
    """Builds `step(state) -> (state, info)`: a generation, compiled at the first call, only once.

    Left to `jax.jit` it would be compiled anew for the state's every placement on the devices: new,
    restored, or as the generation before returned it.
    """
    import jax

    @functools.cache
    def compiled() -> Any:
        state = jax.eval_shape(program.init, jax.random.key(0)[None])
        return jax.jit(program.generation, donate_argnums=0).lower(state).compile()

    return lambda state: compiled()(state)


def learn_one(config: Any, program: Any, step: Callable[..., Any]) -> pd.DataFrame:
    """One run of Algorithm 1, saved after each generation; goes on where it was stopped.

    Args:
      config: with the run's seed and folder.
      program: from `bilevel.make_program`.
      step: from `make_step`; it uses up the state's buffers.

    Returns:
      The rows of the run's `metrics.csv`.
    """
    import jax

    from sejax import checkpoints
    from sejax.run_directory import RunDirectory

    directory = RunDirectory.open(config)
    state = jax.jit(program.init)(jax.random.key(config.seed)[None])
    state, generation, _ = checkpoints.restore_newest(directory.checkpoints, state)
    directory.drop_rows_from(generation)
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


def collect(configs: list[Any], path: Path) -> None:
    """Writes the best SE of each run into one file."""
    from sejax.experiments.proxy_sets import save_set
    from sejax.proxies import io as proxy_io

    best = [proxy_io.load_proxy(config.run_dir) for config in configs]
    save_set(
        path,
        configs[0],
        [proxy.params.weights for proxy in best],
        [proxy.metadata["score"] for proxy in best],
        [proxy.metadata["generation"] for proxy in best],
        [config.seed for config in configs],
    )


def generations_to_solve(curve: pd.DataFrame, solved_reward: float) -> float:
    """Generations until the first whose incumbent mean reaches the threshold; inf if none does.

    Args:
      curve: one run, in the order of its generations.
      solved_reward: the threshold.
    """
    solved = curve["generation"][curve["incumbent_mean"] >= solved_reward]
    return float(solved.iloc[0]) + 1 if len(solved) else np.inf
