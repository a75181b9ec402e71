"""sejax.proxies.exact: SEs whose best policy is a given one."""

import itertools

import jax
import numpy as np
import pytest
from support import numpy_forward, refused

import sejax
from sejax.envs.base import Task
from sejax.envs.spec import Box, Discrete, TaskSpec
from sejax.proxies.exact import gaussian, make_exact
from sejax.proxies.io import AbsentEnv

RNG = np.random.default_rng(0)
OBS_DIM = 3


def task_with(action):
    """A task of which only the spaces count."""
    spec = TaskSpec(observation=Box.symmetric(*[9.0] * OBS_DIM), action=action, max_steps=7)
    return Task.of(spec, name="spaces", env=AbsentEnv(spec, "it has no dynamics"))


TASKS = {"continuous": task_with(Box.symmetric(0.5, 0.5)), "discrete": task_with(Discrete(3))}
STATES = RNG.normal(size=(50, OBS_DIM)) * [1.0, 3.0, 0.1] + [0.0, -2.0, 5.0]


def layers_of(*sizes):
    return [
        (RNG.normal(size=(n_out, n_in)), RNG.normal(size=n_out))
        for n_in, n_out in itertools.pairwise(sizes)
    ]


def plain_outputs(layers, obs):
    """The policy, unit by unit."""
    params = {f"Dense_{i}": {"kernel": k, "bias": b} for i, (k, b) in enumerate(layers)}
    return numpy_forward(params, obs, "relu", len(layers) - 1)


def rewards(env, weights, states, actions):
    each = jax.vmap(jax.vmap(env.predict, (None, None, 0)), (None, 0, None))
    return np.asarray(each(weights, states.astype(np.float32), actions)[1])


@pytest.mark.parametrize("hidden", [(), (5,), (4, 6)])
def test_a_continuous_action_costs_its_distance_to_the_policys(hidden):
    layers = layers_of(OBS_DIM, *hidden, 2)
    env, weights = make_exact(TASKS["continuous"], layers, STATES)
    actions = RNG.uniform(-0.5, 0.5, (9, 2)).astype(np.float32)
    best = np.array([np.clip(plain_outputs(layers, s), -0.5, 0.5) for s in STATES])
    wanted = -np.abs(actions - best[:, None]).sum(axis=2)
    np.testing.assert_allclose(rewards(env, weights, STATES, actions), wanted, atol=2e-4)


@pytest.mark.parametrize("hidden", [(), (5,)])
def test_a_discrete_action_costs_for_each_better_one(hidden):
    layers = layers_of(OBS_DIM, *hidden, 3)
    env, weights = make_exact(TASKS["discrete"], layers, STATES)
    outputs = np.array([plain_outputs(layers, s) for s in STATES])
    apart = outputs[:, None, :] - outputs[:, :, None]  # [state, chosen, better]
    margin = np.quantile(np.abs(apart[:, ~np.eye(3, dtype=bool)]), 0.1)
    wanted = -np.clip(apart / margin, 0, 1).sum(axis=2)
    got = rewards(env, weights, STATES, np.arange(3))
    np.testing.assert_allclose(got, wanted, atol=2e-3)
    assert (got.argmax(axis=1) == outputs.argmax(axis=1)).all()


@pytest.mark.parametrize("independent", [False, True])
def test_episodes_begin_like_the_states_that_were_visited(independent):
    states = STATES @ [[1.0, 2.0, 0.0], [0.0, 1.0, 0.02], [0.0, 0.0, 1.0]]  # correlated
    env, weights = make_exact(TASKS["continuous"], layers_of(OBS_DIM, 2), states, independent)
    params = env.params(weights)
    keys = jax.random.split(jax.random.key(0), 40_000)
    starts = np.asarray(jax.jit(jax.vmap(lambda key: env.reset_env(key, params)[0]))(keys))
    std = states.std(axis=0)
    np.testing.assert_allclose((starts.mean(axis=0) - states.mean(axis=0)) / std, 0, atol=0.04)
    scale = np.outer(std, std)
    wanted = np.cov(states.T)
    assert np.abs(wanted / scale - np.diag(np.diag(wanted / scale))).max() > 0.5
    wanted = np.diag(np.diag(wanted)) if independent else wanted
    np.testing.assert_allclose(np.cov(starts.T) / scale, wanted / scale, atol=0.1)


@pytest.mark.parametrize("unit", [1.0, 1e4])
def test_a_number_that_never_varies_is_kept(unit):
    states = np.stack([np.full(9, 4.0), unit * np.linspace(0, 1, 9)], axis=1)
    (kernel, bias), (last, shift) = gaussian(states)
    noise = RNG.normal(size=(2, 1000))
    moved = noise + last @ np.maximum(kernel @ noise + bias[:, None], 0) + shift[:, None]
    assert np.abs(moved[0] - 4.0).max() < 1e-3
    assert 0.25 < moved[1].std() / unit < 0.45


@pytest.mark.parametrize("task, layers, field", [
    ("cliff_walking", layers_of(48, 4), "env"), ("pendulum", layers_of(4, 1), "policy"),
    ("pendulum", layers_of(3, 2), "policy"), ("pendulum", [], "policy"),
])  # fmt: skip
def test_what_does_not_fit_is_refused(task, layers, field):
    assert refused(make_exact, sejax.envs.make(task), layers, STATES) == field
    assert refused(make_exact, sejax.envs.make("pendulum"), layers, STATES[:1]) == "states"
