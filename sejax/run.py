"""`python -m sejax.run`: learn a proxy for a task.

Running the same command on an existing run directory goes on where it stopped.
"""

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sejax.cli import commands, compose, runtime
from sejax.cli import config as configuration
from sejax.cli.config import LearnConfig

ABOUT = """Learn a small network that stands in for an RL task (proxy=se), or for its reward on the
real dynamics (proxy=rn), from agents trained on nothing else.

  python -m sejax.run env=acrobot es.population_size=32 run_dir=runs/mine
  python -m sejax.run agents=[ddqn,ppo] agents.ddqn.weight=2 agents.aggregate=min
  python -m sejax.run env=gymnax/MountainCar-v0 agent=my_module:MyAgent
  python -m sejax.run seed=0,1,2 es.noise_std=0.03,0.06      a run for each combination

The same command on the same run_dir goes on where it stopped.
Then: python -m sejax.evaluate proxy=RUN_DIR
"""


def main(overrides: Sequence[str]) -> None:
    """Learns a proxy for each configuration that the overrides describe.

    Raises:
      ConfigError: for overrides that cannot be, or a run directory that cannot be used.
      OSError: if a file cannot be written; everything saved before is whole.
    """
    configs = []
    for of_run in compose.expand(overrides):
        config = configuration.config(of_run)
        given = config.run_dir
        known = LearnConfig.in_run_dir if given is None else ("run_dir",)
        own = compose.name_in_sweep(overrides, of_run, known)
        if own:  # or all runs of a sweep would have one folder
            folder = f"{config.resolved_run_dir}_{own}" if given is None else f"{given}/{own}"
            config = dataclasses.replace(config, run_dir=folder)
        configs += runs_of(config)
    learn_all(configs)


def help_text(overrides: Sequence[str]) -> str:
    """What `--help` prints."""
    return f"{ABOUT}\n{compose.help_text(LearnConfig, overrides)}"


def learn(config: LearnConfig) -> list[float]:
    """Learns a proxy for each of `num_seeds` seeds; see `learn_all`."""
    return learn_all(runs_of(config))


def learn_all(configs: Sequence[LearnConfig]) -> list[float]:
    """Learns a proxy for each configuration, one after the other.

    Each has a run directory of its own. Those that differ from the one before in the seed alone run
    on its executable.

    Returns:
      The best incumbent score of each.

    Raises:
      ConfigError: if a run directory cannot be used.
      OSError: if a file cannot be written; everything saved before is whole.
    """
    with contextlib.ExitStack() as stack:
        before: dict[str, Any] = {}

        def chunks_of(config: LearnConfig) -> Any:
            program = dataclasses.replace(config, seed=0, run_dir=None)
            if before.get("program") != program:
                stack.close()
                runtime.configure_jax()
                made = config.machines.make(config, Path(config.resolved_run_dir), print)
                before.update(program=program, chunks=stack.enter_context(made))
            return before["chunks"]

        several = len(configs) > 1
        scores = [_learn(config, chunks_of, says_more=not several) for config in configs]
    if several:
        print("Best incumbent scores:")
        for config, score in zip(configs, scores, strict=True):
            print(f"{score:10.1f}  {config.resolved_run_dir}")
    return scores


def runs_of(config: LearnConfig) -> list[LearnConfig]:
    """The configuration of each seed; where `run_dir` is given, with `seed0` and so on in it."""
    if config.num_seeds == 1:
        return [config]
    return [
        dataclasses.replace(
            config,
            seed=seed,
            num_seeds=1,
            run_dir=config.run_dir and f"{config.run_dir}/seed{seed}",
        )
        for seed in range(config.seed, config.seed + config.num_seeds)
    ]


def _learn(config: LearnConfig, chunks_of: Callable[[LearnConfig], Any], says_more: bool) -> float:
    """Learns a proxy in its run directory, with a live line of progress.

    Ctrl-C leaves at once, with exit code 130: finished generations are saved.

    Args:
      config: the configuration.
      chunks_of: gives its compiled generations.
      says_more: whether it prints at the end where everything is, and what to do next.

    Returns:
      The best incumbent score.
    """
    from sejax.cli.progress import RunProgress

    # Before the task is imported: a refusal must be quick.
    from sejax.cli.run_directory import open_for

    with open_for(config) as directory, RunProgress(config) as progress:
        try:
            progress.status("importing jax and the task")
            from sejax.cli import session

            chunks = chunks_of(config)
            ended = session.run(config, directory, chunks, progress)
        except KeyboardInterrupt:
            progress.stop()
            print(
                f"Interrupted. {directory.finished_generations} generations are saved in "
                f"{directory.path}; the same command goes on from there."
            )
            commands.leave(commands.INTERRUPTED)
        best = max(float(row["best_so_far"]) for row in directory.rows)
        if says_more:
            progress.finish(directory, chunks.learner, best, ended)
    return best


if __name__ == "__main__":
    commands.start(main, help_text)
