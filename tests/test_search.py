"""Studies: what becomes of trials that are pruned, lost or refused, and what is written."""

import math
import shlex
import subprocess
import sys
import time
from types import SimpleNamespace

import filelock
import numpy as np
import pandas as pd
import pytest
from support import metrics, printed, refused

optuna = pytest.importorskip("optuna", reason="needs Optuna: pip install 'sejax[search]'")

from sejax.ops.files import write_text  # noqa: E402
from sejax.options import ConfigError  # noqa: E402
from sejax.run import learn_all  # noqa: E402
from sejax.runs import config as configuration  # noqa: E402
from sejax.searching import config as search_config  # noqa: E402
from sejax.searching import study, trials  # noqa: E402

SPACE = "es.noise_std=interval(0.1, 0.9)"
ONE = ("min_generations=1", "max_generations=1")


class Learning:
    """Stands in for `trials.learning`: scores of 100 noise_std + generation, kept in a file.

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
            raise ConfigError(self.refusal)

        def run(generations):
            folder.mkdir(parents=True, exist_ok=True)
            done = folder / "done"
            for generation in range(int(done.read_text()) if done.exists() else 0, generations):
                self.meanwhile(folder.name, generation)
                self.ran.append((folder.name, generation))
                write_text(done, str(generation + 1))
            scores = [self.score(config, i) for i in range(1, generations + 1)]
            return trials.Progress(
                scores=np.array(scores),
                train_steps=1000,
                generations=generations,
                is_over=self.is_over,
            )

        return run


@pytest.fixture
def learning(monkeypatch):
    fake = Learning()
    monkeypatch.setattr(trials, "learning", fake)
    return fake


def opened(path, *overrides):
    search = search_config.read([SPACE, f"search_dir={path}", *overrides])
    return study.open_study(search), search


def states(found):
    return [trial.state.name for trial in found.get_trials(deepcopy=False)]


def drawn(found):
    return [trial.params["es.noise_std"] for trial in found.trials]


# --- trials that end -----------------------------------------------------------------------------


def test_hyperband_ends_trials_that_are_behind(tmp_path, learning):
    found, search = opened(tmp_path, "trials=10", "min_generations=1", "max_generations=3")
    study.work(found, search)
    assert set(states(found)) == {"COMPLETE", "PRUNED"}
    lasted = {x.state.name: x.user_attrs["generations"] for x in found.trials}
    assert lasted == {"PRUNED": 1, "COMPLETE": 3}
    total = sum(trial.user_attrs["generations"] for trial in found.trials)
    assert len(learning.ran) == total  # a pruned trial stops at once
    assert found.best_params["es.noise_std"] == max(drawn(found))


def test_a_search_that_is_stopped_goes_on_to_the_same_draws(tmp_path, learning):
    for count in (2, 4):
        study.work(*opened(tmp_path / "a", *ONE, f"trials={count}"))
    undisturbed, search = opened(tmp_path / "b", *ONE, "trials=4")
    study.work(undisturbed, search)
    assert drawn(opened(tmp_path / "a", *ONE)[0]) == drawn(undisturbed)
    assert len(set(drawn(undisturbed))) == 4
    other, search = opened(tmp_path / "c", *ONE, "trials=4", "seed=1")
    study.work(other, search)
    assert not set(drawn(other)) & set(drawn(undisturbed))


def test_the_current_settings_are_tried_first(tmp_path):
    assert not opened(tmp_path / "a")[0].trials  # which the range does not hold
    found, _ = opened(tmp_path / "b", "es.noise_std=interval(0.01, 0.1)")
    current = configuration.config([]).es.noise_std
    assert found.ask().suggest_float("es.noise_std", 0.01, 0.1) == current


@pytest.mark.parametrize("reason", ["these do not fit", ""])
def test_trials_that_are_refused_or_not_finite_are_pruned(tmp_path, learning, capsys, reason):
    learning.refusal, learning.score = reason, lambda *_: math.nan
    found, search = opened(tmp_path, *ONE, "trials=2")
    study.work(found, search)
    study.report(found, search)
    assert states(found) == ["PRUNED"] * 2
    assert reason in capsys.readouterr().out


def test_a_trial_that_has_solved_the_task_is_not_pruned(tmp_path, learning):
    learning.is_over = True
    found, search = opened(tmp_path, "trials=8", "min_generations=1", "max_generations=3")
    study.work(found, search)
    assert set(states(found)) == {"COMPLETE"}


# --- trials whose worker is lost -----------------------------------------------------------------

THREE = ("trials=3", "min_generations=1", "max_generations=3")


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_an_interrupted_trial_goes_on_from_its_files(tmp_path, learning, error):
    learning.is_over = True  # so that nothing is pruned

    def interrupt(*now):
        if now == ("0001", 1):
            raise error

    found, search = opened(tmp_path, *THREE)
    learning.meanwhile = interrupt
    with pytest.raises(error):
        study.work(found, search)
    assert states(found) == ["COMPLETE", "RUNNING"]
    learning.meanwhile = lambda *_: None
    study.work(*opened(tmp_path, *THREE))
    assert states(found) == ["COMPLETE"] * 3
    assert len(learning.ran) == len(set(learning.ran)) == 9
    undisturbed, search = opened(tmp_path / "other", *THREE)
    study.work(undisturbed, search)
    assert drawn(found) == drawn(undisturbed)
    reported = [[x.intermediate_values for x in each.trials] for each in (found, undisturbed)]
    assert reported[0] == reported[1]


@pytest.mark.slow
def test_a_trial_that_was_killed_as_it_was_pruned_is_pruned_again(tmp_path, learning, monkeypatch):
    words = "trials=10", "min_generations=1", "max_generations=3"
    undisturbed, search = opened(tmp_path / "a", *words)
    study.work(undisturbed, search)
    found, search = opened(tmp_path / "b", *words)

    asked = optuna.trial.Trial.should_prune
    killed = []

    def kill_once(trial):
        answer = asked(trial)
        if trial.number not in killed:
            killed.append(trial.number)
            raise KeyboardInterrupt
        return answer

    monkeypatch.setattr(optuna.trial.Trial, "should_prune", kill_once)
    for _ in range(10):
        with pytest.raises(KeyboardInterrupt):
            study.work(found, search)
    study.work(found, search)
    assert states(found) == states(undisturbed) and drawn(found) == drawn(undisturbed)


def test_a_trial_that_fails_each_time_is_given_up(tmp_path, learning):
    def fail(*_):
        raise OSError("disk full")

    found, search = opened(tmp_path, "trials=1", *ONE)
    learning.meanwhile = fail
    for _ in range(study.ATTEMPTS):
        with pytest.raises(OSError, match="disk full"):
            study.work(found, search)
    assert states(found) == ["RUNNING"]
    learning.meanwhile = lambda *_: None
    study.work(found, search)
    assert states(found) == ["FAIL", "COMPLETE"]


def test_the_trial_of_a_worker_that_lives_is_left_to_it(tmp_path, learning):
    found, search = opened(tmp_path, "trials=1", *ONE)
    others = found.ask()
    with filelock.FileLock(tmp_path / "trials" / f"{others.number:04d}.lock"):
        study.work(found, search)
    assert states(found) == ["RUNNING", "COMPLETE"]


# --- the study -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "other",
    [["env=pendulum"], ["seeds=3"], ["es.step_size=interval(0.1, 1)"], ["es.noise_std=0.1,0.2"]],
)
def test_a_study_is_of_one_search(tmp_path, other):
    overrides = "env=acrobot", "study=mine", "seeds=2", *ONE
    opened(tmp_path, *overrides)
    opened(tmp_path, *overrides, "trials=3", "verify=0")
    assert refused(opened, tmp_path, *overrides, *other) == "study"


def test_a_folder_that_cannot_be_used_is_refused(tmp_path):
    search = search_config.read([SPACE, "search_dir=/proc/x"])
    assert refused(study.open_study, search) == "search_dir"
    (tmp_path / "study.db").write_bytes(b"no database" * 100)
    search = search_config.read([SPACE, f"search_dir={tmp_path}"])
    assert refused(study.open_study, search) == "search_dir"


# --- what is found -------------------------------------------------------------------------------


def test_the_preset_file_makes_the_settings_of_the_command(tmp_path):
    fixed = ["env=acrobot", "preset=paper", "agent_hparams=varied", "devices=1", "trials=3"]
    search = search_config.read([SPACE, f"search_dir={tmp_path}", *fixed, "agent.batch_size=16,32"])
    line = study.write_best(["es.noise_std=0.25", "agent.batch_size=16"], search)
    assert (tmp_path / "best.txt").read_text() == f"{line}\n"
    best = configuration.config(shlex.split(line)[3:])
    assert configuration.config([f"preset={tmp_path}/preset.yaml", "devices=1"]) == best
    assert best.es.noise_std == 0.25 and best.preset == "paper"


def test_what_was_found_is_written_and_the_best_of_the_verified_is_the_result(
    tmp_path, learning, capsys
):
    found, search = opened(tmp_path, *ONE, "trials=5", "verify=3")
    study.work(found, search)
    first, second, third = sorted(found.trials, key=lambda trial: -trial.value)[:3]
    again = {first.params["es.noise_std"]: math.nan, second.params["es.noise_std"]: 1.0}
    learning.score = lambda config, generation: next(
        (score for noise, score in again.items() if abs(noise - config.es.noise_std) < 1e-5), 2.0
    )
    study.report(found, search)
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
    words = [*GRID, "es.noise_std=0.1,0.2", "max_generations=3", "seeds=2"]
    search = search_config.read([*words, f"search_dir={tmp_path}"])
    overrides = ["es.noise_std=0.2", "agent.learning_rate=0.5"]
    run = trials.learning(search.trial_config(overrides), tmp_path / "trial", range(2))
    assert run(1).scores.shape == (1,)
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


ON_PROXY = (
    *("proxy=cartpole", "agent=ppo", "max_generations=2", "min_generations=1", "seeds=2"),
    "agent.learning_rate=interval(0.001,0.01)",
)


def tuned(*overrides):
    return search_config.read(ON_PROXY).trial_config(["agent.learning_rate=0.002", *overrides])


@pytest.fixture
def rounds(monkeypatch):
    """Trains nobody: an agent's return is 10 for each letter of its world, plus the round.

    Returns the rounds that were asked for.
    """
    asked = []

    def train_and_test(config, world, number, num_agents):
        asked.append(number)
        returns = np.full(num_agents, 10.0 * len(world) + number)
        return SimpleNamespace(test_return=returns, train_steps=np.full(num_agents, 7))

    monkeypatch.setattr(trials, "_train_and_test", train_and_test)
    return asked


def test_a_trial_on_a_proxy_goes_on_round_by_round_and_scores_their_mean(rounds):
    run = trials.tuning(tuned(), 2)
    assert run(1).scores.tolist() == [90.0]
    progress = run(3)
    assert progress.scores.tolist() == [90.0, 90.5, 91.0] and progress.train_steps == 42
    assert rounds == [0, 1, 2]


def test_settings_are_tested_on_the_real_task_or_on_the_proxy_alone(rounds):
    values = trials.tested(tuned(), 2)
    assert (values["proxy_return"], values["real_return"], values["verified"]) == (92, 132, 132)
    values = trials.tested(tuned("baseline=false"), 2)
    assert "real_return" not in values and values["verified"] == 92


@pytest.mark.parametrize(
    ("words", "field"),
    [
        (["proxy=no/such/run"], "proxy"),
        (["proxy=real", "env=cartpole"], "proxy"),
        ([*ON_PROXY, "agent_hparams=varied"], "agent"),
        (
            [*ON_PROXY, "training_from=config", "training.solved_by=train",
             "training.stop_rule=solved"],
            "training.solved_by",
        ),
    ],
)  # fmt: skip
def test_what_the_proxy_refuses_is_refused_before_a_trial_runs(words, field):
    assert refused(search_config.read(words).trial_config, []) == field


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
    found = optuna.load_study(study_name=None, storage=f"sqlite:///{path / 'study.db'}")
    assert states(found).count("COMPLETE") + states(found).count("PRUNED") == len(found.trials)
    best = configuration.config([f"preset={path / 'preset.yaml'}"])
    assert best.name("agent") == "q_learning" and "The best:" in said
    printed(*words(tmp_path / "undisturbed"), timeout=500)
    for trial in ("0000", "0001"):
        assert metrics(path / "trials" / trial) == metrics(tmp_path / "undisturbed/trials" / trial)


@pytest.mark.slow
def test_an_agent_is_tuned_on_a_proxy_and_verified_on_the_real_task(tmp_path):
    overrides = [
        *("proxy=cartpole", "agent=ppo", "space=agent", "trials=3", "min_generations=2"),
        *("max_generations=2", "verify=2", "num_agents=2", "real_training.max_steps=2000"),
        f"search_dir={tmp_path}",
    ]
    printed(sys.executable, "-m", "sejax.search", *overrides)
    table = pd.read_csv(tmp_path / "verification.csv")
    assert len(table) == 2
    assert table["real_return"].clip(upper=195).is_monotonic_decreasing  # then by steps
    assert (tmp_path / "best.txt").read_text().startswith("python -m sejax.evaluate proxy=cartpole")
