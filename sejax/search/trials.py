"""A trial's own side: what it tells the study, and how one goes on that another process began."""

import contextlib
import dataclasses
import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import optuna

from sejax.search.settings import Search


@dataclass(frozen=True, kw_only=True)
class Progress:
    """What a trial has come to, generation by generation.

    Attributes:
      scores: `[generation, seed]`, each generation's score; nan where nothing finite came of it. A
        seed that is over keeps its last.
      cost: training steps of all agents so far.
      seconds: on the clock, compiling included.
    """

    scores: np.ndarray
    cost: int
    seconds: float


class Lost(Exception):
    """The trial is no longer this process's: it was taken for dead and given to another."""


class Follower:
    """Tells the study a trial's progress and asks it whether to go on."""

    def __init__(self, trial: Any, search: Search):
        self._trial, self._search = trial, search
        self._told = 0

    def tell(self, progress: Progress) -> None:
        """Tells each generation that the study has not heard of.

        Raises:
          optuna.TrialPruned: if the pruner ends the trial.
          Lost: if the study counts it as failed.
        """
        config = self._search.config
        for step in range(self._told + 1, len(progress.scores) + 1):
            self._report(self.score(progress, step), step)
            self._told = step
            if step < config.max_generations and self._trial.should_prune():
                self.keep(progress, step)
                raise optuna.TrialPruned

    def finish(self, progress: Progress) -> float:
        """The score of a trial that is over, which for its rivals stays what it is to the end.

        Raises:
          optuna.TrialPruned: if it is not finite.
          Lost: as of `tell`.
        """
        num_generations, most = len(progress.scores), self._search.config.max_generations
        progress = whole(progress, most)
        for step in range(self._told + 1, most + 1):
            self._report(self.score(progress, step), step)
            self._trial.should_prune()  # so that the pruner knows it; nothing is left to be saved
        self.keep(progress, most, num_generations)
        score = self.score(progress, most)
        if not math.isfinite(score):
            raise optuna.TrialPruned
        return score

    def score(self, progress: Progress, step: int) -> float:
        """What the trial is worth after `step` generations."""
        return worth(progress, step, self._search)[self._search.config.score]

    def keep(self, progress: Progress, step: int, generations: int | None = None) -> None:
        """Keeps with the trial what the table says of it."""
        values = {
            **worth(progress, step, self._search),
            "generations": generations or step,
            "cost": progress.cost,
            "seconds": round(progress.seconds, 1),
        }
        for name, value in values.items():
            self._trial.set_user_attr(name, value if np.isfinite(value) else None)

    def _report(self, score: float, step: int) -> None:
        try:
            self._trial.report(score, step)
        except optuna.exceptions.UpdateFinishedTrialError as error:
            raise Lost from error


def worth(progress: Progress, step: int, search: Search) -> dict[str, float]:
    """What a trial is worth after `step` generations: mean and worst of its seeds."""
    so_far = progress.scores[:step]
    match search.measure:
        case "best":
            of_seeds = np.fmax.reduce(so_far)
        case "mean":
            of_seeds = so_far.mean(axis=0)
        case _:
            of_seeds = so_far[-1]
    return {"mean": float(of_seeds.mean()), "worst": float(of_seeds.min())}


def whole(progress: Progress, generations: int) -> Progress:
    """A trial that was over early, with its last scores to the end."""
    rest = np.repeat(progress.scores[-1:], generations - len(progress.scores), axis=0)
    return dataclasses.replace(progress, scores=np.concatenate([progress.scores, rest]))


def take_over(folder: Path, predecessors: Sequence[Path]) -> bool:
    """Copies the newest directory that is there of the trials before.

    A copy, as a process that was only slow may still write there. Checkpoints are copied first: the
    rows that one vouches for were there before it, and later ones are dropped when the run goes on.

    Returns:
      Whether there was one.
    """
    found = next((path for path in reversed(predecessors) if path.is_dir()), None)
    if found is None or folder.exists():
        return False
    partial = folder.with_name(f"{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    names = sorted((x.name for x in found.iterdir()), key=lambda name: name != "checkpoint")
    for name in names:
        source = found / name
        if name == "sejax.lock" or name.startswith("."):
            continue
        if source.is_dir():
            shutil.copytree(
                source,
                partial / name,
                ignore=shutil.ignore_patterns(".*"),
                copy_function=_copy_if_there,
            )
        else:
            _copy_if_there(source, partial / name)
    partial.rename(folder)
    return True


def _copy_if_there(source: str | Path, to: str | Path) -> None:
    """Copies a file that may be removed meanwhile, as a checkpoint is once a newer one is there."""
    with contextlib.suppress(FileNotFoundError):
        shutil.copy2(source, to)
