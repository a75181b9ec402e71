"""Handing shares of a generation's trials to workers that may die, hang, lie, come and go.

Shares shrink towards the end of a generation, so that nobody waits long for the last one (guided
self-scheduling, Polychronopoulos and Kuck, 1987). A worker without work takes a copy of a share
that somebody has had for too long, and the first answer counts (backup tasks, Dean and Ghemawat,
2004): a worker that hangs holds nobody up. Copies change nothing, as an answer depends on the share
alone. How workers are reached is the crew's business.
"""

import time
from collections import defaultdict, deque
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from sejax.errors import ConfigError, FailedError, told
from sejax.machines.scorer import About, Scored, Work

COPIED_AFTER = 2.0  # times what a share has been seen to take, until another worker begins it too
GIVEN_UP_AFTER = 10.0  # times that, until its worker counts as hanging
LEAST_S = 20.0  # before which none counts as hanging
MOST_FAILURES = 5  # of one share, or of starts in succession: that is no accident any more
LOOK_S = 1.0  # between looks at what hangs, and for machines that have come
ALONE_S = 30.0  # without any worker that is ready, until somebody is told


class Lost(Exception):
    """A worker is gone, whatever it did."""


class Crew(Protocol):
    """Worker processes, each of which does one thing at a time."""

    def recruit(self) -> list[Hashable]:
        """Starts workers where there is room, without waiting for them to get ready."""

    def send(self, worker: Hashable, work: Work) -> None:
        """Gives a worker a share."""

    def wait(self, timeout_s: float) -> list[tuple[Hashable, Any]]:
        """Waits until workers are done with something, or for so long.

        Returns:
          The workers, each with an `About` if it has got ready, a `Scored`, or the exception by
          which it failed; `Lost` if it is gone.
        """

    def dismiss(self, worker: Hashable) -> None:
        """Ends a worker, whatever it does."""


@dataclass(eq=False)
class Share:
    """Trials of one family.

    Attributes:
      family: index.
      places: of the trials among all `[seed, trial]` of a generation, flat.
      failures: workers that have failed at them.
    """

    family: int
    places: np.ndarray
    failures: int = 0


@dataclass
class Done:
    """What a worker did in a generation.

    Attributes:
      shares: that it scored.
      trainings: in these.
      train_steps: of the agents.
      busy_s: seconds that it computed.
      cpu_s: CPU seconds of its process.
      bytes_out: of the arrays that it was sent.
      bytes_in: of those that came back.
      lost: shares that it did not bring back, or later than another.
    """

    shares: int = 0
    trainings: int = 0
    train_steps: int = 0
    busy_s: float = 0.0
    cpu_s: float = 0.0
    bytes_out: int = 0
    bytes_in: int = 0
    lost: int = 0


@dataclass
class _Hand:
    """A worker: who it is once it is ready, what it has, and since when."""

    since: float
    about: About | None = None
    share: Share | None = None


class HandOut:
    """Gets generations scored by a crew."""

    def __init__(
        self,
        crew: Crew,
        capacities: Sequence[int],
        num_parallel: Sequence[int],
        patience_s: float = 3600.0,
        say: Callable[[str], None] = lambda text: None,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Of a crew; see `score` for when it raises.

        Args:
          crew: the workers.
          capacities: most trials in a share, by family.
          num_parallel: trials in lockstep, by family; so many take as long as a single one.
          patience_s: seconds that a worker may take while nobody has shown how long it takes.
          say: told what a person should know.
          clock: seconds.
        """
        self._crew, self._capacities, self._lanes = crew, capacities, num_parallel
        self._patience_s, self._say, self._clock = patience_s, say, clock
        self._hands: dict[Hashable, _Hand] = {}
        self._known: dict[Hashable, About] = {}
        # Longest seconds a trial, by family: in the last generation and in this one.
        self._seen: list[dict[int, float]] = [{}, {}]
        self._failed_starts, self._start_failed_at = 0, -np.inf
        self._looked = self._staffed = clock()

    def about(self, worker: Hashable) -> About:
        """Who a worker that was given a share is."""
        return self._known[worker]

    def start(self) -> None:
        """Starts workers, without waiting for them to get ready."""
        self._look()

    def get_ready(self) -> None:
        """Waits until the first worker is ready; raises as `score` does."""
        self.start()
        while not any(hand.about for hand in self._hands.values()):
            self._events()

    def score(
        self,
        families: Sequence[np.ndarray],
        work_of: Callable[[Share], Work],
        problem_of: Callable[[Share, Any], str | None],
    ) -> tuple[list[tuple[Share, Any]], dict[Hashable, Done]]:
        """Gets a generation scored.

        Args:
          families: places of each family's trials.
          work_of: a share as it is sent.
          problem_of: what is wrong with an outcome, if anything is.

        Returns:
          The outcomes of shares that make up all trials, and what each worker did.

        Raises:
          FailedError: if a share fails everywhere.
          ConfigError: if no worker gets ready.
        """
        plan = _Plan(families, self._capacities, self._lanes)
        done: dict[Hashable, Done] = defaultdict(Done)
        self._seen = [self._seen[1] or self._seen[0], {}]
        # Who goes while it has nothing to do is missed when it is sent something, and no share is
        # to blame: a node may go with more workers than a share may fail at.
        idle = {worker for worker, hand in self._hands.items() if hand.about and not hand.share}
        self._look()
        while not plan.is_complete:
            for worker, hand in self._hands.items():
                if hand.about is None or hand.share is not None:
                    continue
                share = plan.next(len(self._hands)) or self._late(plan)
                if share is None:
                    break
                work = work_of(share)
                self._crew.send(worker, work)
                plan.give(share)
                hand.share, hand.since = share, self._clock()
                done[worker].bytes_out += work.nbytes
            for worker, share, came, seconds in self._events():
                problem = told(came) if isinstance(came, Exception) else problem_of(share, came)
                if problem is not None:
                    self._dismiss(worker)
                    plan.fail(share, problem, not (worker in idle and isinstance(came, Lost)))
                    done[worker].lost += 1
                elif plan.finish(share, came.outcome):
                    self._note(done[worker], share, came, seconds)
                else:
                    done[worker].lost += 1
                idle.discard(worker)
        return plan.outcomes, done

    def close(self) -> None:
        """Ends all workers."""
        for worker in list(self._hands):
            self._dismiss(worker)

    def _note(self, done: Done, share: Share, scored: Scored, seconds: float) -> None:
        each = seconds / self._size(share)
        self._seen[1][share.family] = max(self._seen[1].get(share.family, 0.0), each)
        done.shares += 1
        done.trainings += len(share.places)
        done.train_steps += int(scored.outcome["train_steps"].sum())
        done.busy_s += scored.seconds
        done.cpu_s += scored.cpu_s
        done.bytes_in += sum(x.nbytes for x in scored.outcome.values())

    def _size(self, share: Share) -> int:
        """Trials that a share takes the time of."""
        return _whole(len(share.places), self._lanes[share.family])

    def _expected(self, share: Share) -> float | None:
        """Seconds that a share takes at most, by what was seen; None if nothing was."""
        seen = [times[share.family] for times in self._seen if share.family in times]
        return max(seen) * self._size(share) if seen else None

    def _late(self, plan: "_Plan") -> Share | None:
        """The share that is most overdue, of those that a single worker has."""
        overdue: list[tuple[float, Share]] = []
        for hand in self._hands.values():
            if hand.share is None or not plan.may_copy(hand.share):
                continue
            expected = self._expected(hand.share)
            late = expected and (self._clock() - hand.since) / expected
            if late and late > COPIED_AFTER:
                overdue.append((late, hand.share))
        return max(overdue, key=lambda each: each[0])[1] if overdue else None

    def _events(self) -> list[tuple[Hashable, Share, Any, float]]:
        """What came of shares: a `Scored` or an exception, and after how many seconds."""
        is_anyone_idle = any(h.about and h.share is None for h in self._hands.values())
        came = self._crew.wait(LOOK_S / 10 if is_anyone_idle else LOOK_S)
        now = self._clock()
        came += [
            (worker, TimeoutError("it does not answer"))
            for worker in self._hanging(now)
            if worker not in dict(came)
        ]
        ended = []
        for worker, what in came:
            hand = self._hands.get(worker)
            if hand is None:  # dismissed meanwhile
                continue
            if isinstance(what, About):
                hand.about, self._failed_starts = what, 0
                self._known[worker] = what
            elif hand.share is None:
                self._dismiss(worker)
                self._start_failed(hand, what, now)
            else:
                ended.append((worker, hand.share, what, now - hand.since))
                hand.share = None
        if now - self._looked > LOOK_S:
            self._look()
        return ended

    def _hanging(self, now: float) -> list[Hashable]:
        return [
            worker for worker, hand in self._hands.items() if now - hand.since > self._limit(hand)
        ]

    def _limit(self, hand: _Hand) -> float:
        """Seconds that a worker may take for what it does."""
        if hand.about is not None and hand.share is None:
            return np.inf
        expected = self._expected(hand.share) if hand.share else None
        if hand.share is None or not expected:
            return self._patience_s
        # Twice as long for the next one: it may be the training that takes longer than any before.
        return max(LEAST_S, GIVEN_UP_AFTER * expected) * 2**hand.share.failures

    def _look(self) -> None:
        """Starts workers where machines have come, or others were lost."""
        now = self._looked = self._clock()
        if self._failed_starts < MOST_FAILURES or not self._hands:
            for worker in self._crew.recruit():
                self._hands[worker] = _Hand(now)
        if any(hand.about for hand in self._hands.values()):
            self._staffed = now
        elif now - self._staffed > ALONE_S:
            self._staffed = now
            self._say(
                f"None of {len(self._hands)} workers is ready yet: they compile, or other jobs "
                f"hold what they need (ray status). Waiting for one."
                if self._hands
                else "No machine has room for a worker; waiting for one."
            )

    def _start_failed(self, hand: _Hand, error: Exception, now: float) -> None:
        if hand.since >= self._start_failed_at:  # those before may have gone with one node
            self._failed_starts += 1
            self._start_failed_at = now
        is_hopeless = isinstance(error, ConfigError) or self._failed_starts >= MOST_FAILURES
        if is_hopeless and not self._hands:  # those that compile still may get ready
            if isinstance(error, ConfigError):
                raise error
            raise ConfigError(
                f"machines must have workers that get ready, because they compute; the last "
                f"{MOST_FAILURES} did not: {told(error)}. Install what the driver has on each."
            ) from error
        if self._failed_starts == MOST_FAILURES and self._start_failed_at == now:
            self._say(
                f"No more workers are started, as the last {MOST_FAILURES} did not get ready "
                f"({told(error)})."
            )

    def _dismiss(self, worker: Hashable) -> None:
        if self._hands.pop(worker, None) is not None:
            self._crew.dismiss(worker)


class _Plan:
    """The shares of a generation: not cut yet, given to workers, to be given again, done."""

    def __init__(
        self, families: Sequence[np.ndarray], capacities: Sequence[int], num_parallel: Sequence[int]
    ):
        self.outcomes: list[tuple[Share, Any]] = []
        self._left = [np.asarray(places) for places in families]
        self._capacities, self._lanes = capacities, num_parallel
        self._again: deque[Share] = deque()
        self._holders: dict[Share, int] = {}  # workers that have a share which is not done

    @property
    def is_complete(self) -> bool:
        return not (self._again or self._holders or any(map(len, self._left)))

    def next(self, num_workers: int) -> Share | None:
        """A share that nobody has."""
        if self._again:
            return self._again.popleft()
        for family, places in enumerate(self._left):
            if len(places):
                fair = _whole(-(-len(places) // (2 * num_workers)), self._lanes[family])
                size = min(self._capacities[family], fair)
                self._left[family] = places[size:]
                return Share(family, places[:size])
        return None

    def may_copy(self, share: Share) -> bool:
        return self._holders.get(share) == 1

    def give(self, share: Share) -> None:
        self._holders[share] = self._holders.get(share, 0) + 1

    def finish(self, share: Share, outcome: Any) -> bool:
        """Takes an outcome; False if it was known, or is of an earlier generation."""
        if self._holders.pop(share, None) is None:
            return False
        self.outcomes.append((share, outcome))
        return True

    def fail(self, share: Share, problem: str, counts: bool) -> None:
        """A worker will not bring the share; `counts`: that may be because of the share.

        Raises:
          FailedError: if that has happened too often.
        """
        if share not in self._holders:
            return
        share.failures += counts
        if share.failures >= MOST_FAILURES:
            raise FailedError(
                f"{MOST_FAILURES} workers have failed at the same {len(share.places)} trainings, "
                f"the last one so: {problem}. The generations before are saved; the same command "
                f"with machines=local goes on from there on this machine alone."
            )
        self._holders[share] -= 1
        if not self._holders[share]:
            del self._holders[share]
            self._again.append(share)


def _whole(num_trials: int, num_parallel: int) -> int:
    """As many trials in whole groups of lanes."""
    return num_parallel * -(-num_trials // num_parallel)
