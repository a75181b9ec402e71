"""A study whose workers are processes on a Ray cluster.

They share nothing but the study's database, as any workers do: Ray starts them where there is room,
and another in the place of one that is lost.
"""

import time
from collections.abc import Callable
from typing import Any

import optuna
import ray

from sejax.errors import require, told
from sejax.machines import ray_crew
from sejax.machines.handout import LOOK_S, MOST_FAILURES
from sejax.search.results import ENDED
from sejax.search.settings import Search
from sejax.search.study import sentence


def work(study: optuna.Study, search: Search, say: Callable[[str], None]) -> None:
    """Has the trials of a study made by workers on the cluster, until it is over.

    Raises:
      ConfigError: if the cluster cannot be reached or no worker can work there.
      KeyboardInterrupt: the trials at hand are queued again once their heartbeats have ended.
    """
    machines = search.machines
    with ray_crew.connected():
        ray_crew.require_workers(machines)
        start = ray.remote(num_cpus=1, num_gpus=machines.gpus_per_worker, max_retries=0)(_work)
        running: list[Any] = []
        failures, is_over = 0, False
        told_of = {trial.number for trial in study.get_trials(deepcopy=False, states=ENDED)}
        while running or not is_over:
            room = ray_crew.num_workers(machines) if not is_over else 0
            running += [start.remote(_words(search)) for _ in range(room - len(running))]
            if not running:
                time.sleep(LOOK_S)
                continue
            ready, running = ray.wait(running, num_returns=1, timeout=LOOK_S)
            for trial in study.get_trials(deepcopy=False, states=ENDED):
                if trial.number not in told_of:
                    told_of.add(trial.number)
                    say(sentence(trial, trial.state.name.lower(), search))
            for each in ready:
                came = ray_crew.result_of(each)
                is_over = is_over or not isinstance(came, Exception)
                failures = failures + 1 if isinstance(came, Exception) else 0
                if isinstance(came, Exception):
                    say(f"A worker was lost ({told(came)}).")
                    require(failures < MOST_FAILURES, "machines", "have workers that stay", "they "
                            "make the trials", f"{failures} lost in a row, the last by "
                            f"{told(came)}", "machines=local to see why")  # fmt: skip


def _words(search: Search) -> list[str]:
    """The words by which a worker joins, and has what may differ between workers."""
    folder = search.folder.resolve()
    own = {"study": search.study, "search_dir": folder,
           "storage": search.config.storage or f"sqlite:///{folder / 'study.db'}",
           "trials": search.config.trials, "timeout": search.config.timeout}  # fmt: skip
    return [f"{name}={value}" for name, value in own.items() if value is not None]


def _work(words: list[str]) -> None:
    """A worker: joins the study and takes trials until there are none."""
    from sejax.app import runtime

    runtime.configure_xla(1)
    from sejax.search import settings, study

    runtime.enable_compilation_cache()
    found, search = study.open_study(settings.read(words))
    study.work(found, search, study.runner_of(search), lambda text: None)
