"""`python -m sejax.run` as a user meets it: files, resume, kills, damage, bad input."""

import csv
import dataclasses
import functools
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import types
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from support import is_drawn

import sejax
from sejax import run
from sejax.cli import build, checkpoints, commands, progress, run_directory, session
from sejax.cli.metrics import COLUMNS, FAMILY_COLUMNS
from sejax.cli.progress import RunProgress
from sejax.errors import ConfigError
from sejax.proxies import files

# A room of 2 x 2 cells for tables: what takes time is importing and compiling.
TINY = [
    "env=gridworld_2x2", "agent.learning_rate=0.5", "proxy.hidden_size=4", "es.population_size=2",
    "es.num_incumbent_evals=2", "es.noise_std=1.0", "training.max_steps=30",
    "training.test_episodes=1", "generations=3", "seed=12",
]  # fmt: skip
FILES = {"config.yaml", "metrics.csv", "proxy.safetensors", "proxy_last.safetensors",
         "checkpoint", "learning_curve.png", "run.json"}  # fmt: skip
RUN = [sys.executable, "-m", "sejax.run"]


@functools.cache
def chunks(*words):
    """The compiled program of a configuration, which all runs of it share."""
    return session.make_chunks(sejax.config([*TINY, *words]))


class Report(session.Quiet):
    """Keeps what is told."""

    def __init__(self):
        self.said = []

    def print(self, text):
        self.said.append(text)


def learn(path, *words, program=()):
    """A session of a run, as `sejax.run` has it; returns what it told."""
    config = sejax.config([*TINY, *program, *words, f"run_dir={path}"])
    report = Report()
    with run_directory.open_for(config) as directory:
        session.run(config, directory, chunks(*program), report)
    return "\n".join(report.said)


def rows(path: Path) -> list[dict[str, str]]:
    """Metrics without the one column that depends on the clock."""
    with (path / "metrics.csv").open(newline="") as file:
        return [{k: v for k, v in row.items() if k != "wall_s"} for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory) -> Path:
    """A whole run of six generations."""
    path = tmp_path_factory.mktemp("whole")
    learn(path, "generations=6")
    return path


# --- a run and its files -------------------------------------------------------------------------


def test_a_run_writes_the_files_of_the_design(uninterrupted):
    assert {path.name for path in uninterrupted.iterdir()} == FILES
    assert len(rows(uninterrupted)) == 6
    header = (uninterrupted / "metrics.csv").read_text().splitlines()[0]
    assert header == ",".join(COLUMNS)
    stored = yaml.safe_load((uninterrupted / "config.yaml").read_text())
    assert stored["es"]["population_size"] == 2
    words = ["generations=6", f"run_dir={uninterrupted}"]
    assert build.learn_config(stored) == sejax.config([*TINY, *words])


def test_the_stored_proxy_is_the_one_of_the_best_generation(uninterrupted):
    scores = [float(row["incumbent_mean"]) for row in rows(uninterrupted)]
    record = files.load_proxy(uninterrupted).record
    assert record["score"] == pytest.approx(max(scores))
    best = max(range(6), key=lambda generation: (scores[generation], generation))
    assert record["generation"] == best not in (0, 5)
    last = files.load_proxy(uninterrupted / "proxy_last.safetensors").record
    assert last["generation"] == 5 and last["score"] == pytest.approx(scores[-1])


def test_a_run_in_two_sessions_equals_one_in_one(uninterrupted, tmp_path):
    learn(tmp_path, "generations=4")
    assert "Going on at generation 4" in learn(tmp_path, "generations=6")
    assert rows(tmp_path) == rows(uninterrupted)
    proxy = "proxy.safetensors"
    assert (tmp_path / proxy).read_bytes() == (uninterrupted / proxy).read_bytes()


def test_what_a_run_cost_adds_up_over_its_sessions(uninterrupted, tmp_path):
    def costs(path):
        ended = json.loads((path / "run.json").read_text())
        return {name: ended[name] for name in ("agents", "train_steps", "real_steps", "cpu_s")}

    learn(tmp_path, "generations=4")
    first = costs(tmp_path)
    _, saved = checkpoints.newest_record(tmp_path / "checkpoint")  # drawn afterwards is forgotten
    learn(tmp_path, "generations=6")
    both, whole = costs(tmp_path), costs(uninterrupted)
    assert both.pop("cpu_s") >= round(saved["cpu_s"], 1) and whole.pop("cpu_s") > 0
    assert both == whole
    assert whole["real_steps"] == int(rows(uninterrupted)[-1]["env_steps_total"])
    assert whole["agents"] % 6 == 0 and whole["train_steps"] > first["train_steps"] > 0


def test_a_finished_run_is_left_as_it_is(uninterrupted):
    before = (uninterrupted / "metrics.csv").read_bytes()
    learn(uninterrupted, "generations=6")
    assert (uninterrupted / "metrics.csv").read_bytes() == before


def test_only_two_checkpoints_are_kept(uninterrupted):
    names = {path.name for path in (uninterrupted / "checkpoint").iterdir()}
    assert names == {f"sejax-generation-{n}.safetensors" for n in (5, 6)}


@pytest.fixture(scope="module")
def two_seeds(tmp_path_factory) -> Path:
    """Two runs of six generations in one program, in chunks of two."""
    path = tmp_path_factory.mktemp("two")
    learn(path, "generations=6", "checkpoint_every=2", program=("num_seeds=2",))
    return path


def test_chunks_of_two_generations_and_seeds_give_the_same_metrics(uninterrupted, two_seeds):
    assert [row["seed"] for row in rows(two_seeds)] == ["12", "13"] * 6
    assert rows(two_seeds)[::2] == rows(uninterrupted)


def test_several_seeds_write_a_proxy_each(two_seeds):
    assert {path.name for path in two_seeds.iterdir()} == FILES | {"proxies"}
    names = {f"seed{seed}.safetensors" for seed in (12, 13)}
    assert {path.name for path in (two_seeds / "proxies").iterdir()} == names
    best = []
    for i, seed in enumerate((12, 13)):
        record = files.load_proxy(two_seeds / "proxies" / f"seed{seed}.safetensors").record
        best.append(max(float(row["incumbent_mean"]) for row in rows(two_seeds)[i::2]))
        assert record["seed"] == seed and record["score"] == pytest.approx(best[i])
    assert files.load_proxy(two_seeds).record["score"] == pytest.approx(max(best))


def test_a_population_that_diverges_finishes_and_is_counted(tmp_path):
    shared = chunks()

    def wild_init(keys):
        state = shared.program.init(keys)
        noise_std = state.es_state.noise_std * 1e30
        return state.replace(es_state=state.es_state.replace(noise_std=noise_std))

    wild = session.Chunks(dataclasses.replace(shared.program, init=wild_init))
    wild._compiled = shared._compiled
    config = sejax.config([*TINY, "generations=2", f"run_dir={tmp_path}"])
    with run_directory.open_for(config) as directory:
        session.run(config, directory, wild)
    assert [int(row["num_nonfinite"]) for row in rows(tmp_path)] == [4, 4]
    assert all(math.isfinite(float(row["incumbent_mean"])) for row in rows(tmp_path))


# --- trackers ------------------------------------------------------------------------------------

TRACKER = """
import json
from pathlib import Path

class Lines:
    def __init__(self, run, fail_at):
        self.path, self.fail_at = run.folder.parent / "lines", fail_at
    def log(self, generation, values, scores):
        if generation == self.fail_at:
            raise RuntimeError("out of paper")
        members = scores.get("member_scores", [])
        line = [generation, values["incumbent_mean"], list(map(float, members))]
        with self.path.open("a") as file:
            file.write(json.dumps(line) + chr(10))
    def show(self, name, picture, generations):
        assert picture.exists()
    def close(self):
        pass

def make(run, fail_at: int | None = None) -> Lines:
    return Lines(run, fail_at)
"""


def test_a_tracker_of_ones_own_is_told_what_the_files_have(uninterrupted, tmp_path, monkeypatch):
    (tmp_path / "my_tracker.py").write_text(TRACKER)
    monkeypatch.syspath_prepend(str(tmp_path))
    learn(tmp_path / "run", "generations=4", "tracker=my_tracker:make")
    said = learn(tmp_path / "run", "generations=6", "tracker=my_tracker:make", "tracker.fail_at=5")
    assert "tracker=my_tracker:make has failed" in said and "RuntimeError: out of paper" in said
    made = rows(tmp_path / "run")
    assert made == rows(uninterrupted)
    proxies = [(path / "proxy.safetensors").read_bytes() for path in (tmp_path / "run",
                                                                      uninterrupted)]  # fmt: skip
    assert proxies[0] == proxies[1]
    lines = [json.loads(line) for line in (tmp_path / "lines").read_text().splitlines()]
    assert [line[0] for line in lines] == [0, 1, 2, 3, 4]
    for (_, mean, scores), row in zip(lines, made, strict=False):
        assert mean == float(row["incumbent_mean"])
        assert max(scores) == pytest.approx(float(row["population_max"]))
        assert sum(scores) / len(scores) == pytest.approx(float(row["population_mean"]))
    learn(tmp_path / "run", "generations=6", "tracker=my_tracker:make")  # what it has missed
    last = json.loads((tmp_path / "lines").read_text().splitlines()[-1])
    assert last == [5, float(made[5]["incumbent_mean"]), []]


# --- families of agents --------------------------------------------------------------------------

FAMILIES = ("agents=[sarsa,q_learning]",)
OWN = [word for word in TINY if not word.startswith("agent.")]


@functools.cache
def family_chunks():
    return session.make_chunks(sejax.config([*OWN, *FAMILIES]))


def learn_families(path, *words):
    """A session of a run with two families; returns the line that is printed of its last chunk."""
    config = sejax.config([*OWN, *words, f"run_dir={path}"])
    with run_directory.open_for(config) as directory, RunProgress(config) as report:
        session.run(config, directory, family_chunks(), report)


@pytest.fixture(scope="module")
def two_families(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("families")
    learn_families(path, *FAMILIES, "generations=5")
    return path


def test_metrics_and_proxies_tell_of_each_family(two_families):
    keys = ("q_learning", "sarsa")
    made = rows(two_families)
    assert list(made[0]) == [
        *(name for name in COLUMNS if name != "wall_s"),
        *(f"{name}_{key}" for key in keys for name in FAMILY_COLUMNS),
    ]
    for row in made:
        mean = sum(float(row[f"incumbent_mean_{key}"]) for key in keys) / 2
        assert float(row["incumbent_mean"]) == pytest.approx(mean, abs=1e-6)
        assert all(row[f"num_nonfinite_{key}"] == "0" for key in keys)
    for name, of in (("proxy", None), ("proxy_last", -1)):
        record = files.load_proxy(two_families / f"{name}.safetensors").record
        row = made[record["generation"] if of is None else of]
        scores = {key: pytest.approx(float(row[f"incumbent_mean_{key}"])) for key in keys}
        assert record["scores"] == scores


def test_a_run_of_families_goes_on_whichever_way_they_are_named(two_families, tmp_path, capsys):
    learn_families(tmp_path, *FAMILIES, "generations=2")
    assert re.search(
        r"incumbent \S+ ± \S+ \(q_learning \S+, sarsa \S+\), best", capsys.readouterr().out
    )
    learn_families(tmp_path, "agents=[q_learning,sarsa]", "generations=5")
    assert "Going on at generation 2" in capsys.readouterr().out
    assert rows(tmp_path) == rows(two_families)
    proxy = "proxy.safetensors"
    assert (tmp_path / proxy).read_bytes() == (two_families / proxy).read_bytes()
    assert is_drawn(tmp_path / "learning_curve.png")


def test_other_families_in_the_same_directory_are_refused(two_families):
    with pytest.raises(ConfigError, match=r"differs in agents\.sarsa\.weight \(1\.0 there, 2\.0"):
        learn_families(two_families, *FAMILIES, "agents.sarsa.weight=2")


def test_the_command_names_all_families_for_the_evaluation(two_families, capsys):
    run.learn(sejax.config([*OWN, *FAMILIES, "generations=5", f"run_dir={two_families}"]))
    said = capsys.readouterr().out
    assert f"sejax.evaluate proxy={two_families} agent=[q_learning,sarsa] num_agents=20" in said


# --- damage --------------------------------------------------------------------------------------


def test_a_damaged_checkpoint_is_named_and_the_one_before_is_used(uninterrupted, tmp_path):
    learn(tmp_path, "generations=4")
    newest = tmp_path / "checkpoint" / "sejax-generation-4.safetensors"
    newest.write_bytes(newest.read_bytes()[:-10])
    said = learn(tmp_path, "generations=6")
    assert f"{newest} is passed over" in said and "Going on at generation 3" in said
    assert rows(tmp_path) == rows(uninterrupted)


def test_a_run_that_lost_its_checkpoints_is_not_replaced(uninterrupted, tmp_path):
    shutil.copytree(uninterrupted, tmp_path, dirs_exist_ok=True)
    shutil.rmtree(tmp_path / "checkpoint")
    files = [tmp_path / name for name in ("metrics.csv", "config.yaml", "proxy.safetensors")]
    before = [file.read_bytes() for file in files]
    with pytest.raises(ConfigError, match=r"keep the checkpoints of a run.*run_dir=FOLDER"):
        learn(tmp_path, "generations=9")
    assert [file.read_bytes() for file in files] == before


def test_another_configuration_in_the_same_directory_is_refused(uninterrupted):
    with pytest.raises(ConfigError, match=r"differs in es\.population_size \(2 there, 3 here\)"):
        learn(uninterrupted, "es.population_size=3")


def test_an_unwritable_directory_is_a_clear_error(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(ConfigError, match=r"run_dir must be a folder that can be written.*Set run"):
        learn(blocked / "run")


def test_a_full_disk_loses_nothing_that_was_written(uninterrupted, tmp_path, monkeypatch):
    learn(tmp_path, "generations=2")
    before = (tmp_path / "metrics.csv").read_bytes()

    fsync = os.fsync

    def full(descriptor):
        if "metrics" in os.readlink(f"/proc/self/fd/{descriptor}"):
            raise OSError(28, "No space left on device")
        fsync(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr("sejax.ops.files.os.fsync", full)
        with pytest.raises(OSError, match="No space left"):
            learn(tmp_path, "generations=6")
    assert (tmp_path / "metrics.csv").read_bytes() == before
    assert not list(tmp_path.glob(".metrics*")), "temporary files are removed"
    learn(tmp_path, "generations=6")
    assert rows(tmp_path) == rows(uninterrupted)


# --- processes -----------------------------------------------------------------------------------

# `sejax.run` whose process gets a signal when it has told of its second generation. A kill comes at
# once; Ctrl-C comes from another thread, at whatever the run is doing then. A shell's background
# jobs, such as a test run may be, ignore Ctrl-C, and what they start does too.
DRIVER = """
import os, runpy, signal, sys, threading
from sejax.cli import progress

number = signal.Signals[sys.argv.pop(1)]
signal.signal(signal.SIGINT, signal.default_int_handler)
update = progress.RunProgress.update

def told(self, generation, info):
    update(self, generation, info)
    if generation == 2 and number == signal.SIGKILL:
        os.kill(os.getpid(), number)
    if generation == 2:
        threading.Timer(0.05, os.kill, (os.getpid(), number)).start()

progress.RunProgress.update = told
runpy.run_module("sejax.run", run_name="__main__", alter_sys=True)
"""


def process(*words: str, timeout: float = 1800) -> subprocess.CompletedProcess[str]:
    """A process of its own, which finds what has been compiled here."""
    cache = {"JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir),
             "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.05"}  # fmt: skip
    return subprocess.run(words, capture_output=True, text=True, timeout=timeout,
                          env=os.environ | cache)  # fmt: skip


def test_a_killed_run_goes_on_to_the_same_metrics(uninterrupted, tmp_path):
    words = [*TINY, "generations=6", f"run_dir={tmp_path}"]
    killed = process(sys.executable, "-c", DRIVER, "SIGKILL", *words)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert len(rows(tmp_path)) == 2
    finished = process(*RUN, *words)
    assert finished.returncode == 0, finished.stderr
    assert "Going on at generation 2" in finished.stdout and "learned" in finished.stdout
    assert rows(tmp_path) == rows(uninterrupted)
    assert {path.name for path in tmp_path.iterdir()} == FILES


def test_ctrl_c_saves_and_exits_130(tmp_path):
    words = [*TINY, "generations=1000000", f"run_dir={tmp_path}"]
    ended = process(sys.executable, "-c", DRIVER, "SIGINT", *words)
    assert ended.returncode == 130, ended.stderr
    saved = next(line for line in ended.stdout.splitlines() if "are saved in" in line)
    assert 2 <= int(saved.split()[1]) <= len(rows(tmp_path))
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


def test_bad_input_ends_a_process_with_one_message_and_status_2(tmp_path):
    for word, message in [
        ("env=cartpol", "Did you mean env=cartpole?"),
        ("~env=[[1]]", "env must be chosen"),
    ]:
        ended = process(*RUN, word, f"run_dir={tmp_path}/run")
        assert ended.returncode == 2
        assert message in ended.stderr and len(ended.stderr.strip().splitlines()) == 1
        assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("env=cartpol", "Did you mean env=cartpole?"),
        ("es.population_size=1", "es.population_size must be at least 2"),
        ("es.noise_sdt=1", "Did you mean es.noise_std?"),
        ("devices=x", "devices must be a whole number"),
    ],
)
def test_bad_input_ends_with_one_message_and_status_2(
    override, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(sys, "argv", ["sejax.run", override, f"run_dir={tmp_path}/run"])
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(SystemExit) as ended:
        commands.start("run", run.main)
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert message in said and len(said.strip().splitlines()) == 1
    assert not (tmp_path / "run").exists()


def test_the_command_says_how_it_ended_and_what_to_do_next(uninterrupted, capsys):
    best = run.learn(sejax.config([*TINY, "generations=6", f"run_dir={uninterrupted}"]))
    said = capsys.readouterr().out
    scores = [float(row["incumbent_mean"]) for row in rows(uninterrupted)]
    assert best == pytest.approx(max(scores))
    assert f"best incumbent mean {best:.1f}, solved at 0.8" in said
    assert f"python -m sejax.evaluate proxy={uninterrupted} agent=q_learning" in said


# --- sweeps --------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode, words, name", [
    ("RUN", ["es.noise_std=0.03"], ""),
    ("MULTIRUN", ["es.noise_std=0.03", "seed=1", "env=acrobot"], "es.noise_std_0.03"),
    ("MULTIRUN", ["seed=1"], ""),
    ("MULTIRUN", ["agent.learning_rate=0.1", "+a=[1, 2]"], "agent.learning_rate_0.1_+a_1_2_"),
])  # fmt: skip
def test_a_job_of_a_sweep_has_a_folder_of_its_own(monkeypatch, mode, words, name):
    job = types.SimpleNamespace(mode=RunMode[mode],
                                overrides=types.SimpleNamespace(task=words))  # fmt: skip
    monkeypatch.setattr(HydraConfig, "initialized", lambda: True)
    monkeypatch.setattr(HydraConfig, "get", lambda: job)
    assert commands.name_in_sweep(build.IN_RUN_DIR) == name
    job.overrides.task = [f"agent.x={'9' * 500}"]
    assert len(commands.name_in_sweep(build.IN_RUN_DIR)) <= 120


def test_a_progress_line_is_of_the_generations_that_ran():
    active = np.array([[True, True, False], [True, False, False]])
    last = progress._last_rows(Rows(active=active, values=np.arange(6.0).reshape(2, 3)))
    np.testing.assert_array_equal(last.values, [3.0, 1.0])  # of the third seed none


class Rows(NamedTuple):
    active: Any
    values: Any
