"""Trackers: tools that follow a run, such as TensorBoard or one of your own.

A tracker hears of each generation after the run directory has saved it. It adds nothing to a run
and cannot stop it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Protocol, runtime_checkable

import numpy as np
import yaml

from sejax.options import registry, require_package, told
from sejax.options.registry import Makes


@dataclass(frozen=True, kw_only=True)
class TrackedRun:
    """The run that a tracker is made for.

    Attributes:
      folder: the run directory; at the end it holds `learning_curve.png`.
      id: 8 hexadecimal digits, the same in all sessions of the run.
      generation: the first generation that the tracker will hear of; 0 for a new run.
      config: the configuration, plain values in nested mappings.
    """

    folder: Path
    id: str
    generation: int
    config: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class FinishedGeneration:
    """What the callbacks of a run hear of a generation.

    Attributes:
      generation: its number, from 0 on.
      values: the columns of `metrics.csv`, but for `generation` and `seed`.
      scores: the finite scores of the population's evaluations, `[evaluation]`.
      train_steps: steps of all trainings.
    """

    generation: int
    values: Mapping[str, float]
    scores: np.ndarray
    train_steps: int


@runtime_checkable
class Tracker(Protocol):
    """The methods of a tracker; its configuration makes it with `make(run: TrackedRun)`."""

    def on_generation(self, info: FinishedGeneration) -> None:
        """Hears of a generation; each comes in order, and once a session."""

    def close(self) -> None:
        """Is called once, when the run ends or is left."""


class GuardedTracker:
    """A run's tracker: made at the first generation, dropped with one message if it raises."""

    def __init__(self, config: Makes[Tracker], run: TrackedRun, say: Callable[[str], None]):
        """The tracker of a configuration; `say` takes the message."""
        self._config, self._run, self._say = config, run, say
        self._tracker: Tracker | None = None
        self._has_failed = False

    def on_generation(self, info: FinishedGeneration) -> None:
        if not self._has_failed:
            self._call("on_generation", info)

    def close(self) -> None:
        if self._tracker is not None:
            self._call("close")

    def _call(self, method: str, *arguments: FinishedGeneration) -> None:
        try:
            if self._tracker is None:
                self._tracker = self._config.make(self._run)
            getattr(self._tracker, method)(*arguments)
        except (Exception, SystemExit) as error:  # foreign code may raise anything
            if not self._has_failed:
                name = registry.name_of("tracker", self._config)
                self._say(f"tracker={name} has failed; the run continues without. {told(error)}")
            self._has_failed = True


@dataclass(frozen=True, kw_only=True)
class NoTracker:
    """No tracker."""

    def make(self, run: TrackedRun) -> Tracker:
        return SimpleNamespace(on_generation=lambda info: None, close=lambda: None)


@dataclass(frozen=True, kw_only=True)
class TensorBoardConfig:
    """Event files in `tensorboard/` of the run directory, by tensorboardX, which needs no torch."""

    def __post_init__(self) -> None:
        require_package("tracker", "tensorboardX", "tensorboard")

    def make(self, run: TrackedRun) -> Tracker:
        from tensorboardX import SummaryWriter

        # Later generations of a killed session are purged. The suffix keeps that session's file
        # from being replaced by a file that begins in the same second.
        folder = str(run.folder / "tensorboard")
        suffix = f".{run.generation}"
        writer = SummaryWriter(folder, purge_step=run.generation, filename_suffix=suffix)
        text = yaml.safe_dump(run.config, sort_keys=False)
        writer.add_text("config", f"```\n{text}```", run.generation)

        def on_generation(info: FinishedGeneration) -> None:
            for name, value in info.values.items():
                writer.add_scalar(name, value, info.generation)
            if info.scores.size:
                writer.add_histogram("population_scores", info.scores, info.generation)
            writer.flush()

        return SimpleNamespace(on_generation=on_generation, close=writer.close)
