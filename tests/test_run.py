"""`python -m sejax.run` as a user meets it: files, resume, kills, damage, bad input."""

import contextlib
import functools
import io
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import jax
import pytest
import yaml
from support import ROOM, ended, is_drawn, refusal, refused
from support import metrics as rows

import sejax
from sejax import run
from sejax.runs import commands, run_directory, runtime, session
from sejax.runs.chunks import Chunks
from sejax.runs.config import LearnConfig
from sejax.runs.progress import RunProgress
from sejax.runs.run_directory import AGENT_COLUMNS, COLUMNS

OWN = [*ROOM, "seed=12"]
TINY = [*OWN, "agent.learning_rate=0.5"]
FILES = {"config.yaml", "metrics.csv", "proxy.safetensors", "proxy_last.safetensors",
         "checkpoint.safetensors", "learning_curve.png", "run.json", "sejax.lock"}  # fmt: skip
RUN = [sys.executable, "-m", "sejax.run"]
START = functools.partial(commands.start, run.main, run.help_text, LearnConfig.of_sweep)


@functools.cache
def chunks(*words):
    """The compiled program of a configuration, which all runs of it share."""
    return Chunks(sejax.config(words))


def learn(path, *words, program=(), base=TINY):
    """A session of a run, as `sejax.run` has it; returns its messages."""
    config = sejax.config([*base, *program, *words, f"run_dir={path}"])
    directory, said = run_directory.RunDirectory(config), io.StringIO()
    with directory, contextlib.redirect_stdout(said):
        session.run(config, directory, chunks(*base, *program), RunProgress(config))
    return said.getvalue()


def assert_same(folder, other):
    """Two runs have the same rows and proxies."""
    assert rows(folder) == rows(other)
    for name in ("proxy.safetensors", "proxy_last.safetensors"):
        assert (folder / name).read_bytes() == (other / name).read_bytes()


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory) -> Path:
    """A whole run of six generations."""
    path = tmp_path_factory.mktemp("whole")
    learn(path, "generations=6")
    return path


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["ddqn", "ppo"])
def test_agents_with_networks_learn_the_same_on_any_number_of_devices(tmp_path, agent):
    words = "env=cartpole", f"agent={agent}", "es.population_size=8", "generations=2"
    for devices in "12":
        command = sys.executable, "-m", "sejax.run", *words, f"devices={devices}"
        subprocess.run([*command, f"run_dir={tmp_path / devices}"], check=True)
    assert rows(tmp_path / "1") == rows(tmp_path / "2")


# --- a run and its files -------------------------------------------------------------------------


def test_a_run_writes_the_files_of_the_design(uninterrupted):
    assert {path.name for path in uninterrupted.iterdir()} == FILES
    assert len(rows(uninterrupted)) == 6
    stored = yaml.safe_load((uninterrupted / "config.yaml").read_text())
    words = ["generations=6", f"run_dir={uninterrupted}"]
    assert LearnConfig.of_stored(stored) == sejax.config([*TINY, *words])


def test_the_stored_proxy_is_the_one_of_the_best_generation(uninterrupted):
    scores = [float(row["incumbent_mean"]) for row in rows(uninterrupted)]
    record = sejax.load_proxy(uninterrupted).record
    assert record["score"] == pytest.approx(max(scores))
    best = max(range(6), key=lambda generation: (scores[generation], generation))
    assert record["generation"] == best not in (0, 5)
    last = sejax.load_proxy(uninterrupted / "proxy_last.safetensors").record
    assert last["generation"] == 5 and last["score"] == pytest.approx(scores[-1])


def test_a_run_in_two_sessions_equals_one_in_one(uninterrupted, tmp_path, monkeypatch):
    with monkeypatch.context() as context:
        context.setattr(runtime, "versions", lambda: {"jax": "0.1"})
        learn(tmp_path, "generations=4")
    said = learn(tmp_path, "generations=6")
    assert "Resuming at generation 4" in said and "made with {'jax': '0.1'}" in said
    assert_same(tmp_path, uninterrupted)
    both, whole = (
        json.loads((path / "run.json").read_text()) for path in (tmp_path, uninterrupted)
    )
    counts = ("agents", "train_steps", "real_steps", "generations")
    assert [both[name] for name in counts] == [whole[name] for name in counts]
    assert whole["real_steps"] == int(rows(uninterrupted)[-1]["env_steps_total"])
    assert both["cpu_s"] > 0 and whole["agents"] % 6 == 0 and whole["train_steps"] > 0


def test_seeds_run_one_after_the_other_on_one_executable(
    uninterrupted, tmp_path, monkeypatch, capsys
):
    compiled, compile_ = [], Chunks.compile
    monkeypatch.setattr(Chunks, "compile", lambda self, n: (compiled.append(n), compile_(self, n)))
    words = ["generations=6", "checkpoint_every=2", "seed=12,13", f"run_dir={tmp_path}"]
    best = run.learn_all(LearnConfig.of_sweep([*TINY, *words]))
    assert compiled == [2]
    scores = capsys.readouterr().out.partition("Best scores of the search mean:")[2]
    assert all(f"{tmp_path}/seed_{seed}" in scores for seed in (12, 13))
    assert {path.name for path in tmp_path.iterdir()} == {"seed_12", "seed_13"}
    for seed, score in zip((12, 13), best, strict=True):
        folder = tmp_path / f"seed_{seed}"
        assert {path.name for path in folder.iterdir()} == FILES
        assert {row["seed"] for row in rows(folder)} == {str(seed)}
        record = sejax.load_proxy(folder).record
        assert record["seed"] == seed and record["score"] == pytest.approx(score)
    assert rows(tmp_path / "seed_12") == rows(uninterrupted)
    other = LearnConfig.of_sweep([*TINY, "seed=11,13", f"run_dir={tmp_path}", "es.noise_std=0.5"])
    assert refusal(run.learn_all, other).field == "run_dir" and not (tmp_path / "seed_11").exists()


# --- trackers ------------------------------------------------------------------------------------

TRACKER = """
import json

class Lines:
    def __init__(self, run, fail_at):
        self.path, self.fail_at = run.folder.parent / "lines", fail_at
        self.write("open", run.id, run.generation)
    def write(self, *values):
        with self.path.open("a") as file:
            file.write(json.dumps(values) + chr(10))
    def on_generation(self, info):
        if info.generation == self.fail_at:
            raise RuntimeError("out of paper")
        scores = list(map(float, info.scores))
        self.write(info.generation, info.values["incumbent_mean"], scores, info.train_steps)
    def close(self):
        self.write("close")

def make(run, fail_at: int | None = None) -> Lines:
    return Lines(run, fail_at)
"""


def test_a_tracker_of_ones_own_hears_what_the_files_have(uninterrupted, tmp_path, monkeypatch):
    (tmp_path / "my_tracker.py").write_text(TRACKER)
    monkeypatch.syspath_prepend(str(tmp_path))
    folder, word = tmp_path / "run", "tracker=my_tracker:make"
    learn(folder, "generations=3", word)
    said = learn(folder, "generations=6", word, "tracker.fail_at=5")
    assert "tracker=my_tracker:make has failed" in said and "RuntimeError: out of paper" in said
    learn(folder, "generations=6", word)  # nothing is left to do: not even opened
    assert_same(folder, uninterrupted)
    lines = [json.loads(line) for line in (tmp_path / "lines").read_text().splitlines()]
    assert [line[0] for line in lines] == ["open", 0, 1, 2, "close", "open", 3, 4, "close"]
    assert lines[0][1] == lines[5][1] and (lines[0][2], lines[5][2]) == (0, 3)
    heard = [line for line in lines if isinstance(line[0], int)]
    for (_, mean, scores, steps), row in zip(heard, rows(folder), strict=False):
        assert mean == float(row["incumbent_mean"])
        assert max(scores) == pytest.approx(float(row["population_max"]))
        assert steps % float(row["train_steps_mean"]) == 0


# --- families of agents --------------------------------------------------------------------------

FAMILIES = ("agents=[sarsa,q_learning]",)


learn_families = functools.partial(learn, program=FAMILIES, base=OWN)


@pytest.fixture(scope="module")
def two_families(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("families")
    learn_families(path, "generations=5")
    return path


def test_metrics_and_proxies_tell_of_each_family(two_families):
    keys = ("q_learning", "sarsa")
    made = rows(two_families)
    assert list(made[0]) == [
        *(name for name in COLUMNS if name != "wall_s"),
        *(f"{name}_{key}" for key in keys for name in AGENT_COLUMNS),
    ]
    for row in made:
        mean = sum(float(row[f"incumbent_mean_{key}"]) for key in keys) / 2
        assert float(row["incumbent_mean"]) == pytest.approx(mean, abs=1e-6)
        assert all(row[f"num_nonfinite_{key}"] == "0" for key in keys)
    for name, of in (("proxy", None), ("proxy_last", -1)):
        record = sejax.load_proxy(two_families / f"{name}.safetensors").record
        row = made[record["generation"] if of is None else of]
        scores = {key: pytest.approx(float(row[f"incumbent_mean_{key}"])) for key in keys}
        assert record["scores"] == scores


def test_a_run_of_families_goes_on_whichever_way_they_are_named(two_families, tmp_path):
    said = learn_families(tmp_path, "generations=2")
    assert re.search(r"search mean \S+ ± \S+ \(q_learning \S+, sarsa \S+\), best", said)
    said = learn_families(tmp_path, "agents=[q_learning,sarsa]", "generations=5")
    assert "Resuming at generation 2" in said
    assert_same(tmp_path, two_families)
    assert is_drawn(tmp_path / "learning_curve.png")


# --- damage --------------------------------------------------------------------------------------


def test_files_that_lack_or_are_damaged_are_made_again(uninterrupted, tmp_path):
    folder = Path(shutil.copytree(uninterrupted, tmp_path / "run"))
    for name in FILES - {"checkpoint.safetensors"}:
        (folder / name).unlink()
    (folder / "proxy.safetensors").write_text("damaged")
    learn(folder, "generations=6")
    assert {path.name for path in folder.iterdir()} == FILES
    assert_same(folder, uninterrupted)


# --- processes -----------------------------------------------------------------------------------

# `sejax.run` whose process gets a signal after its second generation. A kill comes at once; Ctrl-C
# comes from another thread, at whatever the run is doing then. A shell's background jobs, such as a
# test run may be, ignore Ctrl-C, and the processes that they start do too.
DRIVER = """
import os, runpy, signal, sys, threading
from sejax.runs import progress

number = signal.Signals[sys.argv.pop(1)]
signal.signal(signal.SIGINT, signal.default_int_handler)
on_generation = progress.RunProgress.on_generation

def heard(self, info):
    on_generation(self, info)
    if info.generation == 1 and number == signal.SIGKILL:
        os.kill(os.getpid(), number)
    if info.generation == 1:
        threading.Timer(0.05, os.kill, (os.getpid(), number)).start()

progress.RunProgress.on_generation = heard
runpy.run_module("sejax.run", run_name="__main__", alter_sys=True)
"""


def process(*words: str) -> subprocess.CompletedProcess[str]:
    """A process of its own."""
    cache = {"JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir),
             "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.05"}  # fmt: skip
    environment = os.environ | cache
    return subprocess.run(words, capture_output=True, text=True, timeout=1800, env=environment)


def test_a_killed_run_goes_on_to_the_same_numbers(uninterrupted, tmp_path):
    words = [*TINY, "generations=6", f"run_dir={tmp_path}"]
    ended = process(sys.executable, "-c", DRIVER, "SIGKILL", *words)
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    assert len(rows(tmp_path)) == 2
    assert "Resuming at generation 2" in learn(tmp_path, "generations=6")
    assert_same(tmp_path, uninterrupted)
    assert {path.name for path in tmp_path.iterdir()} == FILES


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_ctrl_c_and_sigterm_save_and_exit_130_and_143(tmp_path, number):
    words = [*TINY, "generations=1000000", f"run_dir={tmp_path}"]
    ended = process(sys.executable, "-c", DRIVER, number.name, *words)
    assert ended.returncode == 128 + number, ended.stderr
    assert ended.stdout.endswith("What has ended is saved; the same command goes on from there.\n")
    assert (count := len(rows(tmp_path))) >= 2 and (tmp_path / "proxy.safetensors").exists()
    assert f"Resuming at generation {count}" in learn(tmp_path, f"generations={count + 1}")


def test_a_sweep_with_a_run_that_cannot_be_begins_none(tmp_path):
    words = ["agent=ppo", "agent.num_minibatches=4,1000", f"run_dir={tmp_path}/a"]
    assert refused(run.main, words) == "agent.num_minibatches" and not (tmp_path / "a").exists()
    for sign, number in (("<", 1), (">", 2)):
        (tmp_path / f"a{sign}.yaml").write_text(f"generations: {number}")
    words = [f"preset={tmp_path}/a<.yaml,{tmp_path}/a>.yaml", f"run_dir={tmp_path}/a"]
    assert refused(run.main, words) == "run_dir" and not (tmp_path / "a").exists()


def test_a_run_in_a_pipe_says_what_it_does_and_counts_as_its_file(tmp_path, capsys):
    run.main([*TINY, f"run_dir={tmp_path}"])
    said = capsys.readouterr().out
    assert "compiling ...\n" in said
    counted = [x.split("/")[0] for x in said.splitlines() if x.startswith("generation ")]
    assert counted == [f"generation {row['generation']}" for row in rows(tmp_path)]
    assert "generation 2/2: search mean" in said  # the last one


def test_stop_when_solved_may_change_between_sessions(uninterrupted, tmp_path):
    def go(generations, *program):
        learn(tmp_path, f"generations={generations}", program=program)
        return json.loads((tmp_path / "run.json").read_text())["ended"]

    assert go(6, "stop_when_solved=true") == "solved" and len(rows(tmp_path)) == 3
    assert go(6) == "finished" and rows(tmp_path) == rows(uninterrupted)
    assert go(9, "stop_when_solved=true") == "solved" and rows(tmp_path) == rows(uninterrupted)


def test_an_interrupt_waits_until_files_are_written():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    written = []
    try:
        with pytest.raises(KeyboardInterrupt), session.interrupts_held():
            signal.raise_signal(signal.SIGINT)
            written.append("all")
        assert written == ["all"]
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_print_config_prints_what_would_run_and_runs_nothing(tmp_path, monkeypatch, capsys):
    words = [*TINY, f"run_dir={tmp_path}/run", "seed=1,2"]
    status, said, _ = ended(monkeypatch, capsys, START, *words, "--print-config")
    parsed = [LearnConfig.of_stored(x) for x in yaml.safe_load_all(said)]
    assert status == 0 and parsed == LearnConfig.of_sweep(words) and not (tmp_path / "run").exists()


def test_the_command_says_how_it_ended_and_what_to_do_next(uninterrupted, tmp_path, capsys):
    folder = shutil.copytree(uninterrupted, tmp_path / "it's a, b")
    word = f'run_dir="{folder}"'
    (best,) = run.learn_all([sejax.config([*TINY, "generations=6", word])])
    said = capsys.readouterr().out
    scores = [float(row["incumbent_mean"]) for row in rows(uninterrupted)]
    assert best == pytest.approx(max(scores))
    assert f"best search mean {best:.1f}, solved at 0.8" in said
    assert f"python -m sejax.evaluate {shlex.quote(word.replace('run_dir', 'proxy'))} num" in said
    assert "\ngridworld_2x2: " + ("solved" if best >= 0.8 else "learned") in f"\n{said}"


BROKEN = """
import math
import sejax
from sejax.envs.gridworld import GridParams, GridWorld

def make(reward: float = math.nan):
    params = GridParams(step_reward=reward, goal_reward=reward)
    return sejax.Task(name="room", env=GridWorld(["S ", " G"]), params=params, solved_reward=3.0)
"""


@pytest.mark.slow
def test_a_run_whose_agents_all_diverge_stops_and_recommends_nothing(tmp_path, monkeypatch, capsys):
    (tmp_path / "my_broken.py").write_text(BROKEN)
    monkeypatch.chdir(tmp_path)
    words = [*TINY, "env=my_broken:make", "run_dir=run"]
    for _ in range(2):  # typed again it says the same, and computes nothing
        status, out, err = ended(monkeypatch, capsys, START, *words)
        assert status == commands.FAILED and err.startswith("error: All agents of run diverged")
        assert "Does the task return NaN?" in err and err.count("\n") == 1
        assert "sejax.evaluate" not in out and "sejax.load" not in out
        assert [row["num_nonfinite"] for row in rows(tmp_path / "run")] == ["6"]
        assert not [*(tmp_path / "run").glob("proxy*")]
        summary = json.loads((tmp_path / "run" / "run.json").read_text())
        assert summary["ended"] == "diverged"
        (tmp_path / "run" / "run.json").write_text(json.dumps(summary | {"machine": "mine"}))
    assert summary["machine"] == "mine"  # of the one that computed it
    (tmp_path / "run" / "run.json").write_text(json.dumps(summary | {"real_steps": 0}))
    ended(monkeypatch, capsys, START, *words)  # and not of another run
    assert json.loads((tmp_path / "run" / "run.json").read_text())["real_steps"] > 0
    sweep = [*TINY, "env=my_broken:make", "env.reward=nan,1.0", "generations=1", "run_dir=sweep"]
    status, _, err = ended(monkeypatch, capsys, START, *sweep)
    assert status == commands.FAILED and "All agents of sweep/env.reward_nan diverged" in err
    assert (tmp_path / "sweep" / "env.reward_1.0" / "proxy.safetensors").exists()
