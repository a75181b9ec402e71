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


def test_costs_are_those_of_the_card():
    for card in sejax.pretrained():
        assert proxy_users.costs_of(card.name)["learning_steps"] == card.learning.real_steps > 0
