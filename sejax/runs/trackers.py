"""Following a run with other tools: TensorBoard, Weights & Biases, or one of your own.

A tracker hears of each generation after the run directory has it. It adds nothing to a run and
cannot stop it.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
import yaml

from sejax.options import registry, told


@dataclass(frozen=True, kw_only=True)
class TrackedRun:
    """The run that a tracker is made for.

    Attributes:
      folder: the run directory; at the end it holds `learning_curve.png`.
      id: 8 hexadecimal digits, the same when the run goes on.
      generation: the first generation that the tracker will hear of; 0 for a new run.
      config: the configuration, plain values in nested mappings.
    """

    folder: Path
    id: str
    generation: int
    config: dict[str, Any]

    @property
    def picture(self) -> Path:
        """The learning curve."""
        return self.folder / "learning_curve.png"


@dataclass(frozen=True, kw_only=True)
class FinishedGeneration:
    """A generation as the callbacks of a run hear of it.

    Attributes:
      generation: its number, from 0 on.
      values: the columns of `metrics.csv`.
      scores: scores of the population's evaluations that are finite, `[evaluation]`.
      train_steps: steps of all trainings.
    """

    generation: int
    values: Mapping[str, float]
    scores: np.ndarray
    train_steps: int


class Reporter:
    """Hears how a run goes on; this one tells nobody. See `sejax.runs.progress`."""

    def status(self, text: str) -> None:
        """Hears what is being done now."""

    def say(self, text: str) -> None:
        """Hears a message that is worth keeping."""

    def on_generation(self, info: FinishedGeneration) -> None:
        """Hears of a generation after it was saved. What this raises ends the session."""


@runtime_checkable
class Tracker(Protocol):
    """The methods of a tracker, which its configuration makes by `make(run: TrackedRun)`."""

    def on_generation(self, info: FinishedGeneration) -> None:
        """Hears of a generation; each comes in order, and once a session."""

    def close(self) -> None:
        """Is called once, when the run ends or is left."""


class GuardedTracker:
    """The tracker of a run, made at its first generation, dropped with one message if it raises."""

    def __init__(self, config: Any, run: TrackedRun, say: Callable[[str], None]):
        """The tracker of a configuration; `say` takes the message."""
        self._config, self._run, self._say = config, run, say
        self._tracker: Tracker | None = None
        self._is_dropped = False

    def on_generation(self, info: FinishedGeneration) -> None:
        if self._is_dropped:
            return
        with self._guarded():
            self._tracker = self._tracker or self._config.make(self._run)
            self._tracker.on_generation(info)

    def close(self) -> None:
        tracker, self._tracker = self._tracker, None
        if tracker is not None and not self._is_dropped:
            with self._guarded():
                tracker.close()

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        try:
            yield
        except (Exception, SystemExit) as error:  # foreign code may raise anything
            self._is_dropped = True
            name = registry.name_of("tracker", self._config)
            self._say(f"tracker={name} has failed; the run goes on without. {told(error)}")
            with contextlib.suppress(Exception, SystemExit):
                if self._tracker is not None:
                    self._tracker.close()


@dataclass(frozen=True, kw_only=True)
class NoTracker:
    """No tracker."""

    def make(self, run: TrackedRun) -> "NoTracker":
        return self

    def on_generation(self, info: FinishedGeneration) -> None:
        pass

    def close(self) -> None:
        pass


@dataclass(frozen=True, kw_only=True)
class TensorBoardConfig:
    """Event files in `tensorboard/` of the run directory, by tensorboardX, which needs no torch."""

    package: ClassVar[str] = "tensorboardX"

    def make(self, run: TrackedRun) -> "TensorBoard":
        return TensorBoard(run)


class TensorBoard:
    def __init__(self, run: TrackedRun):
        from tensorboardX import SummaryWriter

        self._picture, self._next = run.picture, run.generation
        # Later generations of a killed session are purged. The suffix keeps its file from being
        # replaced by one that begins in the same second.
        self._writer = SummaryWriter(
            str(run.folder / "tensorboard"),
            purge_step=run.generation,
            filename_suffix=f".{run.generation}",
        )
        text = yaml.safe_dump(run.config, sort_keys=False)
        self._writer.add_text("config", f"```\n{text}```", run.generation)

    def on_generation(self, info: FinishedGeneration) -> None:
        for name, value in info.values.items():
            self._writer.add_scalar(name, value, info.generation)
        if info.scores.size:
            self._writer.add_histogram("population_scores", info.scores, info.generation)
        self._writer.flush()
        self._next = info.generation + 1

    def close(self) -> None:
        from PIL import Image

        if self._picture.exists():
            pixels = np.asarray(Image.open(self._picture).convert("RGB"))
            self._writer.add_image("learning_curve", pixels, self._next, dataformats="HWC")
        self._writer.close()


@dataclass(frozen=True, kw_only=True)
class WandbConfig:
    """A run of Weights & Biases; offline with `WANDB_MODE=offline`."""

    package: ClassVar[str] = "wandb"
    project: str = "sejax"

    def make(self, run: TrackedRun) -> "Wandb":
        import wandb

        logged = wandb.init(
            project=self.project,
            name=run.folder.name,
            id=run.id,
            resume="allow",
            dir=str(run.folder),
            config=run.config,
            # The console belongs to the progress line; by default wandb waits 90 s for a network.
            settings=wandb.Settings(console="off", init_timeout=20),
        )
        return Wandb(run, wandb, logged)


class Wandb:
    """A run of Weights & Biases that has begun."""

    def __init__(self, run: TrackedRun, module: Any, logged: Any):
        self._picture, self._module, self._run = run.picture, module, logged
        self._last = max(run.generation - 1, 0)

    def on_generation(self, info: FinishedGeneration) -> None:
        values: dict[str, Any] = {"generation": info.generation, **info.values}
        if info.scores.size:
            values["population_scores"] = self._module.Histogram(info.scores)
        self._run.log(values, step=info.generation)
        self._last = info.generation

    def close(self) -> None:
        if self._picture.exists():
            # With the last generation: wandb drops what comes with a lower step than the last one,
            # and a step of its own would be that of the generation where the run goes on.
            picture = self._module.Image(str(self._picture))
            self._run.log({"learning_curve": picture}, step=self._last)
        self._run.finish()
