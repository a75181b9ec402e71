"""`python -m sejax.run`: learn a proxy for a task.

Running the same command on an existing run directory goes on where it stopped.
"""

import dataclasses

import hydra
from omegaconf import DictConfig

from sejax.cli import commands, compose, runtime
from sejax.cli.build import IN_RUN_DIR, LearnConfig


@hydra.main(config_path="conf", config_name="run", version_base="1.3")
@commands.guarded
def main(cfg: DictConfig) -> float:
    """Learns a proxy as configured and returns the best incumbent mean (for Hydra's sweepers)."""
    config = compose.learn_config(cfg)
    given = config.run_dir
    own = commands.name_in_sweep(IN_RUN_DIR if given is None else ("run_dir",))
    if own:  # or all jobs of a sweep would have one folder
        folder = f"{config.resolved_run_dir}_{own}" if given is None else f"{given}/{own}"
        config = dataclasses.replace(config, run_dir=folder)
    return learn(config)


def learn(config: LearnConfig) -> float:
    """Learns a proxy in its run directory, with a live line of progress and last words.

    Ctrl-C leaves at once, with exit code 130: what is finished has been saved.

    Returns:
      The best incumbent mean of all seeds.

    Raises:
      ConfigError: if the run directory cannot be used.
      OSError: if a file cannot be written; everything saved before is whole.
    """
    from sejax.cli.progress import RunProgress

    # Before the task is imported: a refusal must be quick.
    from sejax.cli.run_directory import open_for

    with open_for(config) as directory, RunProgress(config) as progress:
        try:
            progress.say("importing jax and the task")
            from sejax.cli import session

            runtime.configure_jax()
            with config.machines.make(config, directory.path, progress.print) as chunks:
                ended = session.run(config, directory, chunks, progress)
        except KeyboardInterrupt:
            progress.stop()
            print(
                f"Interrupted. {directory.finished_generations} generations are saved in "
                f"{directory.path}; the same command goes on from there."
            )
            commands.leave(commands.INTERRUPTED)
        best = max(float(row["best_so_far"]) for row in directory.rows)
        progress.finish(directory, chunks.program, best, ended)
    return best


if __name__ == "__main__":
    commands.start("run", main)
