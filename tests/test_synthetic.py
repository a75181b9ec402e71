"""sejax.proxies.synthetic: the SE's equations, its ends of episodes, and plain gymnax usage."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import numpy_forward

from sejax import envs, plugins
from sejax.proxies.configs import SyntheticConfig
from sejax.proxies.proxy import ABSURD, World, world_of

CONFIG = SyntheticConfig(hidden_size=5, num_layers=2, activation="leaky_relu")
OBS = jnp.array([0.1, -0.2, 0.3, -0.4])


def make_env(task="cartpole", **changes):
    config = SyntheticConfig(**{**vars(CONFIG), **changes})
    return plugins.make("proxy", config, envs.make(task))


@pytest.fixture(scope="module")
def step():
    """Jitted `step_env` from OBS at time 0 with action 1, by done mode: `(weights)`."""

    def build(done):
        env = make_env(done=done)
        _, state = env.reset_env(jax.random.key(0), env.default_params)
        state = state.replace(vector=OBS)
        return jax.jit(lambda w: env.step_env(jax.random.key(1), state, 1, env.params(w)))

    return {done: build(done) for done in ("soft", "threshold")}


def constant_weights(state, reward, done):
    """Weights with which the three outputs are these constants, whatever the input."""
    shapes = jax.eval_shape(make_env().init_weights, jax.random.key(0))
    weights = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)
    for head, value in {"state": state, "reward": reward, "done": done}.items():
        weights[head][f"Dense_{CONFIG.num_layers}"]["bias"][:] = value
    return weights


# --- equations -----------------------------------------------------------------------------------


@pytest.mark.parametrize("task", ["cartpole", "acrobot"])
def test_predict_equals_three_separate_mlps_fed_the_one_hot_action_first(task):
    env = make_env(task)
    num_actions, obs_dim = env.task.num_actions, env.task.obs_dim
    weights = env.init_weights(jax.random.key(3))
    predict = jax.jit(env.predict)
    for action in range(num_actions):
        obs = np.random.default_rng(action).normal(size=obs_dim)
        one_hot = [1.0 if i == action else 0.0 for i in range(num_actions)]
        x = np.concatenate([one_hot, obs])  # action first
        expected = {
            head: numpy_forward(weights[head], x, CONFIG.activation, CONFIG.num_layers)
            for head in ("state", "reward", "done")
        }
        next_obs, reward, done = predict(weights, jnp.float32(obs), jnp.int32(action))
        np.testing.assert_allclose(next_obs, expected["state"], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(reward, expected["reward"][0], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(done, expected["done"][0], rtol=1e-5, atol=1e-6)


def test_the_networks_share_a_shape_and_no_weights():
    env = make_env()
    weights = env.init_weights(jax.random.key(0))
    for head, outputs in {"state": 4, "reward": 1, "done": 1}.items():
        shapes = [weights[head][f"Dense_{i}"]["kernel"].shape for i in range(3)]
        assert shapes == [(5, 6), (5, 5), (outputs, 5)]  # 2 actions + 4 numbers of state
    first = [np.asarray(weights[head]["Dense_0"]["kernel"]) for head in weights]
    assert not np.allclose(first[0], first[1]) and not np.allclose(first[1], first[2])


def test_the_papers_se_for_cartpole_has_2247_parameters():
    # (6 * 83 + 83) * 3 for the hidden layers, (83 + 1) * (4 + 1 + 1) for the heads:
    # 1743 + 504 = 2247, as the authors' networks have.
    env = make_env(hidden_size=83, num_layers=1)
    weights = jax.eval_shape(env.init_weights, jax.random.key(0))
    assert sum(x.size for x in jax.tree.leaves(weights)) == 2247


def test_a_step_moves_to_the_predicted_state_itself(step):
    weights = make_env().init_weights(jax.random.key(5))
    next_obs, reward, _ = make_env().predict(weights, OBS, jnp.int32(1))
    obs, state, got_reward, _, _ = step["soft"](weights)
    np.testing.assert_allclose(obs, next_obs, rtol=1e-6)
    np.testing.assert_array_equal(state.vector, obs)
    np.testing.assert_allclose(got_reward, reward, rtol=1e-6)


@pytest.mark.parametrize(
    ("done", "terminates"), [(-3.0, False), (0.0, False), (0.5, False), (0.501, True), (7.0, True)]
)
@pytest.mark.parametrize("mode", ["soft", "threshold"])
def test_an_episode_terminates_where_the_done_output_exceeds_one_half(step, mode, done, terminates):
    _, _, reward, terminated, info = step[mode](constant_weights(1.0, 2.0, done))
    assert terminated == terminates
    assert reward == 2.0  # the reward of the last step counts
    # soft: 1 - d, not confined to [0, 1]; threshold: 1 - [d > 0.5].
    expected = 1.0 - done if mode == "soft" else 1.0 - terminates
    np.testing.assert_allclose(info["discount"], expected, rtol=1e-6)
    assert not info["nonfinite"]


# --- outputs that no world has -------------------------------------------------------------------


@pytest.mark.parametrize(
    "outputs",
    [
        {"state": np.nan}, {"state": np.inf}, {"reward": np.nan}, {"reward": -np.inf},
        {"done": np.nan}, {"done": -np.inf},
        {"state": 2 * ABSURD}, {"reward": -2 * ABSURD}, {"done": -2 * ABSURD},
    ],
    ids=str,
)  # fmt: skip
@pytest.mark.parametrize("mode", ["soft", "threshold"])
def test_an_absurd_or_nonfinite_output_ends_the_episode_where_it_was(step, mode, outputs):
    weights = constant_weights(**{"state": 1.0, "reward": 2.0, "done": 0.0, **outputs})
    obs, state, reward, terminated, info = step[mode](weights)
    np.testing.assert_array_equal(obs, OBS)
    np.testing.assert_array_equal(state.vector, OBS)
    assert terminated
    assert reward == 0.0
    assert info["discount"] == 0.0
    (value,) = outputs.values()
    assert info["nonfinite"] == (not np.isfinite(value))


def test_outputs_just_below_absurd_are_a_world(step):
    weights = constant_weights(0.99 * ABSURD, 0.99 * ABSURD, 0.0)
    obs, _, reward, terminated, info = step["soft"](weights)
    np.testing.assert_allclose(obs, 0.99 * ABSURD)
    np.testing.assert_allclose(reward, 0.99 * ABSURD)
    assert not terminated and not info["nonfinite"]


# --- as a gymnax environment ---------------------------------------------------------------------


@pytest.mark.parametrize("task", ["cartpole", "acrobot"])
def test_initial_states_are_the_real_tasks(task):
    env = make_env(task)
    keys = jax.random.split(jax.random.key(0), 5)
    obs, state = jax.vmap(env.reset_env, (0, None))(keys, env.default_params)
    real, _ = jax.vmap(env.task.env.reset_env, (0, None))(keys, env.task.params)
    np.testing.assert_array_equal(obs, real)
    np.testing.assert_array_equal(state.vector, real)
    np.testing.assert_array_equal(state.time, 0)


def test_plain_gymnax_usage_counts_time_truncates_at_the_limit_and_resets():
    env = make_env()
    # d = 0.25 never terminates: the episode runs to the real task's limit.
    params = env.params(constant_weights(0.7, 1.5, 0.25))
    assert params.max_steps_in_episode == 200
    obs, state = env.reset(jax.random.key(0), params)
    for t in range(1, 4):
        obs, state, reward, terminated, truncated, info = env.step(
            jax.random.key(t), state, env.action_space(params).sample(jax.random.key(t)), params
        )
        assert state.time == t
        assert not terminated and not truncated and reward == 1.5
    state = state.replace(time=jnp.int32(199))
    obs, state, reward, terminated, truncated, info = env.step(jax.random.key(9), state, 0, params)
    assert truncated and not terminated and reward == 1.5
    assert info["discount"] == 0.75  # a learned discount: the limit itself does not cut it
    np.testing.assert_allclose(info["final_observation"], 0.7)
    assert state.time == 0 and np.abs(obs).max() <= 0.05  # the next episode has begun


def test_termination_resets_too():
    env = make_env()
    params = env.params(constant_weights(0.7, 1.5, 0.6))
    _, state = env.reset(jax.random.key(0), params)
    obs, state, _, terminated, truncated, info = env.step(jax.random.key(1), state, 0, params)
    assert terminated and not truncated and state.time == 0
    np.testing.assert_allclose(info["final_observation"], 0.7)
    assert np.abs(obs).max() <= 0.05


def test_weights_are_traced_so_that_many_proxies_step_at_once():
    env = make_env()
    keys = jax.random.split(jax.random.key(0), 3)
    each = [env.init_weights(key) for key in keys]
    weights = jax.tree.map(lambda *x: jnp.stack(x), *each)
    _, state = env.reset(keys[0], env.default_params)
    step = jax.jit(jax.vmap(lambda w: env.step_env(keys[0], state, 1, env.params(w))[:3]))
    obs, _, reward = step(weights)
    assert obs.shape == (3, 4)
    predict = jax.jit(env.predict)
    for i in range(3):
        expected_obs, expected_reward, _ = predict(each[i], state.vector, jnp.int32(1))
        np.testing.assert_allclose(obs[i], expected_obs, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(reward[i], expected_reward, rtol=1e-5, atol=1e-6)


def test_spaces_and_names_are_those_of_the_task():
    env = make_env("acrobot")
    assert env.num_actions == 3
    assert env.observation_space().shape == (6,)
    assert env.name == "Synthetic-acrobot"
    assert make_env("acrobot") is env  # one instance for each configuration
    assert world_of(env) == World(is_real=False, max_steps=500)
