"""Studies: what trials tell them, what becomes of those that die, and what is written."""

import atexit
import contextlib
import dataclasses
import errno
import functools
import os
import shlex
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

optuna = pytest.importorskip("optuna", reason="needs Optuna: pip install 'sejax[search]'")

from optuna.trial import TrialState  # noqa: E402

from sejax.cli import commands, compose  # noqa: E402
from sejax.errors import ConfigError  # noqa: E402
from sejax.search import __main__, results, settings, spaces, study, trials, verification  # noqa: E402
from sejax.search.learning import Learning  # noqa: E402
from sejax.search.trials import Follower, Progress  # noqa: E402

SPACE = "es.noise_std=interval(0.1, 0.9)"


class Runner:
    """Trials whose score in each generation is 100 noise_std + generation, kept in a file."""

    def __init__(self, search):
        self.most = search.config.max_generations
        self.ran = []

    def config(self, words, folder=None):
        (value,) = [float(word.partition("=")[2]) for word in words]
        return value, folder

    def run(self, config, follower, is_inherited):
        value, folder = config
        folder.mkdir(parents=True, exist_ok=True)
        done = folder / "done"
        start = int(done.read_text()) if is_inherited and done.exists() else 0
        for generation in range(start + 1, self.most + 1):
            self.ran.append((folder.name, generation))
            done.write_text(str(generation))
            self.meanwhile(folder.name, generation)
            follower.tell(self.progress(value, generation))
        return self.progress(value, self.most)

    def meanwhile(self, name, generation):
        pass

    def progress(self, value, generations):
        scores = 100 * value + np.arange(1.0, generations + 1)[:, None]
        return Progress(scores=scores, cost=1000 * generations, seconds=1.0)


def read(path, *words):
    return settings.read([SPACE, f"search_dir={path}", "sampler_seed=0", *words])


@functools.cache
def empty_database():
    """A database with Optuna's tables, which take longer to make than most of these tests."""
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder)
    study.open_study(read(folder, "study=none"))
    optuna.delete_study(study_name="none", storage=f"sqlite:///{folder / 'study.db'}")
    return folder / "study.db"


def opened(path, *words):
    """A study in a database, where others may be at work on it."""
    if not (path / "study.db").exists():
        with (  # of SQLite's own: part of the database is in its log while a connection is open
            contextlib.closing(sqlite3.connect(empty_database())) as empty,
            contextlib.closing(sqlite3.connect(path / "study.db")) as copy,
        ):
            empty.backup(copy)
    return study.open_study(read(path, *words))


def in_memory(path, *words):
    """A study of one worker."""
    search = read(path, *words)
    parts = {"sampler": study._sampler(search), "pruner": study._pruner(search)}
    return optuna.create_study(direction="maximize", **parts), search


def states(found):
    return [trial.state.name for trial in found.get_trials(deepcopy=False)]


def test_hyperband_ends_trials_that_are_behind_and_every_trial_ends(tmp_path):
    found, search = in_memory(tmp_path, "trials=12", "sampler=random", "min_generations=1",
                           "max_generations=3")  # fmt: skip
    runner = Runner(search)
    study.work(found, search, runner, lambda text: None)
    ended = states(found)
    assert len(ended) == 12 and set(ended) == {"COMPLETE", "PRUNED"}
    table = results.table(found, search)
    pruned = table[table["state"] == "pruned"]
    assert set(pruned["generations"]) == {1}  # the one rung below the last generation
    assert set(table[table["state"] == "complete"]["generations"]) == {3}
    assert len(runner.ran) == table["generations"].sum()  # a pruned trial stops at once
    best = results.ranked(found)[0]
    assert best.params["es.noise_std"] == max(x.params["es.noise_std"] for x in found.trials)


def test_the_median_pruner_is_taken_by_name(tmp_path):
    found, search = in_memory(tmp_path, "pruner=median", "trials=8", "min_generations=1",
                           "max_generations=2")  # fmt: skip
    study.work(found, search, Runner(search), lambda text: None)
    assert states(found)[:5] == ["COMPLETE"] * 5 and "PRUNED" in states(found)


def test_the_median_pruner_spares_the_first_generations(tmp_path):
    found, search = in_memory(tmp_path, "pruner=median", "trials=10", "min_generations=3",
                           "max_generations=4", "sampler=random")  # fmt: skip
    study.work(found, search, Runner(search), lambda text: None)
    pruned = [trial.last_step for trial in found.trials if trial.state.name == "PRUNED"]
    assert pruned and min(pruned) == 3


@pytest.mark.parametrize("sampler", ["random", "tpe"])
def test_a_search_that_goes_on_draws_what_it_has_not_drawn(tmp_path, sampler):
    words = (f"sampler={sampler}", "pruner=none", "min_generations=1", "max_generations=1")
    for count in (3, 6):
        found, search = opened(tmp_path, *words, f"trials={count}")
        study.work(found, search, Runner(search), lambda text: None)
    drawn = [trial.params["es.noise_std"] for trial in found.trials]
    assert len(set(drawn)) == len(drawn) == 6
    uninterrupted, search = in_memory(tmp_path / "other", *words, "trials=3")
    study.work(uninterrupted, search, Runner(search), lambda text: None)
    assert drawn[:3] == [trial.params["es.noise_std"] for trial in uninterrupted.trials]


def test_one_worker_alone_counts_a_trial_as_failed(tmp_path):
    found, _ = opened(tmp_path)
    others = [opened(tmp_path)[0]._storage for _ in range(3)]
    for _ in range(5):
        trial, barrier = take(found), threading.Barrier(3)

        def fail(storage, trial=trial, barrier=barrier):
            barrier.wait()
            with contextlib.suppress(optuna.exceptions.UpdateFinishedTrialError):
                return storage.set_trial_state_values(trial._trial_id, TrialState.FAIL)

        with ThreadPoolExecutor(3) as pool:
            assert sorted(map(str, pool.map(fail, others))) == ["None", "None", "True"]


def test_a_trial_that_another_has_failed_is_queued_once_and_ctrl_c_stays_ctrl_c(tmp_path):
    found, search = opened(tmp_path, "trials=3", "pruner=none")

    class TakenForDead(Runner):
        def meanwhile(self, name, generation):
            number = int(name)
            study.queue_again(found, found.trials[number])
            found.tell(number, state=TrialState.FAIL)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        study.work(found, search, TakenForDead(search), lambda text: None)
    assert states(found) == ["FAIL", "WAITING"]


def take(found):
    """A trial as a worker has it; Optuna wants heartbeats from its own loop alone."""
    with pytest.warns(UserWarning, match="Heartbeat"):
        return found.ask()


def age_heartbeats(found):
    with found._storage._backend.engine.begin() as connection:
        connection.exec_driver_sql("UPDATE trial_heartbeats SET heartbeat='2020-01-01 00:00:00'")


def kill(found, number):
    """What is left of a worker that died long ago."""
    found._storage.record_heartbeat(found.trials[number]._trial_id)
    age_heartbeats(found)


def test_a_trial_whose_worker_died_is_retried_and_goes_on_from_its_files(tmp_path):
    words = ("trials=2", "pruner=none", "max_generations=5")
    found, search = opened(tmp_path, *words)
    dead = take(found)
    value = search.space["es.noise_std"].suggest(dead)
    folder = study.trial_folder(search, dead.number)
    folder.mkdir(parents=True)
    (folder / "done").write_text("3")
    (folder / "sejax.lock").write_text("of the dead")
    kill(found, dead.number)

    found, search = opened(tmp_path, *words)
    runner = Runner(search)
    study.work(found, search, runner, lambda text: None)
    assert states(found) == ["FAIL", "COMPLETE", "COMPLETE"]
    again = found.trials[1]
    assert search.space["es.noise_std"].of(again.params) == value
    assert again.user_attrs[study.HISTORY] == [0]
    assert [x for x in runner.ran if x[0] == "0001"] == [("0001", 4), ("0001", 5)]
    assert sorted(again.intermediate_values) == [1, 2, 3, 4, 5]  # those before, told anew
    assert not (study.trial_folder(search, 1) / "sejax.lock").exists()


def test_a_trial_that_takes_its_process_down_each_time_is_given_up(tmp_path):
    found, search = opened(tmp_path, "trials=1", "pruner=none", "max_generations=3")
    for number in range(study.RETRIES + 1):
        assert take(found).number == number
        kill(found, number)
        with pytest.warns(optuna.exceptions.ExperimentalWarning):
            optuna.storages.fail_stale_trials(found)
    assert states(found) == ["FAIL"] * (study.RETRIES + 1)  # and none waits
    study.work(found, search, Runner(search), lambda text: None)
    assert states(found)[-1] == "COMPLETE"


def test_an_interrupted_trial_is_queued_again(tmp_path):
    class Interrupted(Runner):
        def meanwhile(self, name, generation):
            if (name, generation) == ("0001", 2):
                raise KeyboardInterrupt

    words = ("trials=3", "pruner=none", "max_generations=3")
    found, search = opened(tmp_path, *words)
    with pytest.raises(KeyboardInterrupt):
        study.work(found, search, Interrupted(search), lambda text: None)
    assert states(found) == ["COMPLETE", "FAIL", "WAITING"]
    found, search = opened(tmp_path, *words)
    runner = Runner(search)
    study.work(found, search, runner, lambda text: None)
    assert states(found) == ["COMPLETE", "FAIL", "COMPLETE", "COMPLETE"]
    assert runner.ran[0] == ("0002", 3)


@pytest.mark.parametrize("moment", ["begins", "computes", "ends"])
def test_a_worker_that_was_taken_for_dead_leaves_the_trial_to_others(tmp_path, monkeypatch, moment):
    found, search = in_memory(tmp_path, "trials=2", "pruner=none", "max_generations=3")
    said = []

    def stopped():
        """Stops for so long that another worker takes the first trial."""
        (trial,) = found.trials
        found._storage.set_trial_state_values(trial._trial_id, optuna.trial.TrialState.FAIL)
        study.queue_again(found, trial)

    class Stopped(Runner):
        def meanwhile(self, name, generation):
            if moment == "computes" and (name, generation) == ("0000", 2):
                stopped()

    def suggest(self, trial):
        if moment == "begins" and trial.number == 0:
            stopped()
        return own_suggest(self, trial)

    def say(line):
        said.append(line)
        if moment == "ends" and line.startswith("trial 0") and "complete" in line:
            stopped()

    own_suggest = spaces.Dimension.suggest
    monkeypatch.setattr(spaces.Dimension, "suggest", suggest)
    study.work(found, search, Stopped(search), say)
    assert states(found) == ["FAIL", "COMPLETE", "COMPLETE"]
    assert any("taken for dead" in line for line in said)


def test_a_trial_whose_worker_died_before_its_first_heartbeat_is_not_left_behind(
    tmp_path, monkeypatch
):
    found, search = opened(tmp_path, "trials=1", "pruner=none", "max_generations=3")
    study.work(found, search, Runner(search), lambda text: None)
    take(found)
    naps = iter("ab")

    def later(seconds):
        next(naps)  # it waits once
        age_heartbeats(found)

    monkeypatch.setattr(study.time, "sleep", later)
    study.work(found, search, Runner(search), lambda text: None)
    assert states(found) == ["COMPLETE", "FAIL", "COMPLETE"]


def test_settings_that_cannot_work_together_are_pruned_with_their_reason(tmp_path):
    class Picky(Runner):
        def config(self, words, folder=None):
            if folder.name == "0000":
                raise ConfigError("no such pair")
            return super().config(words, folder)

    found, search = in_memory(tmp_path, "trials=2", "pruner=none", "max_generations=3")
    study.work(found, search, Picky(search), lambda text: None)
    assert states(found) == ["PRUNED", "COMPLETE"]
    assert found.trials[0].user_attrs["refused"] == "no such pair"
    assert len(results.table(found, search)) == 2


def test_an_error_is_no_trial_and_ends_the_worker(tmp_path):
    class Broken(Runner):
        def meanwhile(self, name, generation):
            raise ValueError("a bug")

    found, search = in_memory(tmp_path, "trials=2")
    with pytest.raises(ValueError, match="a bug"):
        study.work(found, search, Broken(search), lambda text: None)


def test_a_trial_that_cannot_be_written_is_queued_again_and_goes_on(tmp_path):
    class Full(Runner):
        is_full = True

        def meanwhile(self, name, generation):
            if self.is_full and (name, generation) == ("0001", 2):
                Full.is_full = False
                raise OSError(errno.ENOSPC, "No space left on device")

    found, search = in_memory(tmp_path, "trials=3", "pruner=none", "max_generations=3")
    with pytest.raises(OSError, match="No space"):
        study.work(found, search, Full(search), lambda text: None)
    study.work(found, search, Full(search), lambda text: None)
    assert states(found) == ["COMPLETE", "FAIL", "COMPLETE", "COMPLETE"]
    assert found.trials[2].user_attrs[study.HISTORY] == [1]
    assert found.trials[2].params == found.trials[1].params


def test_no_two_workers_get_the_same_waiting_trial(tmp_path):
    found, _ = opened(tmp_path, "study=mine")
    for _ in range(20):
        found.enqueue_trial({})
    url, start = f"sqlite:///{tmp_path / 'study.db'}", threading.Barrier(2)

    def take(_):
        mine, _ = study.open_study(settings.read(["study=mine", f"storage={url}"]))
        start.wait()
        return [mine._pop_waiting_trial_id() for _ in range(20)]

    with ThreadPoolExecutor(2) as pool:
        taken = [number for each in pool.map(take, range(2)) for number in each if number]
    assert sorted(taken) == [trial._trial_id for trial in found.trials]
    assert states(found) == ["RUNNING"] * 20 and found.trials[0].datetime_start


def test_workers_join_by_the_studys_name_and_other_searches_are_refused(tmp_path):
    _, search = opened(tmp_path, "env=acrobot", "study=mine", "seeds=2")
    url = search.storage
    joined, theirs = study.open_study(settings.read(["study=mine", f"storage={url}"]))
    assert joined.study_name == "mine" and theirs.stored() == search.stored()
    assert theirs.config.seeds == 2
    with pytest.raises(ConfigError, match=r"differs in seeds \(2 there, 3 here\)"):
        opened(tmp_path, "env=acrobot", "study=mine", "seeds=3")
    with pytest.raises(ConfigError, match="env=acrobot there, env=cartpole here"):
        opened(tmp_path, "env=cartpole", "study=mine", "seeds=2")
    with pytest.raises(
        ConfigError, match=r"study must be one that is there.* got other.* has mine"
    ):
        study.open_study(settings.read(["study=other", f"storage={url}"]))
    with pytest.raises(ConfigError, match="space must be given"):
        study.open_study(settings.read(["study=other", "seeds=2", f"storage={url}"]))
    assert optuna.get_all_study_names(url) == ["mine"]


def test_a_study_of_a_version_with_other_fields_is_joined(tmp_path):
    made, search = opened(tmp_path, "seeds=2")
    stored = search.stored()
    stored["search"] = {"seeds": 2, "max_generations": 27, "verify": 7}  # verify is free today
    made.set_user_attr(study.STORED, stored)
    _, theirs = opened(tmp_path, "seeds=2", "verify=3")
    assert theirs.config == dataclasses.replace(search.config, verify=3)
    with pytest.raises(ConfigError, match=r"differs in score \(mean there, worst here\)"):
        opened(tmp_path, "seeds=2", "score=worst")


def test_a_verification_that_is_interrupted_says_how_to_go_on(tmp_path, monkeypatch, capsys):
    def interrupted(*words):
        raise KeyboardInterrupt

    left = []
    found, search = in_memory(tmp_path)
    monkeypatch.setattr(verification, "verify", interrupted)
    monkeypatch.setattr(commands, "leave", lambda status: left.append(status) or sys.exit(status))
    with pytest.raises(SystemExit):
        __main__._verified(found, search, Runner(search))
    assert left == [commands.INTERRUPTED]
    assert "the same command goes on with the others" in capsys.readouterr().out


def test_a_storage_that_cannot_be_used_is_refused_without_its_password(tmp_path):
    search = settings.read([SPACE, "storage=nothing://me:secret@there/x"])
    with pytest.raises(ConfigError, match="storage must be a database") as caught:
        study.open_study(search)
    assert "secret" not in str(caught.value)


class Told:
    """A trial that keeps what it is told."""

    def __init__(self):
        self.values, self.kept = {}, {}

    def report(self, value, step):
        self.values[step] = value

    def should_prune(self):
        return False

    def set_user_attr(self, name, value):
        self.kept[name] = value


@pytest.mark.parametrize(
    ("measure", "score", "expected"),
    # Two seeds with 1, 5, 3 and 2, 0, 4 that end after the third of four generations.
    [
        ("last", "mean", [1.5, 2.5, 3.5, 3.5]),
        ("last", "worst", [1, 0, 3, 3]),
        ("best", "mean", [1.5, 3.5, 4.5, 4.5]),
        ("mean", "mean", [1.5, 2, 2.5, 2.75]),  # (1 + 5 + 3 + 3) / 4 = 3, (2 + 0 + 4 + 4) / 4 = 2.5
        ("mean", "worst", [1, 1, 2, 2.5]),
    ],
)
def test_scores_are_of_generations_and_seeds_as_asked(measure, score, expected):
    search = settings.read(
        [SPACE, f"measure={measure}", f"score={score}", "seeds=2", "max_generations=4"]
    )
    trial = Told()
    progress = Progress(scores=np.array([[1.0, 2], [5, 0], [3, 4]]), cost=7, seconds=1.0)
    value = Follower(trial, search).finish(progress)
    assert list(trial.values.values()) == pytest.approx(expected)
    assert value == pytest.approx(expected[-1])
    assert trial.kept["generations"] == 3 and trial.kept["cost"] == 7


def test_what_is_not_finite_is_pruned():
    search = settings.read([SPACE, "max_generations=3"])
    progress = Progress(scores=np.array([[1.0], [np.nan], [np.nan]]), cost=7, seconds=1.0)
    with pytest.raises(optuna.TrialPruned):
        Follower(Told(), search).finish(progress)


def test_the_newest_directory_is_copied_with_its_checkpoint_first(tmp_path, monkeypatch):
    old = tmp_path / "0001"
    (old / "checkpoint").mkdir(parents=True)
    for name in ("checkpoint/x", "metrics.csv", "sejax.lock", ".metrics.csv.sejax-00000000.csv"):
        (old / name).write_text(name)
    copied = []
    tree, one = trials.shutil.copytree, trials.shutil.copy2
    monkeypatch.setattr(
        trials.shutil, "copytree", lambda s, d, **k: (copied.append(s.name), tree(s, d, **k))
    )
    monkeypatch.setattr(
        trials.shutil, "copy2", lambda s, d: (copied.append(Path(s).name), one(s, d))
    )
    assert trials.take_over(tmp_path / "0005", [tmp_path / "0000", old, tmp_path / "0003"])
    assert copied[0] == "checkpoint"
    assert sorted(x.name for x in (tmp_path / "0005").iterdir()) == ["checkpoint", "metrics.csv"]
    assert not trials.take_over(tmp_path / "0006", [tmp_path / "0004"])


def test_a_checkpoint_that_is_replaced_while_it_is_copied_does_no_harm(tmp_path, monkeypatch):
    old = tmp_path / "0000" / "checkpoint"
    old.mkdir(parents=True)
    for name in ("1.msgpack", "2.msgpack"):
        (old / name).write_text(name)
    one = trials.shutil.copy2

    def copy(source, to):
        (old / "1.msgpack").unlink(missing_ok=True)
        return one(source, to)

    monkeypatch.setattr(trials.shutil, "copy2", copy)
    assert trials.take_over(tmp_path / "0001", [tmp_path / "0000"])
    assert [x.name for x in (tmp_path / "0001" / "checkpoint").iterdir()] == ["2.msgpack"]


def test_what_was_refused_is_not_what_pruning_saved(tmp_path):
    rows = pd.DataFrame({"state": ["complete", "pruned", "pruned"], "generations": [4, 1, None]})
    said = results.saved_by_pruning(rows, read(tmp_path, "max_generations=4"))
    assert said == ("1 of 2 trials were pruned, which saved 3 of 8 generations (38%). "
                    "Refused: 1.")  # fmt: skip


def test_names_are_text_whatever_yaml_takes_them_for():
    config = settings.read([SPACE, "study=2024-01-01", "search_dir=007", "storage=null"]).config
    assert (config.study, config.search_dir, config.storage) == ("2024-01-01", "007", None)


def test_the_front_has_what_none_beats_at_its_cost():
    rows = pd.DataFrame(
        {"trial": range(5), "cost": [1, 2, 3, 3, 4], "mean": [5.0, 4.0, 7.0, 6.0, 7.0]}
    )
    assert results.pareto_front(rows, "mean")["trial"].tolist() == [0, 2]


def test_the_preset_file_makes_the_settings_of_the_override_line(tmp_path):
    fixed = ["env=acrobot", "preset=paper", "agent_hparams=varied", "devices=1", "trials=3"]
    search = read(tmp_path, *fixed, "agent.batch_size=16,32")
    words = ["es.noise_std=0.25", "agent.batch_size=16"]
    results.write_best(words, search, "sejax.run")
    (line,) = (tmp_path / "best.txt").read_text().splitlines()
    asked = compose.config(shlex.split(line)[3:])
    preset = results.preset_line(search, "sejax.run").partition(" sejax.run ")[2]
    assert compose.config([preset, "devices=1"]) == asked
    tracked = read(tmp_path, *fixed, "tracker=tensorboard", "agent.batch_size=16,32")
    tracked = dataclasses.replace(tracked, fixed=(*tracked.fixed, "tracker.project=mine"))
    results.write_best(words, tracked, "sejax.run")
    assert compose.config([preset, "devices=1"]) == asked
    assert asked.es.noise_std == 0.25 and asked.preset == "paper"


def test_what_was_found_is_written(tmp_path):
    found, search = in_memory(tmp_path, "trials=11", "sampler=random", "pruner=none",
                           "min_generations=1", "max_generations=1",
                           "es.step_size=interval(0.5,1)")  # fmt: skip

    class Two(Runner):
        def config(self, words, folder=None):
            return super().config(words[:1], folder)

    study.work(found, search, Two(search), lambda text: None)
    words = results.write(found, search, "sejax.run")
    best = results.ranked(found)[0]
    assert words[0] == f"es.noise_std={search.space['es.noise_std'].of(best.params)}"
    assert (tmp_path / "best.txt").read_text() == f"python -m sejax.run {' '.join(words)}\n"
    assert len(pd.read_csv(tmp_path / "trials.csv")) == 11
    assert (tmp_path / "pareto.png").stat().st_size > 5000
    shares = results.importances(found, search)
    assert max(shares, key=shares.get) == "es.noise_std"


# --- real searches -------------------------------------------------------------------------------

GRID = ("env=gridworld_2x2", "proxy.hidden_size=8", "es.population_size=4",
        "training.max_steps=50")  # fmt: skip
SMALL = (*GRID, "agent=q_learning")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("agents", "number"),
    [
        ("agent=q_learning", "agent.learning_rate=0.5"),
        ("agents=[q_learning,sarsa]", "agents.sarsa.learning_rate=0.5"),
    ],
)
def test_trials_of_a_shape_share_one_program_and_its_numbers_are_those_of_a_run(
    tmp_path, agents, number
):
    from sejax.cli import session
    from sejax.cli.run_directory import open_for
    from sejax.search.programs import Programs

    programs = Programs()

    def rows(name, chunks_of, *words):
        config = compose.config(
            [*GRID, agents, "generations=3", f"run_dir={tmp_path / name}", *words]
        )
        with open_for(config) as directory:
            session.run(config, directory, chunks_of(config))
            return [{k: float(v) for k, v in row.items() if k != "wall_s"}
                    for row in directory.rows]  # fmt: skip

    numbers = ("es.noise_std=0.2", "es.step_size=0.7", number)
    other = rows("other", programs.chunks)
    shared = rows("shared", programs.chunks, *numbers)
    assert len(programs.shapes) == 1
    assert shared != other
    for one, two in zip(shared, rows("plain", session.make_chunks, *numbers), strict=True):
        assert one == pytest.approx(two, rel=1e-5)
    rows("wider", programs.chunks, "proxy.hidden_size=9")
    assert len(programs.shapes) == 2


def command(path, *words):
    return [sys.executable, "-m", "sejax.search", *SMALL, "es.noise_std=interval(0.05,0.5)",
            "min_generations=1", "max_generations=6", "trials=12", "heartbeat=1", "devices=1",
            f"search_dir={path}", *words]  # fmt: skip


def stop(worker, database):
    """Stops it outside of a write to SQLite, which would make all others wait for it."""
    while True:
        os.kill(worker.pid, signal.SIGSTOP)
        if not database.exists():  # it is elsewhere
            return
        with (
            contextlib.closing(sqlite3.connect(database, timeout=1)) as connection,
            contextlib.suppress(sqlite3.OperationalError),
        ):
            connection.execute("BEGIN IMMEDIATE")
            return
        os.kill(worker.pid, signal.SIGCONT)
        time.sleep(0.1)


def run_with_casualties(path, *words):
    """Two workers, one of which is killed and the other stopped for longer than it may be."""
    workers = [subprocess.Popen(command(path, *words), stdout=subprocess.DEVNULL) for _ in "ab"]
    try:
        while not (path / "trials" / "0003").exists():
            assert all(worker.poll() is None for worker in workers)
            time.sleep(0.1)
        workers[0].kill()
        stop(workers[1], path / "study.db")
        third = subprocess.run(command(path, *words), capture_output=True, text=True, timeout=500)
        os.kill(workers[1].pid, signal.SIGCONT)
        assert third.returncode == 0, third.stderr
        assert workers[1].wait(timeout=300) == 0
    finally:
        for worker in workers:
            worker.kill()
            worker.wait()


def check_study(url, name="gridworld_2x2-se-q_learning"):
    storage = optuna.storages.RDBStorage(url)
    found = optuna.load_study(study_name=name, storage=storage)
    left = [x for x in found.trials if x.state.name != "FAIL"]
    assert {x.state.name for x in left} <= {"COMPLETE", "PRUNED"} and len(left) >= 12
    retried = {number for x in found.trials for number in x.user_attrs.get(study.HISTORY, [])}
    failed = {x.number for x in found.trials if x.state.name == "FAIL"}
    assert failed and failed <= retried
    # What a retried trial was told is what an undisturbed one would have been.
    for again in (x for x in left if study.HISTORY in x.user_attrs):
        before = found.trials[again.user_attrs[study.HISTORY][-1]].intermediate_values
        for step in before.keys() & again.intermediate_values.keys():
            assert again.intermediate_values[step] == pytest.approx(before[step], rel=1e-5)
    storage.engine.dispose()


@pytest.mark.slow
def test_a_killed_and_a_stopped_worker_cost_the_study_no_trial(tmp_path):
    run_with_casualties(tmp_path / "s")
    url = f"sqlite:///{tmp_path / 's' / 'study.db'}"
    check_study(url)
    with contextlib.closing(sqlite3.connect(tmp_path / "s" / "study.db")) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    again = subprocess.run(command(tmp_path / "s"), capture_output=True, text=True)
    assert again.returncode == 0 and "The best:" in again.stdout
    preset = f"preset={tmp_path / 's' / 'preset.yaml'}"
    assert preset in again.stdout
    rows = pd.read_csv(tmp_path / "s" / "trials.csv").set_index("trial")
    best = rows.loc[pd.read_csv(tmp_path / "s" / "verification.csv")["trial"][0]]
    made = compose.config([preset])
    assert made.name("agent") == "q_learning" and made.training.max_steps == 50
    assert best["state"] == "complete" and made.es.noise_std == best["es.noise_std"]


@pytest.fixture
def postgres(tmp_path):
    """URL of a database of a server of our own."""
    pytest.importorskip("psycopg", reason="needs its driver: pip install 'psycopg[binary]'")
    programs = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    if not programs:
        pytest.skip("needs PostgreSQL's server: apt install postgresql")
    folder = Path(tempfile.mkdtemp(dir="/tmp"))  # a path that the server's user can enter
    who = {"user": "postgres"} if os.geteuid() == 0 else {}  # the server refuses root
    if who:
        shutil.chown(folder, **who)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    started = [programs[-1].with_name("pg_ctl"), "-D", folder / "db", "-w"]
    options = f"-p {port} -c listen_addresses=127.0.0.1 -k {folder}"
    subprocess.run([programs[-1], "-D", folder / "db", "-U", "me", "-A", "trust"], check=True,
                   cwd=folder, stdout=subprocess.DEVNULL, **who)  # fmt: skip
    subprocess.run([*started, "-o", options, "-l", folder / "log", "start"], check=True,
                   cwd=folder, stdout=subprocess.DEVNULL, **who)  # fmt: skip
    yield f"postgresql://me@127.0.0.1:{port}/postgres"
    subprocess.run([*started, "-m", "immediate", "stop"], check=True, cwd=folder,
                   stdout=subprocess.DEVNULL, **who)  # fmt: skip
    shutil.rmtree(folder)


@pytest.mark.slow
def test_the_same_with_postgresql(tmp_path, postgres):
    run_with_casualties(tmp_path / "s", f"storage={postgres}", "study=there")
    check_study(postgres, "there")


@pytest.mark.slow
def test_an_agent_is_tuned_on_a_proxy_and_verified_on_the_real_task(tmp_path):
    words = ["proxy=cartpole", "agent=boltzmann_is_none"]
    done = subprocess.run([sys.executable, "-m", "sejax.search", *words, "space=agent"],
                          capture_output=True, text=True, cwd=tmp_path)  # fmt: skip
    assert done.returncode == 2 and "agent must be one of" in done.stderr
    words = ["proxy=cartpole", "agent=ppo", "space=agent", "trials=3", "min_generations=1",
             "max_generations=2", "verify=2", "num_agents=2", "real_training.max_steps=2000",
             "pruner=none", f"search_dir={tmp_path}"]  # fmt: skip
    done = subprocess.run([sys.executable, "-m", "sejax.search", *words],
                          capture_output=True, text=True)  # fmt: skip
    assert done.returncode == 0, done.stderr
    table = pd.read_csv(tmp_path / "verification.csv")
    assert len(table) == 2
    assert table["real_return"].clip(upper=195).is_monotonic_decreasing  # then by steps
    assert (tmp_path / "best.txt").read_text().startswith("python -m sejax.evaluate proxy=cartpole")


@pytest.mark.slow
def test_the_best_are_tried_again_with_other_seeds(tmp_path):
    words = ["env=gridworld_2x2", "agent=q_learning", "es.noise_std=0.05,0.3", "trials=2",
             "pruner=none", "sampler_seed=0", "min_generations=1", "max_generations=2",
             "es.population_size=2",
             "training.max_steps=50", "verify=1", "fresh_seeds=3", "devices=1"]  # fmt: skip
    found, search = opened(tmp_path, *words)
    runner = Learning(search)
    study.work(found, search, runner, lambda text: None)
    table = verification.verify(found, search, runner)
    (best,) = table.to_dict("records")
    assert best["trial"] == results.ranked(found)[0].number and best["rank"] == 1
    folder = tmp_path / "verified" / f"{best['trial']:04d}-3"
    rows = pd.read_csv(folder / "metrics.csv")
    assert sorted(set(rows["seed"])) == [1, 2, 3]  # 0 was the trial's
    last = rows[rows["generation"] == 1]["incumbent_mean"]
    assert best["mean"] == pytest.approx(last.mean()) and best["worst"] == last.min()
    runner.verify = None  # what was tried is kept
    assert verification.verify(found, search, runner).to_dict("records") == [best]
