"""What a generation takes with any number of workers: the hand-out's own code, simulated workers.

`sejax.machines.handout.HandOut` hands out shares as in a run, copies of late ones included. Its
workers take measured times, and its clock is theirs. The driver does one thing at a time: what it
needs to send a share and to take its outcome delays all others.
"""

import dataclasses
import heapq
import itertools
import math
import time
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sejax.machines.handout import HandOut, Share
from sejax.machines.scorer import About, Scored

COLORS = ("#1f5fa8", "#2a9d8f", "#d9822b", "#b8336a", "#6b4c9a")


@dataclass(frozen=True, kw_only=True)
class Costs:
    """What is no training.

    Attributes:
      serial_s: of the driver in a generation: ask and tell.
      share_s: of the driver, to send a share and to take its outcome.
      pending_s: of the driver for each event and each worker that it waits for.
      gap_s: of a worker between two shares, beyond what the driver does.
      bytes_each: on the wire for each that is handed out, out and in.
      bandwidth: of the driver's connection, bytes a second.
    """

    serial_s: float = 0.0
    share_s: float = 0.0
    pending_s: float = 0.0
    gap_s: float = 0.0
    bytes_each: float = 0.0
    bandwidth: float = math.inf


@dataclass(frozen=True)
class Generation:
    """What the model says.

    Attributes:
      wall_s: seconds.
      serial_s: of these, of the driver alone.
      ideal_s: what the trainings would take if workers could divide them at will.
      wire_s: that the driver's connection was in use.
      driver_s: that the driver was busy with shares.
      idle: share of the workers' time in which they did not compute.
      longest_s: seconds of the longest share.
      shares: that were sent, copies included.
    """

    wall_s: float
    serial_s: float
    ideal_s: float
    wire_s: float
    driver_s: float
    idle: float
    longest_s: float
    shares: int


def simulate(
    seconds: Sequence[float] | np.ndarray, num_workers: int, costs: Costs, capacity: int = 16
) -> Generation:
    """A generation.

    Args:
      seconds: what is handed out takes: of each training, or of each group of lanes.
      num_workers: all ready.
      costs: what else there is.
      capacity: most of `seconds` in a share.
    """
    crew = Simulated(np.asarray(seconds, float), num_workers, costs)
    hand_out = HandOut(crew, [capacity], [1], clock=lambda: crew.now)
    hand_out.get_ready()
    crew.now = 0.0
    places = np.arange(len(seconds))

    def work_of(share: Share) -> Any:
        return Sent(share, costs.bytes_each)

    hand_out.score([places], work_of, lambda share, scored: None)
    total = float(np.sum(seconds))
    return Generation(
        wall_s=crew.now + costs.serial_s,
        serial_s=costs.serial_s,
        ideal_s=total / num_workers,
        wire_s=crew.wire_s,
        driver_s=crew.driver_s,
        idle=1 - total / (num_workers * (crew.now + costs.serial_s)),
        longest_s=crew.longest_s,
        shares=crew.num_sent,
    )


@dataclass(frozen=True)
class Sent:
    """In the place of `sejax.machines.scorer.Work`."""

    share: Share
    bytes_each: float

    @property
    def nbytes(self) -> int:
        return round(self.bytes_each * len(self.share.places))


@dataclass
class Simulated:
    """A crew by the clock `now`, which stands still but for what is said here."""

    seconds: np.ndarray
    num_workers: int
    costs: Costs
    now: float = 0.0
    driver_s: float = 0.0
    wire_s: float = 0.0
    num_sent: int = 0
    longest_s: float = 0.0
    _wire_free: float = 0.0
    _events: list[tuple[float, int, Hashable, Any]] = field(default_factory=list)
    _order: Any = field(default_factory=itertools.count)
    _is_recruited: bool = False

    def recruit(self) -> list[Hashable]:
        new: list[Hashable] = [] if self._is_recruited else list(range(self.num_workers))
        self._is_recruited = True
        for worker in new:
            self._come(self.now, worker, About("simulated", 0, 0.0))
        return new

    def send(self, worker: Hashable, work: Any) -> None:
        self._work(self.costs.share_s)
        self.num_sent += 1
        on_wire = work.nbytes / self.costs.bandwidth
        self.wire_s += on_wire
        self._wire_free = max(self._wire_free, self.now) + on_wire
        took = float(self.seconds[work.share.places].sum())
        self.longest_s = max(self.longest_s, took)
        outcome = {"train_steps": np.zeros(1, int)}
        self._come(self._wire_free + self.costs.gap_s + took, worker, Scored(outcome, took, took))

    def wait(self, timeout_s: float) -> list[tuple[Hashable, Any]]:
        if not self._events or self._events[0][0] > self.now + timeout_s:
            self.now += timeout_s
            return []
        self.now = max(self.now, self._events[0][0])
        came = []
        while self._events and self._events[0][0] <= self.now:
            _, _, worker, what = heapq.heappop(self._events)
            came.append((worker, what))
        if isinstance(came[0][1], Scored):
            self._work(self.costs.pending_s * (len(self._events) + len(came)))
        return came

    def dismiss(self, worker: Hashable) -> None:
        self._events = [event for event in self._events if event[2] != worker]
        heapq.heapify(self._events)

    def _work(self, seconds: float) -> None:
        self.now += seconds
        self.driver_s += seconds

    def _come(self, when: float, worker: Hashable, what: Any) -> None:
        heapq.heappush(self._events, (when, next(self._order), worker, what))


def hand_out_pending_s(many: int = 1000, few: int = 10) -> float:
    """Seconds that `HandOut` itself takes for an event and each worker more: it looks at all."""
    seconds = np.random.default_rng(0).uniform(1, 2, 2000)

    def measure(num_workers: int) -> float:
        started = time.process_time()
        simulate(seconds, num_workers, Costs(), capacity=1)
        return time.process_time() - started

    return max(0.0, (measure(many) - measure(few)) / (len(seconds) * (many - few)))


# --- for tables and pictures ----------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class World:
    """What a generation hands out.

    Attributes:
      seconds: measured times, from which some are drawn.
      count: how many are handed out: trainings, or groups of lanes.
      num_trials: trainings in a generation.
      capacity: as of `simulate`.
      dims: parameters of a candidate.
    """

    seconds: np.ndarray
    count: int
    num_trials: int
    capacity: int
    dims: int

    def simulate(self, num_workers: int, costs: Costs, of: "World", seed: int = 0) -> Generation:
        """With costs that were measured `of` another world: they grow with what is asked."""
        times = np.random.default_rng(seed).choice(self.seconds, self.count)
        larger = self.num_trials * self.dims / (of.num_trials * of.dims)
        own = dataclasses.replace(
            costs,
            serial_s=costs.serial_s * larger,
            bytes_each=costs.bytes_each * of.count * larger / self.count,
        )
        return simulate(times, num_workers, own, self.capacity)


def draw(curves: dict[str, dict[str, dict[str, float]]], path: Path) -> None:
    """Draws seconds a generation against the number of workers.

    Args:
      curves: by world and number of workers, a `Generation`.
      path: of the picture.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    with plt.rc_context({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False}):
        figure, axes = plt.subplots(figsize=(7, 4.5), layout="constrained")
        for color, (name, points) in zip(COLORS, curves.items(), strict=False):
            workers = [int(n) for n in points]
            axes.plot(workers, [p["wall_s"] for p in points.values()], color=color, label=name)
            axes.plot(workers, [p["ideal_s"] for p in points.values()], color=color, ls=":", lw=1)
        axes.set(xscale="log", yscale="log", xlabel="workers, a core each",
                 ylabel="seconds a generation (dotted: trainings divided at will)")  # fmt: skip
        axes.set_ylim(bottom=0.02)
        axes.legend(frameon=False, fontsize=8)
        figure.savefig(path, dpi=150)
        plt.close(figure)
