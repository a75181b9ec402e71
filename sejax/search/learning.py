"""Trials that learn a proxy: runs of `sejax.run`, each in a directory of its own."""

import math
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sejax.cli import build, compose, session
from sejax.cli.run_directory import RunDirectory, open_for
from sejax.cli.trackers import Reporter
from sejax.cli.words import word
from sejax.errors import ConfigError
from sejax.search.programs import Programs
from sejax.search.settings import Search
from sejax.search.trials import Follower, Progress, whole, worth


class Learning:
    """Learns a proxy in each trial."""

    command = "sejax.run"

    def __init__(self, search: Search):
        self._search = search
        self._programs = Programs()

    def config(
        self, words: Sequence[str], folder: Path | None = None, num_seeds: int | None = None
    ) -> build.LearnConfig:
        """The configuration of a trial, or of as many other seeds.

        Raises:
          ConfigError: if it is none that can run.
        """
        own = [
            f"generations={self._search.config.max_generations}",
            f"num_seeds={num_seeds or self._search.config.seeds}",
            "checkpoint_every=1",
        ]
        where = [f"run_dir={word(str(folder))}"] if folder is not None else []
        return compose.config([*self._search.fixed, *words, *own, *where])

    def run(self, config: build.LearnConfig, follower: Follower, is_inherited: bool) -> Progress:
        """Runs a trial, or what is left of it, and tells the study as it goes.

        Args:
          config: of the trial.
          follower: told each generation.
          is_inherited: whether its directory is the copy of another's, which may be unusable: then
            the trial begins anew.

        Raises:
          ConfigError: if the directory cannot be used.
          optuna.TrialPruned, Lost: as of `Follower.tell`.
        """
        try:
            return self._run(config, follower)
        except ConfigError:
            if not is_inherited:
                raise
            shutil.rmtree(config.resolved_run_dir)
            return self._run(config, follower)

    def num_fresh(self) -> int:
        """How many seeds `verify` runs."""
        return self._search.config.fresh_seeds

    def verify(self, words: Sequence[str], number: int) -> dict[str, float]:
        """What settings are worth with seeds that no trial has had; goes on where it stopped.

        Args:
          words: the settings.
          number: of their trial.
        """
        search, usual = self._search, self.config([])
        fresh = [f"seed={usual.seed + usual.num_seeds}"]
        folder = search.folder / "verified" / f"{number:04d}-{self.num_fresh()}"
        config = self.config([*words, *fresh], folder, self.num_fresh())
        with open_for(config, "Set search_dir=FOLDER.") as directory:
            chunks = self._programs.chunks(config)
            session.run(config, directory, chunks)
            progress = progress_of(directory, chunks.learner.strategy.num_evaluations)
        generations = search.config.max_generations
        return {
            **worth(whole(progress, generations), generations, search),
            "generations": float(directory.finished_generations),
        }

    def order(self, row: dict[str, float]) -> tuple[float, float]:
        """By which the best rows of `verify` come first, and those that are not finite last."""
        score = row[self._search.config.score]
        return (-score, row["generations"]) if math.isfinite(score) else (math.inf, 0.0)

    def _run(self, config: build.LearnConfig, follower: Follower) -> Progress:
        with open_for(config, "Set search_dir=FOLDER.") as directory:
            chunks = self._programs.chunks(config)
            num_candidates = chunks.learner.strategy.num_evaluations
            over_at = chunks.learner.solved_score if config.stop_when_solved else None
            report = _Report(directory, follower, num_candidates, over_at)
            session.run(config, directory, chunks, report)
            return progress_of(directory, num_candidates)


class _Report(Reporter):
    """Hears of each generation after its files are written, so that to end there loses nothing."""

    def __init__(
        self,
        directory: RunDirectory,
        follower: Follower,
        num_candidates: int,
        over_at: float | None,
    ):
        self._directory, self._follower = directory, follower
        self._num_candidates, self._over_at = num_candidates, over_at

    def on_generation(self, info: Any) -> None:
        progress = progress_of(self._directory, self._num_candidates)
        if self._over_at is None or not (progress.scores[-1] >= self._over_at).all():
            self._follower.tell(progress)  # what is over by itself is not pruned


def progress_of(directory: RunDirectory, num_candidates: int) -> Progress:
    """What a run's rows say."""
    rows = directory.rows
    scores = np.array([[float(row["incumbent_mean"])] for row in rows])
    steps = sum(float(row["train_steps_mean"]) for row in rows)
    return Progress(
        scores=np.where(np.isfinite(scores), scores, np.nan),
        cost=round(steps * num_candidates),
        seconds=float(rows[-1]["wall_s"]),
    )
