"""Learn a small network that replaces an RL task (proxy=se), or only its reward (proxy=rn, with
the task's real dynamics). Its score comes from agents that train on nothing else.

  python -m sejax.run env=acrobot es.population_size=32 run_dir=runs/mine
  python -m sejax.run 'agents=[ddqn,ppo]' mixture.weights.ddqn=2 mixture.aggregate=min
  python -m sejax.run env=gymnax/MountainCar-v0 agent=my_module:MyAgent
  python -m sejax.run seed=0,1,2 es.noise_std=0.03,0.06      a run for each combination

The same command on the same run_dir resumes where it stopped. --print-config prints the
configuration of each run, and runs nothing.
Then: python -m sejax.evaluate proxy=RUN_DIR
"""

import functools
from collections.abc import Sequence
from pathlib import Path

from sejax.bilevel import make_bilevel
from sejax.options import FailedError
from sejax.runs import commands, session
from sejax.runs.config import LearnConfig
from sejax.runs.progress import RunProgress
from sejax.runs.run_directory import RunDirectory


def main(overrides: Sequence[str]) -> None:
    """Learns a proxy for each configuration that the overrides describe.

    Raises:
      ConfigError: for invalid overrides, or a run directory that cannot be used.
      OSError: if a file cannot be written; everything saved before is whole.
    """
    learn_all(LearnConfig.of_sweep(overrides))


help_text = functools.partial(commands.help_of, LearnConfig, __doc__)


def learn_all(configs: Sequence[LearnConfig]) -> list[float]:
    """Learns a proxy for each configuration, one after the other; each has a run directory.

    Runs that differ only in their seeds follow each other, and use the same executable. After a
    single run it prints where everything is and what to do next; after several, a line for each.
    If it is interrupted, finished generations are saved.

    Returns:
      The best score of each run's search mean.

    Raises:
      ConfigError: if a run directory cannot be used.
      FailedError: after the last run, if no search mean of some run had a finite score.
      OSError: if a file cannot be written; everything saved before is whole.
    """
    by_program: dict[str, list[LearnConfig]] = {}
    for config in configs:
        program = str(config.plain() | {"seed": 0, "run_dir": None})
        by_program.setdefault(program, []).append(config)
    # The last run of a sweep must not be refused after the others have run.
    for config in configs:
        with RunDirectory(config):
            pass
    if len(by_program) > 1:
        for config, *_ in by_program.values():
            make_bilevel(**config.parts())
    scores = dict[Path, float]()
    diverged = list[Path]()
    for of_program in by_program.values():
        with of_program[0].machines.make(of_program[0]) as chunks:
            for config in of_program:
                progress = RunProgress(config)
                with RunDirectory(config) as directory:
                    summary = session.run(config, directory, chunks, progress)
                    score = max(float(row["best_so_far"]) for row in directory.rows)
                    if summary["ended"] == "diverged":
                        diverged.append(directory.folder)
                    elif len(configs) == 1:
                        progress.finish(directory, chunks.bilevel, score)
                    scores[config.folder] = score
    if len(configs) > 1:
        print("Best scores of the search mean:")
        for config in configs:
            print(f"{scores[config.folder]:10.1f}  {config.folder}")
    if diverged:
        runs = ", ".join(map(str, diverged))
        what = f"All agents of {runs} diverged, or all on its search means: nothing was learned."
        fix = "Does the task return NaN? If not, set another agent.learning_rate and run_dir."
        raise FailedError(f"{what} {fix}")
    return [scores[config.folder] for config in configs]


if __name__ == "__main__":
    commands.start(main, help_text, LearnConfig.of_sweep)
