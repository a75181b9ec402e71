"""A search's workers on a cluster: those that are lost, those that hang, and when all is over.

Ray is a small fake with a clock of its own, as `dev` has it not.
"""

import dataclasses
import importlib
import sys
from types import SimpleNamespace

import pytest

optuna = pytest.importorskip("optuna", reason="needs Optuna: pip install 'sejax[search]'")

from optuna.trial import TrialState  # noqa: E402

from sejax.cli import runtime  # noqa: E402
from sejax.errors import ConfigError  # noqa: E402
from sejax.machines import scorer  # noqa: E402
from sejax.search import settings  # noqa: E402

FOREVER = float("inf")
SEARCH = settings.read(["es.noise_std=interval(0.1, 0.9)", "study=some"])


class RayError(Exception):
    pass


class WorkerCrashedError(RayError):
    pass


class Cluster:
    """Ray, and a study whose trials are made on it.

    Args:
      room: for workers.
      fate: `(worker, start) -> (end, what)`: when a worker ends, and what it returns or raises.
        Workers are numbered as they are started.
    """

    exceptions = SimpleNamespace(
        RayError=RayError,
        RayTaskError=type("RayTaskError", (RayError,), {}),
        ActorDiedError=type("ActorDiedError", (RayError,), {}),
    )

    def __init__(self, room, fate):
        self.room, self.fate, self.now = room, fate, 0.0
        self.started, self.cancelled, self.said, self.timeouts = 0, [], [], []
        self.study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
        self._ends, self._trials = {}, []  # of workers; what happens to trials, and when

    def has_trial(self, start, end, state=TrialState.COMPLETE):
        """Some worker begins a trial that ends so."""
        self._trials += [(start, self._begin, None), (end, self._end, state)]

    def _begin(self, _):
        trial = self.study.ask()
        SEARCH.space["es.noise_std"].suggest(trial)
        trial.set_user_attr("mean", 50.0)
        trial.set_user_attr("generations", 27)

    def _end(self, state):
        (trial,) = self.study.get_trials(states=(TrialState.RUNNING,))
        self.study.tell(trial.number, 50.0 if state == TrialState.COMPLETE else None, state)

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds
        assert self.now < 1e4, "the search does not end"
        due = [each for each in self._trials if each[0] <= self.now]
        for each in sorted(due, key=lambda each: each[0]):
            self._trials.remove(each)
            _, happens, state = each
            happens(state)

    # --- what is Ray's ---

    def is_initialized(self):
        return True

    def cluster_resources(self):
        return {"CPU": float(self.room), "GPU": float(self.room)}

    def remote(self, **options):
        assert options == {"num_cpus": 1, "num_gpus": 0.5, "max_retries": 0}
        return lambda function: SimpleNamespace(remote=self._start)

    def _start(self, words, gpu_share, typed):
        assert "study=some" in words and gpu_share == 0.5
        self.timeouts += [word for word in words if word.startswith("timeout=")]
        worker, self.started = self.started, self.started + 1
        self._ends[worker] = self.fate(worker, self.now)
        return worker

    def wait(self, workers, num_returns, timeout):
        end, first = min((self._ends[worker][0], worker) for worker in workers)
        self.sleep(min(timeout, max(0.0, end - self.now)))
        ready = [first] if end <= self.now else []
        return ready, [worker for worker in workers if worker not in ready]

    def get(self, worker):
        _, what = self._ends.pop(worker)
        if isinstance(what, Exception):
            raise what
        return what

    def cancel(self, worker, force):
        assert force and worker in self._ends
        self.cancelled.append(worker)


@pytest.fixture
def search(monkeypatch):
    """Searches on a cluster; no module that has seen the fake stays behind."""

    def forget():
        for package, name in [("sejax.machines", "ray_crew"), ("sejax.search", "cluster")]:
            sys.modules.pop(f"{package}.{name}", None)
            vars(importlib.import_module(package)).pop(name, None)

    def run(cluster, **fields):
        monkeypatch.setitem(sys.modules, "ray", cluster)
        searching = importlib.import_module("sejax.search.cluster")
        monkeypatch.setattr(searching, "time", cluster)
        machines = SimpleNamespace(workers=None, gpus_per_worker=0.5)
        config = dataclasses.replace(SEARCH.config, **fields)
        asked = dataclasses.replace(SEARCH, config=config, machines=machines)
        searching.work(cluster.study, asked, cluster.said.append)

    forget()
    yield run
    forget()


LOST = "A worker was lost (Lost: WorkerCrashedError: killed)."


def lost():
    return WorkerCrashedError("killed")


def test_every_trial_is_told_of_and_workers_end_by_themselves(search):
    cluster = Cluster(2, lambda worker, start: (5.0 + worker, None))
    cluster.has_trial(1.0, 2.5)
    cluster.has_trial(3.0, 4.5, TrialState.PRUNED)
    search(cluster)
    told = [text.partition(", es")[0].partition(": es")[0] for text in cluster.said]
    assert told == ["trial 0: 50, complete at generation 27/27",
                    "trial 1: 50, pruned at generation 27/27"]  # fmt: skip
    assert (cluster.now, cluster.started, cluster.cancelled) == (6.0, 2, [])


def test_workers_that_go_with_their_node_are_one_loss(search):
    cluster = Cluster(40, lambda worker, start: (10.0, lost()) if worker < 10 else (60.0, None))
    search(cluster)
    assert cluster.said == [LOST] * 10
    assert (cluster.now, cluster.started, cluster.cancelled) == (60.0, 50, [])


def test_losses_between_which_trials_end_do_not_add_up(search):
    def fate(worker, start):
        return (start + 100.0, lost()) if worker < 20 else (start + 100.0, None)

    cluster = Cluster(1, fate)
    for loss in range(1, 6):
        cluster.has_trial(400.0 * loss - 70.0, 400.0 * loss - 50.0)  # four in a row at most
    search(cluster)
    assert cluster.said.count(LOST) == 20 and cluster.started == 21


def test_five_losses_in_a_row_are_no_accident(search):
    cluster = Cluster(2, lambda worker, start: (start + 3.0 + worker, lost()))
    with pytest.raises(
        ConfigError,
        match=r"^machines must have workers that stay, because they make the trials; got 5 lost "
        r"in a row, the last by Lost: WorkerCrashedError: killed\. Set machines=local to see why",
    ):
        search(cluster)
    assert set(cluster.said) == {LOST}
    assert cluster.cancelled  # the other one does not stay on somebody else's cluster


def test_an_error_of_a_worker_is_told(search):
    error = Cluster.exceptions.RayTaskError()
    error.cause = OSError(28, "No space left on device")
    cluster = Cluster(1, lambda worker, start: (start + 1.0, None if worker else error))
    search(cluster)
    assert cluster.said == ["A worker was lost (OSError: [Errno 28] No space left on device)."]


def test_a_worker_that_hangs_after_the_study_is_ended(search):
    cluster = Cluster(2, lambda worker, start: (5.0, None) if worker else (FOREVER, None))
    search(cluster)
    assert cluster.said == [
        "The study is over; workers that have not noticed in 10 s are ended: 1."
    ]
    assert (cluster.now, cluster.cancelled) == (15.0, [0])


@pytest.mark.parametrize(
    ("state", "seconds", "hanging"),
    [(TrialState.COMPLETE, 62.0, []), (TrialState.FAIL, 70.0, [0])],
    ids=["works", "hangs"],
)
def test_a_trial_at_hand_after_the_time_is_waited_for(search, state, seconds, hanging):
    """Until it ends, or its heartbeats do, by which it counts as failed."""
    end = 62.0 if state == TrialState.COMPLETE else FOREVER
    cluster = Cluster(2, lambda worker, start: (5.0 if worker else end, None))
    cluster.has_trial(1.0, 61.0, state)
    search(cluster)
    assert (cluster.now, cluster.cancelled) == (seconds, hanging)


def test_a_worker_that_is_lost_after_the_study_is_not_missed(search):
    def fate(worker, start):
        return (10.0, None) if worker == 0 else (start + 1.0 if worker < 5 else 11.0, lost())

    cluster = Cluster(2, fate)
    search(cluster)
    assert cluster.said == [LOST] * 5
    assert (cluster.now, cluster.started, cluster.cancelled) == (11.0, 6, [])


def test_a_worker_in_anothers_place_has_the_time_that_is_left(search):
    cluster = Cluster(1, lambda worker, start: (FOREVER, None) if worker else (40.0, lost()))
    search(cluster, timeout=100.0)
    assert cluster.timeouts == ["timeout=100.0", "timeout=60.0"]
    assert (cluster.now, cluster.started, cluster.cancelled) == (110.0, 2, [1])


def test_workers_keep_to_their_share_of_a_gpu_and_the_driver_to_the_cpu(search, monkeypatch):
    class Told(Exception):
        pass

    taken, actors = [], []

    def take(share):
        taken.append(share)
        if share:
            raise Told

    def remote(**options):
        def start(*arguments):
            actors.append((options["num_gpus"], scorer.Scorer(*arguments)))
            return SimpleNamespace(prepare=SimpleNamespace(remote=lambda: len(actors)))

        return lambda function: SimpleNamespace(remote=start)

    monkeypatch.setattr(runtime, "take_share_of_gpu", take)
    cluster = Cluster(1, lambda worker, start: (5.0, None))
    search(cluster)
    assert taken == [0]  # of the search's driver
    with pytest.raises(Told):
        importlib.import_module("sejax.search.cluster")._work(["study=some"], 0.5, [])
    cluster.remote = remote
    crew = importlib.import_module("sejax.machines.ray_crew").RayCrew(
        SimpleNamespace(workers=1, gpus_per_worker=0.5), {}, (4,)
    )
    crew.recruit()
    ((num_gpus, worker),) = actors
    with pytest.raises(Told):
        worker.prepare()
    assert num_gpus == 0.5 and taken == [0, 0.5, 0.5]
