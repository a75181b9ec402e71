"""sejax.distill: the search of linear policies, copies of policies, and what SEs teach."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from support import assert_equal, refused

from sejax import envs
from sejax.distill.policies import CopyConfig, acting, copy_policy, erring, visit
from sejax.distill.policy_search import (
    Policy,
    PolicySearchConfig,
    first_policy,
    linear_agent,
    make_search,
    step_size,
    with_moments,
)
from sejax.distill.teaching import grades
from sejax.envs.wrappers import Wrapper
from sejax.runs.store import Store

CARTPOLE, PENDULUM = envs.make("cartpole"), envs.make("pendulum")
SMALL = PolicySearchConfig(num_directions=6, num_top=3, generations=10, num_tests=4)
RNG = np.random.default_rng(1)


def test_a_generation_moves_along_the_best_directions_on_any_devices():
    weights = jnp.asarray(RNG.normal(size=(2, 5)), jnp.float32) * 0.1
    searches = [make_search(SMALL, CARTPOLE, devices) for devices in (1, 2)]
    before = first_policy(CARTPOLE)._replace(weights=weights)
    on_one, on_two = (jax.jit(search.generation) for search in searches)
    after, returns, num_steps = on_one(jax.random.key(5), before, 2)
    assert_equal((after, returns, num_steps), on_two(jax.random.key(5), before, 2))
    directions = np.asarray(
        jax.random.normal(jax.random.split(jax.random.key(5), 3)[0], (6, 2, 5)), float
    )
    returns = np.asarray(returns, float)
    best = sorted(range(6), key=lambda i: -max(returns[i], returns[6 + i]))[:3]
    used = [returns[i] for i in best] + [returns[6 + i] for i in best]
    step = sum((returns[i] - returns[6 + i]) * directions[i] for i in best)
    wanted = np.asarray(before.weights) + 0.02 * step / (3 * np.std(used))
    np.testing.assert_allclose(after.weights, wanted, rtol=1e-4, atol=1e-6)
    # In CartPole a step pays 1: all steps of the directions, and one episode of the policy.
    assert int(num_steps) == int(returns.sum()) + int(after.num_seen)


def test_moments_are_those_of_all_that_was_seen():
    policy = first_policy(PENDULUM)
    rows = RNG.normal(size=(3, 40, 3)).astype(np.float32) * [1, 5, 0.2] + [3, 0, -1]
    valid = RNG.uniform(size=(3, 40)) < [[0.7], [0.5], [0.0]]
    for obs, mask in zip(rows, valid, strict=True):
        policy = with_moments(policy, jnp.asarray(obs, jnp.float32), jnp.asarray(mask))
    seen = rows[valid]
    assert int(policy.num_seen) == len(seen)
    np.testing.assert_allclose(policy.mean, seen.mean(0), rtol=1e-4)
    np.testing.assert_allclose(policy.std, seen.std(0), rtol=1e-4)


@pytest.mark.parametrize("task", [CARTPOLE, PENDULUM], ids=lambda task: task.name)
def test_layers_do_what_the_policy_does(task):
    d, m = task.obs_dim, task.action_dim
    policy = Policy(
        jnp.asarray(RNG.normal(size=(m, d + 1)), jnp.float32),
        jnp.float32(10),
        jnp.asarray(RNG.normal(size=d), jnp.float32),
        jnp.asarray(RNG.uniform(1, 9, d), jnp.float32),
    )
    obs = RNG.normal(size=(30, d)).astype(np.float32)
    # The action draws nothing.
    wanted = jax.vmap(lambda x: linear_agent(task).act(None, policy, x, explore=False))(obs)
    got = acting(task, policy.layers(task.max_action))(obs)
    np.testing.assert_allclose(got, wanted, atol=1e-4)


def test_the_step_size_declines_in_the_second_half():
    config = PolicySearchConfig(generations=100, step_size=0.5)
    sizes = [float(step_size(config, i)) for i in (0, 49, 75, 99)]
    np.testing.assert_allclose(sizes, [0.5, 0.5, 0.25, 0.05], rtol=1e-6)


@pytest.mark.slow
def test_a_search_solves_cartpole_and_takes_bonuses_out():
    search = make_search(dataclasses.replace(SMALL, num_directions=16), CARTPOLE)
    generation, policy = jax.jit(search.generation), first_policy(CARTPOLE)
    for i in range(6):
        policy, *_ = generation(jax.random.fold_in(jax.random.key(0), i), policy, i)
    assert float(jax.jit(search.test)(jax.random.key(1), policy).returns.mean()) > 150
    # Without the reward for standing nothing is learned: every direction is as good.
    flat = make_search(dataclasses.replace(SMALL, alive_bonus=1.0), CARTPOLE)
    policy, *_ = jax.jit(flat.generation)(jax.random.key(0), first_policy(CARTPOLE), 0)
    assert not np.asarray(policy.weights).any()


@pytest.mark.parametrize(("task", "change", "field"), [
    (CARTPOLE, {"num_top": 7}, "search.num_top"),
    (CARTPOLE, {"noise_std": 0.0}, "search.noise_std"),
    (CARTPOLE, {"policy_error": -1.0}, "search.policy_error"),
    (envs.make("cliff_walking"), {}, "env"),
])  # fmt: skip
def test_searches_that_cannot_be_are_refused(task, change, field):
    assert refused(lambda: make_search(dataclasses.replace(SMALL, **change), task)) == field


# --- copies --------------------------------------------------------------------------------------

KEYS = dict(zip(("search", "record"), jax.random.split(jax.random.key(0)), strict=True))
COPY = CopyConfig(rounds=3, episodes=4, steps=3000)


def swings_up(obs):
    return np.clip(np.maximum(obs @ [[2.0], [-4.0], [-1.0]] + 0.3, -0.5), -2, 2)


def balances(obs):
    return (obs @ [0.1, 0.3, 1.0, 0.6] > 0).astype(int)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "policy", "hidden_size", "most"),
    [(PENDULUM, swings_up, 8, 0.2), (CARTPOLE, balances, 0, 0.4)],
)
def test_a_copy_does_what_the_policy_does(task, policy, hidden_size, most, tmp_path):
    config = dataclasses.replace(COPY, hidden_size=hidden_size)
    store, name = Store(tmp_path, {}), f"{__name__}:{policy.__name__}"
    (lesson,), costs = copy_policy(config, task, name, KEYS, store)
    assert len(lesson.layers) == 1 + (hidden_size > 0)
    error = acting(task, lesson.layers)(lesson.states) - policy(lesson.states)
    assert np.sqrt((error**2).mean()) < most
    assert len(lesson.states) < costs["real_steps"].item() <= 4 * 4 * task.max_steps


def test_errors_have_their_size_and_do_not_depend_on_who_has_ended():
    states, key = RNG.normal(size=(4000, 3)), jax.random.key(3)
    act = erring(PENDULUM, [(np.zeros((1, 3)), np.zeros(1))], states, key, 4000)
    errors = act(states)
    assert 0.17 < np.sqrt((errors**2).mean()) < 0.25  # of a bound of 2, with the bias's part
    states[1:] *= 1e4  # as of episodes that go on after their end
    assert act(states)[0] == errors[0]


def test_visits_are_whole_episodes():
    states, mean_return = visit(CARTPOLE, lambda obs: np.zeros(len(obs)), jax.random.key(0), 5)
    assert 5 * mean_return == len(states) and mean_return < 15  # pushed to one side all the time

    class Short(Wrapper):
        def is_truncated(self, state, params):
            return state.time >= 3

    task = dataclasses.replace(CARTPOLE, env=Short(CARTPOLE.env))
    assert len(visit(task, lambda obs: np.zeros(len(obs)), jax.random.key(0), 5)[0]) == 15


# --- what SEs teach ------------------------------------------------------------------------------


def test_grades_weigh_the_worst_student_and_count_those_that_diverged():
    columns = ["generation", "agent", "test_return"]
    rows = [(1, "td3", 10.0), (1, "td3", 20.0), (1, "sac", 5.0), (1, "sac", 5.0),
            (2, "td3", 30.0), (2, "td3", np.nan), (2, "sac", 8.0), (2, "sac", 0.0)]  # fmt: skip
    marks = grades(pd.DataFrame(rows, columns=columns))
    assert marks[1] == pytest.approx(((15 + 10) / 2 + 5) / 2)
    assert marks[2] == pytest.approx(((15 + 0) / 2 + (4 + 0) / 2) / 2)  # nan counts as 0
