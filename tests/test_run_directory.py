"""A run directory: resume, damage, kills at every file operation, full disks."""

import contextlib
import dataclasses
import os
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from support import bits, refusal

import sejax
from sejax.ops import checksummed
from sejax.ops.files import atomic_path
from sejax.options import ConfigError
from sejax.runs.config import LearnConfig
from sejax.runs.run_directory import COLUMNS, RunDirectory

CONFIG = sejax.config(["env=gridworld_2x2", "agent=q_learning", "seed=7", "es.noise_std=0.0124"])
FILES = {"checkpoint.safetensors", "config.yaml", "metrics.csv", "sejax.lock"}
CHECKPOINT = "checkpoint.safetensors"


def state_after(generation: int) -> dict[str, jax.Array]:
    return {"x": jnp.array([generation, 7 * generation + 1]), "key": jax.random.key(generation)}


def info_of(start: int, length: int, **columns) -> SimpleNamespace:
    """The info of a block of generations, whose values depend on the generation alone."""
    generation = np.arange(start, start + length)
    values = {name: (generation / 3).astype(np.float32) for name in COLUMNS}
    values |= {"generation": generation, "num_nonfinite": np.zeros_like(generation)}
    values |= {"real_steps": np.full((length, 2), 2**30), "active": np.ones(length, bool)}
    return SimpleNamespace(**(values | columns))


def open_run(path: Path, **changes) -> RunDirectory:
    return RunDirectory(dataclasses.replace(CONFIG, run_dir=str(path), **changes))


def go(path: Path, generations: int, block: int = 1, **changes) -> int:
    """A session of a run; returns the generation that it went on from."""
    with open_run(path, generations=generations, **changes) as directory:
        start = len(directory.rows)
        state = directory.restore(state_after(0))
        if state is None:
            assert start == 0
        else:
            assert bits(state) == bits(state_after(start))
        for generation in range(start, generations, block):
            info = info_of(generation, min(block, generations - generation))
            directory.save(state_after(generation + len(info.generation)), info, 1.0, 2.0)
    return start


def content(path: Path) -> dict[str, bytes | None]:
    return {
        str(each.relative_to(path)): each.read_bytes() if each.is_file() else None
        for each in path.rglob("*")
    }


def results(path: Path) -> dict[str, object]:
    """The content of a run directory without what differs between equal runs."""
    files: dict[str, object] = dict(content(path))
    files["config.yaml"] = files["config.yaml"].replace(bytes(path), b"")
    tensors, manifest = checksummed.read(path / CHECKPOINT, "sejax_run")
    assert len(manifest.pop("id")) == 8 and manifest["config"].pop("run_dir") == str(path)
    files[CHECKPOINT] = {name: x.tobytes() for name, x in tensors.items()}, manifest
    return files


def refused(path: Path, **changes) -> str:
    """The message of a refusal that leaves every file as it is."""
    before = content(path)
    error = refusal(open_run(path, **changes).__enter__)
    assert error.field == "run_dir" and content(path) == before
    return str(error)


def change_checkpoint(path: Path, change=lambda manifest: None, **tensors) -> None:
    """Writes a checkpoint anew, with another manifest or other tensors."""
    before, manifest = checksummed.read(path / CHECKPOINT, "sejax_run")
    change(manifest)
    (path / CHECKPOINT).write_bytes(checksummed.pack(before | tensors, "sejax_run", manifest))


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A run of five generations."""
    path = tmp_path_factory.mktemp("runs") / "whole"
    go(path, 5)
    return path


@pytest.fixture
def run(whole, tmp_path) -> Path:
    """A copy of it, to be damaged."""
    return Path(shutil.copytree(whole, tmp_path / "run"))


# --- what is stored ------------------------------------------------------------------------------


def test_a_run_has_these_files(whole):
    assert {path.name for path in whole.iterdir()} == FILES
    lines = (whole / "metrics.csv").read_text().splitlines()
    assert lines[0] == ",".join(COLUMNS)
    third = "0.333333343"
    assert lines[2] == f"1,7,{','.join([third] * 8)},0,{2 * 2**31},1.000"
    stored = LearnConfig.of_stored(yaml.safe_load((whole / "config.yaml").read_text()))
    assert stored == dataclasses.replace(CONFIG, generations=5, run_dir=str(whole))


def test_a_finished_run_is_left_as_it_is(run):
    go(run, 5)  # whose folder is another one
    written = [path for path in run.iterdir() if path.name != "sejax.lock"]
    before = [path.stat().st_mtime_ns for path in written]
    assert go(run, 5) == 5
    assert [path.stat().st_mtime_ns for path in written] == before


def test_a_state_comes_back_bit_for_bit(tmp_path):
    state = {
        "key": jax.random.split(jax.random.key(3), 2),
        "special": jnp.array([jnp.nan, jnp.inf, -0.0, 1e-45]),
        "empty": jnp.zeros((0, 3)),
        "flag": jnp.array(True),
        "placed": jax.device_put(jnp.arange(3), jax.devices()[1]),
        "nested": [(jnp.arange(3), None), {"y": jnp.uint8(7)}],
    }
    with open_run(tmp_path) as directory:
        directory.save(state, info_of(0, 1), 1.0, 1.0)
    with open_run(tmp_path) as directory:
        restored = directory.restore(jax.eval_shape(lambda: state))
    assert jax.tree.structure(restored) == jax.tree.structure(state)
    assert bits(restored) == bits(state)
    assert not restored["placed"].committed


def test_numbers_read_back_as_the_same_float32_or_integer(tmp_path):
    values = np.array([0.1, np.nan, -np.inf, 1e-45], np.float32)
    counts = np.array([0, 1, 2**31 - 1, 5], np.int32)
    info = info_of(0, 4, incumbent_mean=values, train_steps_max=counts)
    with open_run(tmp_path) as directory:
        rows = directory.save(state_after(4), info, 12.3456, 1.0)
    np.testing.assert_array_equal([np.float32(row["incumbent_mean"]) for row in rows], values)
    assert [row["train_steps_max"] for row in rows] == [str(x) for x in counts]
    assert [row["env_steps_total"] for row in rows] == [str(2**31 * i) for i in range(1, 5)]
    assert rows[0]["wall_s"] == "12.346"


def test_a_column_that_an_older_version_did_not_write_is_nan(run, monkeypatch):
    newer = (*COLUMNS, "novelty")
    monkeypatch.setattr("sejax.runs.run_directory.COLUMNS", newer)
    with open_run(run) as directory:
        directory.save(state_after(6), info_of(5, 1, novelty=np.array([1.5])), 1.0, 1.0)
    lines = [line.split(",") for line in (run / "metrics.csv").read_text().splitlines()]
    assert lines[0] == list(newer) and {len(line) for line in lines} == {len(newer)}
    assert lines[5][-1] == "nan" and lines[6][-1] == "1.5"


# --- files beside the checkpoint, and without it -------------------------------------------------


@pytest.mark.parametrize("kept", ["metrics.csv", "config.yaml", "proxy.safetensors", "checkpoint"])
def test_files_of_a_run_without_its_checkpoint_are_not_replaced(tmp_path, kept):
    (tmp_path / kept).write_bytes(b"precious")
    assert kept in refused(tmp_path)


def test_other_files_stay_and_only_temporaries_of_killed_sessions_are_removed(tmp_path):
    dead = [".checkpoint.safetensors.sejax-0123abcd.safetensors", ".run.json.sejax-0123abcd.json"]
    others = ["notes.txt", ".metrics.csv.abcd1234.csv", "run.json.bak"]
    for name in (*dead, *others):
        (tmp_path / name).write_text("precious")
    (tmp_path / ".metrics.csv.sejax-0123abcd.csv").mkdir()
    with atomic_path(tmp_path / "report.html") as temporary:
        temporary.write_text("whole")
        go(tmp_path, 1)
    assert not any((tmp_path / name).exists() for name in dead)
    assert {(tmp_path / name).read_text() for name in others} == {"precious"}
    assert (tmp_path / ".metrics.csv.sejax-0123abcd.csv").exists()
    assert (tmp_path / "report.html").read_text() == "whole"


# --- damage --------------------------------------------------------------------------------------


@pytest.mark.parametrize("change", [
    {"format_version": 2}, {"config": None}, {"config": [1]}, {"cpu_s": "long"}, {"metrics": b""},
    {"metrics": b"generation,seed\n0\n"}, {"metrics": b"generation,seed\n0,7\n"},
    {"metrics": b"\xff\n"},
])  # fmt: skip
def test_a_checkpoint_that_says_something_else_is_refused_and_changes_nothing(run, change):
    ((name, value),) = change.items()
    if name == "metrics":
        change_checkpoint(run, metrics=np.frombuffer(value, np.uint8))
    else:
        change_checkpoint(run, lambda manifest: manifest.update(change))
    refused(run)


@pytest.mark.parametrize("like", [
    {"x": jnp.zeros(3, jnp.int32)}, {"x": jnp.zeros(2)}, {"y": jnp.zeros(2)},
    {"key": jax.random.key(0, impl="rbg")},
])  # fmt: skip
def test_a_state_of_another_structure_is_refused(run, like):
    with open_run(run) as directory:
        error = refusal(directory.restore, state_after(0) | like)
    assert error.field == "run_dir" and next(iter(like)) in str(error)
    with open_run(run) as directory:
        assert "'key'] (" in str(refusal(directory.restore, {"x": state_after(0)["x"]}))


# --- another configuration -----------------------------------------------------------------------


def test_another_configuration_is_refused_with_what_differs(run):
    said = refused(run, es=dataclasses.replace(CONFIG.es, noise_std=0.1), seed=3)
    assert "es.noise_std (0.0124 there, 0.1 here), seed (7 there, 3 here)" in said
    (run / "config.yaml").unlink()
    assert "seed (7 there, 3 here)" in refused(run, seed=3)
    other = RunDirectory(sejax.config(["proxy=rn", f"run_dir={run}"]))
    with pytest.raises(ConfigError, match=r"and \d+ more"):
        other.__enter__()


def test_fields_that_change_no_number_may_change(run):
    assert go(run, 7, devices=3, checkpoint_every=2, stop_when_solved=True) == 5
    assert yaml.safe_load((run / "config.yaml").read_text())["devices"] == 3


@pytest.mark.parametrize("name", ["file/run", "a\0b", "/proc/run"])
def test_a_folder_that_cannot_be_made_is_one_message(tmp_path, name):
    (tmp_path / "file").write_text("")
    assert refusal(open_run(tmp_path / name).__enter__).field == "run_dir"


def test_a_run_without_a_generation_leaves_no_folder(tmp_path):
    with open_run(tmp_path / "runs" / "a"):
        assert (tmp_path / "runs" / "a").exists()
    assert not (tmp_path / "runs").exists()
    (tmp_path / "mine").mkdir()
    with open_run(tmp_path / "mine"):
        pass
    assert (tmp_path / "mine").exists()


# --- full disks and kills ------------------------------------------------------------------------


def test_a_folder_that_was_removed_ends_the_run_and_is_not_made_again(run):
    with open_run(run) as directory:
        shutil.rmtree(run)
        with pytest.raises(FileNotFoundError, match="was removed"):
            directory.save(state_after(6), info_of(5, 1), 1.0, 1.0)
    assert not run.exists()


class Killed(BaseException):
    """The process is no more."""


class Full(OSError):
    """The disk has no space left."""


def failed(monkeypatch, count: int, error: type[BaseException], *arguments) -> bool:
    """Whether a session met its end: from file operation number `count` on each raises `error`.

    Of a write that is number `count`, half happens.
    """
    done: list[str] = []

    def guard(owner, name):
        real = getattr(owner, name)

        def operation(*arguments, **options):
            done.append(name)
            if len(done) == count + 1 and name == "write_bytes":
                real(arguments[0], arguments[1][: len(arguments[1]) // 2])
            if len(done) > count:
                raise error
            return real(*arguments, **options)

        return operation

    with monkeypatch.context() as patch:
        for name in ("open", "fsync", "replace", "unlink", "mkdir", "rmdir"):
            patch.setattr(os, name, guard(os, name))
        patch.setattr(Path, "write_bytes", guard(Path, "write_bytes"))
        with contextlib.suppress(Killed, OSError, ConfigError):
            go(*arguments)
    return len(done) > count


def saved(path: Path) -> int:
    """Generations in the checkpoint."""
    if not (path / CHECKPOINT).exists():
        return 0
    tensors, _ = checksummed.read(path / CHECKPOINT, "sejax_run")
    return tensors["metrics"].tobytes().count(b"\n") - 1


@pytest.mark.parametrize("error", [Killed, pytest.param(Full, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("start", "block", "operations"), [(0, 1, 20), (0, 2, 18), (1, 1, 12)])
def test_after_a_kill_or_a_full_disk_at_any_file_operation_it_goes_on_from_a_whole_moment(
    tmp_path, monkeypatch, start, block, operations, error
):
    first, whole, count = tmp_path / "first", tmp_path / "whole", 0
    go(whole, 3)
    if start:
        go(first, start)
        (first / "metrics.csv").write_text("damaged")
    while True:
        path = tmp_path / str(count)
        if start:
            shutil.copytree(first, path)
        if not failed(monkeypatch, count, error, path, 3, block):
            break
        committed = saved(path)
        assert committed >= start and go(path, 3, block) == committed
        assert results(path) == results(whole), "no temporaries are left"
        count += 1
    assert count > operations


def test_a_checkpoint_is_on_the_disk_before_it_takes_its_name(run, monkeypatch):
    done, fsync, replace = [], os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda x: (done.append(os.fstat(x).st_ino), fsync(x)))
    monkeypatch.setattr(os, "replace", lambda a, b: (done.append(Path(b).name), replace(a, b)))
    with open_run(run) as directory:
        directory.save(state_after(6), info_of(5, 1), 1.0, 1.0)
    inodes = [(run / name).stat().st_ino for name in (CHECKPOINT, "metrics.csv")]
    assert done == [inodes[0], CHECKPOINT, inodes[1], "metrics.csv"]


# --- locks ---------------------------------------------------------------------------------------


def test_a_folder_is_free_again_after_a_refusal_or_a_session(run):
    refused(run, seed=3)
    for _ in range(2):
        with open_run(run):
            refusal(open_run(run).__enter__)


def test_a_lock_that_is_a_link_is_not_followed(tmp_path):
    (tmp_path / "precious").write_text("precious")
    (tmp_path / "sejax.lock").symlink_to(tmp_path / "precious")
    refused(tmp_path)


# --- of a command's configuration ----------------------------------------------------------------


def test_a_run_of_a_version_without_a_field_goes_on_with_its_default(tmp_path):
    words = ["proxy=rn", f"run_dir={tmp_path}"]
    with RunDirectory(sejax.config(words)) as directory:
        directory.save(state_after(1), info_of(0, 1), 1.0, 1.0)
    change_checkpoint(tmp_path, lambda manifest: manifest["config"]["proxy"].pop("output_scale"))
    for field in ("proxy.output_scale", "es.noise_std"):
        said = str(refusal(RunDirectory(sejax.config([*words, f"{field}=0.5"])).__enter__))
        assert re.search(rf"{field} \(\S+ there, 0.5 here\)\. Set", said)
    with RunDirectory(sejax.config(words)):
        pass
    change_checkpoint(tmp_path, lambda manifest: manifest["config"]["es"].update(fashion=1))
    said = str(refusal(RunDirectory(sejax.config(words)).__enter__))  # which had other fields
    assert "es.fashion (1 there, None here)" in said
