"""`machines=ray`: workers on a Ray cluster compute the trainings of a run.

This process, the driver, keeps the strategy, its state and all files. In each generation it sends
shares of the candidates to workers, which return outcomes. An outcome depends only on its key and
its candidate. So the numbers are those of a single process, whichever worker computes an outcome. A
share is a task of Ray. Ray starts workers where cores are free, also on machines that join later,
and sends a share again if its worker dies.
"""

import contextlib
import dataclasses
import functools
import json
import os
import socket
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, ClassVar, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from sejax.bilevel import Bilevel, LearnState, make_bilevel
from sejax.generation import Trainings
from sejax.objectives import Outcome
from sejax.ops.parallel import compiler_options, spread_over_devices
from sejax.options import ConfigError, Count, FailedError, require_package, shortened, told
from sejax.runs import runtime
from sejax.runs.chunks import Chunks, Pool
from sejax.runs.config import LearnConfig, MachinesConfig
from sejax.scoring import GenerationInfo

WorkShare: TypeAlias = tuple[int, Trainings]  # an agent's index and trainings, whose keys are data
# Computes shares: their outcomes and the CPU seconds that these took, in the order of the shares.
Compute: TypeAlias = Callable[[Sequence[WorkShare]], Iterable[tuple[Outcome, float]]]
BATCH = 16  # trainings in a share if neither the agent nor the user says how many
RETRIES = 20  # how often Ray sends a share again if its worker dies
LOOK_S = 1.0  # seconds between checks that the cluster still answers


@dataclasses.dataclass(frozen=True, kw_only=True)
class RayConfig(MachinesConfig):
    """Worker processes on a Ray cluster, each on a CPU core.

    Attributes:
      address: HOST:PORT of the cluster; local: one on this machine; null: RAY_ADDRESS, or local
      workers: worker processes; null: one for each CPU core of the cluster
    """

    is_elsewhere: ClassVar[bool] = True

    address: str | None = None
    workers: Count | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require_package("machines", "ray", "ray")

    @contextlib.contextmanager
    def make(self, config: LearnConfig) -> Iterator["RemoteChunks"]:
        """The generations of a run, computed by workers while the context is open.

        Raises:
          ConfigError: if the cluster cannot be reached.
        """
        # A worker needs this text, and keeps its compiled programs by it. It need not have the
        # packages of the two parts that are left out.
        parts = config.plain().items()
        setup = json.dumps({name: x for name, x in parts if name not in ("tracker", "machines")})
        with self.pool() as pool:
            yield RemoteChunks(config, lambda sent: pool(outcomes_of, [(setup, x) for x in sent]))

    @contextlib.contextmanager
    def pool(self) -> Iterator[Pool]:
        """Calls a function on workers with each of several tuples of arguments.

        Raises:
          ConfigError: if the cluster cannot be reached.
        """
        import ray  # it comes with an extra

        _use_one_core()
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        quiet = {"log_to_driver": False, "logging_level": "ERROR", "include_dashboard": False}
        try:
            with warnings.catch_warnings():  # the processes that Ray forks do not use jax
                warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)
                ray.init(self.address, **quiet)
        except (ConnectionError, RuntimeError, ValueError) as error:
            rule = f"must be within reach; got {self.address} ({told(error)})"
            raise ConfigError("machines.address", rule, use="local") from error
        try:
            yield functools.partial(_on_cluster, self.workers)
        finally:
            ray.shutdown()


# --- shares of a generation -----------------------------------------------------------------------


def share_sizes(bilevel: Bilevel, num_parallel: int | None) -> list[int]:
    """The number of trainings in a share, which is one batch, for each agent.

    It does not depend on the number of workers, because sums over batches of other widths round
    otherwise.
    """
    return [num_parallel or width or BATCH for width in bilevel.evaluate.cpu_num_parallel]


class RemoteChunks(Chunks):
    """Generations whose trainings are computed by workers.

    This process computes `ask` and `tell`. The state after a generation equals that of
    `Bilevel.generation` to the last bit, if the workers have the same kind of CPU.

    Args:
      config: the run's configuration.
      compute: returns `outcomes_of` each share.

    Attributes:
      cpu_s: CPU seconds that the workers spent on trainings.
    """

    def __init__(self, config: LearnConfig, compute: Compute):
        super().__init__(config, devices=1)
        self._compute = compute
        self._sizes = share_sizes(self.bilevel, config.num_parallel)

    def compile(self, length: int) -> None:
        """Compiles `ask` and `tell`, which serve chunks of any length."""
        generation, no_outcome = self._program

        def chunk(state: LearnState) -> tuple[LearnState, GenerationInfo]:
            infos = []
            for _ in range(length):
                _, trainings = generation(state, no_outcome)
                (state, info), _ = generation(state, self._evaluate(jax.device_get(trainings)))
                infos.append(info)
            return state, jax.tree.map(lambda *leaves: jnp.stack(leaves), *infos)

        self.compiled[length] = chunk

    @functools.cached_property
    def _program(self) -> tuple[jax.stages.Compiled, Outcome]:
        """The program of `ask` and `tell`, and the outcome that it is given to ask.

        One program does both, and runs twice in a generation. In a program of `ask` alone, XLA
        would round the candidates otherwise than in `Bilevel.generation`.
        """
        bilevel = self.bilevel

        def generation(state: LearnState, outcome: Outcome) -> tuple[Any, ...]:
            candidates = bilevel.ask(state)
            trainings = bilevel.evaluate.trainings(candidates)
            sent = [dataclasses.replace(x, key=jax.random.key_data(x.key)) for x in trainings]
            return bilevel.tell(state, candidates, outcome), sent

        state = jax.eval_shape(bilevel.init, jax.random.key(0))
        outcome = jax.eval_shape(lambda state: bilevel.evaluate(bilevel.ask(state)), state)
        no_outcome = jax.tree.map(jnp.zeros_like, outcome)
        jitted = jax.jit(generation, compiler_options=compiler_options())
        return jitted.lower(state, no_outcome).compile(), no_outcome

    def _evaluate(self, by_agent: Sequence[Trainings]) -> Outcome:
        """The outcomes of all trainings, leaves `[training, ...]`."""
        shares: list[WorkShare] = []
        for agent_index, (trainings, size) in enumerate(zip(by_agent, self._sizes, strict=True)):
            for start in range(0, len(trainings.active), size):
                part = slice(start, start + size)
                shares.append((agent_index, jax.tree.map(lambda x, part=part: x[part], trainings)))
        parts: list[list[Outcome]] = [[] for _ in by_agent]
        for (agent_index, _), (outcome, cpu_s) in zip(shares, self._compute(shares), strict=True):
            parts[agent_index].append(outcome)
            self.cpu_s += cpu_s
        outcomes = [jax.tree.map(lambda *leaves: np.concatenate(leaves), *part) for part in parts]
        return self.bilevel.evaluate.joined(outcomes)


# --- the cluster ----------------------------------------------------------------------------------


def require_cluster() -> None:
    """Checks that the cluster still answers.

    Raises:
      FailedError: if it is gone: Ray itself would wait for ever.
    """
    import ray  # it comes with an extra

    here = ray.get_runtime_context().get_node_id()
    if not any(node["NodeID"] == here and node["Alive"] for node in ray.nodes()):
        what = "Ray has ended on this machine, so that no training can be sent out."
        fix = "The generations before are saved; start Ray and repeat the command to resume."
        raise FailedError(f"{what} {fix}")


def _on_cluster(
    workers: int | None, function: Callable[..., Any], items: Sequence[tuple[Any, ...]]
) -> Iterator[Any]:
    """A function's results for tuples of arguments, in their order, each as soon as it is there.

    As many calls run at a time as there are workers: the user's number, or one for each CPU core
    that the cluster has now.

    Raises:
      FailedError: if a worker raises an error or dies again and again, or the cluster is lost.
    """
    import ray  # it comes with an extra

    task = ray.remote(num_cpus=1, max_retries=RETRIES)(call)
    versions = runtime.versions()
    require_cluster()
    limit = workers or max(1, int(ray.cluster_resources().get("CPU", 1)))
    tasks: list[Any] = []  # sent ones, in the order of their items
    running: list[Any] = []
    try:
        for i in range(len(items)):
            while i >= len(tasks) or tasks[i] in running:
                num_free = limit - len(running)
                for item in items[len(tasks) : len(tasks) + num_free]:
                    tasks.append(task.remote(versions, function, item))
                    running.append(tasks[-1])
                done, running = ray.wait(running, timeout=LOOK_S)
                if not done:
                    require_cluster()
            yield ray.get(tasks[i])
    except ray.exceptions.RayError as error:  # its last line is the worker's error
        reason = shortened(str(error).strip().splitlines()[-1].strip(), 160)
        fix = "the same command with machines=local resumes here."
        message = f"A worker has failed: {reason}. What was finished before is saved; {fix}"
        raise FailedError(message) from error


# --- a worker -------------------------------------------------------------------------------------


def outcomes_of(setup: str, share: WorkShare) -> tuple[Outcome, float]:
    """The outcomes of a share, leaves `[n, ...]`, and the CPU seconds that they took."""
    started = time.process_time()
    agent_index, trainings = share
    size, program = _share_programs(setup)[agent_index]
    # Copies fill the share up; nothing is computed for them.
    n = len(trainings.active)
    numbers = np.arange(size)
    trainings = jax.tree.map(lambda x: x[np.minimum(numbers, n - 1)], trainings)
    outcome = program(dataclasses.replace(trainings, active=trainings.active & (numbers < n)))
    outcome = jax.tree.map(lambda x: x[:n], jax.device_get(outcome))
    return outcome, time.process_time() - started


@functools.lru_cache(maxsize=1)
def _share_programs(setup: str) -> list[tuple[int, Any]]:
    """For each agent of a run: the size of a share, and the program that computes a share."""
    # Whoever started the run has typed the names of its plugins, so all may be imported.
    config = LearnConfig.of_tree(json.loads(setup))
    bilevel = make_bilevel(**config.parts() | {"devices": 1})

    def program_of(agent_index: int, size: int) -> Any:
        evaluator = bilevel.evaluate.evaluators[agent_index]
        spread = spread_over_devices(evaluator, num_devices=1, num_parallel=size)

        def evaluate(sent: Trainings) -> Any:
            return spread(dataclasses.replace(sent, key=jax.random.wrap_key_data(sent.key)))

        return jax.jit(evaluate, compiler_options=compiler_options())

    sizes = share_sizes(bilevel, config.num_parallel)
    return [(size, program_of(i, size)) for i, size in enumerate(sizes)]


def call(versions: dict[str, str], function: Callable[..., Any], item: tuple[Any, ...]) -> Any:
    """Calls a function on a worker with a tuple of arguments.

    Raises:
      ConfigError: if this machine has other versions of the packages that decide the numbers.
    """
    _use_one_core()
    if (here := runtime.versions()) != versions:
        got = f"{here} on {socket.gethostname()} and {versions} here"
        raise ConfigError("machines", f"must have the same versions everywhere; got {got}.")
    runtime.configure_jax()
    return function(*item)


def _use_one_core() -> None:
    """Keeps this process on one CPU core, without a GPU; call it before jax first computes."""
    runtime.configure_xla(1)
    jax.config.update("jax_platforms", "cpu")
