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
from sejax.evaluation import Candidates, Evaluator, of_vectors
from sejax.objectives import GenerationInfo, Outcome
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
    """Worker processes on a Ray cluster."""

    group: ClassVar[str] = "machines"
    is_elsewhere: ClassVar[bool] = True
    package: ClassVar[str] = "ray"

    # HOST:PORT of the cluster; local: one on this machine; null: that of RAY_ADDRESS, or local
    address: str | None = None
    # worker processes; null: one for each CPU core of the cluster, or for each GPU
    workers: int | None = option(None, counts("somebody must compute"))
    # 0: a worker computes on a CPU core; 0.5: two workers share a GPU
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
    """How the evaluations of one evaluator are computed.

    Attributes:
      capacity: most evaluations in a share.
      width: evaluations that are computed together, so that one takes as long as all of them.
    """

    capacity: int
    width: int


def batches_of(
    config: LearnConfig, learner: Bilevel, machines: RayConfig, num_first: int
) -> list[Batch]:
    """The batches of each evaluator: one for each agent of a mixture, or as an objective has them.

    On a CPU they are the same for any number of workers, because sums over batches of other widths
    round otherwise. A worker with a GPU computes its part of a generation at once.
    """
    batches = []
    for evaluator, places in zip(learner.evaluators, _places(learner), strict=True):
        if machines.gpus_per_worker:
            capacity, width = -(-len(places) // num_first), config.num_parallel
        else:
            capacity = CAPACITY
            width = config.num_parallel or evaluator.cpu_num_parallel
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


def _places(learner: Bilevel) -> list[np.ndarray]:
    """The indices of each evaluator's evaluations in a generation."""
    evaluators = learner.scoring.agent_of_evaluation
    return [np.flatnonzero(evaluators == i) for i in range(len(learner.evaluators))]


class Share(NamedTuple):
    """Evaluations of one evaluator.

    Attributes:
      evaluator: its index.
      arguments: data of their keys `[n, ...]`, candidates `[n, dims]`, whether anything is computed
        `[n]`, and the length of the test episodes that are scored, `[n]` or None.
    """

    evaluator: int
    arguments: tuple[Any, ...]


class RemoteChunks:
    """In the place of `sejax.runs.session.Chunks`: the trainings are sent to workers.

    `ask` and `tell` stay here. The state after a generation equals that of `Bilevel.generation` to
    the last bit, if the workers' CPUs are of this one's kind.

    Args:
      learner: the functions of Algorithm 1.
      batches: of each evaluator.
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
        self._batches, self._places = batches, _places(learner)
        self._compiled: Any = None

    def is_ready(self, length: int) -> bool:
        """Whether this process's part is compiled, which it is for chunks of any length."""
        return self._compiled is not None

    def compile(self, length: int) -> None:
        """Compiles `ask` and `tell`.

        Both are one program that runs twice in a generation: in a program of its own XLA would
        round the candidates of `ask` otherwise than in `Bilevel.generation`.
        """

        def generation(state: LearnState, outcome: Outcome) -> tuple[Any, ...]:
            asked = self.learner.ask(state)
            return self.learner.tell(state, asked, outcome), _arguments(asked)

        def evaluate(key: Array) -> Outcome:
            return self.learner.evaluate(self.learner.ask(self.learner.init(key)))

        key = jax.random.key(0)
        shapes = jax.eval_shape(evaluate, key)
        self._no_outcome = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        jitted = jax.jit(generation, compiler_options=compiler_options())
        state = jax.eval_shape(self.learner.init, key)
        self._compiled = jitted.lower(state, self._no_outcome).compile()

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
            _, arguments = self._compiled(state, self._no_outcome)
            outcome = self._evaluate(jax.device_get(arguments))
            (state, info), _ = self._compiled(state, outcome)
            infos.append(info)
        return state, jax.tree.map(lambda *each: jnp.stack(each), *infos)

    def _evaluate(self, arguments: tuple[Any, ...]) -> Outcome:
        """The outcome of a generation, leaves `[evaluation, ...]`."""
        places, shares, num_workers = [], [], self._num_workers()
        for evaluator, (own, batch) in enumerate(zip(self._places, self._batches, strict=True)):
            for some in cut(own, batch, num_workers):
                places.append(some)
                shares.append(Share(evaluator, _at(arguments, some)))
        outcomes, cpu_s = zip(*self._compute(shares), strict=True)
        self.cpu_s += sum(cpu_s)
        order = np.argsort(np.concatenate(places))
        merged: Outcome = jax.tree.map(lambda *parts: np.concatenate(parts)[order], *outcomes)
        return merged


def _arguments(asked: Candidates) -> tuple[Any, ...]:
    """What a generation's trainings need, leaves `[evaluation, ...]`; see `Share`."""
    shared = asked.active, asked.eval_steps
    of_each = jax.tree.map(lambda x: jnp.repeat(x, len(asked.params)), shared)
    return jax.random.key_data(asked.keys), asked.params, *of_each


def _at(arguments: tuple[Any, ...], places: np.ndarray) -> tuple[Any, ...]:
    return tuple(x if x is None else x[places] for x in arguments)


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
    capacity, program = _programs(setup)[share.evaluator]
    started, n = time.process_time(), len(share.arguments[0])
    # Filled up with copies, for which nothing is computed.
    places, is_own = np.minimum(np.arange(capacity), n - 1), np.arange(capacity) < n
    keys, params, active, eval_steps = _at(share.arguments, places)
    outcome = program(keys, params, active & is_own, eval_steps)
    outcome = jax.tree.map(lambda x: x[:n], jax.device_get(outcome))
    return outcome, time.process_time() - started


@functools.lru_cache(maxsize=1)
def _programs(setup: str) -> list[tuple[int, Any]]:
    """Most evaluations in a share, and their compiled program, for each evaluator of a run."""
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
        (capacity, _compiled_share(learner, evaluator, capacity, config.num_parallel))
        for evaluator, capacity in zip(learner.evaluators, capacities, strict=True)
    ]


def _compiled_share(
    learner: Bilevel, evaluator: Evaluator, capacity: int, num_parallel: int | None
) -> Any:
    """The program that evaluates up to `capacity` candidates."""
    spread = spread_over_devices(
        of_vectors(evaluator, learner.params_of), 1, num_parallel, evaluator.cpu_num_parallel
    )

    def evaluate(key_data: Array, *arguments: Array | None) -> Outcome:
        outcome: Outcome = spread(jax.random.wrap_key_data(key_data), *arguments)
        return outcome

    def arguments(key: Array) -> tuple[Any, ...]:
        asked = learner.ask(learner.init(key))
        return _at(_arguments(asked), np.zeros(capacity, int))

    shapes = jax.eval_shape(arguments, jax.random.key(0))
    return jax.jit(evaluate, compiler_options=compiler_options()).lower(*shapes).compile()
