"""`machines=`: whether this process computes the trainings of a run, or workers on a Ray cluster.

The driver, this process, keeps the strategy, its state and all files. In each generation it sends
candidates to the workers in shares, and outcomes come back. An outcome depends on its key and its
candidate alone, so that the numbers are those of a single process whichever worker computes it. A
share is a task of Ray: Ray starts workers where there is room, also on machines that join, and
sends a share again whose worker died.

Shares shrink towards the end of a generation (guided self-scheduling, Polychronopoulos and Kuck,
1987), so that no worker waits long for the last one.
"""

import contextlib
import dataclasses
import functools
import json
import os
import socket
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from sejax.bilevel import Bilevel, LearnState, make_bilevel
from sejax.generation import Candidates, Trainings
from sejax.objectives import Outcome
from sejax.ops.parallel import compiler_options, spread_over_devices
from sejax.options import (
    ConfigError,
    FailedError,
    Options,
    counts,
    fraction,
    option,
    require,
    shortened,
    told,
)
from sejax.runs import config as configuration
from sejax.runs import runtime
from sejax.runs.config import LearnConfig
from sejax.scoring import GenerationInfo

if TYPE_CHECKING:
    from sejax.runs.session import Chunks

CAPACITY = 16  # most evaluations in a share on a CPU core, where batches follow one another
RETRIES = 20  # by Ray, of a share whose worker dies
LOOK_S = 1.0  # between looks whether the cluster is there


@dataclass(frozen=True, kw_only=True)
class LocalConfig(Options):
    """This process computes everything: one compiled program over its devices."""

    group: ClassVar[str] = "machines"
    is_elsewhere: ClassVar[bool] = False

    def make(self, config: LearnConfig) -> contextlib.AbstractContextManager["Chunks"]:
        """The compiled generations of a run."""
        from sejax.runs import session  # which chooses how matplotlib draws

        return contextlib.nullcontext(session.make_chunks(config))


@dataclass(frozen=True, kw_only=True)
class RayConfig(Options):
    """Worker processes on a Ray cluster.

    Attributes:
      address: HOST:PORT of the cluster; local: one on this machine; null: that of RAY_ADDRESS, or
        local
      workers: worker processes; null: one for each CPU core of the cluster, or for each GPU
      gpus_per_worker: 0: a worker computes on a CPU core; 0.5: two workers share a GPU
    """

    group: ClassVar[str] = "machines"
    is_elsewhere: ClassVar[bool] = True
    package: ClassVar[str] = "ray"

    address: str | None = None
    workers: int | None = option(None, counts("somebody must compute"))
    gpus_per_worker: float = option(0.0, fraction())

    @contextlib.contextmanager
    def make(self, config: LearnConfig) -> Iterator["RemoteChunks"]:
        """The generations of a run, computed by workers while the context is open.

        Raises:
          ConfigError: if the cluster cannot be reached.
        """
        runtime.take_share_of_gpu(0)  # GPUs are the workers'
        learner = make_bilevel(**config.parts() | {"devices": 1})
        with _connected(self):
            batches = batches_of(config, learner, self, num_workers(self))
            setup = setup_of(config, batches, self.gpus_per_worker)
            compute = functools.partial(_on_cluster, self, setup)
            yield RemoteChunks(learner, batches, lambda: num_workers(self), compute)


# --- shares of a generation -----------------------------------------------------------------------


class Batch(NamedTuple):
    """How the trainings of one agent are computed.

    Attributes:
      capacity: most trainings in a share.
      width: trainings that are computed together, so that one takes as long as all of them.
    """

    capacity: int
    width: int


def batches_of(
    config: LearnConfig, learner: Bilevel, machines: RayConfig, num_first: int
) -> list[Batch]:
    """The batches of each agent's trainings.

    On a CPU they are the same for any number of workers, because sums over batches of other widths
    round otherwise. A worker with a GPU computes its part of a generation at once.
    """
    batches = []
    for size, cpu_width in zip(learner.evaluate.sizes, learner.evaluate.widths, strict=True):
        if machines.gpus_per_worker:
            capacity, width = -(-size // num_first), config.num_parallel
        else:
            capacity, width = CAPACITY, config.num_parallel or cpu_width
        width = width or capacity
        batches.append(Batch(width * -(-capacity // width), width))
    return batches


def cut(places: np.ndarray, batch: Batch, num_workers: int) -> Iterator[np.ndarray]:
    """Shares of the places, each half of what is left to each worker, in whole batches."""
    while len(places):
        size = batch.width * -(-len(places) // (2 * num_workers * batch.width))
        size = min(size, batch.capacity)
        yield places[:size]
        places = places[size:]


class Share(NamedTuple):
    """Trainings of one agent.

    Attributes:
      agent: its index.
      trainings: leaves `[n, ...]` of NumPy, the keys as data.
    """

    agent: int
    trainings: Trainings


class RemoteChunks:
    """In the place of `sejax.runs.session.Chunks`: the trainings are sent to workers.

    `ask` and `tell` stay here. The state after a generation equals that of `Bilevel.generation` to
    the last bit, if the workers' CPUs are of this one's kind.

    Args:
      learner: the functions of Algorithm 1.
      batches: of each agent.
      num_workers: workers that there are now.
      compute: what `score` returns for each share, in their order.

    Attributes:
      learner: the functions of Algorithm 1.
      cpu_s: CPU seconds of the workers in trainings.
    """

    def __init__(
        self,
        learner: Bilevel,
        batches: Sequence[Batch],
        num_workers: Callable[[], int],
        compute: Callable[[Sequence[Share]], Sequence[tuple[Outcome, float]]],
    ):
        self.learner, self.cpu_s = learner, 0.0
        self.init: Callable[[Array], LearnState] = jax.jit(learner.init)  # before generation 0
        self._num_workers, self._compute = num_workers, compute
        self._batches = batches
        self._compiled: Any = None

    def is_ready(self, length: int) -> bool:
        """Whether this process's part is compiled, which it is for chunks of any length."""
        return self._compiled is not None

    def compile(self, length: int) -> None:
        """Compiles `ask` and `tell`.

        Both are one program that runs twice in a generation: in a program of its own XLA would
        round the candidates of `ask` otherwise than in `Bilevel.generation`.
        """

        def generation(state: LearnState, by_agent: list[Outcome]) -> tuple[Any, ...]:
            candidates = self.learner.ask(state)
            outcome = self.learner.evaluate.joined(by_agent)
            return self.learner.tell(state, candidates, outcome), _sent(self.learner, candidates)

        def evaluate(state: LearnState) -> list[Outcome]:
            trainings = self.learner.evaluate.trainings(self.learner.ask(state))
            pairs = zip(self.learner.evaluate.runs, trainings, strict=True)
            return [jax.vmap(run)(of_agent) for run, of_agent in pairs]

        state = jax.eval_shape(self.learner.init, jax.random.key(0))
        shapes = jax.eval_shape(evaluate, state)
        self._no_outcomes = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        jitted = jax.jit(generation, compiler_options=compiler_options())
        self._compiled = jitted.lower(state, self._no_outcomes).compile()

    def advance(self, state: LearnState, length: int) -> tuple[LearnState, GenerationInfo]:
        """Runs `length` generations.

        Returns:
          The state, and an info with leaves `[length, ...]`.

        Raises:
          FailedError: if a worker fails, or the whole cluster is lost.
        """
        if not self.is_ready(length):
            self.compile(length)
        infos = []
        for _ in range(length):
            _, trainings = self._compiled(state, self._no_outcomes)
            outcomes = self._evaluate(jax.device_get(trainings))
            (state, info), _ = self._compiled(state, outcomes)
            infos.append(info)
        return state, jax.tree.map(lambda *each: jnp.stack(each), *infos)

    def _evaluate(self, by_agent: Sequence[Trainings]) -> list[Outcome]:
        """The outcomes of each agent's trainings, leaves `[training, ...]`."""
        num_workers = self._num_workers()
        shares = [
            Share(agent, jax.tree.map(lambda x, places=places: x[places], trainings))
            for agent, (trainings, batch) in enumerate(zip(by_agent, self._batches, strict=True))
            for places in cut(np.arange(len(trainings.active)), batch, num_workers)
        ]
        outcomes, cpu_s = zip(*self._compute(shares), strict=True)
        self.cpu_s += sum(cpu_s)
        parts: list[list[Outcome]] = [[] for _ in by_agent]
        for share, outcome in zip(shares, outcomes, strict=True):
            parts[share.agent].append(outcome)
        return [jax.tree.map(lambda *leaves: np.concatenate(leaves), *some) for some in parts]


def _sent(learner: Bilevel, candidates: Candidates) -> list[Trainings]:
    """The trainings of each agent, with keys as data."""
    return [
        dataclasses.replace(trainings, key=jax.random.key_data(trainings.key))
        for trainings in learner.evaluate.trainings(candidates)
    ]


# --- the cluster ----------------------------------------------------------------------------------


@contextlib.contextmanager
def _connected(machines: RayConfig) -> Iterator[None]:
    """A connection to the cluster.

    Raises:
      ConfigError: if it cannot be reached.
    """
    import ray  # of an extra

    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    quiet = {"log_to_driver": False, "logging_level": "ERROR", "include_dashboard": False}
    try:
        with warnings.catch_warnings():  # Ray's processes do not go on with jax
            warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)
            ray.init(machines.address, **quiet)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise ConfigError(
            f"machines.address must be a cluster that can be reached; got {machines.address} "
            f"({told(error)}). Start one with ray start --head, or set machines.address=local.",
            "machines.address",
        ) from error
    try:
        yield
    finally:
        ray.shutdown()


def num_workers(machines: RayConfig) -> int:
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
    return max(1, int(room))


def _on_cluster(
    machines: RayConfig, setup: str, shares: Sequence[Share]
) -> list[tuple[Outcome, float]]:
    """What `score` returns for each share, as many at a time as there are workers.

    Raises:
      FailedError: if a worker raises an error or dies again and again, or the cluster is lost.
    """
    import ray  # of an extra

    gpus = machines.gpus_per_worker
    # By default Ray ends a process after a task that has a GPU, and all that it has compiled.
    task = ray.remote(num_cpus=1, num_gpus=gpus, max_retries=RETRIES, max_calls=0)(score)
    most, tasks, running = num_workers(machines), [], []
    for i, share in enumerate(shares, 1):
        tasks.append(task.remote(setup, share))
        running.append(tasks[-1])
        while len(running) >= (most if i < len(shares) else 1):
            done, running = ray.wait(running, timeout=LOOK_S)
            if not done:
                num_workers(machines)  # which raises if there is no cluster any more
    try:
        results: list[tuple[Outcome, float]] = ray.get(tasks)
    except ray.exceptions.RayError as error:  # its last line is what the worker raised
        reason = shortened(str(error).strip().splitlines()[-1].strip(), 160)
        raise FailedError(
            f"A worker has failed: {reason}. The generations before are saved; the same command "
            f"with machines=local goes on here."
        ) from error
    return results


# --- a worker -------------------------------------------------------------------------------------


def setup_of(config: LearnConfig, batches: Sequence[Batch], gpu_share: float) -> str:
    """What a worker must know of a run, as JSON: a text, by which it keeps what it has compiled."""
    # A worker need not have what it has no use for.
    plain = {
        k: v for k, v in configuration.plain(config).items() if k not in ("tracker", "machines")
    }
    return json.dumps([plain, [x.capacity for x in batches], gpu_share, runtime.versions()])


def score(setup: str, share: Share) -> tuple[Outcome, float]:
    """The outcomes of a share, leaves `[n, ...]`, and the CPU seconds that they took.

    Raises:
      ConfigError: if this machine has other versions of what decides the numbers.
    """
    capacity, program = _programs(setup)[share.agent]
    started, n = time.process_time(), len(share.trainings.active)
    # Filled up with copies, for which nothing is computed.
    places, is_own = np.minimum(np.arange(capacity), n - 1), np.arange(capacity) < n
    trainings = jax.tree.map(lambda x: x[places], share.trainings)
    outcome = program(dataclasses.replace(trainings, active=trainings.active & is_own))
    outcome = jax.tree.map(lambda x: x[:n], jax.device_get(outcome))
    return outcome, time.process_time() - started


@functools.lru_cache(maxsize=1)
def _programs(setup: str) -> list[tuple[int, Any]]:
    """Most evaluations in a share, and their compiled program, for each agent of a run."""
    plain, capacities, gpu_share, expected = json.loads(setup)
    runtime.configure_xla(1)
    runtime.take_share_of_gpu(gpu_share)
    versions = runtime.versions()
    require(
        versions == expected,
        "machines",
        f"must have the same versions everywhere; got {versions} on {socket.gethostname()} and "
        f"{expected} here. Set the same versions up there.",
    )
    runtime.configure_jax()
    config = configuration.learn_config(plain)
    learner = make_bilevel(**config.parts() | {"devices": 1})
    return [
        (capacity, _compiled_share(learner, agent, capacity, config.num_parallel))
        for agent, capacity in enumerate(capacities)
    ]


def _compiled_share(learner: Bilevel, agent: int, capacity: int, num_parallel: int | None) -> Any:
    """The program that evaluates up to `capacity` trainings of an agent."""
    run, cpu_width = learner.evaluate.runs[agent], learner.evaluate.widths[agent]
    spread = spread_over_devices(run, 1, num_parallel, cpu_width)

    def evaluate(sent: Trainings) -> Outcome:
        key = jax.random.wrap_key_data(sent.key)
        outcome: Outcome = spread(dataclasses.replace(sent, key=key))
        return outcome

    def example(key: Array) -> Trainings:
        sent = _sent(learner, learner.ask(learner.init(key)))[agent]
        filled: Trainings = jax.tree.map(lambda x: x[np.zeros(capacity, int)], sent)
        return filled

    shapes = jax.eval_shape(example, jax.random.key(0))
    return jax.jit(evaluate, compiler_options=compiler_options()).lower(shapes).compile()
