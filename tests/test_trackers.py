"""Trackers: what they are told, once and as the files have it, and what their failing costs."""

import json
import struct
import types
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import sejax
from sejax.cli import follower, trackers
from sejax.cli.metrics import columns_of
from sejax.cli.session import Quiet
from sejax.errors import ConfigError


class Told(Quiet):
    def __init__(self):
        self.said = []

    def print(self, text):
        self.said.append(text)


class Listener:
    """A tracker that keeps what it is told, and fails at the calls that it is asked to fail at."""

    def __init__(self, run, fails=()):
        self.run, self.fails, self.calls = run, fails, []

    def __getattr__(self, name):
        def take(*args):
            self.calls.append((name, *args))
            if name in self.fails:
                raise OSError(f"cannot {name}")

        return take


class Plugin:
    """A configuration that makes listeners."""

    def __init__(self, fails=()):
        self.fails, self.made = fails, []

    def make(self, run):
        if "make" in self.fails:
            raise SystemExit("no account")
        self.made.append(Listener(run, self.fails))
        return self.made[-1]


def directory(path, generations, seeds=(7,)):
    """A run directory as far as trackers look at it: rows of generations, seed by seed."""
    rows = [{name: str(i + 0.5) for i, name in enumerate(columns_of())}
            | {"generation": str(generation), "seed": str(seed)}
            for generation in range(generations) for seed in seeds]  # fmt: skip
    Image.new("RGB", (4, 3), "red").save(path / "learning_curve.png")
    config = {"env": {"name": "cartpole"}, "seed": seeds[0]}
    return types.SimpleNamespace(path=path, rows=rows, seeds=list(seeds), config=config)


def chunk(generations, seeds=1):
    """What a chunk's info says of the members: three scores each, one of them not finite."""
    numbers = np.repeat(np.asarray(generations)[:, None], seeds, axis=1)
    scores = numbers[..., None] + 10.0 * np.arange(seeds)[:, None] + np.array([0.1, np.nan, 0.2])
    return types.SimpleNamespace(generation=numbers, member_scores=scores)


def follow(plugin, folder, told=None, infos=(None,)):
    """A session that tells of what the folder has."""
    config = types.SimpleNamespace(tracker=plugin)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(follower.plugins, "name_of", lambda group, config: "mine:tracker")
        with follower.Follower(config, folder, told or Told()) as following:
            for info in infos:
                following.tell(info)


def logged(listener):
    return [call for call in listener.calls if call[0] == "log"]


def test_a_tracker_is_told_the_rows_and_the_finite_scores(tmp_path):
    plugin = Plugin()
    follow(plugin, directory(tmp_path, 2), infos=[chunk([0, 1])])
    (listener,) = plugin.made
    assert listener.run.folder == tmp_path and listener.run.generations == 0
    assert listener.run.config["env"]["name"] == "cartpole" and len(listener.run.id) == 8
    (_, number, values, scores), _ = logged(listener)
    assert number == 0 and set(values) == {*columns_of()} - {"generation", "seed"}
    assert values["incumbent_mean"] == 2.5 and values["wall_s"] == 12.5
    np.testing.assert_allclose(scores["member_scores"], [0.1, 0.2])
    end = [("show", "learning_curve", tmp_path / "learning_curve.png", 2), ("close",)]
    assert listener.calls[2:] == end


def test_several_seeds_are_told_apart_by_name(tmp_path):
    plugin = Plugin()
    follow(plugin, directory(tmp_path, 1, seeds=(7, 8)), infos=[chunk([0], seeds=2)])
    ((_, _, values, scores),) = logged(plugin.made[0])
    assert {name.partition("/")[0] for name in values} == {"seed7", "seed8"}
    np.testing.assert_allclose(scores["seed8/member_scores"], [10.1, 10.2])


def test_a_run_that_goes_on_is_told_once_under_its_id(tmp_path):
    plugin = Plugin()
    follow(plugin, directory(tmp_path, 2), infos=[chunk([0, 1])])
    follow(plugin, directory(tmp_path, 2))  # nothing is new: not even opened
    follow(plugin, directory(tmp_path, 5), infos=[None, chunk([4])])
    first, second = plugin.made
    assert first.run.id == second.run.id and second.run.generations == 2
    assert [call[1] for call in logged(first) + logged(second)] == [0, 1, 2, 3, 4]


def test_a_tracker_that_comes_later_is_told_from_the_beginning(tmp_path):
    plugin = Plugin()
    (tmp_path / "tracker.json").write_text('{"wandb": {"id": "0123abcd", "generations": 9}}')
    follow(plugin, directory(tmp_path, 3))
    assert [call[1] for call in logged(plugin.made[0])] == [0, 1, 2]
    assert not any(scores for *_, scores in logged(plugin.made[0]))  # nobody kept these
    records = json.loads((tmp_path / "tracker.json").read_text())
    assert records["wandb"]["generations"] == 9 and records["mine:tracker"]["generations"] == 3


@pytest.mark.parametrize(
    ("fails", "reason"),
    [("make", "SystemExit: no account"), ("log", "OSError: cannot log"),
     ("show", "OSError: cannot show"), ("close", "OSError: cannot close")],
)  # fmt: skip
def test_a_tracker_that_fails_is_dropped_with_one_warning(tmp_path, fails, reason):
    plugin, told = Plugin({fails}), Told()
    follow(plugin, directory(tmp_path, 3), told, infos=[chunk([0]), chunk([1, 2])])
    (said,) = told.said
    assert said.startswith("tracker=mine:tracker has failed") and said.endswith(reason)
    if plugin.made:
        assert plugin.made[0].calls[-1] == ("close",)
        assert len(logged(plugin.made[0])) == (1 if fails == "log" else 3)


def test_a_damaged_record_drops_the_tracker(tmp_path):
    (tmp_path / "tracker.json").write_text("[")
    told = Told()
    follow(Plugin(), directory(tmp_path, 1), told)
    assert len(told.said) == 1 and "JSONDecodeError" in told.said[0]


def test_nobody_is_told_without_a_tracker(tmp_path):
    follow(trackers.NoTracker(), directory(tmp_path, 2))
    assert not (tmp_path / "tracker.json").exists()


def test_a_package_that_is_missing_is_named_before_anything_starts(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigError) as error:
        sejax.config(["tracker=wandb"])
    assert "pip install 'sejax[wandb]'" in str(error.value) and "\n" not in str(error.value)


# --- the real ones -------------------------------------------------------------------------------


def tracked(path, config):
    """A run in two sessions."""
    for number, generations in enumerate((2, 3)):
        folder = directory(path, generations)
        told = Told()
        context = types.SimpleNamespace(tracker=config)
        with follower.Follower(context, folder, told) as following:
            following.tell(chunk([0, 1] if not number else [2]))
        assert not told.said, told.said


def events(folder):
    """The events of TensorBoard files, by the format's description: length, CRC, data, CRC."""
    from tensorboardX.proto.event_pb2 import Event

    for path in sorted(folder.iterdir()):
        data = path.read_bytes()
        while data:
            (length,) = struct.unpack("<Q", data[:8])
            yield Event.FromString(data[12 : 12 + length])
            data = data[16 + length :]


def test_tensorboard_reads_scalars_histograms_and_the_curve(tmp_path):
    pytest.importorskip("tensorboardX", reason="pip install 'sejax[tensorboard]'")
    tracked(tmp_path, trackers.TensorBoardConfig())
    found = [(event.step, value) for event in events(tmp_path / "tensorboard")
             for value in event.summary.value]  # fmt: skip
    means = [(step, x.simple_value) for step, x in found if x.tag == "incumbent_mean"]
    assert means == [(0, 2.5), (1, 2.5), (2, 2.5)]
    counts = [(step, x.histo.num) for step, x in found if x.tag == "member_scores"]
    assert counts == [(0, 2), (1, 2), (2, 2)]
    assert [(step, x.image.width) for step, x in found if x.tag == "learning_curve"] == \
        [(2, 4), (3, 4)]  # fmt: skip
    assert "cartpole" in str(next(x for _, x in found if x.tag.startswith("config")))


@pytest.mark.filterwarnings("default")
def test_wandb_keeps_a_run_offline_and_goes_on_with_it(tmp_path, monkeypatch):
    pytest.importorskip("wandb", reason="pip install 'sejax[wandb]'")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    tracked(tmp_path, trackers.WandbConfig())
    id = json.loads((tmp_path / "tracker.json").read_text())["wandb"]["id"]
    sessions = sorted((tmp_path / "wandb").glob(f"offline-run-*-{id}/*.wandb"))
    assert len(sessions) in (1, 2)  # one folder for each, named by the second
    assert b"member_scores" in sessions[0].read_bytes()


@pytest.mark.filterwarnings("default")
def test_trackio_keeps_one_run_on_this_machine(tmp_path, monkeypatch):
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))
    pytest.importorskip("trackio", reason="pip install 'sejax[trackio]'")
    import sqlite3

    tracked(tmp_path, trackers.TrackioConfig())
    with sqlite3.connect(tmp_path / "trackio" / "sejax.db") as database:
        rows = database.execute("select step, run_name, metrics from metrics").fetchall()
    assert len({name for _, name, _ in rows}) == 1
    told = [(step, json.loads(metrics)) for step, _, metrics in rows]
    steps = {step: values for step, values in told if "incumbent_mean" in values}
    assert sorted(steps) == [0, 1, 2] and steps[2]["incumbent_mean"] == 2.5
    assert steps[0]["member_scores"]["_type"] == "trackio.histogram"


def test_the_picture_takes_no_step_that_a_run_which_goes_on_will_log():
    """wandb drops what is logged with a step below the last one."""
    module = types.SimpleNamespace(Image=str, Histogram=list)
    steps = []
    run = types.SimpleNamespace(log=lambda values, step: steps.append(step), finish=lambda: None)
    for generations in (range(3), range(3, 5)):
        wandb = trackers.Wandb(module, run)
        for generation in generations:
            wandb.log(generation, {}, {})
        wandb.show("learning_curve", Path("a.png"), generations.stop)
    assert steps == [0, 1, 2, 2, 3, 4, 4]
