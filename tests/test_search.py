"""Studies: what becomes of trials that are pruned, lost or refused, and what is written."""

import contextlib
import json
import math
import os
import shlex
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from support import printed, refusal, refused

optuna = pytest.importorskip("optuna", reason="needs Optuna: pip install 'sejax[search]'")

from optuna.trial import TrialState  # noqa: E402

from sejax.options import ConfigError  # noqa: E402
from sejax.runs import config as configuration  # noqa: E402
from sejax.searching import config as search_config  # noqa: E402
from sejax.searching import results as search_results  # noqa: E402
from sejax.searching import study, trials  # noqa: E402

SPACE = "es.noise_std=interval(0.1, 0.9)"
ONE = ("min_generations=1", "max_generations=1", "pruner=none")


class Runner:
    """Trials whose score in each generation is 100 noise_std + generation, kept in a file."""

    command = "sejax.run"

    def __init__(self):
        self.ran = []

    def config(self, overrides):
        return float(overrides[0].partition("=")[2])

    def run(self, config, folder, generations):
        folder.mkdir(parents=True, exist_ok=True)
        done = folder / "done"
        for generation in range(int(done.read_text()) if done.exists() else 0, generations):
            self.meanwhile(folder.name, generation)
            self.ran.append((folder.name, generation))
            done.write_text(str(generation + 1))
        scores = 100 * config + np.arange(1.0, generations + 1)[:, None]
        return trials.Progress(scores=scores, cost=1000, seconds=1.0, generations=generations)

    def meanwhile(self, name, generation):
        pass


def opened(path, *overrides, current=None):
    search = search_config.read([SPACE, f"search_dir={path}", "sampler_seed=0", *overrides])
    return study.open_study(search, current), search


def states(found):
    return [trial.state.name for trial in found.get_trials(deepcopy=False)]


def worked(found, search, runner=None):
    """Works on a study; returns its runner and what was said."""
    said, runner = [], runner or Runner()
    study.work(found, search, runner, said.append)
    return runner, said


# --- trials that end -----------------------------------------------------------------------------


def test_hyperband_ends_trials_that_are_behind(tmp_path):
    found, search = opened(
        tmp_path, "trials=10", "sampler=random", "min_generations=1", "max_generations=3"
    )
    runner, said = worked(found, search)
    assert len(said) == 10 and set(states(found)) == {"COMPLETE", "PRUNED"}
    table = search_results.table(found, search)
    assert set(table[table["state"] == "pruned"]["generations"]) == {1}
    assert set(table[table["state"] == "complete"]["generations"]) == {3}
    assert len(runner.ran) == table["generations"].sum()  # a pruned trial stops at once
    best = search_results.ranked(found)[0]
    assert best.params["es.noise_std"] == max(x.params["es.noise_std"] for x in found.trials)


@pytest.mark.parametrize("sampler", ["random", "tpe"])
def test_a_search_that_is_stopped_goes_on_to_the_same_draws(tmp_path, sampler):
    overrides = (f"sampler={sampler}", *ONE)
    for count in (2, 4):
        worked(*opened(tmp_path / "a", *overrides, f"trials={count}"))
    worked(*opened(tmp_path / "b", *overrides, "trials=4"))
    drawn = [
        [x.params for x in opened(tmp_path / name, *overrides)[0].trials] for name in ("a", "b")
    ]
    assert drawn[0] == drawn[1] and len({str(x) for x in drawn[0]}) == 4


def test_what_one_has_is_tried_first(tmp_path):
    found, search = opened(tmp_path, *ONE, "trials=1", current={"es.noise_std": 0.25})
    worked(found, search)
    assert found.trials[0].params == {"es.noise_std": 0.25}


@pytest.mark.parametrize("reason", ["these do not fit", ""])
def test_trials_that_are_refused_or_whose_score_is_not_finite_are_pruned(tmp_path, reason):
    class Failing(Runner):
        def config(self, overrides):
            if reason:
                raise ConfigError(reason)
            return math.nan

    found, search = opened(tmp_path, *ONE, "trials=2")
    _, said = worked(found, search, Failing())
    assert states(found) == ["PRUNED"] * 2 and reason in said[0]
    search_results.write(found, search, "sejax.run")
    search_results.print_table(found, search)


def test_a_trial_that_has_solved_the_task_is_not_pruned(tmp_path):
    class Solving(Runner):
        def run(self, config, folder, generations):
            scores = np.full((generations, 1), -config)
            return trials.Progress(scores=scores, cost=1, seconds=1.0, generations=1, is_over=True)

    found, search = opened(tmp_path, "trials=8", "min_generations=1", "max_generations=3")
    worked(found, search, Solving())
    assert set(states(found)) == {"COMPLETE"}


@pytest.mark.parametrize(
    ("measure", "expected"),
    # Two seeds with 1, 5, 3 and 2, 0, 4.
    [("last", (3.5, 3)), ("best", (3.5, 2)), ("mean", (2.5, 2))],
)
def test_scores_are_of_generations_and_seeds_as_asked(measure, expected):
    scores = np.array([[1.0, 2], [5, 0], [3, 4]])
    progress = trials.Progress(scores=scores, cost=1, seconds=1.0, generations=3)
    step = 2 if measure == "best" else 3  # after two generations the best are 5 and 2
    worth = trials.worth(progress, step, SimpleNamespace(measure=measure))
    assert tuple(worth.values()) == expected


# --- trials whose worker is lost -----------------------------------------------------------------


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_a_trial_that_is_interrupted_is_queued_again_and_goes_on_from_its_files(tmp_path, error):
    class Interrupted(Runner):
        def meanwhile(self, name, generation):
            if (name, generation) == ("0001", 1):
                raise error

    overrides = "trials=3", "min_generations=1", "max_generations=3", "pruner=none"
    found, search = opened(tmp_path, *overrides)
    with pytest.raises(error):
        worked(found, search, Interrupted())
    assert states(found) == ["COMPLETE", "FAIL", "WAITING"]
    runner, _ = worked(*opened(tmp_path, *overrides))
    assert states(found)[:3] == ["COMPLETE", "FAIL", "COMPLETE"]
    assert found.trials[2].params == found.trials[1].params
    assert [x for x in runner.ran if x[0] == "0002"] == [("0002", 1), ("0002", 2)]
    undisturbed, _ = opened(tmp_path / "other", *overrides)
    worked(undisturbed, search)
    drawn = [[x.params for x in each.trials if x.state.name != "FAIL"]
             for each in (found, undisturbed)]  # fmt: skip
    assert drawn[0] == drawn[1]


def test_a_trial_that_fails_each_time_is_given_up(tmp_path):
    class Failing(Runner):
        def meanwhile(self, name, generation):
            raise OSError("disk full")

    found, search = opened(tmp_path, "trials=1", *ONE)
    for _ in range(study.RETRIES + 1):
        with pytest.raises(OSError, match="disk full"):
            worked(found, search, Failing())
    assert states(found) == ["FAIL"] * (study.RETRIES + 1)


@pytest.mark.parametrize("moment", [0, 1])
def test_a_worker_that_was_taken_for_dead_leaves_its_trial_to_others(tmp_path, moment):
    found, search = opened(
        tmp_path, "trials=2", "min_generations=1", "max_generations=2", "pruner=none"
    )

    class Slow(Runner):
        def meanwhile(self, name, generation):
            if (name, generation) == ("0000", moment):
                found.tell(0, state=TrialState.FAIL)  # as another worker does

    _, said = worked(found, search, Slow())
    assert states(found) == ["FAIL", "COMPLETE", "COMPLETE"]
    assert "another worker's" in said[0]


# Python's filters of warnings are no thread's own.
@pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
@pytest.mark.filterwarnings("ignore:The reported value is ignored:UserWarning")
def test_a_trial_that_two_workers_draw_is_computed_once(tmp_path):
    overrides = "trials=1", "min_generations=1", "max_generations=2", "pruner=none"
    found, search = opened(tmp_path, *overrides)
    found.enqueue_trial({"es.noise_std": 0.5})
    both = threading.Barrier(2)

    def draw(_):
        mine, _ = opened(tmp_path, *overrides)
        ask = mine.ask

        def ask_together(*arguments, **options):
            both.wait(30)
            return ask(*arguments, **options)

        mine.ask = ask_together
        return worked(mine, search)[0].ran

    with ThreadPoolExecutor(2) as pool:
        ran = [each for one in pool.map(draw, range(2)) for each in one]
    assert sorted(set(ran)) == sorted(ran)
    assert set(states(found)) == {"COMPLETE"}


# --- the study -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "other",
    [["env=pendulum"], ["seeds=3"], ["es.step_size=interval(0.1, 1)"], ["es.noise_std=0.1,0.2"]],
)
def test_a_study_is_of_one_search(tmp_path, other):
    overrides = "env=acrobot", "study=mine", "seeds=2", "trials=1", *ONE
    worked(*opened(tmp_path, *overrides))
    again, _ = opened(tmp_path, *overrides, "trials=3", f"storage=sqlite:///{tmp_path}/study.db")
    assert len(again.trials) == 1
    assert refused(opened, tmp_path, *overrides, *other) == "study"


@pytest.mark.parametrize(
    ("override", "field"),
    [("storage=nothing://me:secret@there/x", "storage"), ("search_dir=/proc/x", "search_dir")],
)
def test_a_storage_that_cannot_be_used_is_refused_without_its_password(override, field):
    error = refusal(study.open_study, search_config.read([SPACE, override]))
    assert error.field == field and "secret" not in str(error)


# --- what is found -------------------------------------------------------------------------------


def test_the_preset_file_makes_the_settings_of_the_command(tmp_path):
    fixed = ["env=acrobot", "preset=paper", "agent_hparams=varied", "devices=1", "trials=3"]
    search = search_config.read([SPACE, f"search_dir={tmp_path}", *fixed, "agent.batch_size=16,32"])
    search_results.write_best(["es.noise_std=0.25", "agent.batch_size=16"], search, "sejax.run")
    (line,) = (tmp_path / "best.txt").read_text().splitlines()
    asked = configuration.config(shlex.split(line)[3:])
    preset = search_results.preset_line(search, "sejax.run").partition(" sejax.run ")[2]
    assert configuration.config([preset, "devices=1"]) == asked
    assert asked.es.noise_std == 0.25 and asked.preset == "paper"


def test_what_was_found_is_written(tmp_path, capsys):
    found, search = opened(
        tmp_path, "trials=25", "sampler=random", *ONE, "es.step_size=interval(0.5, 1)"
    )
    worked(found, search)
    search_results.write(found, search, "sejax.run")
    best = search_results.ranked(found)[0]
    overrides = " ".join(search_results.overrides_of(best, search))
    assert (tmp_path / "best.txt").read_text() == f"python -m sejax.run {overrides}\n"
    assert len(pd.read_csv(tmp_path / "trials.csv")) == 25
    shares = search_results.importances(found, search)
    assert max(shares, key=shares.get) == "es.noise_std"
    search_results.print_table(found, search)
    assert "0 of 25 trials were pruned" in capsys.readouterr().out


def test_the_best_of_the_verified_come_first_and_what_is_not_finite_last(tmp_path):
    found, search = opened(tmp_path, *ONE, "trials=3", "verify=3")
    runner, _ = worked(found, search)
    first, second, third = (x.number for x in search_results.ranked(found))
    again = {first: math.nan, second: 1.0, third: 2.0}
    runner.verify = lambda overrides, folder: {
        "mean": again[int(folder.name[:4])],
        "generations": 1.0,
    }
    runner.order = trials.Learning(search).order
    best = search_results.verified(found, search, runner)
    assert best == search_results.overrides_of(found.trials[third], search)
    rows = pd.read_csv(tmp_path / "verification.csv")
    assert rows["trial"].tolist() == [third, second, first]
    assert rows["rank"].tolist() == [3, 2, 1]
    assert (tmp_path / "best.txt").read_text().endswith(f"{best[0]}\n")


# --- real trials ---------------------------------------------------------------------------------

GRID = (
    *("env=gridworld_2x2", "agent=q_learning", "proxy.hidden_size=4", "es.population_size=2"),
    *("training.max_steps=50", "devices=1"),
)


def rows_of(path):
    table = pd.read_csv(path / "metrics.csv").drop(columns="wall_s")
    return table[["generation", "seed", "incumbent_mean", "train_steps_mean"]].to_numpy()


def test_trials_are_runs_and_those_of_a_shape_share_one_program(tmp_path):
    search = search_config.read(
        [*GRID, "es.noise_std=0.1,0.2", "max_generations=3", "seeds=2", f"search_dir={tmp_path}"]
    )
    runner = trials.Learning(search)
    overrides = ["es.noise_std=0.2", "agent.learning_rate=0.5"]
    config = runner.config(overrides)
    for generations in (1, 3):
        progress = runner.run(config, tmp_path / "trial", generations)
    assert progress.scores.shape == (3, 2) and progress.generations == 3
    runner.run(runner.config(["es.noise_std=0.1"]), tmp_path / "other", 3)
    assert len(runner._programs.shapes) == 1

    from sejax.run import learn_all

    plain = [*GRID, *overrides, "generations=3", "checkpoint_every=1", f"run_dir={tmp_path}/run"]
    learn_all([configuration.config([*plain, "seed=1"])])
    np.testing.assert_allclose(rows_of(tmp_path / "trial" / "seed1"), rows_of(tmp_path / "run"))
    values = runner.verify(overrides, tmp_path / "again")
    assert sorted(x.name for x in (tmp_path / "again").iterdir()) == [
        f"seed{i}" for i in range(2, 7)
    ]
    assert values["worst"] <= values["mean"]


ON_PROXY = (
    *("proxy=cartpole", "agent=ppo", "max_generations=2", "min_generations=1", "seeds=2"),
    "agent.learning_rate=interval(0.001,0.01)",
)


class Tuning(trials.Tuning):
    """Trains nobody: an agent's return is 10 for each letter of its world, plus the generation."""

    def __init__(self, path, *overrides):
        super().__init__(search_config.read([*ON_PROXY, f"search_dir={path}", *overrides]))
        self.made = []

    def _outcome(self, config, world, generation, num_agents):
        self.made.append(generation)
        returns = np.full(num_agents, 10.0 * len(world) + generation)
        return SimpleNamespace(test_return=returns, train_steps=np.full(num_agents, 7))


def test_a_trial_on_a_proxy_goes_on_from_rounds_of_its_own_settings_alone(tmp_path):
    runner = Tuning(tmp_path)
    config = runner.config(["agent.learning_rate=0.002"])
    runner.run(config, tmp_path, 1)
    assert runner.run(config, tmp_path, 2).scores.tolist() == [[90.0] * 2, [91.0] * 2]
    assert runner.made == [0, 1]
    other = runner.config(["agent.learning_rate=0.003"])
    assert refused(runner.run, other, tmp_path, 2) == "search_dir"
    (tmp_path / trials.ROUNDS).write_text(json.dumps([{"returns": [1.0]}]))
    assert refused(runner.run, config, tmp_path, 2) == "search_dir"


def test_settings_are_verified_on_the_real_task_once_or_on_the_proxy_alone(tmp_path):
    runner = Tuning(tmp_path)
    values = runner.verify(["agent.learning_rate=0.002"], tmp_path / "a")
    assert (values["proxy_return"], values["real_return"]) == (92.0, 132.0)
    runner.made.clear()
    assert runner.verify(["agent.learning_rate=0.002"], tmp_path / "a") == values
    assert not runner.made
    alone = Tuning(tmp_path, "baseline=false")
    assert "real_return" not in alone.verify(["agent.learning_rate=0.002"], tmp_path / "b")


def test_what_the_proxy_refuses_is_refused_before_a_trial_runs(tmp_path):
    overrides = ["training_from=config", "training.solved_by=train", "training.stop_rule=solved"]
    assert refused(Tuning(tmp_path).config, overrides) == "training.solved_by"
    assert refused(Tuning, tmp_path, "proxy=no/such/run") == "proxy"


# --- the command ---------------------------------------------------------------------------------


def words(path, *overrides):
    return [
        *(sys.executable, "-m", "sejax.search", *GRID, "es.noise_std=interval(0.05,0.5)"),
        *("min_generations=1", "max_generations=6", "trials=12", "heartbeat=1", "verify=1"),
        *("fresh_seeds=2", f"search_dir={path}", *overrides),
    ]


def stop(worker, database):
    """Stops it outside of a write to SQLite, which would make all others wait for it."""
    while True:
        os.kill(worker.pid, signal.SIGSTOP)
        with (
            contextlib.closing(sqlite3.connect(database, timeout=1)) as connection,
            contextlib.suppress(sqlite3.OperationalError),
        ):
            connection.execute("BEGIN IMMEDIATE")
            return
        os.kill(worker.pid, signal.SIGCONT)
        time.sleep(0.1)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
def test_a_killed_and_a_stopped_worker_cost_the_study_no_trial(tmp_path):
    path = tmp_path / "s"
    workers = [subprocess.Popen(words(path), stdout=subprocess.DEVNULL) for _ in "ab"]
    try:
        while not (path / "trials" / "0003").exists():
            assert all(worker.poll() is None for worker in workers)
            time.sleep(0.1)
        workers[0].kill()
        stop(workers[1], path / "study.db")
        third = printed(*words(path), timeout=500)
        os.kill(workers[1].pid, signal.SIGCONT)
        assert workers[1].wait(timeout=300) == 0
    finally:
        for worker in workers:
            worker.kill()
            worker.wait()
    with contextlib.closing(sqlite3.connect(path / "study.db")) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    url = f"sqlite:///{path / 'study.db'}"
    found = optuna.load_study(study_name="gridworld_2x2-se-q_learning", storage=url)
    ended = [x for x in found.trials if x.state in study.ENDED]
    assert len(ended) >= 12 and "FAIL" in states(found)
    for again in ended:  # what a retried trial reports is what an undisturbed one would have
        history = optuna.storages.RetryHeartbeatStaleTrialCallback.retry_history(again)
        for number in history:
            before = found.trials[number].intermediate_values
            assert before.items() <= again.intermediate_values.items()
    made = configuration.config([f"preset={path / 'preset.yaml'}"])
    assert made.name("agent") == "q_learning" and "The best:" in third


@pytest.mark.slow
def test_an_agent_is_tuned_on_a_proxy_and_verified_on_the_real_task(tmp_path):
    overrides = [
        *("proxy=cartpole", "agent=ppo", "space=agent", "trials=3", "min_generations=1"),
        *("max_generations=2", "verify=2", "num_agents=2", "real_training.max_steps=2000"),
        *("pruner=none", f"search_dir={tmp_path}"),
    ]
    printed(sys.executable, "-m", "sejax.search", *overrides)
    table = pd.read_csv(tmp_path / "verification.csv")
    assert len(table) == 2
    assert table["real_return"].clip(upper=195).is_monotonic_decreasing  # then by steps
    assert (tmp_path / "best.txt").read_text().startswith("python -m sejax.evaluate proxy=cartpole")
