"""Trackers: what they hear, where they go on, and that one that fails is dropped."""

import struct
from unittest.mock import MagicMock

import numpy as np
import pytest

from sejax.runs import trackers
from sejax.runs.trackers import FinishedGeneration, GuardedTracker, TrackedRun


class Listener:
    """A configuration that makes itself, and fails at the calls that it is asked to fail at."""

    def __init__(self, *fails):
        self.fails, self.calls = fails, []

    def make(self, run):
        self._take("make", run)
        return self

    def on_generation(self, info):
        self._take("on_generation", info)

    def close(self):
        self._take("close")

    def _take(self, *call):
        self.calls.append(call[0])
        if call[0] in self.fails:
            raise SystemExit("no account") if call[0] == "make" else OSError(f"cannot {call[0]}")


def tracked_run(path, generation=0):
    config = {"env": {"name": "cartpole"}, "seed": 7}
    return TrackedRun(folder=path, id="0123abcd", generation=generation, config=config)


def generation(number):
    return FinishedGeneration(
        generation=number,
        values={"incumbent_mean": 2.5, "wall_s": 12.5},
        scores=np.array([number + 0.1, number + 0.2]),
        train_steps=100,
    )


@pytest.mark.parametrize(("fails", "reason", "calls"), [
    ("make", "SystemExit: no account", ["make"]),
    ("on_generation", "OSError: cannot on_generation", ["make", "on_generation", "close"]),
    ("close", "OSError: cannot close", ["make", "on_generation", "on_generation", "close"]),
])  # fmt: skip
def test_a_tracker_that_fails_is_dropped_with_one_message(tmp_path, fails, reason, calls):
    listener, said = Listener(fails), []
    tracker = GuardedTracker(listener, tracked_run(tmp_path), said.append)
    for number in range(2):
        tracker.on_generation(generation(number))
    tracker.close()
    assert listener.calls == calls
    (message,) = said
    assert "Listener has failed" in message and reason in message


def test_ctrl_c_is_not_taken_for_a_failure(tmp_path):
    config = MagicMock(make=MagicMock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        GuardedTracker(config, tracked_run(tmp_path), print).on_generation(generation(0))


# --- the real ones -------------------------------------------------------------------------------


def track(path, config):
    """A run in two sessions, of two generations and one."""
    said = []
    for numbers in ((0, 1), (2,)):
        tracker = GuardedTracker(config, tracked_run(path, numbers[0]), said.append)
        for number in numbers:
            tracker.on_generation(generation(number))
        tracker.close()
    assert not said


def events(folder):
    """The events of TensorBoard files, by the format's description: length, CRC, data, CRC."""
    from tensorboardX.proto.event_pb2 import Event

    for path in sorted(folder.iterdir()):
        data = path.read_bytes()
        while data:
            (length,) = struct.unpack("<Q", data[:8])
            yield Event.FromString(data[12 : 12 + length])
            data = data[16 + length :]


def test_tensorboard_reads_scalars_and_histograms(tmp_path):
    pytest.importorskip("tensorboardX", reason="pip install '.[tensorboard]'")
    track(tmp_path, trackers.TensorBoardConfig())
    values = [(event.step, value) for event in events(tmp_path / "tensorboard")
              for value in event.summary.value]  # fmt: skip
    means = [(step, x.simple_value) for step, x in values if x.tag == "incumbent_mean"]
    assert means == [(0, 2.5), (1, 2.5), (2, 2.5)]
    counts = [(step, x.histo.num) for step, x in values if x.tag == "population_scores"]
    assert counts == [(0, 2), (1, 2), (2, 2)]
    assert "cartpole" in str(next(x for _, x in values if x.tag.startswith("config")))
