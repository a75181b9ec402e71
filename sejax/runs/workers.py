"""`machines=`: whether this process computes the trainings of a run, or workers on a Ray cluster.

The driver, this process, keeps the strategy, its state and all files. In each generation it sends
candidates to the workers in shares, and outcomes come back. An outcome depends on its key and its
candidate alone, so that the numbers are those of a single process whichever worker computes it. A
worker has no state: any other one can compute its share again.

Shares shrink towards the end of a generation (guided self-scheduling, Polychronopoulos and Kuck,
1987), so that no worker waits long for the last one.
"""

import contextlib
import dataclasses
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sejax.options import Options, counts, fraction, option, require
from sejax.runs import runtime
from sejax.runs.cluster import RESTARTS, RETRIES, Pool, connected, num_workers

if TYPE_CHECKING:  # jax must not be imported before a worker has chosen its devices
    from jax import Array

    from sejax.bilevel import Bilevel, LearnState
    from sejax.generation import Candidates, Trainings
    from sejax.objectives import Outcome
    from sejax.runs.config import LearnConfig
    from sejax.runs.session import Chunks
    from sejax.scoring import GenerationInfo

CAPACITY = 16  # most evaluations in a share on a CPU core, where batches follow one another


@dataclass(frozen=True, kw_only=True)
class LocalConfig(Options):
    """This process computes everything: one compiled program over its devices."""

    group: ClassVar[str] = "machines"
    is_elsewhere: ClassVar[bool] = False

    def make(
        self, config: "LearnConfig", say: Callable[[str], None]
    ) -> contextlib.AbstractContextManager["Chunks"]:
        """The compiled generations of a run."""
        from sejax.runs import session  # which imports jax

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

    def make(
        self, config: "LearnConfig", say: Callable[[str], None]
    ) -> contextlib.AbstractContextManager["RemoteChunks"]:
        """The generations of a run, computed by workers while the context is open.

        Raises:
          ConfigError: if the cluster cannot be reached, or has nothing to compute on.
        """
        return _remote_chunks(self, config, say)


@contextlib.contextmanager
def _remote_chunks(
    machines: RayConfig, config: "LearnConfig", say: Callable[[str], None]
) -> Iterator["RemoteChunks"]:
    from sejax.runs import config as configuration

    runtime.take_share_of_gpu(0)  # GPUs are the workers'
    from sejax.bilevel import make_bilevel

    learner = make_bilevel(**config.parts() | {"devices": 1})
    with connected(machines) as ray:
        batches = batches_of(config, learner, machines, max(1, num_workers(machines)))
        # A worker need not have what it has no use for.
        plain = {
            k: v for k, v in configuration.plain(config).items() if k not in ("tracker", "machines")
        }
        arguments = plain, [batch.capacity for batch in batches], machines.gpus_per_worker
        actor = ray.remote(
            num_cpus=1,
            num_gpus=machines.gpus_per_worker,
            max_restarts=RESTARTS,
            max_task_retries=RETRIES,
        )(Worker)
        pool = Pool(
            ray,
            lambda: actor.remote(*arguments, runtime.versions()),
            lambda: num_workers(machines),
            say,
        )
        with contextlib.closing(pool):
            yield RemoteChunks(learner, pool, batches)


@dataclass(frozen=True)
class Batch:
    """How the evaluations of one evaluator are computed.

    Attributes:
      capacity: most evaluations in a share.
      width: evaluations that are computed together, so that one takes as long as all of them.
    """

    capacity: int
    width: int


def batches_of(
    config: "LearnConfig", learner: "Bilevel", machines: RayConfig, num_first: int
) -> list[Batch]:
    """The batches of each evaluator: one for each agent of a mixture, or as an objective has them.

    On a CPU they are the same for any number of workers, because sums over batches of other widths
    round otherwise. A worker with a GPU computes its part of a generation at once.
    """
    batches = []
    for cpu_width, size in zip(learner.evaluate.widths, learner.evaluate.sizes, strict=True):
        if machines.gpus_per_worker:
            capacity, width = -(-size // num_first), config.num_parallel
        else:
            capacity = CAPACITY
            width = config.num_parallel or cpu_width
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


@dataclass(frozen=True)
class Share:
    """Trainings of one agent.

    Attributes:
      agent: its index.
      trainings: leaves `[n, ...]` of NumPy, the keys as data.
    """

    agent: int
    trainings: "Trainings"


class RemoteChunks:
    """In the place of `sejax.runs.session.Chunks`: the trainings are sent to workers.

    `ask` and `tell` stay here. The state after a generation equals that of `Bilevel.generation` to
    the last bit, if the workers' CPUs are of this one's kind.

    Attributes:
      learner: the functions of Algorithm 1.
      cpu_s: CPU seconds of the workers in trainings.
    """

    def __init__(self, learner: "Bilevel", pool: Pool, batches: Sequence[Batch]):
        self.learner, self.cpu_s = learner, 0.0
        self._pool, self._batches = pool, batches
        self._compiled: Any = None

    def init(self, key: "Array") -> "LearnState":
        """The state before the first generation."""
        import jax

        state: LearnState = jax.jit(self.learner.init)(key)
        return state

    def is_ready(self, length: int) -> bool:
        """Whether this process's part is compiled, which it is for chunks of any length."""
        return self._compiled is not None

    def compile(self, length: int) -> None:
        """Compiles `ask` and `tell`, while workers compile their part.

        Both are one program that runs twice in a generation: in a program of its own XLA would
        round the candidates of `ask` otherwise than in `Bilevel.generation`.
        """
        import jax
        import jax.numpy as jnp

        from sejax.ops.parallel import compiler_options

        def generation(state: "LearnState", by_agent: list["Outcome"]) -> tuple[Any, ...]:
            candidates = self.learner.ask(state)
            outcome = self.learner.evaluate.joined(by_agent)
            return self.learner.tell(state, candidates, outcome), _sent(self.learner, candidates)

        def no_outcomes(state: "LearnState") -> list["Outcome"]:
            trainings = self.learner.evaluate.trainings(self.learner.ask(state))
            pairs = zip(self.learner.evaluate.runs, trainings, strict=True)
            return [jax.vmap(run)(of_agent) for run, of_agent in pairs]

        state = jax.eval_shape(self.learner.init, jax.random.key(0))
        shapes = jax.eval_shape(no_outcomes, state)
        self._no_outcomes = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        jitted = jax.jit(generation, compiler_options=compiler_options())
        self._compiled = jitted.lower(state, self._no_outcomes).compile()

    def advance(self, state: "LearnState", length: int) -> tuple["LearnState", "GenerationInfo"]:
        """Runs `length` generations.

        Returns:
          The state, and an info with leaves `[length, ...]`.

        Raises:
          FailedError: as of `Pool.map`.
        """
        import jax
        import jax.numpy as jnp

        if not self.is_ready(length):
            self.compile(length)
        infos = []
        for _ in range(length):
            _, trainings = self._compiled(state, self._no_outcomes)
            by_agent = self._evaluate(jax.device_get(trainings))
            (state, info), _ = self._compiled(state, by_agent)
            infos.append(info)
        return state, jax.tree.map(lambda *each: jnp.stack(each), *infos)

    def _evaluate(self, by_agent: Sequence["Trainings"]) -> list["Outcome"]:
        """The outcomes of each agent's trainings, leaves `[training, ...]`."""
        import jax

        shares = [
            Share(agent, jax.tree.map(lambda x, places=places: x[places], trainings))
            for agent, (trainings, batch) in enumerate(zip(by_agent, self._batches, strict=True))
            for places in cut(np.arange(len(trainings.active)), batch, max(1, self._pool.size))
        ]
        outcomes, cpu_s = zip(*self._pool.map(shares), strict=True)
        self.cpu_s += sum(cpu_s)
        return [
            jax.tree.map(
                lambda *parts: np.concatenate(parts),
                *(
                    outcome
                    for share, outcome in zip(shares, outcomes, strict=True)
                    if share.agent == agent
                ),
            )
            for agent in range(len(by_agent))
        ]


def _sent(learner: "Bilevel", candidates: "Candidates") -> list["Trainings"]:
    """The trainings of each agent, with keys as data."""
    import jax

    return [
        dataclasses.replace(trainings, key=jax.random.key_data(trainings.key))
        for trainings in learner.evaluate.trainings(candidates)
    ]


# --- a worker -------------------------------------------------------------------------------------


class Worker:
    """The compiled trainings of a run, for shares of a generation; one to a process.

    Args:
      config: of the run, plain.
      capacities: most evaluations in a share, for each evaluator.
      gpu_share: the part of a GPU that this process has; 0 for a CPU core.
      expected: versions of the driver's packages.

    Raises:
      ConfigError: if this machine has other versions of what decides the numbers.
    """

    def __init__(
        self,
        config: dict[str, Any],
        capacities: Sequence[int],
        gpu_share: float,
        expected: dict[str, str],
    ):
        runtime.configure_xla(1)
        runtime.take_share_of_gpu(gpu_share)
        versions = runtime.versions()
        require(
            versions == expected,
            "machines",
            f"must have the same versions everywhere; got {versions} on {socket.gethostname()} "
            f"and {expected} here. Set the same versions up there.",
        )
        runtime.configure_jax()
        from sejax.bilevel import make_bilevel
        from sejax.runs import config as configuration

        of_run = configuration.learn_config(config)
        learner = make_bilevel(**of_run.parts() | {"devices": 1})
        self._capacities = capacities
        self._programs = [
            _compiled_share(learner, agent, capacity, of_run.num_parallel)
            for agent, capacity in enumerate(capacities)
        ]

    def ready(self) -> None:
        """Answers as soon as everything is compiled."""

    def evaluate(self, share: Share) -> tuple["Outcome", float]:
        """The outcomes of a share, leaves `[n, ...]`, and the CPU seconds that they took."""
        import jax

        started = time.process_time()
        n, capacity = len(share.trainings.active), self._capacities[share.agent]
        # Filled up with copies, for which nothing is computed.
        places, is_given = np.minimum(np.arange(capacity), n - 1), np.arange(capacity) < n
        trainings = jax.tree.map(lambda x: x[places], share.trainings)
        trainings = dataclasses.replace(trainings, active=trainings.active & is_given)
        outcome = self._programs[share.agent](trainings)
        outcome = jax.tree.map(lambda x: x[:n], jax.device_get(outcome))
        return outcome, time.process_time() - started


def _compiled_share(learner: "Bilevel", agent: int, capacity: int, num_parallel: int | None) -> Any:
    """The program that evaluates up to `capacity` trainings of an agent."""
    import jax

    from sejax.ops.parallel import compiler_options, spread_over_devices

    run, cpu_width = learner.evaluate.runs[agent], learner.evaluate.widths[agent]
    spread = spread_over_devices(run, 1, num_parallel, cpu_width)

    def evaluate(sent: "Trainings") -> "Outcome":
        return spread(dataclasses.replace(sent, key=jax.random.wrap_key_data(sent.key)))

    def example(key: "Array") -> "Trainings":
        sent = _sent(learner, learner.ask(learner.init(key)))[agent]
        return jax.tree.map(lambda x: x[np.zeros(capacity, int)], sent)

    shapes = jax.eval_shape(example, jax.random.key(0))
    return jax.jit(evaluate, compiler_options=compiler_options()).lower(shapes).compile()
