"""A landscape whose trainings are made by workers on a Ray cluster.

Each has a program of its own, and is sent a few trainings at a time. Ray starts one anew that is
lost, and sends it its trainings again.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from sejax.cli import cluster, runtime
from sejax.cli.kinds import CHUNK, Kind, Place, chunks_of, make_chunk_trainer
from sejax.cli.landscape_config import read
from sejax.cli.workers import RayConfig
from sejax.options import FailedError, registry

if TYPE_CHECKING:
    import pandas as pd

    Train = Callable[[Kind, Sequence[Place], int, int], Iterator["pd.DataFrame"]]

RETRIES = 5  # of a worker that is lost
EACH = 4  # calls of a worker, if there are enough trainings, so that all end at about one time


@contextlib.contextmanager
def connected(machines: RayConfig, overrides: Sequence[str]) -> Iterator["Train"]:
    """What stands in the place of `sejax.cli.kinds.train` while the context is open.

    Args:
      machines: the cluster.
      overrides: of `python -m sejax.landscape`.

    Raises:
      ConfigError: if the cluster cannot be reached.
      FailedError: if it is lost, or workers are lost again and again.
    """
    runtime.take_share_of_gpu(0)  # GPUs are the workers'
    with cluster.connected(machines) as ray:
        from ray.util import ActorPool

        num_workers = max(1, cluster.num_workers(machines))
        start = ray.remote(
            num_cpus=1,
            num_gpus=machines.gpus_per_worker,
            max_restarts=RETRIES,
            max_task_retries=RETRIES,
        )(Worker)

        def train(
            kind: Kind, places: Sequence[Place], steps: int, test_episodes: int
        ) -> Iterator["pd.DataFrame"]:
            if not places:
                return
            size = min(CHUNK, -(-len(places) // (EACH * num_workers)))
            arguments = list(overrides), kind.name, size, machines.gpus_per_worker
            pool = ActorPool([start.remote(*arguments) for _ in range(num_workers)])
            yield from pool.map_unordered(
                lambda worker, chunk: worker.train.remote(chunk), chunks_of(places, size)
            )

        try:
            yield train
        except ray.exceptions.RayError as error:
            raise FailedError(
                f"A worker has failed: {cluster.reason(error)}. What has ended is saved; the same "
                "command goes on, with machines=local on this machine alone."
            ) from error


class Worker:
    """Trainings of one kind of agent, at most `size` at once; one to a process.

    Args:
      overrides: of the landscape.
      name: of the agent.
      size: most trainings of a call.
      gpu: the part of a GPU that this process has.
    """

    def __init__(self, overrides: Sequence[str], name: str, size: int, gpu: float):
        runtime.configure_xla(1)
        runtime.take_share_of_gpu(gpu)
        runtime.configure_jax()
        with registry.only_typed(overrides):
            own, kinds = read(overrides)
            (kind,) = (each for each in kinds if each.name == name)
            self._train = make_chunk_trainer(kind, own.steps, own.test_episodes, size)

    def train(self, places: Sequence[Place]) -> "pd.DataFrame":
        """Rows of a landscape."""
        return self._train(places)
