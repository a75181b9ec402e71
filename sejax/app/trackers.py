"""Following a run with other tools: TensorBoard, Weights & Biases, trackio, or one of your own.

A tracker is told of what the run directory has, after it is there: it adds nothing to a run and
cannot stop it. What it was told is kept in `tracker.json`, so that a run that goes on is told of
once, and one that was begun without a tracker from its beginning.
"""

import contextlib
import functools
import itertools
import json
import secrets
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Protocol

import numpy as np
import yaml

from sejax import plugins
from sejax.errors import ConfigError, told
from sejax.files import write_text
from sejax.serialize import flatten

RECORD = "tracker.json"
NOT_LOGGED = ("generation", "seed")  # columns that say of what the others are


class Tracker(Protocol):
    """What a tracker must do; whatever it raises drops it, and the run goes on."""

    def log(
        self, generation: int, values: Mapping[str, float], scores: Mapping[str, np.ndarray]
    ) -> None:
        """Takes a generation.

        Args:
          generation: from 0 on; each comes once, in order.
          values: columns of `metrics.csv`; with several seeds `seed0/incumbent_mean` and so on.
          scores: likewise, the finite scores of all that the members trained, `[tried]`: for a
            histogram. Empty for a generation of an earlier session.
        """

    def show(self, name: str, picture: Path, generations: int) -> None:
        """Takes a PNG, when the run ends or is left after so many generations."""

    def close(self) -> None:
        """Is called once, when nothing more comes."""


@dataclass(frozen=True, kw_only=True)
class TrackedRun:
    """What a tracker is made for.

    Attributes:
      folder: the run directory.
      id: of the run at the tracker, 8 hexadecimal digits; the same when a run goes on.
      generations: that the tracker has been told of in earlier sessions.
      config: of the run, plain values in nested mappings.
    """

    folder: Path
    id: str
    generations: int
    config: dict[str, Any]


# --- those that come with sejax ------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class NoTracker:
    """Nobody is told."""

    def make(self, run: TrackedRun) -> None:
        return None


@dataclass(frozen=True, kw_only=True)
class TensorBoardConfig:
    """Event files in `tensorboard/` of the run directory, by tensorboardX, which needs no torch."""

    package: ClassVar[str] = "tensorboardX"

    def make(self, run: TrackedRun) -> "TensorBoard":
        return TensorBoard(run)


class TensorBoard:
    def __init__(self, run: TrackedRun):
        from tensorboardX import SummaryWriter

        # What an earlier session wrote of later generations does not count. Its file would be
        # replaced, if it began in the same second, but for the suffix.
        self._writer = SummaryWriter(
            str(run.folder / "tensorboard"), purge_step=run.generations,
            filename_suffix=f".{run.generations}",
        )  # fmt: skip
        text = yaml.safe_dump(run.config, sort_keys=False)
        self._writer.add_text("config", f"```\n{text}```", run.generations)

    def log(
        self, generation: int, values: Mapping[str, float], scores: Mapping[str, np.ndarray]
    ) -> None:
        for name, value in values.items():
            self._writer.add_scalar(name, value, generation)
        for name, each in scores.items():
            self._writer.add_histogram(name, each, generation)
        self._writer.flush()

    def show(self, name: str, picture: Path, generations: int) -> None:
        from PIL import Image

        pixels = np.asarray(Image.open(picture).convert("RGB"))
        self._writer.add_image(name, pixels, generations, dataformats="HWC")

    def close(self) -> None:
        self._writer.close()


@dataclass(frozen=True, kw_only=True)
class WandbConfig:
    """A run of Weights & Biases; offline with `WANDB_MODE=offline`, or where it cannot log in."""

    package: ClassVar[str] = "wandb"
    project: str = "sejax"

    def make(self, run: TrackedRun) -> "Wandb":
        import wandb

        # The console is the progress line's, and a minute and a half is long to wait for a network.
        settings = wandb.Settings(console="off", init_timeout=20)
        options: Any = {
            "project": self.project, "name": run.folder.name, "id": run.id, "resume": "allow",
            "dir": str(run.folder), "config": run.config, "settings": settings,
        }  # fmt: skip
        try:
            return Wandb(wandb, wandb.init(**options))
        except wandb.errors.Error as error:
            wandb.termwarn(f"{told(error)}: the run is kept offline, for `wandb sync`.")
            wandb.teardown()
            return Wandb(wandb, wandb.init(mode="offline", **options))


class Wandb:
    """Also of trackio, which has the same functions."""

    def __init__(self, module: Any, run: Any):
        self._module, self._run = module, run

    def log(
        self, generation: int, values: Mapping[str, float], scores: Mapping[str, np.ndarray]
    ) -> None:
        histograms = {name: self._module.Histogram(each) for name, each in scores.items()}
        self._run.log({"generation": generation, **values, **histograms}, step=generation)

    def show(self, name: str, picture: Path, generations: int) -> None:
        self._run.log({name: self._module.Image(str(picture))}, step=generations)

    def close(self) -> None:
        self._run.finish()


@dataclass(frozen=True, kw_only=True)
class TrackioConfig:
    """A run of trackio, kept on this machine where `trackio show` finds it."""

    package: ClassVar[str] = "trackio"
    project: str = "sejax"

    def make(self, run: TrackedRun) -> Wandb:
        import trackio

        # Runs are found again by their names, which must differ between folders.
        name = f"{run.folder.name}-{run.id}"
        config = flatten(run.config)
        return Wandb(trackio, trackio.init(self.project, name, config=config, resume="allow"))


def require_package(config: Any) -> None:
    """Checks that the package of a tracker is there, without importing it.

    Raises:
      ConfigError: if it is not.
    """
    package = getattr(config, "package", None)
    if package is not None and find_spec(package) is None:
        name = plugins.name_of("tracker", config)
        raise ConfigError(
            f"tracker must be one that is installed, because the run is told to it; got {name} "
            f"without the package {package}. Install it with pip install 'sejax[{name}]', or set "
            f"tracker=none."
        )


# --- a run and its tracker -----------------------------------------------------------------------


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
        self._name = plugins.name_of("tracker", config.tracker)
        self._tracker: Tracker | None = None
        self._records: dict[str, Any] = {}  # of each tracker that the run has had, by its name
        self._num_rows = 0  # of the run directory, that were looked at

    def __enter__(self) -> "Follower":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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
            TrackedRun(folder=self._directory.path.resolve(), id=self._record["id"],
                       generations=self._record["generations"], config=self._directory.config)
        )  # fmt: skip
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
            values |= {f"{start}{name}": float(value) for name, value in row.items()
                       if name not in NOT_LOGGED}  # fmt: skip
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
