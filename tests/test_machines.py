"""Trainings that are handed out: workers that die, hang, lie, come and go, and the same numbers."""

import itertools
import os
import random
import re
import subprocess
import sys
from pathlib import Path
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sejax
from sejax.bilevel import make_program
from sejax.cli import session
from sejax.errors import ConfigError, FailedError
from sejax.machines import handout, ledger, scorer
from sejax.machines.chunks import RemoteChunks, problem
from sejax.machines.handout import HandOut, Lost
from sejax.machines.scorer import About, Scored, Work
from sejax.objectives import Outcome

FOREVER = float("inf")


def outcome_of(places):
    """What comes of these trials."""
    places = np.asarray(places)
    counts = places.astype(np.int32)
    returns = np.float32(places[:, None] + np.array([0.25, 0.5]))
    return vars(Outcome(
        test_returns=returns, scored_returns=returns + 1, train_steps=counts + 100,
        train_episodes=counts + 1, auc=returns[:, 0], nonfinite=places % 7 == 3,
        real_steps=counts,
    ))  # fmt: skip


SHAPES = Outcome(**{name: x[None] for name, x in outcome_of(range(1)).items()})


class Crew:
    """Workers on a clock of their own, whose fates are told.

    Args:
      room: for workers.
      fate: `(worker, turn) -> (seconds, what)` that a worker's turn takes, and what comes of it:
        None for the answer, an exception, or a function of the answer. Turn 0 is its start.
    """

    def __init__(self, room=2, fate=lambda worker, turn: (1.0, None)):
        self.now, self.room, self.fate = 0.0, room, fate
        self.turns, self.due, self.dead = {}, {}, set()
        self.sent, self.dismissed, self.said = [], [], []
        self._numbers = itertools.count(1)

    def clock(self):
        return self.now

    def recruit(self):
        new = list(itertools.islice(self._numbers, max(0, self.room - len(self.turns))))
        for worker in new:
            self.turns[worker] = 0
            self._begin(worker, About(f"node{worker}", worker, 0.5))
        return new

    def send(self, worker, work):
        self.sent.append((self.now, worker, work.keys[:, 0]))
        answer = Scored(outcome_of(work.keys[:, 0]), 0.9, 0.8)
        self._begin(worker, answer)

    def _begin(self, worker, answer):
        assert worker not in self.due, "one thing at a time"
        seconds, what = self.fate(worker, self.turns[worker])
        self.turns[worker] += 1
        if worker in self.dead:
            seconds, what = 0.1, Lost("its node is gone")
        self.due[worker] = (self.now + seconds, what(answer) if callable(what) else what or answer)

    def leave(self, *workers):
        """They are gone; nobody hears of it before they have something to do."""
        self.dead |= set(workers)
        for worker in self.due.keys() & set(workers):
            self.due[worker] = (self.now + 0.1, Lost("its node is gone"))

    def wait(self, timeout_s):
        assert self.now < 1e6, "it does not end"
        first = min((at for at, _ in self.due.values()), default=FOREVER)
        self.now = min(self.now + timeout_s, max(self.now, first))
        came = [worker for worker, (at, _) in self.due.items() if at <= self.now]
        return [(worker, self.due.pop(worker)[1]) for worker in came]

    def dismiss(self, worker):
        self.dismissed.append(worker)
        self.turns.pop(worker)
        self.due.pop(worker, None)


def hand_out_of(crew, capacities=(16,), num_parallel=(1,), **options):
    return HandOut(
        crew, capacities, num_parallel, say=crew.said.append, clock=crew.clock, **options
    )


def score(hand_out, *sizes):
    """Scores a generation of families of so many trials; returns its shares, and who did what."""
    ends = np.cumsum(sizes)
    families = [np.arange(end - size, end) for size, end in zip(sizes, ends, strict=True)]

    def work_of(share):
        n = len(share.places)
        return Work(share.family, share.places[:, None].astype(np.uint32),
                    np.zeros((n, 3), np.float32), np.ones(n, bool), None)  # fmt: skip

    outcomes, done = hand_out.score(
        families, work_of, lambda share, came: problem(came, SHAPES, len(share.places))
    )
    places = np.concatenate([share.places for share, _ in outcomes])
    assert sorted(places) == list(range(ends[-1]))
    for share, outcome in outcomes:
        assert set(share.places) <= set(families[share.family])
        for name, x in outcome_of(share.places).items():
            np.testing.assert_array_equal(outcome[name], x)
    assert sum(each.trainings for each in done.values()) == ends[-1]
    return [share for share, _ in outcomes], done


# --- shares --------------------------------------------------------------------------------------


def test_shares_shrink_and_make_up_all_trials_of_each_family():
    crew = Crew(room=2)
    shares, done = score(hand_out_of(crew, (16, 4), (1, 1)), 100, 10)
    sizes = [len(keys) for *_, keys in crew.sent]
    assert sizes == [16, 16, 16, 13, 10, 8, 6, 4, 3, 2, 2, 1, 1, 1, 1, 3, 2, 2, 1, 1, 1]
    assert [share.family for share in shares].count(1) == 6
    assert crew.now == pytest.approx(1 + 11)  # the start, and 21 shares by two workers
    assert done.keys() == {1, 2}


def test_shares_of_agents_in_lockstep_are_whole():
    crew = Crew(room=3)
    score(hand_out_of(crew, (16,), (16,)), 40)
    assert [len(keys) for *_, keys in crew.sent] == [16, 16, 8]


def test_what_a_worker_did_is_counted(tmp_path):
    hand_out = hand_out_of(Crew(room=1))
    _, done = score(hand_out, 20)
    each = done[1]
    assert (each.trainings, each.lost) == (20, 0)
    assert each.train_steps == sum(range(20)) + 20 * 100
    assert each.busy_s == pytest.approx(0.9 * each.shares)
    assert each.cpu_s == pytest.approx(0.8 * each.shares)
    assert each.bytes_out == 20 * (4 + 12 + 1) and each.bytes_in == 20 * (8 + 8 + 4 + 4 + 4 + 1 + 4)
    log = ledger.Ledger(tmp_path)
    for generation in range(2):
        log.write(generation, 1.23456, {1: hand_out.about(1)}, done)
    lines = (tmp_path / "machines.csv").read_text().splitlines()
    assert lines[0].split(",") == list(ledger.COLUMNS) and len(lines) == 3
    assert lines[2].startswith("1,1.235,node1,1,") and lines[2].endswith(",0")


# --- workers that fail ---------------------------------------------------------------------------


def changed(**changes):
    """An answer whose leaves of these names are others."""

    def lie(answer):
        others = {name: change(answer.outcome[name]) for name, change in changes.items()}
        return Scored(answer.outcome | others, answer.seconds, answer.cpu_s)

    return lie


FAULTS = {
    "gone": Lost("killed"),
    "raises": ValueError("bad instruction"),
    "nothing": lambda answer: "done",
    "no outcome": lambda answer: Scored({}, 1.0, 1.0),
    "too few": changed(train_steps=lambda x: x[:-1]),
    "other type": changed(train_steps=lambda x: x.astype(np.int64)),
    "no array": changed(auc=list),
    "negative counts": changed(real_steps=lambda x: x - 1000),
    "nan of a sound agent": changed(
        test_returns=lambda x: x + np.float32(np.nan), nonfinite=np.zeros_like
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_the_share_of_a_worker_that_fails_is_given_to_others(fault):
    bad = {(1, 2): (1.0, FAULTS[fault])}
    crew = Crew(room=2, fate=lambda *turn: bad.get(turn, (1.0, None)))
    hand_out = hand_out_of(crew)
    _, done = score(hand_out, 100)
    assert crew.dismissed == [1]
    assert done[1].lost == 1 and done[1].shares == 1
    assert done[2].lost == 0
    assert done[3].shares > 0  # somebody else was started in its place
    _, done = score(hand_out, 100)
    assert done.keys() == {2, 3}


def test_numbers_that_are_not_finite_are_believed_of_agents_that_diverged():
    outcome = outcome_of([3, 10])  # both diverge
    outcome["test_returns"] = np.full((2, 2), np.nan, np.float32)
    assert problem(Scored(outcome, 1, 1), SHAPES, 2) is None


def test_a_share_that_hangs_is_copied_by_an_idle_worker_and_its_worker_given_up_later():
    bad = {(1, 3): (FOREVER, None)}
    crew = Crew(room=2, fate=lambda *turn: bad.get(turn, (1.0, None)))
    hand_out = hand_out_of(crew, (1,), (1,))
    score(hand_out, 4)  # the first three turns of both, with the start
    before = crew.now
    _, done = score(hand_out, 4)
    assert done[2].shares == 4 and done[1].shares == 0
    assert crew.now - before < handout.COPIED_AFTER + 4 < handout.LEAST_S
    assert not crew.dismissed
    for _ in range(10):
        score(hand_out, 4)
    assert crew.dismissed == [1] and crew.now - before > handout.LEAST_S
    _, done = score(hand_out, 4)
    assert done.keys() == {2, 3}


def test_the_first_answer_counts_and_a_late_one_is_dropped():
    late = {(1, 3): (9.5, None)}
    crew = Crew(room=2, fate=lambda *turn: late.get(turn, (1.0, None)))
    hand_out = hand_out_of(crew, (1,), (1,))
    score(hand_out, 4)
    score(hand_out, 4)
    _, done = score(hand_out, 16)  # the answer comes in this one
    assert done[1].lost == 1 and done[1].shares > 0
    assert not crew.dismissed


def test_nobody_has_more_than_one_copy_of_a_share_at_a_time():
    bad = {(1, 3): (FOREVER, None)}
    crew = Crew(room=4, fate=lambda worker, turn: bad.get((worker, turn), (worker, None)))
    hand_out = hand_out_of(crew, (1,), (1,))
    for _ in range(6):
        score(hand_out, 8)
    copies = [tuple(keys) for at, worker, keys in crew.sent if worker == 1][-1]
    assert copies is not None
    times = sorted(at for at, _, keys in crew.sent if tuple(keys) == copies)
    assert len(times) == 6 + 1


def test_trainings_that_take_far_longer_than_those_before_are_let_end():
    # 100 seconds where there was one: given up after 20, 40 and 80 seconds, then waited for.
    crew = Crew(room=1, fate=lambda worker, turn: (100.0 if worker > 1 or turn > 3 else 1.0, None))
    hand_out = hand_out_of(crew, (1,), (1,))
    score(hand_out, 3)
    _, done = score(hand_out, 1)
    assert len(crew.dismissed) == 3 and done[4].shares == 1


def test_a_worker_may_take_long_while_nobody_knows_how_long_it_takes():
    crew = Crew(room=1, fate=lambda worker, turn: (500.0 if worker == 1 else 1.0, None))
    score(hand_out_of(crew), 1)
    assert not crew.dismissed
    crew = Crew(room=1, fate=lambda worker, turn: (500.0 if worker == 1 else 1.0, None))
    score(hand_out_of(crew, patience_s=100.0), 1)
    assert crew.dismissed == [1] and 100 < crew.now < 110


def test_a_share_that_fails_everywhere_ends_the_run():
    def fate(worker, turn):
        return 1.0, ValueError("no such instruction") if turn else None

    with pytest.raises(
        FailedError,
        match=r"^5 workers have failed at the same 1 trainings, the last one so: "
        r"ValueError: no such instruction\. The generations .* with machines=local goes on",
    ):
        score(hand_out_of(Crew(fate=fate)), 1)  # fmt: skip


def test_a_share_that_kills_its_workers_ends_the_run():
    crew = Crew(fate=lambda worker, turn: (1.0, Lost("killed") if turn else None))
    with pytest.raises(FailedError, match=r"Lost: killed\."):
        score(hand_out_of(crew), 1)


# --- machines that come and go -------------------------------------------------------------------


def test_machines_join_within_and_between_generations():
    crew = Crew(room=1)
    hand_out = hand_out_of(crew, (1,), (1,))
    plain = crew.wait

    def wait(timeout_s):
        crew.room = 3 if crew.now >= 5 else 1
        return plain(timeout_s)

    crew.wait = wait
    _, done = score(hand_out, 20)
    assert done.keys() == {1, 2, 3} and crew.now < 14
    crew.wait, crew.room = plain, 4
    crew.now += 10
    _, done = score(hand_out, 20)
    assert done.keys() == {1, 2, 3, 4}


def test_many_workers_of_one_node_may_go_while_they_are_idle():
    crew = Crew(room=40)
    hand_out = hand_out_of(crew, (16,), (16,))
    score(hand_out, 40 * 16)
    crew.leave(*range(1, 38))
    shares, _ = score(hand_out, 48)  # three shares, each of which is sent to many that are gone
    assert len(shares) == 3
    assert set(crew.dismissed) <= set(range(1, 38))


def test_many_workers_of_one_node_may_go_while_they_start():
    crew = Crew(room=40)
    hand_out = hand_out_of(crew)
    hand_out.start()
    crew.leave(*range(1, 41))
    hand_out.get_ready()
    assert crew.dismissed == list(range(1, 41))


def test_without_any_machine_somebody_is_told_and_it_is_waited_for():
    crew = Crew(room=0)
    plain = crew.wait

    def wait(timeout_s):
        crew.room = int(crew.now > 100)
        return plain(timeout_s)

    crew.wait = wait
    hand_out_of(crew).get_ready()
    assert crew.said == ["No machine has room for a worker; waiting for one."] * 3
    assert crew.now == pytest.approx(102, abs=2)


def test_while_no_worker_is_ready_somebody_is_told():
    crew = Crew(room=2, fate=lambda worker, turn: (70.0, None))
    hand_out_of(crew).get_ready()
    told = "None of 2 workers is ready yet: they compile, or other jobs hold what they need"
    assert [text.partition(" (")[0] for text in crew.said] == [told] * 2


def test_workers_that_never_get_ready_end_the_run():
    crew = Crew(room=3, fate=lambda worker, turn: (1.0, OSError("no space")))
    with pytest.raises(
        ConfigError,
        match=r"machines must have workers that get ready.*the last 5 "
        r"did not: OSError: no space\. Install",
    ):
        hand_out_of(crew).get_ready()  # fmt: skip
    crew = Crew(room=3, fate=lambda worker, turn: (1.0, ConfigError("other versions")))
    with pytest.raises(ConfigError, match=r"^other versions$"):
        hand_out_of(crew).get_ready()
    assert crew.dismissed == [1, 2, 3]


def test_a_machine_with_other_versions_ends_no_run_that_others_get_ready_for():
    def fate(worker, turn):
        return (1.0, ConfigError("other versions")) if worker == 1 else (30.0, None)

    crew = Crew(room=3, fate=fate)
    hand_out = hand_out_of(crew)
    hand_out.get_ready()
    assert 1 in crew.dismissed
    _, done = score(hand_out, 100)
    assert done and 1 not in done


def test_workers_that_do_not_get_ready_are_given_up_where_others_are():
    def fate(worker, turn):
        return (1.0, None) if worker == 1 else (1.5, OSError("no space"))

    crew = Crew(room=2, fate=fate)
    hand_out = hand_out_of(crew)
    _, done = score(hand_out, 100)
    for _ in range(5):
        score(hand_out, 100)
    assert done.keys() == {1}
    assert crew.said == ["No more workers are started, as the last 5 did not get ready (OSError: "
                         "no space)."]  # fmt: skip
    crew.leave(1)  # now there is nobody: one more try, and a word instead of waiting without end
    with pytest.raises(ConfigError, match="no space"):
        score(hand_out, 100)


@settings(max_examples=10)
@given(st.integers(0, 2**32))
def test_whatever_workers_do_generations_are_whole_and_right(seed):
    rng = random.Random(seed)

    def fate(worker, turn):
        if rng.random() < 0.9:
            return rng.choice([0.5, 1.0, 1.0, 3.0, 9.0]), None
        if turn == 0:
            return 1.0, rng.choice([None, Lost("killed"), OSError("no space")])
        fault = rng.choice([*FAULTS, "hangs"])
        if fault == "hangs":
            return FOREVER, None
        return rng.choice([0.0, 1.0, 30.0]), FAULTS[fault]

    crew = Crew(room=rng.randint(1, 6), fate=fate)
    families = [rng.randint(1, 40) for _ in range(rng.randint(1, 3))]
    capacities = [rng.randint(1, 16) for _ in families]
    num_parallel = [rng.choice([1, capacity]) for capacity in capacities]
    hand_out = hand_out_of(crew, capacities, num_parallel, patience_s=60.0)
    plain = crew.wait

    def wait(timeout_s):
        if rng.random() < 0.1:
            crew.room = rng.randint(0, 6)
        if rng.random() < 0.02:
            crew.leave(*list(crew.turns)[rng.randint(0, 2) :])
        return plain(timeout_s)

    crew.wait = wait
    with mock.patch.object(handout, "MOST_FAILURES", 20):  # bad luck is no reason to end
        for _ in range(6):
            score(hand_out, *families)
            crew.now += rng.choice([0.0, 1.0, 50.0])
    hand_out.close()
    assert not crew.turns


# --- the numbers of a single process -------------------------------------------------------------


class InProcess(Crew):
    """Workers of this process, which compute."""

    def __init__(self, program, capacities):
        super().__init__(room=3)
        self._capacities = capacities
        self._programs = [
            scorer.compile_share(program, family, capacity)
            for family, capacity in enumerate(capacities)
        ]

    def send(self, worker, work):
        family = work.family
        outcome = scorer.score(self._programs[family], self._capacities[family], work)
        self._begin(worker, Scored(outcome, 1.0, 1.0))


def numbers(tree):
    """The leaves of a pytree in NumPy, keys as their data."""
    return [
        np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)
        for x in jax.tree.leaves(tree)
    ]


def require_equal_numbers(words, generations, num_seeds=1, length=1):
    """Runs generations here and handed out; returns which seeds had finished after each."""
    config = sejax.config(words)
    program = make_program(**config.parts() | {"devices": 1})
    capacities = [5] * program.families.size
    crew = InProcess(program, capacities)
    local = session.Chunks(program)
    finished = []
    with RemoteChunks(program, hand_out_of(crew, capacities, [1] * len(capacities))) as remote:
        keys = jax.vmap(jax.random.key)(jnp.arange(num_seeds))
        state, other = local.init(keys), remote.init(keys)
        for _ in range(generations):
            state, info = local.advance(state, length)
            other, other_info = remote.advance(other, length)
            wanted, got = numbers((state, info)), numbers((other, other_info))
            assert len(wanted) == len(got)
            for x, y in zip(wanted, got, strict=True):
                assert x.dtype == y.dtype
                np.testing.assert_array_equal(x, y)
            finished.append(np.asarray(state.finished).tolist())
    return finished


TINY = ["env=gridworld_2x2", "agent=q_learning", "agent.learning_rate=0.5",
        "proxy.hidden_size=4", "es.population_size=2", "es.num_incumbent_evals=2",
        "es.noise_std=1.0", "training.max_steps=30", "training.test_episodes=1",
        "stop_when_solved=true"]  # fmt: skip


def test_trainings_that_are_handed_out_give_the_numbers_of_one_process_to_the_last_bit():
    finished = require_equal_numbers(TINY, 4, num_seeds=2)
    assert [True, False] in finished or [False, True] in finished  # nothing is trained for one


CASES = {
    "families": [*TINY[:1], "agents=[q_learning,sarsa]", *TINY[3:]],
    "lockstep": ["env=cartpole", "es.population_size=4", "training.max_episodes=5"],
    "several agents": ["env=cartpole", "agents=[ddqn,ppo]", "es.population_size=4",
                       "training.max_episodes=5"],
    "continuous actions": ["env=pendulum", "es.population_size=4", "training.max_episodes=3"],
    **{es: ["env=cliff_walking", "proxy=rn", f"es={es}", "es.population_size=8",
            "training.max_episodes=20"] for es in ("nes", "cma_es", "open_es", "snes", "pgpe")},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_so_do_all_kinds_of_agents_and_strategies(case):
    # Compiled as commands are: without optimisation fusions round otherwise in larger programs.
    program = ("from sejax.cli import runtime; runtime.configure_xla(1)\n"
               "import sys, test_machines\n"
               "test_machines.require_equal_numbers(sys.argv[1:], 3, num_seeds=2)")  # fmt: skip
    environment = {name: x for name, x in os.environ.items() if name != "XLA_FLAGS"}
    done = subprocess.run([sys.executable, "-c", program, *CASES[case]], env=environment,
                          cwd=Path(__file__).parent, capture_output=True, text=True)  # fmt: skip
    assert done.returncode == 0, done.stderr


# --- the command ---------------------------------------------------------------------------------


def test_without_ray_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(
        ConfigError,
        match=r"^machines must be .*pip install 'sejax\[ray\]', or set "
        r"machines=local\.$",
    ):
        sejax.config(["machines=ray"])  # fmt: skip


def test_ray_is_imported_where_a_run_or_a_search_asks_for_it_alone():
    root = Path(sejax.__file__).parent
    sources = {path.relative_to(root).as_posix(): path.read_text() for path in root.rglob("*.py")}

    def importing(what):
        return {name for name, text in sources.items() if re.search(what, text, re.M)}

    crew, cluster = "machines/ray_crew.py", "search/cluster.py"
    assert importing(r"^ *(import|from) ray\b") == {crew, cluster}
    assert importing(r"^from .*\b(ray_crew|cluster)$") == {cluster}
    assert importing(r"^ +from sejax.machines import ray_crew$") == {"machines/configs.py"}
    assert importing(r"^ +from sejax.search import cluster$") == {"search/__main__.py"}


def test_devices_are_the_workers_own(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: "there")
    with pytest.raises(ConfigError, match=r"^devices must be left out .*got 2\."):
        sejax.config(["machines=ray", "devices=2"])
    assert sejax.config(["machines=ray", "machines.workers=3"]).machines.workers == 3
    with pytest.raises(ConfigError, match=r"^machines\.workers must be"):
        sejax.config(["machines=ray", "machines.workers=0"])
