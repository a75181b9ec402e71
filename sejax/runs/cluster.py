"""A Ray cluster's workers, which come and go.

Ray knows the machines, starts processes there, starts them anew when they die, and carries the
arrays.
"""

import contextlib
import math
import os
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any

from sejax.options import ConfigError, FailedError, shortened, told

if TYPE_CHECKING:
    from sejax.runs.workers import RayConfig

RESTARTS = 20  # by Ray, of a worker that dies
RETRIES = -1  # by Ray, of a share; any number, as many fail at once until Ray knows a node is gone
LOOK_S = 1.0  # between looks for machines that have come, and workers that hang
FIRST_S = 3600.0  # a worker may take to start, compilation included, and for the first share
LEAST_S = 20.0  # a share may always take
LATE = 10.0  # times the longest share so far, after which a worker counts as hanging
QUIET_S = 30.0  # without any worker that is ready, after which the user is told why


@contextlib.contextmanager
def connected(machines: "RayConfig") -> Iterator[ModuleType]:
    """A connection to the cluster, which a library user may have made before; yields `ray`.

    Raises:
      ConfigError: if it cannot be reached.
    """
    import ray  # of an extra

    if ray.is_initialized():
        yield ray
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        with warnings.catch_warnings():  # Ray's processes do not go on with jax
            warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)
            ray.init(
                machines.address,
                log_to_driver=False,
                logging_level="ERROR",
                include_dashboard=False,
            )
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise ConfigError(
            f"machines.address must be a cluster that can be reached; got {machines.address} "
            f"({told(error)}). Start one with ray start --head, or set machines.address=local.",
            "machines.address",
        ) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def num_workers(machines: "RayConfig") -> int:
    """The workers that are asked for, or that the cluster's machines have room for now.

    Raises:
      FailedError: if the cluster is gone: Ray itself would wait for ever.
    """
    import ray  # of an extra

    own = ray.get_runtime_context().get_node_id()
    if not any(node["NodeID"] == own and node["Alive"] for node in ray.nodes()):
        raise FailedError(
            "Ray has ended on this machine, so that no training can be sent out. The generations "
            "before are saved; start Ray and repeat the command to go on."
        )
    if machines.workers:
        return machines.workers
    resources = ray.cluster_resources()
    room = resources.get("CPU", 0.0)
    if machines.gpus_per_worker:
        room = min(room, resources.get("GPU", 0.0) / machines.gpus_per_worker)
    return int(room)


def reason(error: Exception) -> str:
    """The last line of an error, where Ray's errors have what the worker raised."""
    return shortened(str(error).strip().splitlines()[-1].strip(), 160)


@dataclass(frozen=True)
class _Job:
    """What a worker does: the share with this index, or None while it starts.

    `num_late` is how often the share was late before.
    """

    worker: Any
    share: int | None
    since: float
    num_late: int = 0


class Pool:
    """Workers that compute shares.

    Ray starts a worker anew that dies, and sends it its share again. What Ray does not do is left:
    it does not notice a worker that hangs, nor that a share waits for a machine that is gone while
    others are idle, nor does it use machines that join. So a share that is late is taken from its
    worker, which is ended, and goes to the next one that is free.

    Args:
      ray: the module; of it `wait`, `get` and `kill`.
      start: starts a worker, an actor with `ready` and `evaluate`, without waiting for it.
      num_workers: how many there should be now.
      say: tells the user.
      clock: seconds.
    """

    def __init__(
        self,
        ray: ModuleType,
        start: Callable[[], Any],
        num_workers: Callable[[], int],
        say: Callable[[str], None] = lambda text: None,
        clock: Callable[[], float] = time.monotonic,
    ):
        self._ray, self._start, self._num_workers = ray, start, num_workers
        self._say, self._clock = say, clock
        self._idle: list[Any] = []
        self._busy: dict[Any, _Job] = {}  # by what Ray returned for it
        self._longest_s = 0.0  # that a share took
        self._told_at = clock() + QUIET_S
        self._looked = -math.inf
        self._grow()

    @property
    def size(self) -> int:
        """Workers that there are, those included that are not ready."""
        return len(self._idle) + len(self._busy)

    def map(self, shares: Sequence[Any]) -> list[Any]:
        """What workers return for each share, in the order of the shares.

        Raises:
          FailedError: if a worker fails, or the whole cluster is lost.
        """
        waiting, results = deque(range(len(shares))), dict[int, Any]()
        num_late = [0] * len(shares)
        while len(results) < len(shares):
            self._grow()
            while waiting and self._idle:
                worker, share = self._idle.pop(), waiting.popleft()
                job = _Job(worker, share, self._clock(), num_late[share])
                self._busy[worker.evaluate.remote(shares[share])] = job
            for job, answer in self._answers():
                self._idle.append(job.worker)
                self._told_at = math.inf
                if job.share is not None:
                    results[job.share] = answer
                    self._longest_s = max(self._longest_s, self._clock() - job.since)
            for share in self._end_late():
                waiting.appendleft(share)
                num_late[share] += 1
        return [results[share] for share in range(len(shares))]

    def close(self) -> None:
        """Ends all workers."""
        for worker in [*self._idle, *(job.worker for job in self._busy.values())]:
            self._ray.kill(worker)
        self._idle, self._busy = [], {}

    def _grow(self) -> None:
        """Starts workers where machines have come; looks at most once in `LOOK_S`."""
        now = self._clock()
        if now - self._looked < LOOK_S:
            return
        self._looked = now
        for _ in range(self._num_workers() - self.size):
            worker = self._start()
            self._busy[worker.ready.remote()] = _Job(worker, None, now)
        if now > self._told_at:
            self._told_at = math.inf
            self._say(
                f"None of {self.size} workers is ready yet: they compile, or other jobs hold what "
                f"they need (see ray status)."
            )

    def _answers(self) -> list[tuple[_Job, Any]]:
        """The next job that has ended, with its answer; none if there is none within `LOOK_S`."""
        if not self._busy:
            time.sleep(LOOK_S)  # until a machine comes
            return []
        done, _ = self._ray.wait(list(self._busy), num_returns=1, timeout=LOOK_S)
        try:
            return [(self._busy.pop(reference), self._ray.get(reference)) for reference in done]
        except Exception as error:  # that the worker raised, or of Ray, if it died too often
            raise FailedError(
                f"A worker has failed: {reason(error)}. The generations before are saved; the same "
                f"command with machines=local goes on here."
            ) from error

    def _end_late(self) -> list[int]:
        """Ends workers that hang; returns their shares."""
        now, shares = self._clock(), []
        for reference, job in list(self._busy.items()):
            if now - job.since > self._limit_s(job):
                self._ray.kill(job.worker)
                del self._busy[reference]
                shares += [] if job.share is None else [job.share]
        return shares

    def _limit_s(self, job: _Job) -> float:
        """Seconds that a job may take; a share may be far longer than any before, and gets more."""
        if job.share is None or not self._longest_s:
            return FIRST_S
        return max(LEAST_S, LATE * self._longest_s) * 2**job.num_late
