"""A study whose workers are processes on a Ray cluster.

They share nothing but the study's database, as any workers do. Ray starts them where there is room,
and anew where one is lost; trials that they leave behind are queued again by their heartbeats.
"""

from collections.abc import Callable, Sequence
from typing import Any

import optuna

from sejax.options import FailedError
from sejax.runs import cluster, runtime
from sejax.runs.workers import RayConfig
from sejax.searching import config as search_config
from sejax.searching.config import Search
from sejax.searching.study import ENDED, open_study, sentence
from sejax.searching.study import work as take_trials
from sejax.searching.trials import runner_of

RETRIES = 5  # of a worker that is lost
LAST_S = 60.0  # for workers to notice that the study is over


def work(
    study: optuna.Study,
    search: Search,
    machines: RayConfig,
    say: Callable[[str], None],
) -> None:
    """Has the trials of a study made by workers on the cluster, until it is over.

    Args:
      study: the study.
      search: what is searched.
      machines: the cluster.
      say: tells the user.

    Raises:
      ConfigError: if the cluster cannot be reached.
      FailedError: if it is lost, or workers are lost again and again.
    """
    runtime.take_share_of_gpu(0)  # GPUs are the workers'
    gpus = machines.gpus_per_worker
    with cluster.connected(machines) as ray:
        start = ray.remote(num_cpus=1, num_gpus=gpus, max_retries=RETRIES)(_work)
        count = max(1, cluster.num_workers(machines))
        running = [start.remote(search.overrides(), gpus) for _ in range(count)]
        known = {trial.number for trial in study.get_trials(deepcopy=False, states=ENDED)}
        done: list[Any] = []
        while not done:
            done, _ = ray.wait(running, timeout=cluster.LOOK_S)
            cluster.num_workers(machines)  # which raises if there is no cluster any more
            for trial in study.get_trials(deepcopy=False, states=ENDED):
                if trial.number not in known:
                    known.add(trial.number)
                    say(sentence(trial, search))
        try:
            ray.get(done)
        except ray.exceptions.RayError as error:
            raise FailedError(
                f"A worker has failed: {cluster.reason(error)}. What has ended is saved; "
                f"the same command goes on, with machines=local on this machine alone."
            ) from error
        ray.wait(running, num_returns=count, timeout=LAST_S)  # one that hangs is left behind


def _work(overrides: Sequence[str], gpu: float) -> None:
    """A worker, which has this part of a GPU."""
    runtime.configure_xla(1)
    runtime.take_share_of_gpu(gpu)
    runtime.configure_jax()
    search = search_config.read(overrides)
    take_trials(open_study(search), search, runner_of(search), lambda text: None)
