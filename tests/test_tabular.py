"""sejax.agents.tabular: updates by hand and against plain loops, exploration, grid worlds."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sejax import envs
from sejax.agents.buffers import Transition
from sejax.agents.policies import decayed_epsilon
from sejax.agents.tabular import (
    QLearningConfig,
    SARSAConfig,
    entry_of,
    make_q_learning,
    make_sarsa,
    mask_of,
)
from sejax.evaluation import make_tester
from sejax.training import TrainingConfig, make_trainer

NUM_STATES, NUM_ACTIONS = 5, 3
KEY = jax.random.key(0)
NUMBERS = {"learning_rate": 0.5, "discount": 0.9, "epsilon_init": 0.4, "epsilon_min": 0.1}


def q_learning(num_states=NUM_STATES, num_actions=NUM_ACTIONS, **numbers):
    return make_q_learning(QLearningConfig(**{**NUMBERS, **numbers}), num_states, num_actions)


def sarsa(num_states=NUM_STATES, num_actions=NUM_ACTIONS, **numbers):
    return make_sarsa(SARSAConfig(**{**NUMBERS, **numbers}), num_states, num_actions)


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


@functools.cache
def update_of(agent):
    return jax.jit(agent.update)


def step(obs, action, reward, discount, next_obs):
    return Transition(
        obs=np.int32(obs), action=np.int32(action), reward=np.float32(reward),
        discount=np.float32(discount), next_obs=np.int32(next_obs),
    )  # fmt: skip


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


# --- updates by hand -----------------------------------------------------------------------------


def test_q_learning_moves_one_entry_towards_its_target():
    agent = q_learning()  # learning rate 0.5, discount 0.9
    update = update_of(agent)
    state = started(agent)
    np.testing.assert_array_equal(state.q_values, np.zeros((5, 3)))
    state = update(KEY, state, step(2, 1, 4.0, 1.0, 3))  # 0 + 0.5 (4 + 0.9 * 0 - 0) = 2
    state = update(KEY, state, step(0, 2, 1.0, 1.0, 2))  # 0 + 0.5 (1 + 0.9 * 2 - 0) = 1.4
    state = update(KEY, state, step(0, 2, 1.0, 0.5, 2))  # 1.4 + 0.5 (1 + 0.45 * 2 - 1.4) = 1.65
    state = update(KEY, state, step(4, 0, -3.0, 0.0, 2))  # 0 + 0.5 (-3 + 0 - 0) = -1.5
    state = update(KEY, state, step(2, 1, 4.0, 1.0, 2))  # 2 + 0.5 (4 + 0.9 * 2 - 2) = 3.9
    expected = np.zeros((5, 3))
    expected[2, 1], expected[0, 2], expected[4, 0] = 3.9, 1.65, -1.5
    np.testing.assert_allclose(state.q_values, expected, rtol=1e-6)


def test_q_learning_bootstraps_with_the_best_action_also_among_negative_ones():
    agent = q_learning(learning_rate=1.0)
    table = np.zeros((5, 3))
    table[1] = [-5.0, -2.0, -3.0]
    state = update_of(agent)(KEY, started(agent, table), step(0, 0, 1.0, 1.0, 1))
    np.testing.assert_allclose(state.q_values[0, 0], 1 + 0.9 * -2.0, rtol=1e-6)


@pytest.mark.parametrize("make", [q_learning, sarsa])
def test_a_transition_with_discount_zero_ignores_its_next_state(make):
    agent = make(learning_rate=1.0)
    state = started(agent, np.full((5, 3), 7.0))
    after = update_of(agent)(KEY, state, step(3, 1, 2.0, 0.0, 4))
    assert after.q_values[3, 1] == 2.0


def test_a_greedy_sarsa_is_q_learning():
    state = started(sarsa(), epsilon=0.0)
    steps, keys = random_steps(40), jax.random.split(KEY, 40)
    np.testing.assert_array_equal(
        learn_all(sarsa(), state, steps, keys).q_values,
        learn_all(q_learning(), state, steps, keys).q_values,
    )


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


def test_reading_and_writing_a_table_name_the_same_entry():
    table = np.arange(12).reshape(3, 4)
    read_and_mask = jax.jit(lambda s, a: (entry_of(jnp.array(table), s, a), mask_of(s, a, (3, 4))))
    for s, a in np.ndindex(3, 4):
        entry, mask = map(np.asarray, read_and_mask(np.int32(s), np.int32(a)))
        assert mask.sum() == 1 and mask[s, a]
        assert entry == 4 * s + a


def test_an_infinite_entry_elsewhere_does_no_harm():
    table = np.zeros((5, 3))
    table[3, 2] = np.inf
    for agent in (q_learning(), sarsa()):
        state = started(agent, table, epsilon=1.0)
        after = update_of(agent)(KEY, state, step(0, 0, 1.0, 1.0, 1))
        table_after = np.array(after.q_values)
        assert table_after[0, 0] == 0.5 and table_after[3, 2] == np.inf
        table_after[0, 0] = table_after[3, 2] = 0
        np.testing.assert_array_equal(table_after, 0)


# --- hyperparameters -----------------------------------------------------------------------------


@pytest.mark.parametrize("make", [q_learning, sarsa])
def test_hyperparameters_are_traced_so_that_a_population_may_vary_them(make):
    agent = make()
    rates, gammas = jnp.array([0.0, 0.1, 1.0]), jnp.array([0.9, 0.9, 0.5])

    def after(rate, gamma):
        hparams = agent.hparams._replace(learning_rate=rate, discount=gamma)
        state = agent.init(KEY, hparams).replace(q_values=jnp.ones((5, 3)))
        return agent.update(KEY, state, step(0, 0, 2.0, 1.0, 1)).q_values[0, 0]

    # 1, 1 + 0.1 (2 + 0.9 - 1), 2 + 0.5
    got = jax.jit(jax.vmap(after))(rates, gammas)
    np.testing.assert_allclose(got, [1.0, 1.19, 2.5], rtol=1e-6)


@pytest.mark.parametrize("make", [make_q_learning, make_sarsa])
def test_the_defaults_are_the_papers_and_an_agent_is_made_once(make):
    config = QLearningConfig() if make is make_q_learning else SARSAConfig()
    agent = make(config, 48, 4)
    assert agent is make(config, 48, 4)
    assert agent.hparams._asdict() == {
        "learning_rate": 1.0, "discount": 0.8,
        "epsilon_init": 0.1, "epsilon_min": 0.1, "epsilon_decay": 0.0,
    }  # fmt: skip
    assert (agent.spec.warmup_episodes, agent.spec.learns_from) == (0, 0)


def test_learning_starts_after_the_initial_episodes():
    agent = q_learning(warmup_episodes=4)
    assert (agent.spec.warmup_episodes, agent.spec.learns_from) == (4, 4)


# --- exploration ---------------------------------------------------------------------------------


@jax.jit
def epsilons(numbers, hparams):
    """Those of five episodes, from the numbers and by the agent that has them."""
    episodes, agent = jnp.arange(5), q_learning()
    state = agent.init(KEY, hparams)
    direct = jax.vmap(lambda episode: decayed_epsilon(*numbers, episode))(episodes)
    return direct, jax.vmap(agent.begin_episode, (None, 0))(state, episodes).epsilon


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        # (init, minimum, decay): 0.8, 0.4, 0.2, then max(0.1, 0.15) = 0.15.
        ((0.8, 0.15, 0.5), [0.8, 0.4, 0.2, 0.15, 0.15]),
        ((0.8, 0.1, 0.0), [0.8, 0.1, 0.1, 0.1, 0.1]),
        # The first episode uses the initial epsilon even below the minimum.
        ((0.05, 0.1, 0.9), [0.05, 0.1, 0.1, 0.1, 0.1]),
    ],
)
def test_epsilon_decays_by_a_factor_each_episode_down_to_its_minimum(numbers, expected):
    names = ("epsilon_init", "epsilon_min", "epsilon_decay")
    agent = q_learning(**dict(zip(names, numbers, strict=True)))
    numbers = [np.float32(x) for x in numbers]
    direct, begun = epsilons(numbers, agent.hparams)
    np.testing.assert_allclose(direct, expected, rtol=1e-6)
    np.testing.assert_allclose(begun, expected, rtol=1e-6)


@functools.cache
def drawing(make):
    """Actions of 4000 keys in state 1, and the greedy one: `(table, epsilon) -> [4000], []`."""
    agent = make()

    @jax.jit
    def draw(state):
        keys = jax.random.split(jax.random.key(1), 4000)
        drawn = jax.vmap(lambda key: agent.act(key, state, jnp.int32(1), True))(keys)
        return drawn, agent.act(KEY, state, jnp.int32(1), explore=False)

    return lambda table, epsilon: draw(started(agent, table, epsilon))


def assert_shares(drawn, expected):
    """The actions' shares, within five standard deviations."""
    share = np.bincount(drawn, minlength=len(expected)) / drawn.size
    deviation = np.sqrt(expected * (1 - expected) / drawn.size)
    assert (np.abs(share - expected) <= 5 * deviation + 1e-7).all()


@pytest.mark.parametrize("make", [q_learning, sarsa])
@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
def test_actions_are_random_with_probability_epsilon_and_greedy_otherwise(make, epsilon):
    table = np.zeros((5, 3))
    table[1] = [-1.0, -2.0, 3.0]
    drawn, _ = drawing(make)(table, epsilon)
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
    _, action = drawing(q_learning)(table, 1.0)
    assert action == best and action.dtype == jnp.int32
    drawn, _ = drawing(q_learning)(table, 0.0)
    assert (np.asarray(drawn) == best).all()


def test_sarsas_next_action_is_drawn_by_the_same_rule():
    agent = sarsa(learning_rate=1.0, discount=1.0)
    table = np.zeros((5, 3))
    table[1] = [10.0, 30.0, 20.0]
    state = started(agent, table, 0.6)
    keys = jax.random.split(jax.random.key(2), 4000)
    update = jax.jit(jax.vmap(agent.update, (0, None, None)))
    value = np.asarray(update(keys, state, step(0, 2, 0.0, 1.0, 1)).q_values)[:, 0, 2]
    assert set(value.tolist()) == {10.0, 20.0, 30.0}
    action = np.array([0, 2, 1])[np.round(value / 10 - 1).astype(int)]
    assert_shares(action, np.array([0.2, 0.6, 0.2]))


# --- worlds with a known answer ------------------------------------------------------------------


def plain_world(rows, step_reward, goal_reward, hole_reward):
    """`(state, action) -> (next state, reward, discount)` and the inner states of a map."""
    height, width = len(rows), len(rows[0])

    def move(state, action):
        down, right = [(0, 1), (0, -1), (1, 0), (-1, 0)][action]
        y, x = divmod(state, width)
        if not (0 <= y + down < height and 0 <= x + right < width):
            return state, step_reward, 1.0
        y, x = y + down, x + right
        reward = {"G": goal_reward, "O": hole_reward}.get(rows[y][x])
        return y * width + x, step_reward if reward is None else reward, float(reward is None)

    inner = [i for i, cell in enumerate("".join(rows)) if cell not in "GO"]
    return move, inner


def value_iteration(move, inner, num_states, gamma):
    """Q* `[num_states, 4]` by sweeps; 0 in states that are never left."""
    q_values = np.zeros((num_states, 4))
    for _ in range(300):
        for s in inner:
            for a in range(4):
                s2, reward, discount = move(s, a)
                q_values[s, a] = reward + gamma * discount * q_values[s2].max()
    return q_values


CLIFF = plain_world((" " * 12,) * 3 + ("S" + "O" * 10 + "G",), -1.0, 0.0, -100.0)
ROOM = plain_world(("S ", " G"), -0.01, 1.0, -1.0)


def trained(agent, task, num_episodes, num_agents):
    """`num_agents` trainings in the task, in lanes, and their test returns `[num_agents]`."""
    config = TrainingConfig(
        max_episodes=num_episodes, stop_rule="never", time_limit_is_terminal=False
    )
    train, test = make_trainer(agent, task.env, config), make_tester(agent, task, 1)

    @jax.jit
    @jax.vmap
    def run(key):
        result = train(key, task.params)
        return result, test(key, result.agent_state)[0][0]

    return run(jax.random.split(jax.random.key(3), num_agents))


@pytest.fixture(scope="module")
def cliff_agents():
    """Q-learning with the paper's numbers."""
    task = envs.make("cliff_walking")
    agent = make_q_learning(QLearningConfig(), task.num_states, task.num_actions)
    return trained(agent, task, num_episodes=300, num_agents=6)


def test_q_learning_finds_the_shortest_way_along_the_cliff(cliff_agents):
    result, returns = cliff_agents
    np.testing.assert_array_equal(returns, -12.0)  # 13 steps, the last of which is free
    assert not result.nonfinite.any()


def test_q_learning_in_the_cliff_world_never_undervalues_and_knows_the_way(cliff_agents):
    # From 0, which is more than anything is worth here, values fall to Q* with learning rate 1.
    expected = value_iteration(*CLIFF, 48, 0.8)
    np.testing.assert_allclose(expected[36].max(), -(1 - 0.8**12) / (1 - 0.8))
    q_values = np.asarray(cliff_agents[0].agent_state.q_values)  # [agent, state, action]
    assert (q_values >= expected - 1e-4).all()
    way = [36, *range(24, 36)]  # up, along the cliff's edge, and down
    known = q_values[:, way].max(axis=-1)  # [agent, 13]
    np.testing.assert_allclose(known, np.tile(expected[way].max(axis=-1), (6, 1)), atol=1e-4)


def test_q_learning_of_a_room_ends_at_the_optimal_values():
    task = envs.make("gridworld_2x2")
    agent = q_learning(4, 4, learning_rate=1.0, epsilon_init=0.5, epsilon_min=0.5)
    result, returns = trained(agent, task, num_episodes=200, num_agents=3)
    expected = value_iteration(*ROOM, 4, 0.9)
    np.testing.assert_allclose(expected[0], [0.89, 0.791, 0.89, 0.791])  # -0.01 + 0.9 * 1 best
    np.testing.assert_allclose(
        result.agent_state.q_values, np.broadcast_to(expected, (3, 4, 4)), atol=1e-5
    )
    np.testing.assert_allclose(returns, 0.99, rtol=1e-6)


def test_sarsa_finds_the_shortest_way_when_it_explores_less_and_less():
    task = envs.make("cliff_walking")
    config = SARSAConfig(epsilon_init=0.01, epsilon_min=0.0, epsilon_decay=0.9)
    agent = make_sarsa(config, task.num_states, task.num_actions)
    _, returns = trained(agent, task, num_episodes=300, num_agents=6)
    assert (returns >= -14.0).all() and (returns == -12.0).sum() >= 4


@pytest.mark.parametrize(("make", "worth"), [(q_learning, 1.0), (sarsa, 0.8)])
def test_sarsa_values_its_own_exploration_and_q_learning_the_best_action(make, worth):
    # 0 -> 1 for nothing; from 1 action 0 earns 1 and action 1 nothing. With epsilon 0.4 the policy
    # earns 0.6 * 1 + 0.4 * 0.5 = 0.8 there on average, the best action 1.
    agent = make(2, 2, learning_rate=0.05)
    state = started(agent, [[0.0, 0.0], [1.0, 0.0]])

    def learn(key):
        def body(state, key):
            return agent.update(key, state, step(0, 0, 0.0, 1.0, 1)), None

        return jax.lax.scan(body, state, jax.random.split(key, 300))[0]

    values = jax.jit(jax.vmap(learn))(jax.random.split(KEY, 400)).q_values
    values = np.asarray(values)[:, 0, 0]
    error = np.std(values) / np.sqrt(values.size)
    np.testing.assert_allclose(np.mean(values), 0.9 * worth, atol=5 * error + 1e-5)


@pytest.mark.parametrize("make", [q_learning, sarsa])
def test_lanes_equal_single_trainings(make):
    task = envs.make("gridworld_2x2")
    agent = make(4, 4)
    training = TrainingConfig(max_episodes=12, stop_rule="solved", solved_by="train")
    train = make_trainer(agent, task.env, training, task.solved_reward)
    keys = jax.random.split(KEY, 4)
    many = jax.jit(jax.vmap(lambda key: train(key, task.params)))(keys)
    many = jax.tree.map(np.asarray, many)
    assert len(set(np.asarray(many.train_steps).tolist())) > 1  # they stop at different times
    alone = jax.jit(lambda key: train(key, task.params))
    for i, key in enumerate(keys):
        jax.tree.map(
            lambda lane, single, i=i: np.testing.assert_allclose(lane[i], single, rtol=1e-6),
            many, alone(key),
        )  # fmt: skip
