"""A Ray cluster's workers, which come and go.

Ray knows the machines, starts processes there, notices when one is gone and carries the arrays.
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

from sejax.options import ConfigError, FailedError, told

if TYPE_CHECKING:
    from sejax.cli.workers import RayConfig

LOOK_S = 1.0  # between looks for machines that have come, and workers that hang
FIRST_S = 3600.0  # a worker may take for its first answer, compilation included
LEAST_S = 20.0  # a worker may always take
LATE = 10.0  # times the longest share so far, after which a worker counts as hanging
QUIET_S = 30.0  # without any worker that is ready, after which the user is told why
MOST_LOSSES = 5  # of each worker, without an answer in between: that is no accident


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
            f"machines.address must be a cluster that can be reached, because trainings are sent "
            f"there; {told(error)}. Start one with ray start --head, or set machines.address=local."
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


class Pool:
    """Workers that compute shares; lost ones are replaced, and new machines are used.

    Ray restarts and retries by itself only where a worker was, and has room for it: on a cluster
    whose node is lost a share would wait although other workers are idle. Here every worker is as
    good as another: one that died and one that hangs are dropped, and their share goes to the next.

    Args:
      ray: the module; of it `wait`, `get` and `kill`.
      start: starts a worker, an actor with `prepare` and `evaluate`, without waiting for it.
      num_workers: how many there should be now.
      say: tells the user.
      clock: seconds.
    """

    def __init__(
        self,
        ray: Any,
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
        self._losses, self._most = 0, 1  # since the last answer; workers that there were
        self._told_at = clock() + QUIET_S
        self._looked = -math.inf
        self._hire()

    @property
    def size(self) -> int:
        """Workers that there are, those included that are not ready."""
        return len(self._idle) + len(self._busy)

    def map(self, shares: Sequence[Any]) -> list[Any]:
        """What workers return for each share, in the order of the shares.

        Raises:
          FailedError: if workers are lost again and again, or the whole cluster is.
        """
        waiting, results = deque(range(len(shares))), dict[int, Any]()
        while len(results) < len(shares):
            while waiting and self._idle:
                worker, index = self._idle.pop(), waiting.popleft()
                job = _Job(worker, index, self._clock())
                self._busy[worker.evaluate.remote(shares[index])] = job
            for job, answer in self._answers():
                if isinstance(answer, Exception):
                    self._drop(job, answer)
                    if job.share is not None:
                        waiting.appendleft(job.share)
                    continue
                self._idle.append(job.worker)
                self._told_at = math.inf
                if job.share is not None:
                    results[job.share], self._losses = answer, 0
                    self._longest_s = max(self._longest_s, self._clock() - job.since)
        return [results[index] for index in range(len(shares))]

    def close(self) -> None:
        """Ends all workers."""
        for worker in [*self._idle, *(job.worker for job in self._busy.values())]:
            self._ray.kill(worker)
        self._idle, self._busy = [], {}

    def _answers(self) -> list[tuple["_Job", Any]]:
        """Jobs that have ended within `LOOK_S`, each with its answer or an exception."""
        self._hire()
        if not self._busy:
            time.sleep(LOOK_S)  # until a machine comes
            return []
        # With one reference Ray wakes up for the first answer; the others that came are taken too.
        done, _ = self._ray.wait(list(self._busy), num_returns=1, timeout=LOOK_S)
        if done:
            done, _ = self._ray.wait(list(self._busy), num_returns=len(self._busy), timeout=0)
        now = self._clock()
        answers = [(self._busy.pop(reference), self._answer(reference)) for reference in done]
        late = [ref for ref, job in self._busy.items() if now - job.since > self._limit_s(job)]
        hanging = TimeoutError("it does not answer")
        return answers + [(self._busy.pop(reference), hanging) for reference in late]

    def _hire(self) -> None:
        """Starts workers that are missing; at most once in `LOOK_S`."""
        now = self._clock()
        if now - self._looked < LOOK_S:
            return
        self._looked = now
        for _ in range(self._num_workers() - self.size):
            worker = self._start()
            self._busy[worker.prepare.remote()] = _Job(worker, None, now)
        self._most = max(self._most, self.size)
        if now > self._told_at:
            self._told_at = math.inf
            self._say(
                f"None of {self.size} workers is ready yet: they compile, or other jobs hold what "
                f"they need (see ray status)."
            )

    def _answer(self, reference: Any) -> Any:
        try:
            return self._ray.get(reference)
        except Exception as error:  # that the worker raised, or of Ray if it has died
            return error

    def _limit_s(self, job: "_Job") -> float:
        if job.share is None or not self._longest_s:
            return FIRST_S
        return max(LEAST_S, LATE * self._longest_s)

    def _drop(self, job: "_Job", error: Exception) -> None:
        """Ends a worker that failed or hangs.

        Raises:
          FailedError: if that has happened too often.
        """
        with contextlib.suppress(Exception):  # it may be gone
            self._ray.kill(job.worker)
        reason = told(error).splitlines()[-1].strip()
        self._losses += 1
        if self._losses >= MOST_LOSSES * self._most:  # a node may take many with it
            raise FailedError(
                f"{self._losses} workers were lost in a row, the last one so: {reason}. The "
                f"generations before are saved; the same command with machines=local goes on here."
            ) from error
        if job.share is None:
            self._say(f"A worker did not start: {reason}. Another one is started.")
        if isinstance(error, TimeoutError):
            self._longest_s *= 2  # its share may take longer than any before


@dataclass(frozen=True)
class _Job:
    """What a worker does: the share with this index, or None while it gets ready."""

    worker: Any
    share: int | None
    since: float
