"""Following a run with other tools: TensorBoard, Weights & Biases, trackio, or one of your own.

Each is told what the run directory has; by whom and when, see `sejax.cli.follower`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
import yaml

from sejax.errors import told
from sejax.serialize import flatten


@runtime_checkable
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
            str(run.folder / "tensorboard"),
            purge_step=run.generations,
            filename_suffix=f".{run.generations}",
        )
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
            "project": self.project,
            "name": run.folder.name,
            "id": run.id,
            "resume": "allow",
            "dir": str(run.folder),
            "config": run.config,
            "settings": settings,
        }
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
        # With the last row, which is open still: a step of its own would be the next row's, which
        # a run that goes on could not log any more.
        self._run.log({name: self._module.Image(str(picture))}, step=max(generations - 1, 0))

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
