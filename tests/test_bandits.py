"""Bandits that copy a policy: what they pay, and the policies that they copy."""

import dataclasses

import jax
import numpy as np
import pytest

from experiments.common import agents, bandits
from experiments.common.bandits import PolicyBandit
from sejax import envs

CARTPOLE, CAR = envs.make("cartpole"), envs.make("mountain_car_continuous")


@pytest.mark.parametrize("task, actions, tried, paid", [
    (CARTPOLE, np.int32([0, 1]), np.int32([1, 1]), [0.0, 1.0]),
    (CAR, np.float32([[0.5], [-1.0]]), np.float32([[0.25], [1.0]]), [-0.25, -2.0]),
])  # fmt: skip
def test_a_bandit_pays_for_the_action_of_the_table(task, actions, tried, paid):
    env = PolicyBandit(task)
    states = np.arange(2 * task.obs_dim, dtype=np.float32).reshape(2, -1)
    params = env.params({"states": states, "actions": actions})
    met = set()
    for seed in range(20):
        obs, state = env.reset_env(jax.random.key(seed), params)
        row = int(np.flatnonzero((states == np.asarray(obs)).all(1))[0])
        after, _, reward, terminated, _ = env.step_env(jax.random.key(0), state, tried[row], params)
        assert float(reward) == paid[row] and terminated and (after == obs).all()
        met.add(row)
    assert met == {0, 1}


def by_hand(task, num_states, widen):
    return bandits.copy(task, bandits.by_hand(task, seed=0), num_states, widen)


GAINS = np.array([0.1, 0.3, 1.0, 0.6])


def test_the_controller_of_cartpole_balances_and_is_copied():
    copied = by_hand(CARTPOLE, num_states=64, widen=1.5)
    assert copied.policy_return == 200.0 and copied.real_steps == 2000  # ten tests, nothing else
    assert (copied.actions == (copied.states @ GAINS > 0)).all() and 0 < copied.actions.mean() < 1


@pytest.mark.slow
@pytest.mark.parametrize("task, least", [(CARTPOLE, 195.0), (CAR, 90.0)], ids=lambda x: str(x)[:8])
def test_a_random_search_solves_a_task_and_counts_its_steps(task, least):
    teacher = bandits.search_teacher(task, real_steps=100_000, seed=0)
    copied = bandits.copy(task, teacher, num_states=8, widen=0.0)
    assert copied.policy_return >= least
    tests = 2 * bandits.TEST_EPISODES * 20  # of a generation, and the last ones, at least
    assert tests < copied.real_steps < 110_000


@pytest.mark.slow
def test_a_search_ends_when_its_steps_are_spent():
    task = dataclasses.replace(envs.make("pendulum"), max_steps=9, params=None)  # of all episodes
    teacher = bandits.search_teacher(task, real_steps=1, seed=0)
    copied = bandits.copy(task, teacher, num_states=8, widen=0.0)
    one_generation = 2 * bandits.TEST_EPISODES + 2 * bandits.ARS["num_directions"] + 1
    assert copied.real_steps == 9 * one_generation


def test_a_copy_of_an_agent_has_its_greedy_actions_and_its_steps():
    teacher = bandits.trained(CARTPOLE, agents.tuned_agent("cartpole", "ddqn"), 300, seed=0)
    copied = bandits.copy(CARTPOLE, teacher, num_states=32, widen=1.5)
    assert copied.states.shape == (32, 4) and set(np.unique(copied.actions)) <= {0, 1}
    tested = copied.policy_return * bandits.TEST_EPISODES  # a step is a unit of return
    assert copied.real_steps == 300 + tested
    wide, visited = copied.states[1::2], copied.states[::2]
    assert np.std(wide[:, 3]) > np.std(visited[:, 3])


def test_a_table_of_noise_has_the_units_of_the_task_and_the_actions_of_the_policy():
    copied = by_hand(CARTPOLE, num_states=512, widen=np.inf)
    assert np.allclose(copied.states.std(0), 1, atol=0.15)  # CartPole's SEs see its own units
    assert (copied.actions == (copied.states @ GAINS > 0)).all()
    car = by_hand(envs.make("mountain_car"), num_states=512, widen=np.inf)
    assert np.allclose(car.states.std(0), [0.45, 0.035], rtol=0.15)  # half of each bound
