"""A run and its tracker.

A tracker is told of what the run directory has, after it is there: it adds nothing to a run and
cannot stop it. What it was told is kept in `tracker.json`, so that a run that goes on is told of
once, and one that was begun without a tracker from its beginning.
"""

import contextlib
import functools
import itertools
import json
import secrets
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from sejax import registry
from sejax.cli.trackers import NoTracker, TrackedRun, Tracker
from sejax.errors import told
from sejax.ops.files import write_text

RECORD = "tracker.json"
NOT_LOGGED = ("generation", "seed")  # columns that say of what the others are


def _guarded(method: Callable[..., None]) -> Callable[..., None]:
    """A method of `Follower` that does nothing once its tracker has failed."""

    @functools.wraps(method)
    def attempt(self: "Follower", *args: Any) -> None:
        if self.is_over:
            return
        try:
            method(self, *args)
        except (Exception, SystemExit) as error:  # whatever somebody else's code comes up with
            self.drop(error)

    return attempt


class Follower:
    """Tells a run's tracker of each generation once. Where the tracker fails, it is dropped."""

    def __init__(self, config: Any, directory: Any, report: Any):
        """Of a `LearnConfig`, its `RunDirectory`, and who is told of a failure (`Reporter`)."""
        self.is_over = isinstance(config.tracker, NoTracker)
        self._config, self._directory, self._report = config.tracker, directory, report
        self._name = registry.name_of("tracker", config.tracker)
        self._tracker: Tracker | None = None
        self._records: dict[str, Any] = {}  # of each tracker that the run has had, by its name
        self._num_rows = 0  # of the run directory, that were looked at

    def __enter__(self) -> "Follower":
        return self

    def __exit__(self, *_: Any) -> None:
        self._end()

    @_guarded
    def open(self) -> None:
        """Begins with the tracker, or goes on with it; `tell` does so too, where there is news."""
        if self._tracker is None:
            self._tracker = self._open()

    @_guarded
    def tell(self, info: Any = None) -> None:
        """Tells of the rows of `metrics.csv` that are new.

        Args:
          info: of the last chunk, on the host; leaves `[generation, seed]`. Without it, nothing is
            known but the rows.
        """
        rows = self._directory.rows[self._num_rows :]
        self._num_rows += len(rows)
        for generation, of_seeds in itertools.groupby(rows, lambda row: int(row["generation"])):
            if generation >= self._record["generations"]:
                self._log(generation, list(of_seeds), info)

    def drop(self, error: BaseException) -> None:
        """Goes on without the tracker, and says so."""
        self.is_over = True
        self._report.print(
            f"tracker={self._name} has failed and is told nothing more; the run goes on. "
            f"{told(error)}"
        )
        with contextlib.suppress(Exception, SystemExit):
            if self._tracker is not None:
                self._tracker.close()

    def _open(self) -> Tracker:
        made: Tracker = self._config.make(
            TrackedRun(
                folder=self._directory.path.resolve(),
                id=self._record["id"],
                generations=self._record["generations"],
                config=self._directory.config,
            )
        )
        return made

    @property
    def _record(self) -> dict[str, Any]:
        """What this tracker knows: the run's `id` there, and how many `generations`."""
        if not self._records:
            path = self._directory.path / RECORD
            self._records = json.loads(path.read_text("utf-8")) if path.exists() else {}
            self._records.setdefault(self._name, {"id": secrets.token_hex(4), "generations": 0})
        record: dict[str, Any] = self._records[self._name]
        return record

    def _log(self, generation: int, rows: list[dict[str, str]], info: Any) -> None:
        if self._tracker is None:
            self._tracker = self._open()
        values: dict[str, float] = {}
        scores: dict[str, np.ndarray] = {}
        for row in rows:
            seed = self._directory.seeds.index(int(row["seed"]))
            start = f"seed{row['seed']}/" if len(self._directory.seeds) > 1 else ""
            values |= {
                f"{start}{name}": float(value)
                for name, value in row.items()
                if name not in NOT_LOGGED
            }
            for own in _finite_scores(info, generation, seed):
                scores[f"{start}member_scores"] = own
        self._tracker.log(generation, values, scores)
        self._record["generations"] = generation + 1
        write_text(self._directory.path / RECORD, json.dumps(self._records, indent=2) + "\n")

    @_guarded
    def _end(self) -> None:
        if self._tracker is not None:
            picture = self._directory.path / "learning_curve.png"
            if picture.exists():
                self._tracker.show(picture.stem, picture, self._record["generations"])
            self._tracker.close()


def _finite_scores(info: Any, generation: int, seed: int) -> Iterator[np.ndarray]:
    """What a seed's members scored, where the chunk has the generation and some are finite."""
    if info is not None:
        for place in np.flatnonzero(info.generation[:, seed] == generation):
            scores = np.asarray(info.member_scores[place, seed])
            if np.isfinite(scores).any():
                yield scores[np.isfinite(scores)]
