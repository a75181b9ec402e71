"""The best settings tried again, and what a trial on a proxy goes on from."""

import dataclasses
import functools
import json
import math
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

optuna = pytest.importorskip("optuna", reason="needs Optuna: pip install 'sejax[search]'")

from test_search import Runner, in_memory  # noqa: E402

from sejax.cli import compose  # noqa: E402
from sejax.errors import ConfigError  # noqa: E402
from sejax.search import __main__, results, settings, study, verification  # noqa: E402
from sejax.search.learning import Learning  # noqa: E402
from sejax.search.tuning import ROUNDS, Tuning  # noqa: E402

WORDS = ("trials=3", "pruner=none", "max_generations=3", "verify=3")


class Verified(Runner):
    """Trials of which each is worth its number of seeds when it is tried again."""

    command = "sejax.run"

    def __init__(self, search, lost=(), interrupted_at=None):
        super().__init__(search)
        self.search, self.fresh, self.tried = search, search.config.fresh_seeds, []
        self.lost, self.interrupted_at = lost, interrupted_at

    def num_fresh(self):
        return self.fresh

    def verify(self, words, number):
        if number == self.interrupted_at:
            raise KeyboardInterrupt
        self.tried.append(number)
        worth = math.nan if number in self.lost else float(self.fresh)
        return {"mean": worth, "worst": worth, "generations": 3.0}

    def order(self, row):
        return Learning.order(SimpleNamespace(_search=self.search), row)


def searched(path, *words):
    """A study that is over."""
    found, search = in_memory(path, *WORDS, *words)
    study.work(found, search, Runner(search), lambda text: None)
    return found, search


def verify(found, search, **how):
    """Tries the best again; the runner, which keeps what it tried, and the table."""
    runner = Verified(search, **how)
    return runner, verification.verify(found, search, runner)


def with_fresh(search, count):
    config = dataclasses.replace(search.config, fresh_seeds=count)
    return dataclasses.replace(search, config=config)


def test_rows_of_as_many_seeds_are_kept_and_others_are_tried_anew(tmp_path):
    found, search = searched(tmp_path)
    runner, table = verify(found, search)
    assert sorted(runner.tried) == [0, 1, 2] and set(table["num_fresh"]) == {5}
    again, same = verify(found, search)
    assert not again.tried and same.to_dict("records") == table.to_dict("records")
    more, table = verify(found, with_fresh(search, 20))
    assert sorted(more.tried) == [0, 1, 2]
    assert set(table["num_fresh"]) == {20} and set(table["mean"]) == {20.0}
    written = pd.read_csv(tmp_path / verification.FILE)
    assert written["num_fresh"].tolist() == [20, 20, 20, 5, 5, 5]
    assert written["mean"].tolist() == written["num_fresh"].tolist()
    assert not verify(found, search)[0].tried  # which are known still


def test_a_verification_goes_on_where_it_was_interrupted_and_loses_no_row(tmp_path):
    found, search = searched(tmp_path)
    verify(found, search)
    more = with_fresh(search, 20)
    second = results.ranked(found)[1].number
    with pytest.raises(KeyboardInterrupt):
        verify(found, more, interrupted_at=second)
    assert sorted(pd.read_csv(tmp_path / verification.FILE)["num_fresh"]) == [5, 5, 5, 20]
    runner, table = verify(found, more)
    assert len(runner.tried) == 2 and len(table) == 3


def test_rows_of_other_settings_or_of_a_former_version_count_as_not_tried(tmp_path):
    found, search = searched(tmp_path, "study=a", "sampler_seed=1")
    verify(found, search)
    other, search_of_other = searched(tmp_path, "study=b", "sampler_seed=2")
    assert verify(other, search_of_other)[0].tried
    written = pd.read_csv(tmp_path / verification.FILE)
    assert len(written) == 6 and written["settings"].str.contains("es.noise_std=").all()
    written.drop(columns=["num_fresh", "settings"]).to_csv(tmp_path / verification.FILE)
    runner, table = verify(found, search)
    assert sorted(runner.tried) == [0, 1, 2] and len(table) == 3


def test_what_is_not_finite_when_it_is_tried_again_is_never_the_best(tmp_path):
    found, search = searched(tmp_path)
    first, *others = [trial.number for trial in results.ranked(found)]
    runner, table = verify(found, search, lost=[first])
    assert table["trial"].tolist() == [*others, first]
    runner.verify = None  # and no more so when the rows are read back
    words = __main__._verified(found, search, runner)
    assert words == results.words_of(found.trials[others[0]], search)


# --- on a proxy ----------------------------------------------------------------------------------

ON_PROXY = ("proxy=cartpole", "agent=ppo", "max_generations=2", "min_generations=1", "seeds=2",
            "agent.learning_rate=interval(0.001,0.01)")  # fmt: skip


composed = functools.cache(compose.evaluate_config)  # a tenth of a second each time


@pytest.fixture(autouse=True)
def _composed_once(monkeypatch):
    monkeypatch.setattr(compose, "evaluate_config", lambda words: composed(tuple(words)))


class Counted(Tuning):
    """Trains nobody: an agent's return is 10 for each letter of its world, plus the generation."""

    def __init__(self, search):
        super().__init__(search)
        self.made = []

    def outcome(self, config, world, generation, num_agents):
        self.made.append(generation)
        returns = np.full(num_agents, 10.0 * len(world) + generation)
        return SimpleNamespace(test_return=returns, train_steps=np.full(num_agents, 7))


def tuning(path, *words):
    return Counted(settings.read([*ON_PROXY, f"search_dir={path}", *words]))


def configured(runner, path, *words):
    return dataclasses.replace(runner.config(words), out_dir=str(path))


class Follower:
    def tell(self, progress):
        pass


def test_a_trial_on_a_proxy_goes_on_from_rounds_of_its_own_settings_alone(tmp_path):
    runner = tuning(tmp_path)
    config = configured(runner, tmp_path, "agent.learning_rate=0.002")
    other = configured(runner, tmp_path, "agent.learning_rate=0.003")
    first = runner.run(config, Follower(), False)
    again = tuning(tmp_path)
    assert again.run(config, Follower(), False).scores.tolist() == first.scores.tolist()
    assert not again.made
    message = (r"search_dir must be of one study.*agent.learning_rate \(0.002 there, 0.003 here\)"
               r".*Set search_dir=")  # fmt: skip
    with pytest.raises(ConfigError, match=message):
        again.run(other, Follower(), False)
    with pytest.raises(ConfigError, match=r"seeds \(2 there, 5 here\)"):
        tuning(tmp_path, "seeds=5").run(config, Follower(), False)
    assert len(tuning(tmp_path, "max_generations=1").run(config, Follower(), False).scores) == 1
    again.run(other, Follower(), True)  # the copy of a trial before cannot be used: it begins anew
    assert again.made == [0, 1]
    kept = json.loads((tmp_path / ROUNDS).read_text())
    assert kept["settings"]["agent.learning_rate"] == 0.003


def test_rounds_that_do_not_say_of_what_they_are_are_refused(tmp_path):
    former = [{"returns": [1.0, 2.0], "cost": 3, "seconds": 0.1}]
    (tmp_path / ROUNDS).write_text(json.dumps(former))
    runner = tuning(tmp_path)
    config = configured(runner, tmp_path)
    with pytest.raises(ConfigError, match=r"does not say what settings it is of. Remove it"):
        runner.run(config, Follower(), False)
    assert runner.run(config, Follower(), True).scores.shape == (2, 2)


def test_settings_that_the_proxy_refuses_are_refused_before_a_trial_runs(tmp_path):
    runner = tuning(tmp_path)
    words = ["training_from=config", "training.solved_by=train", "training.stop_rule=solved"]
    with pytest.raises(ConfigError, match=r"training\.solved_by must be test"):
        runner.config(words, tmp_path)


def test_a_proxy_that_is_not_here_ends_the_worker_and_prunes_no_trial(tmp_path):
    search = settings.read([*ON_PROXY[1:], "proxy=no/such/run"])
    with pytest.raises(ConfigError, match="proxy must be a run directory"):
        study.runner_of(search)


def test_agents_are_not_trained_on_the_real_task_with_baseline_false(tmp_path, capsys):
    runner = tuning(tmp_path, "baseline=false", "num_agents=4", "verify=2")
    found = optuna.create_study(direction="maximize")
    for rate in (0.002, 0.004):
        trial = found.ask({"agent.learning_rate": optuna.distributions.FloatDistribution(0, 1)})
        trial.set_user_attr("cost", rate)
        found.tell(trial, 5.0)
    table = verification.verify(found, runner._search, runner)
    assert table["proxy_return"].tolist() == [92.0, 92.0]  # of the generation after the last
    assert "real_return" not in table
    verification.print_table(table, runner._search)
    assert "4 fresh agents each" in capsys.readouterr().out
    values = tuning(tmp_path).verify([], 0)
    assert values["real_return"] == 132.0 and values["proxy_return"] == 92.0


def test_on_the_real_task_what_is_not_finite_comes_last(tmp_path):
    runner = tuning(tmp_path)
    rows = [{"real_return": x, "real_steps": 1.0} for x in (math.nan, 5.0, 9.0, math.inf)]
    shown = [row["real_return"] for row in sorted(rows, key=runner.order)]
    assert shown[:2] == [9.0, 5.0]
