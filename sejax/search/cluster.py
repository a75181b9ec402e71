"""A study whose workers are processes on a Ray cluster.

They share nothing but the study's database, as any workers do: Ray starts them where there is room.
Another is started in the place of one that is lost, and one that hangs is ended after the study.
"""

import contextlib
import time
from collections.abc import Callable
from typing import Any

import optuna
import ray
from optuna.trial import TrialState

from sejax import registry
from sejax.cli import runtime
from sejax.errors import require, told
from sejax.machines import ray_crew
from sejax.machines.handout import LOOK_S, MOST_FAILURES
from sejax.search.results import ENDED
from sejax.search.settings import Search
from sejax.search.study import begin_heartbeats, fail_stale, sentence

LAST_LOOKS = 10  # after the study, at workers that look each second whether it is over


def work(study: optuna.Study, search: Search, say: Callable[[str], None]) -> None:
    """Has the trials of a study made by workers on the cluster, until it is over.

    Raises:
      ConfigError: if the cluster cannot be reached or no worker can work there.
      KeyboardInterrupt: the trials at hand are queued again once their heartbeats have ended.
    """
    runtime.take_share_of_gpu(0)  # all of them are the workers'
    with ray_crew.connected():
        ray_crew.require_workers(search.machines)
        with contextlib.closing(_Workers(search)) as workers:
            _attend(study, search, workers, say)


class _Workers:
    """Workers on the cluster.

    Attributes:
      failures: losses in succession; workers that go together, as with their node, are one.
    """

    def __init__(self, search: Search):
        self._search = search
        self._start = ray.remote(
            num_cpus=1, num_gpus=search.machines.gpus_per_worker, max_retries=0
        )(_work)
        self._started_at = time.monotonic()
        self._running: dict[Any, int] = {}  # each with the losses when it was started
        self._losses = 0
        self.failures = 0

    def __len__(self) -> int:
        return len(self._running)

    @property
    def timeout(self) -> float | None:
        """Seconds that are left in which trials may begin; None for any number of them."""
        whole = self._search.config.timeout
        return None if whole is None else whole - (time.monotonic() - self._started_at)

    def recruit(self) -> None:
        """Starts workers where there is room."""
        words, search = _words(self._search, self.timeout), self._search
        typed = [*search.fixed, *(x.text for x in search.space.values())]
        for _ in range(ray_crew.num_workers(self._search.machines) - len(self)):
            started = self._start.remote(words, search.machines.gpus_per_worker, typed)
            self._running[started] = self._losses

    def wait(self) -> list[Any]:
        """Waits until a worker ends, or for a while.

        Returns:
          What it returned, or the exception by which it failed or was lost; empty if none ended.
        """
        if not self._running:
            time.sleep(LOOK_S)
            return []
        ready, _ = ray.wait(list(self._running), num_returns=1, timeout=LOOK_S)
        came = []
        for worker in ready:
            losses_before = self._running.pop(worker)
            came.append(ray_crew.result_of(worker))
            # Those that were there at the last loss may have gone with the same node.
            if isinstance(came[-1], Exception) and losses_before == self._losses:
                self._losses += 1
                self.failures += 1
        return came

    def close(self) -> None:
        """Ends workers, whatever they do."""
        for worker in self._running:
            ray.cancel(worker, force=True)


def _attend(
    study: optuna.Study, search: Search, workers: _Workers, say: Callable[[str], None]
) -> None:
    """Keeps workers at a study until it is over and they have ended, or all but those that hang."""
    told_of = {trial.number for trial in study.get_trials(deepcopy=False, states=ENDED)}
    is_over, last_looks = False, 0
    while not is_over or len(workers):
        is_late = workers.timeout is not None and workers.timeout <= 0
        if not is_over and not is_late:
            workers.recruit()
        came = workers.wait()
        for trial in study.get_trials(deepcopy=False, states=ENDED):
            if trial.number not in told_of:
                told_of.add(trial.number)
                say(sentence(trial, trial.state.name.lower(), search))
                workers.failures = 0
        for error in (each for each in came if isinstance(each, Exception)):
            say(f"A worker was lost ({told(error)}).")
            require(
                is_over or workers.failures < MOST_FAILURES,
                "machines",
                "have workers that stay",
                "they make the trials",
                f"{workers.failures} lost in a row, the last by {told(error)}",
                "machines=local to see why",
            )
        if not is_over and (is_late or any(not isinstance(each, Exception) for each in came)):
            is_over = True  # or the time is, and trials that others have begun go on
            begin_heartbeats(study)
        if is_over:
            fail_stale(study)
            is_anyone_busy = study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
            last_looks = 0 if is_anyone_busy else last_looks + (not came)
        if last_looks == LAST_LOOKS:
            say(
                f"The study is over; workers that have not noticed in {LAST_LOOKS * LOOK_S:.0f} s "
                f"are ended: {len(workers)}."
            )
            return


def _words(search: Search, timeout: float | None) -> list[str]:
    """The words by which a worker joins, and has what may differ between workers."""
    folder = search.folder.resolve()
    own = {
        "study": search.study,
        "search_dir": folder,
        "storage": search.config.storage or f"sqlite:///{folder / 'study.db'}",
        "trials": search.config.trials,
        "timeout": timeout,
    }
    return [f"{name}={value}" for name, value in own.items() if value is not None]


def _work(words: list[str], gpu_share: float, typed: list[str]) -> None:
    """A worker: joins the study and takes trials until there are none.

    Args:
      words: of its command.
      gpu_share: of a GPU.
      typed: words of the search, as the driver has read them: what they name may be imported.
    """
    runtime.configure_xla(1)
    runtime.take_share_of_gpu(gpu_share)
    from sejax.search import settings, study

    runtime.configure_jax()
    with registry.only_typed(typed):
        found, search = study.open_study(settings.read(words))
        study.work(found, search, study.runner_of(search), lambda text: None)
