"""`python -m sejax.run` as a user meets it: files, resume, kills, damage, bad input."""

import csv
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

import sejax
from sejax import checkpoints, commands, run
from sejax.errors import ConfigError
from sejax.run_directory import COLUMNS, RunDirectory

TINY = [
    "preset=paper", "checkpoint_every=1",
    "es.population_size=2", "agent.hidden_size=4", "agent.batch_size=4", "agent.init_episodes=1",
    "proxy.hidden_size=4", "training.max_episodes=2", "training.test_episodes=1", "generations=3",
]  # fmt: skip
FILES = {"config.yaml", "metrics.csv", "proxy.safetensors", "proxy_last.safetensors",
         "checkpoint", "learning_curve.png", "run.json"}  # fmt: skip


def command(*overrides: str, timeout: float = 120) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "sejax.run", *overrides],
        capture_output=True, text=True, timeout=timeout, env=_environment(),
    )  # fmt: skip


# A shell's background jobs, such as a test run may be, ignore Ctrl-C, and what they start does too.
HEARS_CTRL_C = (
    "import runpy, signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "runpy.run_module('sejax.run', run_name='__main__', alter_sys=True)"
)


def start(*overrides: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", HEARS_CTRL_C, *overrides],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=_environment(),
    )  # fmt: skip


def _environment() -> dict[str, str]:
    return {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"}


def rows(path: Path) -> list[dict[str, str]]:
    """Metrics without the one column that depends on the clock."""
    with (path / "metrics.csv").open(newline="") as file:
        return [{k: v for k, v in row.items() if k != "wall_s"} for row in csv.DictReader(file)]


def wait_for_rows(path: Path, count: int, process: subprocess.Popen[str]) -> None:
    deadline = time.time() + 90
    while time.time() < deadline and process.poll() is None:
        if (path / "metrics.csv").exists() and len(rows(path)) >= count:
            return
        time.sleep(0.05)
    raise AssertionError(f"no {count} rows in time; the run said {process.communicate()}")


def learn(path: Path, *overrides: str) -> float:
    return run.learn(sejax.config([*TINY, f"run_dir={path}", *overrides]))


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory) -> Path:
    """A whole run of six generations."""
    path = tmp_path_factory.mktemp("whole")
    learn(path, "generations=6")
    return path


def test_a_run_writes_the_files_of_the_design(uninterrupted):
    assert {path.name for path in uninterrupted.iterdir()} == FILES
    assert len(rows(uninterrupted)) == 6
    header = (uninterrupted / "metrics.csv").read_text().splitlines()[0]
    assert header == ",".join(COLUMNS)
    assert yaml.safe_load((uninterrupted / "config.yaml").read_text())["es"]["population_size"] == 2


def test_the_stored_proxy_is_the_one_of_the_best_generation(uninterrupted):
    from sejax.proxies.io import load_proxy

    scores = [float(row["incumbent_mean"]) for row in rows(uninterrupted)]
    metadata = load_proxy(uninterrupted).metadata
    assert metadata["score"] == pytest.approx(max(scores))
    assert metadata["generation"] == scores.index(max(scores))
    last = load_proxy(uninterrupted / "proxy_last.safetensors").metadata
    assert last["generation"] == 5


def test_a_run_in_two_sessions_equals_one_in_one(uninterrupted, tmp_path, capsys):
    learn(tmp_path, "generations=4")
    learn(tmp_path, "generations=6")
    assert "Going on at generation 4" in capsys.readouterr().out
    assert rows(tmp_path) == rows(uninterrupted)
    proxy = "proxy.safetensors"
    assert (tmp_path / proxy).read_bytes() == (uninterrupted / proxy).read_bytes()


def test_chunks_of_two_generations_give_the_same_metrics(uninterrupted, tmp_path):
    learn(tmp_path, "generations=6", "checkpoint_every=2")
    assert rows(tmp_path) == rows(uninterrupted)


def test_a_finished_run_is_left_as_it_is(uninterrupted):
    before = (uninterrupted / "metrics.csv").read_bytes()
    learn(uninterrupted, "generations=6")
    assert (uninterrupted / "metrics.csv").read_bytes() == before


def test_a_damaged_checkpoint_is_named_and_the_one_before_is_used(uninterrupted, tmp_path, capsys):
    learn(tmp_path, "generations=4")
    newest = tmp_path / "checkpoint" / "4"
    victim = max((p for p in newest.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
    victim.write_bytes(victim.read_bytes()[:-10])
    learn(tmp_path, "generations=6")
    said = capsys.readouterr().out
    assert f"{newest} is damaged" in said and "Going on at generation 3" in said
    assert rows(tmp_path) == rows(uninterrupted)


def test_a_run_that_lost_its_checkpoints_is_not_replaced(uninterrupted, tmp_path):
    shutil.copytree(uninterrupted, tmp_path, dirs_exist_ok=True)
    shutil.rmtree(tmp_path / "checkpoint")
    files = [tmp_path / name for name in ("metrics.csv", "config.yaml", "proxy.safetensors")]
    before = [file.read_bytes() for file in files]
    with pytest.raises(ConfigError, match=r"keep the checkpoints of a run.*run_dir=FOLDER"):
        learn(tmp_path, "generations=9")
    assert [file.read_bytes() for file in files] == before


def test_a_checkpoint_without_manifest_does_not_count(tmp_path):
    import jax.numpy as jnp

    checkpoints.save(tmp_path, 1, {"x": jnp.arange(3)})
    checkpoints.save(tmp_path, 2, {"x": jnp.arange(3) + 1})
    (tmp_path / "2.json").unlink()
    state, generation, problems = checkpoints.restore_newest(tmp_path, {"x": jnp.zeros(3, int)})
    assert generation == 1 and state["x"].tolist() == [0, 1, 2] and len(problems) == 1


def test_only_two_checkpoints_are_kept(uninterrupted):
    names = {path.name for path in (uninterrupted / "checkpoint").iterdir()}
    assert names == {"5", "5.json", "6", "6.json"}


def test_a_killed_run_goes_on_to_the_same_metrics(uninterrupted, tmp_path):
    process = start(*TINY, "generations=6", f"run_dir={tmp_path}")
    wait_for_rows(tmp_path, 2, process)
    process.kill()
    process.communicate()
    finished = command(*TINY, "generations=6", f"run_dir={tmp_path}")
    assert finished.returncode == 0, finished.stderr
    assert rows(tmp_path) == rows(uninterrupted)


def test_ctrl_c_saves_and_exits_130(tmp_path):
    process = start(*TINY, "generations=100000", f"run_dir={tmp_path}")
    wait_for_rows(tmp_path, 2, process)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "are saved in" in out
    assert (tmp_path / "proxy.safetensors").exists()


def test_an_interrupt_waits_until_files_are_written():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    written = []
    try:
        with pytest.raises(KeyboardInterrupt), commands.interrupts_held():
            signal.raise_signal(signal.SIGINT)
            written.append("all")
        assert written == ["all"]
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_another_configuration_in_the_same_directory_is_refused(uninterrupted):
    with pytest.raises(ConfigError, match=r"differs in es\.population_size \(2 there, 3 here\)"):
        learn(uninterrupted, "es.population_size=3")


def test_an_unwritable_directory_is_a_clear_error(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(ConfigError, match=r"run_dir must be a folder that can be written.*Set run"):
        RunDirectory.open(sejax.config([f"run_dir={blocked}/run"]))


def test_a_full_disk_loses_nothing_that_was_written(uninterrupted, tmp_path, monkeypatch):
    learn(tmp_path, "generations=2")
    before = (tmp_path / "metrics.csv").read_bytes()

    fsync = os.fsync

    def full(descriptor):
        if "metrics" in os.readlink(f"/proc/self/fd/{descriptor}"):
            raise OSError(28, "No space left on device")
        fsync(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr("sejax.files.os.fsync", full)
        with pytest.raises(OSError, match="No space left"):
            learn(tmp_path, "generations=6")
    assert (tmp_path / "metrics.csv").read_bytes() == before
    assert not list(tmp_path.glob(".metrics*")), "temporary files are removed"
    learn(tmp_path, "generations=6")
    assert rows(tmp_path) == rows(uninterrupted)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("env=cartpol", "Did you mean env=cartpole?"),
        ("es.population_size=1", "es.population_size must be at least 2"),
        ("es.noise_sdt=1", "Did you mean es.noise_std?"),
        ("devices=x", "could not be converted to Integer"),
    ],
)
def test_bad_input_ends_with_one_message_and_status_2(override, message, tmp_path):
    ended = command(override, f"run_dir={tmp_path}/run")
    assert ended.returncode == 2
    assert message in ended.stderr and len(ended.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "run").exists()


def test_several_seeds_write_a_proxy_each(tmp_path):
    learn(tmp_path, "num_seeds=2", "generations=2")
    assert sorted(p.name for p in (tmp_path / "proxies").iterdir()) == [
        "seed0.safetensors",
        "seed1.safetensors",
    ]
    assert [row["seed"] for row in rows(tmp_path)] == ["0", "1", "0", "1"]


def test_a_population_that_diverges_finishes_and_is_counted(tmp_path):
    learn(tmp_path, "es.noise_std=1e30", "generations=2")
    assert [int(row["num_nonfinite"]) for row in rows(tmp_path)] == [4, 4]
