"""benchmarks/scale_model.py: what a generation takes with simulated workers, by hand."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
from scale_model import Costs, World, simulate


def test_one_worker_does_one_share_after_the_other():
    costs = Costs(serial_s=5.0, share_s=0.5, gap_s=0.25)
    said = simulate([1.0, 2.0, 3.0], 1, costs, capacity=1)
    assert said.wall_s == pytest.approx(5.0 + 6.0 + 3 * 0.75)
    assert (said.shares, said.longest_s) == (3, 3.0)
    assert said.idle == pytest.approx(1 - 6.0 / 13.25)


def test_shares_are_cut_as_the_hand_out_cuts_them():
    # Of 8 trainings and one worker: 4, 2, 1, 1.
    assert simulate([1.0] * 8, 1, Costs()).shares == 4
    assert simulate([1.0] * 8, 1, Costs(), capacity=2).shares == 5  # 2, 2, 2, 1, 1


def test_workers_without_costs_divide_equal_trainings():
    said = simulate([2.0] * 12, 4, Costs(), capacity=1)
    assert said.wall_s == said.ideal_s == 6.0
    assert said.idle == 0.0


def test_more_workers_than_trainings_take_what_the_longest_takes():
    said = simulate([1.0, 1.0, 1.5], 100, Costs(), capacity=1)
    assert said.wall_s == 1.5


def test_the_driver_hands_out_one_share_at_a_time():
    said = simulate([1.0] * 8, 8, Costs(share_s=0.5), capacity=1)
    assert said.wall_s == pytest.approx(8 * 0.5 + 1.0)  # the last one's
    assert said.driver_s == pytest.approx(4.0)


def test_shares_follow_one_another_on_the_wire():
    said = simulate([1.0] * 4, 4, Costs(bytes_each=100.0, bandwidth=200.0), capacity=1)
    assert said.wall_s == pytest.approx(4 * 0.5 + 1.0)
    assert said.wire_s == pytest.approx(2.0)


def test_what_is_asked_and_sent_grows_with_the_population():
    small = World(seconds=[1.0], count=4, num_trials=32, capacity=1, dims=10)
    large = World(seconds=[1.0], count=64, num_trials=64, capacity=1, dims=20)
    costs = Costs(serial_s=1.0, bytes_each=80.0, bandwidth=1000.0)
    assert small.simulate(1, costs, of=small).wire_s == pytest.approx(4 * 0.08)
    said = large.simulate(1, costs, of=small)
    assert said.serial_s == 4.0
    assert said.wire_s == pytest.approx(4 * 4 * 0.08)
