"""SEs of one step whose reward has a known form: what it is, how it is stored, what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import numpy_forward, refused

import sejax
from sejax import envs
from sejax.proxies.synthetic import SyntheticConfig
from sejax.runs import config as configuration

CONFIG = SyntheticConfig(
    hidden_size=8, horizon=1, initial_state="noise", state_units="bounds", reward_form="distance",
)  # fmt: skip
OBS = jnp.array([0.6, 0.8, -2.0])


def made():
    env = CONFIG.make(envs.make("pendulum"))
    return env, env.init_weights(jax.random.key(3))


def step_reward(env, weights, obs, action):
    """As an agent would meet it."""
    params = env.params(weights)
    _, state = env.reset_env(jax.random.key(0), params)
    state = state.replace(vector=jnp.asarray(obs))
    return float(env.step_env(jax.random.key(0), state, jnp.asarray(action), params)[2])


def test_the_reward_is_what_the_form_says():
    env, weights = made()
    # The network by hand: leaky ReLUs of the state in units of half the way to the bounds.
    seen = np.asarray(OBS) / np.array([0.5, 0.5, 4.0])
    output = numpy_forward(weights["reward"], seen, "leaky_relu", 1)
    best = 2.0 * np.clip(output, -1, 1)
    for action in (-2.0, 0.3, 5.0):  # the last is clipped to 2
        wanted = -abs(min(action, 2.0) - best[0])
        assert step_reward(env, weights, OBS, [action]) == pytest.approx(wanted, rel=1e-4)


def test_it_is_stored_and_plays_in_numpy_alike(tmp_path):
    env, weights = made()
    sejax.save(tmp_path / "se.safetensors", env, weights)
    alike = sejax.gym.make(str(tmp_path / "se.safetensors"))
    obs, _ = alike.reset(seed=1)
    action = np.array([-1.3], np.float32)
    _, reward, terminated, *_ = alike.step(action)
    assert terminated
    np.testing.assert_allclose(reward, env.bandit_reward(weights, obs, action), rtol=1e-4)


@pytest.mark.parametrize("words", [
    ["proxy.reward_form=distance", "env=cartpole", "proxy.horizon=1"],
    ["proxy.reward_form=distance", "env=pendulum", "proxy.horizon=null"],
])  # fmt: skip
def test_a_form_that_cannot_be_is_refused(words):
    assert refused(configuration.config, words) == words[0].partition("=")[0]
