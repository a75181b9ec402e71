"""Tabular agents, also with a count-based bonus: updates against plain loops, grid worlds."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import assert_shares, drawing, paper_training

from sejax import envs
from sejax.agents.buffers import Transition
from sejax.agents.exploration import CountBasedConfig
from sejax.agents.tabular import QLearningConfig, SARSAConfig, Tabular
from sejax.evaluation import make_tester
from sejax.training import make_trainer

NUM_STATES, NUM_ACTIONS = 5, 3
KEY = jax.random.key(0)
NUMBERS = {"learning_rate": 0.5, "discount": 0.9, "epsilon_init": 0.4, "epsilon_min": 0.1}


@functools.cache
def q_learning(num_states=NUM_STATES, num_actions=NUM_ACTIONS, config=QLearningConfig, **numbers):
    return Tabular(config(**{**NUMBERS, **numbers}), num_states, num_actions).agent()


sarsa = functools.partial(q_learning, config=SARSAConfig)


@functools.cache
def fresh(agent):
    def begin(key):
        return agent.begin_episode(agent.init(key, agent.hparams), jnp.int32(0))

    return jax.tree.map(np.asarray, jax.jit(begin)(KEY))


def started(agent, q_values=None, epsilon=None):
    """The agent in its first episode, with other values or another epsilon if they are given."""
    state = fresh(agent)
    if q_values is not None:
        state = state.replace(q_values=np.array(q_values, np.float32))
    return state if epsilon is None else state.replace(epsilon=np.float32(epsilon))


def step(obs, action, reward, discount=0.0, next_obs=0):
    obs, action, next_obs = (np.int32(x) for x in (obs, action, next_obs))
    return Transition(obs, action, np.float32(reward), np.float32(discount), next_obs)


def random_steps(num_steps, num_states=NUM_STATES, num_actions=NUM_ACTIONS, seed=0):
    """Leaves `[num_steps]`: discounts are 0, 1 and, in a third of the steps, a soft done's."""
    rng = np.random.default_rng(seed)
    soft = rng.uniform(-0.2, 1.2, num_steps)
    discount = np.choose(rng.integers(0, 3, num_steps), [np.zeros(num_steps), 1.0, soft])
    return Transition(
        obs=np.int32(rng.integers(0, num_states, num_steps)),
        action=np.int32(rng.integers(0, num_actions, num_steps)),
        reward=np.float32(rng.normal(size=num_steps)),
        discount=np.float32(discount),
        next_obs=np.int32(rng.integers(0, num_states, num_steps)),
    )


def learn_all(agent, state, steps, keys):
    """All states after each of these steps, leaves `[num_steps, ...]`; a scan keeps the types."""

    def learn(state, item):
        key, transition = item
        state = agent.update(key, state, transition)
        return state, state

    steps = steps._replace(weight=np.ones(len(steps.obs), np.float32))
    return jax.jit(lambda state: jax.lax.scan(learn, state, (keys, steps))[1])(state)


# --- updates against plain loops -----------------------------------------------------------------


def plain_updates(steps, next_value, learning_rate=0.5, gamma=0.9):
    """Tables after each step by a loop; `next_value(i, row)` is what the next state is worth."""
    table, tables = [[0.0] * NUM_ACTIONS for _ in range(NUM_STATES)], []
    for i in range(len(steps.obs)):
        s, a, r, d, s2 = (np.asarray(x)[i].item() for x in steps[:5])
        target = r + gamma * d * next_value(i, table[s2])
        table[s][a] += learning_rate * (target - table[s][a])
        tables.append([list(row) for row in table])
    return np.array(tables)


def test_q_learning_equals_a_plain_loop():
    steps = random_steps(200)
    expected = plain_updates(steps, lambda i, row: max(row))
    got = learn_all(q_learning(), started(q_learning()), steps, jax.random.split(KEY, 200))
    np.testing.assert_allclose(got.q_values, expected, rtol=1e-4, atol=1e-5)


def test_sarsa_equals_a_plain_loop_that_draws_from_the_same_bits():
    steps, keys = random_steps(200, seed=1), jax.random.split(KEY, 200)
    bits = np.asarray(jax.random.key_data(keys))  # a step's key is random bits itself

    def next_value(i, row):
        if (bits[i, 1] >> 8) / 2**24 < 0.4:  # epsilon
            return row[bits[i, 0] % NUM_ACTIONS]
        return row[row.index(max(row))]

    expected = plain_updates(steps, next_value)
    got = learn_all(sarsa(), started(sarsa()), steps, keys)
    np.testing.assert_allclose(got.q_values, expected, rtol=1e-4, atol=1e-5)
    greedy = plain_updates(steps, lambda i, row: max(row))
    assert np.abs(greedy[-1] - expected[-1]).max() > 0.1  # the draws do matter


# --- exploration ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("numbers", "expected"), [
    # (init, minimum, decay): 0.8, 0.4, 0.2, then max(0.1, 0.15) = 0.15.
    ((0.8, 0.15, 0.5), [0.8, 0.4, 0.2, 0.15, 0.15]),
    ((0.8, 0.1, 0.0), [0.8, 0.1, 0.1, 0.1, 0.1]),
    # The first episode uses the initial epsilon even below the minimum.
    ((0.05, 0.1, 0.9), [0.05, 0.1, 0.1, 0.1, 0.1]),
])  # fmt: skip
def test_epsilon_decays_by_a_factor_each_episode_down_to_its_minimum(numbers, expected):
    names = ("epsilon_init", "epsilon_min", "epsilon_decay")
    agent = q_learning(**dict(zip(names, numbers, strict=True)))
    state = fresh(agent)
    got = [agent.begin_episode(state, jnp.int32(episode)).epsilon for episode in range(5)]
    np.testing.assert_allclose(got, expected, rtol=1e-6)


def drawn_in_state_1(agent, table, epsilon):
    """Actions of exploring and of testing, given this table of values."""
    return drawing(agent)(started(agent, table, epsilon), np.int32(1))


@pytest.mark.parametrize("make", [q_learning, sarsa])
@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
def test_actions_are_random_with_probability_epsilon_and_greedy_otherwise(make, epsilon):
    table = np.zeros((5, 3))
    table[1] = [-1.0, -2.0, 3.0]
    drawn, _ = drawn_in_state_1(make(), table, epsilon)
    assert drawn.dtype == jnp.int32
    # Random actions are uniform, the greedy one included.
    assert_shares(drawn, np.full(3, epsilon / 3) + (1 - epsilon) * np.array([0, 0, 1]))


@pytest.mark.parametrize(
    ("row", "best"),
    [([0, 0, 0], 0), ([-1, 0, 0], 1), ([-1, -1, -2], 0), ([2, 3, 3], 1), ([1, 2, 3], 2)],
)
def test_of_equal_actions_the_first_is_greedy(row, best):
    table = np.zeros((5, 3))
    table[1] = row
    greedy, tested = drawn_in_state_1(q_learning(), table, 0.0)
    assert (greedy == best).all() and (tested == best).all()


# --- worlds with a known answer ------------------------------------------------------------------


def trained(agent, task, num_episodes, num_agents):
    """`num_agents` trainings in the task, in lanes, and their test returns `[num_agents]`."""
    config = paper_training(
        max_episodes=num_episodes, stop_rule="never", time_limit_is_terminal=False
    )
    train, test = make_trainer(agent, task.env, config), make_tester(agent, task, 1)

    @jax.jit
    @jax.vmap
    def run(key):
        result = train(key, task.params)
        return result, test(key, result.agent_state)[0][0]

    return run(jax.random.split(jax.random.key(3), num_agents))


def test_q_learning_finds_the_shortest_way_along_the_cliff_and_never_undervalues():
    task = envs.make("cliff_walking")  # with the paper's numbers
    agent = Tabular(QLearningConfig(), task.num_states, task.num_actions).agent()
    result, returns = trained(agent, task, num_episodes=300, num_agents=6)
    np.testing.assert_array_equal(returns, -12.0)  # 13 steps, the last of which is free
    assert not result.nonfinite.any()
    # From 0, which is more than anything is worth here, values fall to Q* with learning rate 1.
    # V* of n steps and a free last one: -(1 - 0.8^n) / (1 - 0.8).
    rows, columns = np.divmod(np.arange(36), 12)
    num_paid = (3 - rows) + (11 - columns) - 1  # [36]: all states above the cliff
    expected = -(1 - 0.8 ** np.append(num_paid, 12)) / (1 - 0.8)  # [37]: and the start
    q_values = np.asarray(result.agent_state.q_values)  # [agent, state, action]
    values = q_values[:, :37].max(axis=-1)
    assert (values >= expected - 1e-4).all()
    way = [36, *range(24, 36)]  # up, along the cliff's edge, and down
    np.testing.assert_allclose(values[:, way], np.tile(expected[way], (6, 1)), atol=1e-4)


# --- count-based exploration ---------------------------------------------------------------------

BETA = 0.5
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


def test_in_a_training_each_learning_step_counts_and_returns_stay_without_the_bonus():
    task = envs.make("cliff_walking")
    agent = counting(Tabular(QLearningConfig(warmup_episodes=2), 48, 4).agent(), 1.0, 48, 4)
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
