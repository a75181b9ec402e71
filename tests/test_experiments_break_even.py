"""The experiment on when a proxy pays."""

import numpy as np
import pandas as pd
import pytest

import sejax
from experiments import break_even
from experiments.common import proxy_users
from experiments.common.shards import stack

TUNED = [900.0, 1100.0, 1000.0, 950.0, 1050.0]  # mean 1,000, variance 6,250


def test_a_proxy_has_paid_when_what_its_students_save_is_what_it_cost():
    """By hand: t of 4 degrees of freedom is 2.7764; its half width 2.7764 * sqrt(6250 / 5)."""
    value, low, high = break_even.break_even(1e6, TUNED, np.zeros(5))
    assert value == 1000
    half = 2.77645 * np.sqrt(6250 / 5)
    assert (low, high) == pytest.approx((1e6 / (1000 + half), 1e6 / (1000 - half)), rel=1e-5)

    value, low, high = break_even.break_even(1e6, TUNED, [990.0, 1005, 995, 1010, 1000])
    assert value == np.inf and 0 < low < np.inf and high == np.inf, "open: it may save something"
    assert break_even.break_even(1e6, TUNED, np.add(TUNED, 500)) == (np.inf, np.inf, np.inf)
    value, *ends = break_even.break_even(1e6, TUNED[:4], np.zeros(4))
    assert value == 1e6 / 987.5 and np.isnan(ends).all(), "four agents have no interval"


def agents(role, steps, returns, proxy="cartpole"):
    columns = {"proxy": proxy, "role": role, "kind": "ppo" if role == "tuned" else "ddqn",
               "target": 195.0, "most_steps": 2000, "train_steps": steps, "test_return": returns,
               "cpu_s": 0.5 if role == "tuned" else 0.1}  # fmt: skip
    return pd.DataFrame(columns | {"group": range(5), "agent": 0, "nonfinite": False})


def stored(of="se"):
    made = [agents("student", 500, [200.0, 200, 200, 200, 190]),
            agents("same", [2000, 1500, 1500, 1500, 1500], 196.0),
            agents("pilot", 100, 200.0), agents("tuned", TUNED, 200.0)]  # fmt: skip
    costs = {"proxy": ["cartpole"], "of": of, "task": "cartpole", "learning_steps": 1e6,
             "learning_cpu_s": np.nan}  # fmt: skip
    return stack({"agents": pd.concat(made), "costs": pd.DataFrame(costs)})


def test_students_of_an_se_take_no_real_step_and_those_of_an_rn_do():
    (se,) = break_even.summarise(stored()).itertuples()
    assert se.break_even == 1000 and se.break_even_same == 1e6 / 1600
    assert se.student_real_steps_mean == 0 and se.student_steps_mean == 500
    assert se.same_reached == 0.8 and se.student_solved == 0.8
    assert se.student_return_worst_tenth == 190 and np.isnan(se.break_even_cpu)
    (rn,) = break_even.summarise(stored("rn")).itertuples()
    assert rn.break_even == 1e6 / 500 and rn.student_real_steps_mean == 500


def test_the_cheapest_bandit_is_one_whose_students_are_good_enough(tmp_path, monkeypatch):
    summary = break_even.summarise(stored())
    missing = break_even.with_nulls(summary, tmp_path).iloc[0]
    assert missing[["by_hand_real_steps", "best_of_four_break_even"]].isna().all()
    rows = [("by_hand", 0, 180), ("best_of_four", 9000, 190), ("best_of_four", 32_000, 199),
            ("best_of_four", 40_000, 200), ("agent", 10, 200)]  # fmt: skip
    columns = ["source", "real_steps", "test_return_mean"]
    table = pd.DataFrame(rows, columns=columns).assign(kind="ddqn", hparams="default", cpu_s=1.0)
    monkeypatch.setattr(break_even, "stored_nulls", lambda path: table)
    found = break_even.with_nulls(summary, tmp_path).iloc[0]
    assert found["by_hand_test_return_mean"] == 180 and found["by_hand_break_even"] == 0
    assert found["best_of_four_real_steps"] == 32_000
    assert found["best_of_four_break_even"] == 32
    (row,) = break_even.make_table(break_even.with_nulls(summary, tmp_path)).to_dict("records")
    assert row["agents until it breaks even"].startswith("1,000 [")
    assert row["an SE of the best of four"] == "32,000; 199.0"


def test_costs_are_those_of_the_card():
    for card in sejax.pretrained():
        costs = proxy_users.costs_of(card.name)
        assert costs["learning_steps"] == card.learning.real_steps > 0
