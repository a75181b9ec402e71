"""Workers that die, hang, come and go, on a clock of the test's own and without Ray."""

import itertools
import os
import random
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import ROOM, bits, printed, refusal, refused

import sejax
from sejax.bilevel import make_bilevel
from sejax.options import FailedError
from sejax.runs import cluster, runtime, session, workers
from sejax.runs import config as configuration
from sejax.runs.cluster import Pool
from sejax.runs.workers import Batch, RemoteChunks, cut

FOREVER = 1e9


class Ray:
    """The three functions of Ray that a pool uses, and workers whose answers are planned.

    `fate(worker, turn)` says how many seconds what a worker does takes and how it ends: None for
    an answer, or an exception. Turn 0 is the start.
    """

    def __init__(self, room=2, fate=lambda worker, turn: (1.0, None)):
        self.room, self.fate, self.now = room, fate, 0.0
        self.started, self.killed, self.said = 0, [], []
        self.due = {}
        self.references = itertools.count()

    def pool(self, make=lambda: None):
        """A pool of workers that return what `make()` evaluates, or the share and their number."""
        return Pool(
            self, lambda: Worker(self, make()), lambda: self.room, self.said.append, self.clock
        )

    def clock(self):
        return self.now

    def wait(self, references, num_returns, timeout):
        ends = sorted(self.due[reference][0] for reference in references)
        self.now = max(self.now, min(ends[num_returns - 1], self.now + timeout))
        done = [each for each in references if self.due[each][0] <= self.now]
        return done[:num_returns], [each for each in references if each not in done]

    def get(self, reference):
        _, answer = self.due.pop(reference)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def kill(self, worker):
        self.killed.append(worker.number)


class Worker:
    """An actor's handle."""

    def __init__(self, ray, real):
        ray.started += 1
        self.ray, self.real = ray, real
        self.number, self.turns = ray.started, itertools.count()
        self.ready = self.evaluate = self

    def remote(self, share=None):
        seconds, error = self.ray.fate(self.number, next(self.turns))
        answer = share, self.number
        if self.real is not None:
            answer = None if share is None else self.real.evaluate(share)
        reference = next(self.ray.references)
        self.ray.due[reference] = self.ray.now + seconds, error or answer
        return reference


def evaluated(pool, num_shares):
    """The workers that evaluated a generation, which must be whole and in order."""
    answers = pool.map(list(range(num_shares)))
    assert [share for share, _ in answers] == list(range(num_shares))
    return [worker for _, worker in answers]


def test_shares_make_up_all_places_in_whole_batches_and_shrink():
    shares = list(cut(np.arange(100), Batch(capacity=16, width=4), num_workers=2))
    assert list(np.concatenate(shares)) == list(range(100))
    assert [len(share) for share in shares] == [16, 16, 16, 16, 12, 8, 4, 4, 4, 4]


def test_a_generation_is_divided_among_all_workers():
    ray = Ray(room=3)
    assert sorted(evaluated(ray.pool(), 6)) == [1, 1, 2, 2, 3, 3]
    assert ray.now == pytest.approx(3.0)  # the start and two shares each


def test_a_worker_that_hangs_is_given_up_and_its_share_sent_to_another():
    ray = Ray(fate=lambda *turn: (FOREVER if turn == (1, 2) else 1.0, None))
    evaluated(ray.pool(), 4)
    assert ray.killed == [1]
    assert cluster.LEAST_S < ray.now < cluster.LEAST_S + 10


def test_a_training_that_takes_far_longer_than_all_before_ends_in_the_end():
    ray = Ray(room=1, fate=lambda worker, turn: (100.0 if turn == 2 or worker > 1 else 1.0, None))
    evaluated(ray.pool(), 2)
    assert 1 <= len(ray.killed) < 5


def test_the_first_share_may_take_long():
    ray = Ray(room=1, fate=lambda worker, turn: (3000.0 if turn == 1 else 1.0, None))
    evaluated(ray.pool(), 2)
    assert not ray.killed


@pytest.mark.parametrize("turn", [0, 1])
def test_a_worker_that_fails_ends_the_run(turn):
    told = OSError("ray::Worker.evaluate()\n  File worker.py\nOSError: no space\n")
    ray = Ray(fate=lambda worker, now: (1.0, told if now == turn else None))
    with pytest.raises(FailedError, match="failed: OSError: no space"):
        evaluated(ray.pool(), 2)


def test_machines_join_while_a_generation_runs():
    ray = Ray(room=1)

    def fate(worker, turn):
        ray.room = 3 if ray.now > 5 else 1
        return 1.0, None

    ray.fate = fate
    assert set(evaluated(ray.pool(), 20)) == {1, 2, 3}
    assert ray.now < 15


def test_the_user_is_told_once_while_no_worker_is_ready():
    ray = Ray(fate=lambda worker, turn: (70.0, None))
    evaluated(ray.pool(), 2)
    assert len(ray.said) == 1 and "None of 2 workers" in ray.said[0]


def test_a_pool_ends_its_workers():
    ray = Ray(room=3)
    pool = ray.pool()
    evaluated(pool, 1)
    pool.close()
    assert sorted(ray.killed) == [1, 2, 3]


@settings(max_examples=20)
@given(st.integers(0, 2**32))
def test_generations_are_whole_whatever_workers_do(seed):
    rng = random.Random(seed)

    def fate(worker, turn):
        return rng.choice([0.5, 1.0, 3.0]) if rng.random() < 0.8 else FOREVER, None

    ray = Ray(room=rng.randint(1, 6), fate=fate)
    pool = ray.pool()
    for _ in range(3):
        evaluated(pool, rng.randint(1, 40))
        ray.room = rng.randint(1, 6)


# --- the numbers of a single process -------------------------------------------------------------


def remote_chunks(config, ray):
    """The generations of a run on workers of a planned cluster."""
    learner = make_bilevel(**config.parts() | {"devices": 1})
    size = len(learner.evaluate.sizes)
    arguments = configuration.plain(config), [5] * size, 0.0, runtime.versions()
    pool = ray.pool(lambda: workers.Worker(*arguments))
    return RemoteChunks(learner, pool, [Batch(capacity=5, width=1)] * size)


def require_equal_numbers(words, generations):
    """Runs generations in one program and by workers, the first of which soon hangs."""
    ray = Ray(fate=lambda *turn: (FOREVER if turn == (1, 2) else 1.0, None))
    remote = remote_chunks(sejax.config(words), ray)
    local = session.Chunks(remote.learner)
    key = jax.random.key(0)
    state, other = local.init(key), remote.init(key)
    for _ in range(generations):
        state, info = local.advance(state, 1)
        other, other_info = remote.advance(other, 1)
        assert bits((state, info)) == bits((other, other_info))
    assert ray.killed == [1]
    return state


SOLVING = [*ROOM, "es.population_size=4", "stop_when_solved=true"]
TINY = [*SOLVING, "agent.learning_rate=0.5"]


def test_workers_give_the_numbers_of_one_process_to_the_last_bit():
    state = require_equal_numbers(TINY, 4)
    assert bool(state.solved)  # so that nothing was computed in some of them


CASES = {
    "mixture": [*SOLVING, "agents=[q_learning,sarsa]"],
    "batches": ["env=cartpole", "es.population_size=4"],
    "curriculum": [
        *("env=pendulum", "es.population_size=4", "training.max_steps=200"),
        *("training.max_episodes=200", "objective.first_eval_steps=50"),
    ],
    "evosax": ["env=cliff_walking", "proxy=rn", "es=cma_es", "es.population_size=8"],
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_so_they_do_with_the_flags_of_a_command(case):
    program = (
        "from sejax.runs import runtime; runtime.configure_xla(1)\n"
        "import sys, test_workers\n"
        "test_workers.require_equal_numbers(sys.argv[1:], 3)"
    )
    environment = {name: x for name, x in os.environ.items() if name != "XLA_FLAGS"}
    folder = Path(__file__).parent
    printed(sys.executable, "-c", program, *CASES[case], env=environment, cwd=folder)


def test_a_worker_with_other_versions_is_refused():
    config = sejax.config(TINY)
    expected = runtime.versions() | {"jax": "0.1"}
    error = refusal(workers.Worker, configuration.plain(config), [5], 0.0, expected)
    assert error.field == "machines" and "0.1" in str(error)


# --- the command ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "field"),
    [
        (["devices=2"], "devices"),
        (["machines.workers=0"], "machines.workers"),
        (["machines.gpus_per_worker=2"], "machines.gpus_per_worker"),
    ],
)
def test_settings_that_no_worker_can_have_are_refused(words, field, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: "there")
    assert refused(sejax.config, ["machines=ray", *words]) == field
