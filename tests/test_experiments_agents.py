"""The experiment on how agents learn the real tasks."""

import dataclasses

import numpy as np
import pandas as pd
import pytest
from support import refuse

import sejax
from experiments import agent_learning, pieces, return_curves, worlds
from sejax.errors import ConfigError


def curve(steps, returns):
    return pd.DataFrame({"agent": 0, "steps": steps, "test_return": np.array(returns, float)})


def test_a_task_is_solved_when_ten_tests_in_a_row_are_good_on_average():
    good_late = curve(range(10, 310, 10), [0] * 10 + [10] * 20)
    # Ten in a row have mean 9 once nine of them are 10: the window ends at the 19th episode.
    assert return_curves.steps_to_solve(good_late, 9.0) == 190
    assert return_curves.steps_to_solve(good_late, 10.1) == np.inf
    assert return_curves.steps_to_solve(good_late.head(9), 0.0) == np.inf  # too few tests


def test_curves_hold_the_value_of_the_last_finished_episode():
    two = pd.concat([curve([10, 20], [1, 3]), curve([15], [5]).assign(agent=1)])
    values = return_curves.on_grid(two, np.array([5, 10, 19, 20]))
    np.testing.assert_array_equal(values, [[np.nan, 1, 1, 2], [np.nan, np.nan, 5, 5]])


def test_every_agent_learns_and_nothing_is_computed_twice(tmp_path, monkeypatch):
    monkeypatch.setattr(agent_learning, "QUICK_STEPS", 400)
    settings = agent_learning.AgentLearning.of(
        quick=True, out=str(tmp_path), seed=3, envs="cliff_walking"
    )
    table = agent_learning.EXPERIMENT.run(settings)
    assert list(table["agent"]) == ["q_learning", "sarsa", "sarsa"]
    assert (tmp_path / "learning_curves.png").stat().st_size > 10_000
    text = (tmp_path / "table.md").read_text()
    assert "python -m experiments.agent_learning quick=true" in text
    rows = pieces.read_rows(settings.rows_file)
    assert set(rows["study"]) == {6, 7, 8} and set(rows["max_steps"]) == {400}
    curves = rows[rows["study"] == 6]
    assert set(curves["agent"]) == {0, 1}
    for _, mine in curves.groupby("agent"):
        assert (np.diff(mine["steps"], prepend=0) >= 1).all()
        assert (np.diff(mine["steps"], prepend=0) <= 50).all()
        assert mine["steps"].iloc[-1] <= 400
        assert mine["test_return"].between(-150, -12).all()

    monkeypatch.setattr(worlds, "train", refuse)
    pd.testing.assert_frame_equal(agent_learning.EXPERIMENT.run(settings), table)


def test_the_agents_of_reward_networks_train_as_there_but_to_the_end():
    study = agent_learning.PresetStudy(env="pendulum", agent="td3", max_steps=20_000)
    preset = sejax.config(["env=pendulum", "proxy=rn"])
    assert study.configuration() == preset.agent != sejax.TD3Config()
    assert dataclasses.replace(sejax.TD3Config(), **study.changes()) == preset.agent
    training = study.training(quick=False, test_episodes=2)
    assert (preset.training.stop_rule, training.stop_rule) == ("solved", "never")
    assert (training.max_episodes, training.max_steps) == (100, 20_000)
    assert (training.tests_between, training.time_limit_is_terminal) == (2, False)


@pytest.mark.parametrize(
    ("given", "named"), [({"envs": "cartpol"}, "cartpole"), ({"num_agents": 0}, "at least 1")]
)
def test_what_cannot_work_is_refused(tmp_path, given, named):
    with pytest.raises(ConfigError, match=named):
        agent_learning.AgentLearning.of(quick=True, out=str(tmp_path), **given)
