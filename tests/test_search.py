"""Studies: what becomes of trials that are pruned, lost or refused, and what is written."""

import math
import shlex
import sqlite3
import subprocess
import sys
import time

import filelock
import numpy as np
import pandas as pd
import pytest
from support import metrics, printed, refused

optuna = pytest.importorskip("optuna", reason="needs Optuna: pip install '.[search]'")

from sejax.ops.files import write_text  # noqa: E402
from sejax.options import ConfigError, FailedError  # noqa: E402
from sejax.run import learn_all  # noqa: E402
from sejax.runs import config as configuration  # noqa: E402
from sejax.search import __main__ as command  # noqa: E402
from sejax.search import config as search_config  # noqa: E402
from sejax.search import study  # noqa: E402

SPACE = "es.noise_std=interval(0.1, 0.9)"
ONE = ("min_generations=1", "max_generations=1")
THREE = ("min_generations=1", "max_generations=3")


class Learning:
    """Stands in for `study.make_run`: scores of 100 noise_std + generation, kept in a file.

    Attributes:
      ran: trial and generation of all that was computed.
      meanwhile: is called with these before each generation.
    """

    def __init__(self):
        self.ran, self.is_over, self.refusal = [], False, ""
        self.meanwhile = lambda trial, generation: None
        self.score = lambda config, generation: 100 * config.es.noise_std + generation

    def __call__(self, config, folder, seeds):
        if self.refusal:
            raise ConfigError("", self.refusal)

        def run(generations):
            folder.mkdir(parents=True, exist_ok=True)
            done = folder / "done"
            for generation in range(int(done.read_text()) if done.exists() else 0, generations):
                self.meanwhile(folder.name, generation)
                self.ran.append((folder.name, generation))
                write_text(done, str(generation + 1))
            scores = [self.score(config, i) for i in range(1, generations + 1)]
            return study.Progress(np.array(scores), 1000, generations, self.is_over)

        return run


@pytest.fixture
def learning(monkeypatch):
    fake = Learning()
    monkeypatch.setattr(study, "make_run", fake)
    return fake


def opened(path, *overrides):
    search = search_config.plan_of([SPACE, f"search_dir={path}", *overrides])
    return study.open_study(search), search


def worked(path, *overrides):
    """The study after all of its trials."""
    current, search = opened(path, *overrides)
    study.work(current, search)
    return current


def states(current):
    return [trial.state.name for trial in current.get_trials(deepcopy=False)]


def drawn(current):
    return [trial.params["es.noise_std"] for trial in current.trials]


# --- trials that end -----------------------------------------------------------------------------


def test_hyperband_ends_trials_that_are_behind(tmp_path, learning):
    current = worked(tmp_path, "trials=10", *THREE)
    lasted = {x.state.name: x.user_attrs["generations"] for x in current.trials}
    assert lasted == {"PRUNED": 1, "COMPLETE": 3}
    # A pruned trial stops at once.
    assert len(learning.ran) == sum(trial.user_attrs["generations"] for trial in current.trials)
    assert current.best_params["es.noise_std"] == max(drawn(current))


def test_a_search_that_is_stopped_goes_on_to_the_same_draws(tmp_path, learning):
    for count in (2, 4):
        stopped = worked(tmp_path / "a", *ONE, f"trials={count}")
    undisturbed = worked(tmp_path / "b", *ONE, "trials=4")
    assert drawn(stopped) == drawn(undisturbed) and len(set(drawn(undisturbed))) == 4
    assert not set(drawn(worked(tmp_path / "c", *ONE, "trials=4", "seed=1"))) & set(drawn(stopped))


def test_the_current_settings_are_tried_first(tmp_path):
    assert not opened(tmp_path / "a")[0].trials  # which the range does not hold
    current, _ = opened(tmp_path / "b", "es.noise_std=interval(0.01, 0.1)")
    noise_std = configuration.config([]).es.noise_std
    assert current.ask().suggest_float("es.noise_std", 0.01, 0.1) == noise_std
    assert opened(tmp_path / "c", f"es.noise_std=choice({noise_std:.9e}, 1)")[0].trials


@pytest.mark.parametrize("reason", ["these do not fit", ""])
def test_trials_that_are_refused_or_not_finite_are_pruned(tmp_path, learning, capsys, reason):
    learning.refusal, learning.score = reason, lambda *_: math.nan
    current, search = opened(tmp_path, *ONE, "trials=2")
    study.work(current, search)
    with pytest.raises(FailedError, match="No trial"):
        study.report(current, search)
    assert states(current) == ["PRUNED"] * 2
    assert reason in capsys.readouterr().out


def test_a_trial_that_has_solved_the_task_is_not_pruned(tmp_path, learning):
    learning.is_over = True
    assert set(states(worked(tmp_path, "trials=8", *THREE))) == {"COMPLETE"}


# --- trials whose worker is lost -----------------------------------------------------------------


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_an_interrupted_trial_goes_on_from_its_files(tmp_path, learning, error):
    def interrupt(*now):
        if now == ("0001", 1):
            raise error

    learning.is_over = True  # so that nothing is pruned
    learning.meanwhile = interrupt
    with pytest.raises(error):
        worked(tmp_path, "trials=3", *THREE)
    learning.meanwhile = lambda *_: None
    current = worked(tmp_path, "trials=3", *THREE)
    assert states(current) == ["COMPLETE"] * 3
    assert len(learning.ran) == len(set(learning.ran)) == 9
    undisturbed = worked(tmp_path / "other", "trials=3", *THREE)
    values = [[x.intermediate_values for x in one.trials] for one in (current, undisturbed)]
    assert drawn(current) == drawn(undisturbed) and values[0] == values[1]


@pytest.mark.slow
def test_a_trial_that_was_killed_as_it_was_pruned_is_pruned_again(tmp_path, learning, monkeypatch):
    undisturbed = worked(tmp_path / "a", "trials=10", *THREE)
    current, search = opened(tmp_path / "b", "trials=10", *THREE)
    should_prune, killed = optuna.trial.Trial.should_prune, []

    def kill_once(trial):
        answer = should_prune(trial)
        if trial.number not in killed:
            killed.append(trial.number)
            raise KeyboardInterrupt
        return answer

    monkeypatch.setattr(optuna.trial.Trial, "should_prune", kill_once)
    for _ in range(10):
        with pytest.raises(KeyboardInterrupt):
            study.work(current, search)
    study.work(current, search)
    assert states(current) == states(undisturbed) and drawn(current) == drawn(undisturbed)


def test_the_trial_of_a_worker_that_lives_is_left_to_it(tmp_path, learning):
    current, search = opened(tmp_path, "trials=1", *ONE)
    theirs = current.ask()
    with filelock.FileLock(tmp_path / "trials" / f"{theirs.number:04d}.lock"):
        study.work(current, search)
    assert states(current) == ["RUNNING", "COMPLETE"]


def test_a_trial_that_ends_meanwhile_is_left_alone(tmp_path, learning, monkeypatch):
    current, search = opened(tmp_path, "trials=2", *ONE)
    theirs, get_trials = current.ask(), current.get_trials
    ends = [lambda: current.tell(theirs, 1.0)]
    monkeypatch.setattr(current, "get_trials", lambda **_: (get_trials(), ends and ends.pop()())[0])
    study.work(current, search)
    assert states(opened(tmp_path, "trials=2", *ONE)[0]) == ["COMPLETE"] * 2  # as it was told
    assert current.trials[0].value == 1.0


@pytest.mark.parametrize(("place", "state"), [("", "FAIL"), ("my.py:3: f()", "COMPLETE")])
def test_a_trial_that_fails_stops_no_other_worker(tmp_path, learning, monkeypatch, place, state):
    """One that fails in the user's own code is resumed when the code is mended."""
    monkeypatch.setattr(study, "place_of", lambda error: place)
    learning.meanwhile = lambda trial, _: 1 / (trial != "0000")
    with pytest.raises(ZeroDivisionError):
        worked(tmp_path, "trials=2", *ONE)
    learning.meanwhile = lambda *_: None
    assert states(worked(tmp_path, "trials=2", *ONE)) == [state, "COMPLETE"]


# --- the study -----------------------------------------------------------------------------------


def test_a_study_is_of_one_search(tmp_path):
    overrides = "env=acrobot", "study=mine", "seeds=2", *ONE
    opened(tmp_path, *overrides)
    opened(tmp_path, *overrides, "trials=3", "verify=0", "devices=2")
    for other in ("env=pendulum", "seeds=3", "es.step_size=interval(0.1, 1)", "es.noise_std=0.1,1"):
        assert refused(opened, tmp_path, *overrides, other) == "search_dir"


def test_a_folder_may_have_any_name(tmp_path):
    opened(tmp_path / "what? #1%20")
    assert (tmp_path / "what? #1%20" / "study.db").exists() and len(list(tmp_path.iterdir())) == 1


def test_a_database_that_is_none_is_refused(tmp_path):
    (tmp_path / "study.db").write_bytes(b"no database" * 100)
    assert refused(command.main, [SPACE, f"search_dir={tmp_path}"]) == "search_dir"


@pytest.mark.parametrize("number", ["trial_values SET value", "trial_params SET param_value"])
def test_a_changed_number_is_refused(tmp_path, learning, number):
    worked(tmp_path, *ONE, "trials=1")
    sqlite3.connect(tmp_path / "study.db").executescript(f"UPDATE {number} = 0.123")
    assert refused(command.main, [SPACE, *ONE, f"search_dir={tmp_path}"]) == "search_dir"


# --- results -------------------------------------------------------------------------------------


def test_the_preset_file_makes_the_settings_of_the_command(tmp_path):
    (tmp_path / "mine.yaml").write_text("preset: paper\nagent_hparams: varied\n")
    fixed = ["env=acrobot", f"preset={tmp_path}/mine.yaml", "trials=3"]
    search = search_config.plan_of(
        [SPACE, f"search_dir={tmp_path}", *fixed, "agent.batch_size=16,32"]
    )
    line = study.write_best(["es.noise_std=0.25", "agent.batch_size=16"], search)
    assert (tmp_path / "best.txt").read_text() == f"{line}\n"
    best = configuration.config(shlex.split(line)[3:])
    assert configuration.config([f"preset={tmp_path}/preset.yaml"]) == best
    assert best.es.noise_std == 0.25 and best.preset == "paper" and best.agent.batch_size == 16
    several = [SPACE, f"search_dir={tmp_path}", "agents=[ddqn,ppo]", "agents.ppo.hidden_size=8"]
    line = study.write_best(["es.noise_std=0.25"], search_config.plan_of(several))
    best = configuration.config(shlex.split(line)[3:])
    assert configuration.config([f"preset={tmp_path}/preset.yaml"]) == best


def test_the_best_of_those_that_are_tried_again_is_the_result(tmp_path, learning, capsys):
    current, search = opened(tmp_path, *ONE, "trials=5", "verify=3")
    study.work(current, search)
    first, second, third = sorted(current.trials, key=lambda trial: -trial.value)[:3]
    again = {first.params["es.noise_std"]: math.nan, second.params["es.noise_std"]: 1.0}
    learning.score = lambda config, generation: next(
        (score for noise, score in again.items() if abs(noise - config.es.noise_std) < 1e-5), 2.0
    )
    study.report(current, search)
    rows = pd.read_csv(tmp_path / "verification.csv")
    assert rows["number"].tolist() == [third.number, second.number, first.number]
    setting = f"es.noise_std={third.params['es.noise_std']:.6g}"
    assert (tmp_path / "best.txt").read_text() == f"python -m sejax.run {setting}\n"
    assert f"sejax.run {setting}\n" in capsys.readouterr().out
    table = pd.read_csv(tmp_path / "trials.csv")
    assert set(table["state"]) == {"COMPLETE"} and len(table) == 5
    computed = len(learning.ran)
    study.report(*opened(tmp_path, *ONE, "trials=5", "verify=3"))
    assert len(learning.ran) == computed  # once


# --- real trials ---------------------------------------------------------------------------------

GRID = (
    *("env=gridworld_2x2", "agent=q_learning", "proxy.hidden_size=4", "es.population_size=2"),
    *("training.max_steps=50", "devices=1"),
)


def test_trials_are_runs_of_the_command(tmp_path):
    search = search_config.plan_of([*GRID, "es.noise_std=0.1,0.2", "max_generations=3", "seeds=2"])
    overrides = ["es.noise_std=0.2", "agent.learning_rate=0.5"]
    run = study.make_run(search.trial_config(overrides), tmp_path / "trial", range(2))
    study.make_run(search.trial_config(overrides), tmp_path / "trial/seed0", range(1))(2)
    assert run(1).scores.shape == (1,)  # one of both was ahead, as after a kill
    progress = run(3)
    assert progress.scores.shape == (3,) and progress.generations == 3
    plain = [*GRID, *overrides, "generations=3", "checkpoint_every=1", f"run_dir={tmp_path}/run"]
    learn_all([configuration.config([*plain, "seed=1"])])
    assert metrics(tmp_path / "trial" / "seed1") == metrics(tmp_path / "run")
    rows = [metrics(tmp_path / "trial" / f"seed{i}") for i in range(2)]
    means = [
        np.mean([float(row["incumbent_mean"]) for row in pair]) for pair in zip(*rows, strict=True)
    ]
    np.testing.assert_allclose(progress.scores, means)


# --- the command ---------------------------------------------------------------------------------


def words(path, *overrides):
    return [
        *(sys.executable, "-m", "sejax.search", *GRID, "es.noise_std=interval(0.05,0.5)"),
        *("min_generations=1", "max_generations=6", "trials=12", "verify=1", "fresh_seeds=2"),
        *(f"search_dir={path}", *overrides),
    ]


@pytest.mark.slow
def test_killed_workers_cost_the_study_no_trial(tmp_path):
    path = tmp_path / "s"
    workers = [subprocess.Popen(words(path), stdout=subprocess.DEVNULL) for _ in "ab"]
    try:
        while not (path / "trials" / "0003").exists():
            assert all(worker.poll() is None for worker in workers)
            time.sleep(0.1)
    finally:
        for worker in workers:
            worker.kill()
            worker.wait()
    said = printed(*words(path), timeout=500)
    current = optuna.load_study(study_name=None, storage=f"sqlite:///{path / 'study.db'}")
    assert {*states(current)} <= {"COMPLETE", "PRUNED"}
    best = configuration.config([f"preset={path / 'preset.yaml'}"])
    assert best.name("agent") == "q_learning" and "The best:" in said
    printed(*words(tmp_path / "undisturbed"), timeout=500)
    for trial in ("0000", "0001"):
        assert metrics(path / "trials" / trial) == metrics(tmp_path / "undisturbed/trials" / trial)
