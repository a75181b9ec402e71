"""A study whose workers are processes on a Ray cluster.

They share nothing but the study's database, as any workers do. Ray starts them where there is room,
and anew where one is lost; trials that they leave behind are queued again by their heartbeats.
"""

from collections.abc import Callable
from typing import Any

import optuna

from sejax.cli import cluster, runtime
from sejax.errors import ConfigError, told
from sejax.search.results import ENDED
from sejax.search.settings import Search
from sejax.search.study import sentence

RETRIES = 5  # of a worker that is lost
LAST_S = 60  # for workers to notice that the study is over


def work(study: optuna.Study, search: Search, say: Callable[[str], None]) -> None:
    """Has the trials of a study made by workers on the cluster, until it is over.

    Raises:
      ConfigError: if the cluster cannot be reached or no worker can work there.
      FailedError: if the cluster is lost.
    """
    runtime.take_share_of_gpu(0)  # GPUs are the workers'
    machines = search.machines
    with cluster.connected(machines) as ray:
        start = ray.remote(
            num_cpus=1, num_gpus=machines.gpus_per_worker, max_retries=RETRIES, max_calls=1
        )(_work)
        count = max(1, cluster.num_workers(machines))
        running = [start.remote(_words(search), machines.gpus_per_worker) for _ in range(count)]
        known = {trial.number for trial in study.get_trials(deepcopy=False, states=ENDED)}
        done: list[Any] = []
        while not done:
            done, _ = ray.wait(running, timeout=cluster.LOOK_S)
            cluster.num_workers(machines)  # which raises if there is no cluster any more
            for trial in study.get_trials(deepcopy=False, states=ENDED):
                if trial.number not in known:
                    known.add(trial.number)
                    say(sentence(trial, trial.state.name.lower(), search))
        try:
            ray.get(done)
        except ray.exceptions.RayError as error:
            raise ConfigError(
                f"machines must have workers that stay, because they make the trials; one was lost "
                f"{RETRIES + 1} times ({told(error).splitlines()[-1]}). Set machines=local to see "
                f"why."
            ) from error
        ray.wait(running, num_returns=count, timeout=LAST_S)  # one that hangs is left behind


def _words(search: Search) -> list[str]:
    """The words by which a worker joins, and has what may differ between workers."""
    folder = search.folder.resolve()
    own = {
        "study": search.study,
        "search_dir": folder,
        "storage": search.config.storage or f"sqlite:///{folder / 'study.db'}",
        "trials": search.config.trials,
        "timeout": search.config.timeout,
    }
    return [f"{name}={value}" for name, value in own.items() if value is not None]


def _work(words: list[str], gpu_share: float) -> None:
    """A worker: joins the study and takes trials until there are none."""
    runtime.configure_xla(1)
    runtime.take_share_of_gpu(gpu_share)
    from sejax.search import settings, study

    runtime.configure_jax()
    found, search = study.open_study(settings.read(words))
    study.work(found, search, study.runner_of(search), lambda text: None)
