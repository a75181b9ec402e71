"""Runs and agents that fail count in means and medians, as the worst there are."""

import math
import sys
from pathlib import Path

import pandas as pd
import pytest

from experiments import se_feasibility, worlds
from sejax.evaluate import summarise

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))

import time_to_solve


def test_agents_that_diverged_count_as_the_worst(capsys):
    rows = pd.DataFrame({
        "group": "00", "agent": [0, 1, 2], "test_return": [1.0, math.nan, -3.0],
        "return_0": [2.0, math.nan, -5.0], "return_1": [0.0, 4.0, -1.0],
    })  # fmt: skip
    told = worlds.worst_for_diverged(rows, "default-real")
    assert told["test_return"].tolist() == [1.0, -5.0, -3.0]
    assert told["return_0"].tolist() == [2.0, -5.0, -5.0]
    assert "default-real: 1 agents diverged" in capsys.readouterr().out
    pd.testing.assert_frame_equal(worlds.worst_for_diverged(told, "again"), told)
    curves = pd.DataFrame({"agent": [0, 0, 1], "steps": [1, 2, 1], "test_return": [5, 7, math.nan]})
    assert worlds.worst_for_diverged(curves, "curves")["test_return"].tolist() == [5, 7, 5]


def test_an_evaluations_mean_leaves_no_agent_out():
    agents = pd.DataFrame({"world": "w", "test_return": [10.0, math.nan, -20.0], "nonfinite": [
        False, True, False], "train_steps": 5, "train_episodes": 1})  # fmt: skip
    row = summarise(agents, ["world"]).loc["w"]
    assert (row["test_return_mean"], row["num_nonfinite"]) == (-10.0, 1)


@pytest.mark.parametrize("solved, text", [
    ([100, 300, 200], "200"), ([100, 200, None], "200"), ([100, None, None], "> 900"),
])  # fmt: skip
def test_a_run_that_did_not_solve_the_task_took_more_steps_than_all(solved, text):
    runs = pd.DataFrame({
        "generations_to_solve": [math.inf if x is None else 1 for x in solved],
        "env_steps_to_solve": [math.nan if x is None else x for x in solved],
        "env_steps": [900, 950, 1000],
    })  # fmt: skip
    assert se_feasibility.median_steps(runs) == text


@pytest.mark.parametrize("means, share", [
    ([0, 200, 0, 200], "50%"), ([0, 0, 200], "nan%"), ([200, 0, 0], "0%"), ([200] * 3, "100%"),
])  # fmt: skip
def test_what_is_solved_afterwards_is_of_later_generations_alone(means, share):
    curve = pd.DataFrame({"incumbent_mean": means, "wall_s": 60.0, "cpu_s": 60.0,
                          "env_steps_total": 1000})  # fmt: skip
    row = time_to_solve.summarise("best", [curve], 195.0)
    assert row["solved"] == "1 of 1" and share in row["solved afterwards"]
