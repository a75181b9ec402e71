"""sejax.agents.exploration: the bonus by a plain loop, and in a training."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_tabular import step, trained

from sejax import envs
from sejax.agents.exploration import CountBasedConfig
from sejax.agents.tabular import QLearningConfig, SARSAConfig, Tabular

NUM_STATES, NUM_ACTIONS, BETA = 3, 2, 0.5
KEY = jax.random.key(0)
PLAIN = Tabular(QLearningConfig(learning_rate=0.5), NUM_STATES, NUM_ACTIONS).agent()


def counting(plain=PLAIN, power=1.0, num_states=NUM_STATES, num_actions=NUM_ACTIONS):
    config = CountBasedConfig(reward_scale=BETA, count_power=power)
    return config.make(plain, SimpleNamespace(num_states=num_states, num_actions=num_actions))


@pytest.mark.parametrize(
    ("config", "power"), [(QLearningConfig, 1.0), (SARSAConfig, 1.0), (QLearningConfig, 0.5)]
)
def test_the_agent_inside_learns_as_if_the_bonus_were_paid(config, power):
    plain = Tabular(config(learning_rate=0.3, epsilon_init=0.6), NUM_STATES, NUM_ACTIONS).agent()
    agent = counting(plain, power=power)
    rng = np.random.default_rng(0)
    state, expected = agent.init(KEY, agent.hparams), plain.init(KEY, plain.hparams)
    update, plain_update = jax.jit(agent.update), jax.jit(plain.update)
    counts = np.zeros((NUM_STATES, NUM_ACTIONS))
    for key in jax.random.split(KEY, 60):
        obs, next_obs = rng.integers(0, NUM_STATES, 2)
        action, reward = rng.integers(0, NUM_ACTIONS), rng.normal()
        discount = rng.choice([0.0, 1.0, 0.7])
        counts[obs, action] += 1
        paid = reward + BETA / counts[obs, action] ** power
        state = update(key, state, step(obs, action, reward, discount, next_obs))
        expected = plain_update(key, expected, step(obs, action, paid, discount, next_obs))
    np.testing.assert_array_equal(state.counts, counts)
    np.testing.assert_allclose(state.agent_state.q_values, expected.q_values, rtol=1e-5, atol=1e-6)


def test_beta_and_the_numbers_inside_are_traced():
    hparams = counting().hparams
    assert hparams.agent == PLAIN.hparams and hparams.reward_scale == BETA

    def after(beta, rate):
        inner = hparams.agent.replace(learning_rate=rate)
        state = counting().init(KEY, hparams.replace(agent=inner, reward_scale=beta))
        return counting().update(KEY, state, step(0, 0, 1.0)).agent_state.q_values[0, 0]

    values = jax.jit(jax.vmap(after))(jnp.array([0.0, 0.2, 1.0]), jnp.array([1.0, 1.0, 0.5]))
    np.testing.assert_allclose(values, [1.0, 1.2, 1.0], rtol=1e-6)


# --- in a training -------------------------------------------------------------------------------


def test_in_a_training_each_learning_step_counts_and_returns_stay_without_the_bonus():
    task = envs.make("cliff_walking")
    plain = Tabular(QLearningConfig(warmup_episodes=2), 48, 4).agent()
    agent = counting(plain, 1.0, 48, 4)
    result, test_returns = trained(agent, task, num_episodes=200, num_agents=4)
    np.testing.assert_array_equal(test_returns, -12.0)
    returns = np.asarray(result.returns)
    np.testing.assert_array_equal(returns, np.round(returns))
    # The first two episodes are not learned from. One that falls off takes -99 - return steps, one
    # that arrives 1 - return, and one that runs out of time 50.
    first = returns[:, :2]
    lengths = np.where(first <= -100, -99 - first, np.minimum(1 - first, 50)).sum(axis=1)
    counts = np.asarray(result.agent_state.counts)
    np.testing.assert_array_equal(counts.sum(axis=(1, 2)), result.train_steps - lengths)
    assert (counts[:, 37:] == 0).all()  # nothing is done in the cliff or at the goal
