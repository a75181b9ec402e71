"""Workers as Ray's actors.

Ray knows the machines, starts processes there, notices when one is gone and carries the arrays.
What to do then is decided in `sejax.machines.handout`.
"""

import contextlib
import os
import time
import warnings
from collections.abc import Callable, Hashable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import ray

from sejax.errors import ConfigError, told
from sejax.machines import scorer
from sejax.machines.chunks import CAPACITY, RemoteChunks
from sejax.machines.handout import HandOut, Lost
from sejax.machines.ledger import Ledger

if TYPE_CHECKING:
    from sejax.machines.configs import RayConfig


@contextlib.contextmanager
def chunks_of(
    machines: "RayConfig", config: Any, folder: Path, say: Callable[[str], None]
) -> Iterator[RemoteChunks]:
    """Generations of a run on a Ray cluster, which is left at the end.

    Raises:
      ConfigError: if the cluster cannot be reached, or has nothing to compute on.
    """
    from sejax.cli import build, runtime

    runtime.take_share_of_gpu(0)  # all of them are the workers'
    from sejax.bilevel import make_program

    program = make_program(**config.parts() | {"devices": 1})
    with connected():
        num_workers = require_workers(machines)
        capacities, num_parallel = shares_of(config, program, machines, num_workers)
        crew = RayCrew(machines, build.to_plain(config), capacities)
        hand_out = HandOut(crew, capacities, num_parallel, machines.patience_s, say)
        with RemoteChunks(program, hand_out, Ledger(folder)) as chunks:
            yield chunks


@contextlib.contextmanager
def connected() -> Iterator[None]:
    """A connection to the cluster of `RAY_ADDRESS`, of this machine, or a new one.

    Raises:
      ConfigError: if it cannot be reached.
    """
    if ray.is_initialized():  # by whoever uses sejax as a library
        yield
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        with warnings.catch_warnings():  # its processes are no copies that go on with jax
            warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)
            ray.init(log_to_driver=False, logging_level="ERROR", include_dashboard=False)
    except (ConnectionError, RuntimeError, ValueError) as error:
        address = os.environ.get("RAY_ADDRESS")
        raise ConfigError(
            f"machines=ray must reach its cluster, because trainings are sent there; connecting to "
            f"{address or 'one on this machine'} failed ({told(error)}). Start one with ray start "
            f"--head, name it with RAY_ADDRESS=HOST:PORT, or set machines=local."
        ) from error
    try:
        yield
    finally:
        ray.shutdown()


def require_workers(machines: "RayConfig") -> int:
    """The number of workers that a run has now.

    Raises:
      ConfigError: if GPUs are asked for that the cluster does not have.
    """
    resources = ray.cluster_resources()
    gpus = machines.gpus_per_worker
    if gpus and not machines.workers and resources.get("GPU", 0) < gpus:
        raise ConfigError(
            f"machines.gpus_per_worker must be there, because workers wait for them; got {gpus:g} "
            f"on a cluster with {resources.get('GPU', 0):g} GPUs. Set machines.gpus_per_worker=0, "
            f"or machines.workers=N if they will come."
        )
    return num_workers(machines) or 1


def shares_of(
    config: Any, program: Any, machines: "RayConfig", num_workers: int
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Most trials in a share, and how many of them run in lockstep, of each family.

    On a CPU they are the same for any number of workers, as agents in lockstep round by how many
    there are. A worker with a GPU takes its part of a generation at once.
    """
    capacities, widths = [], []
    for family, cpu_num_parallel in enumerate(program.cpu_num_parallel):
        num_parallel, capacity = config.num_parallel or cpu_num_parallel, CAPACITY
        if machines.gpus_per_worker:
            num_trials = config.num_seeds * int((program.family_of_trial == family).sum())
            num_parallel, capacity = config.num_parallel, -(-num_trials // num_workers)
        width = num_parallel or capacity
        capacities.append(width * -(-capacity // width))
        widths.append(width)
    return tuple(capacities), tuple(widths)


class RayCrew:
    """The workers of one run."""

    def __init__(self, machines: "RayConfig", config: dict[str, Any], capacities: tuple[int, ...]):
        """Of a run's plain configuration, and most trials in a share by family."""
        self._machines = machines
        # What a worker has no use for it need not have installed.
        config = {k: x for k, x in config.items() if k not in ("tracker", "machines")}
        self._arguments = (config, capacities, scorer.versions(), machines.gpus_per_worker)
        self._scorer = ray.remote(
            num_cpus=1, num_gpus=machines.gpus_per_worker, max_restarts=0, max_task_retries=0
        )(scorer.Scorer)
        self._actors: dict[Hashable, Any] = {}
        self._pending: dict[Any, Hashable] = {}  # what a worker is doing
        self._num_started = 0

    def recruit(self) -> list[Hashable]:
        wanted = num_workers(self._machines)
        new: list[Hashable] = []
        while len(self._actors) < wanted:
            self._num_started += 1
            worker = self._num_started
            actor = self._scorer.remote(*self._arguments)
            self._actors[worker] = actor
            self._pending[actor.prepare.remote()] = worker
            new.append(worker)
        return new

    def send(self, worker: Hashable, work: scorer.Work) -> None:
        self._pending[self._actors[worker].score.remote(work)] = worker

    def wait(self, timeout_s: float) -> list[tuple[Hashable, Any]]:
        references = list(self._pending)
        if not references:
            time.sleep(timeout_s)
            return []
        ready, _ = ray.wait(references, num_returns=1, timeout=timeout_s)
        if ready and len(references) > 1:
            ready, _ = ray.wait(references, num_returns=len(references), timeout=0)
        return [(self._pending.pop(each), result_of(each)) for each in ready]

    def dismiss(self, worker: Hashable) -> None:
        actor = self._actors.pop(worker, None)
        self._pending = {ref: who for ref, who in self._pending.items() if who != worker}
        if actor is not None:
            ray.kill(actor)


def result_of(reference: Any) -> Any:
    """What a worker returned, or the exception by which it failed or was lost."""
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:  # raised by the worker
        return error.cause if isinstance(error.cause, Exception) else error
    except ray.exceptions.ActorDiedError as error:
        words = [line.strip() for line in str(error).splitlines() if line.strip()]
        return Lost(words[-1])  # the lines before are of Ray's own code
    except ray.exceptions.RayError as error:
        return Lost(told(error))


def num_workers(machines: "RayConfig") -> int:
    """Workers that are asked for, or that the cluster's machines have room for now."""
    if machines.workers:
        return machines.workers
    resources = ray.cluster_resources()
    room = resources.get("CPU", 0.0)
    if machines.gpus_per_worker:
        room = min(room, resources.get("GPU", 0.0) / machines.gpus_per_worker)
    return int(room)
