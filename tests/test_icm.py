"""ICM: models and loss by hand, updates against torch, and what the agent sees."""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from support import numpy_forward, random_like, shapes_of, unraveled

from sejax import envs
from sejax.agents import make_agent
from sejax.agents.base import Agent, AgentSpec
from sejax.agents.buffers import Rollout, Transition, pack, replay_buffer
from sejax.agents.dqn import DDQNConfig, make_ddqn
from sejax.agents.exploration import ICM, ICMConfig, ICMOutputs, icm_loss, with_icm
from sejax.options import ConfigError

OBS_DIM, WIDTH, BATCH = 3, 2, 7  # WIDTH: actions to choose from, or length of an action
GOLDEN = Path(__file__).parent / "golden" / "icm_updates.npz"
KINDS = ("index", "vector")
CONFIG = ICMConfig(
    learning_rate=0.01, forward_weight=0.3, reward_scale=0.5, feature_dim=4, hidden_size=6,
    num_layers=1, num_residual_blocks=1,
)  # fmt: skip
DDQN = DDQNConfig(hidden_size=5, num_layers=1, batch_size=BATCH, learning_rate=0.01)
KEY = jax.random.key(0)


def random_batch(seed, kind):
    rng = np.random.default_rng(seed)
    action = rng.integers(0, WIDTH, BATCH) if kind == "index" else rng.normal(size=(WIDTH, BATCH))
    return Transition(
        obs=np.float32(rng.normal(size=(OBS_DIM, BATCH))),
        action=np.int32(action) if kind == "index" else np.float32(action),
        reward=np.float32(rng.normal(size=BATCH)),
        discount=np.float32(rng.uniform(0, 1, BATCH)),
        next_obs=np.float32(rng.normal(size=(OBS_DIM, BATCH))),
        weight=np.ones(BATCH, np.float32),
    )


@struct.dataclass
class Seen:
    """State of an agent that learns nothing and keeps what it was shown."""

    reward: jax.Array
    rows: jax.Array  # of a rollout
    updates: jax.Array


def stub_agent(kind):
    width = 2 * OBS_DIM + (1 if kind == "index" else WIDTH) + 3

    def update(key, state, batch):
        if isinstance(batch, Rollout):
            state = state.replace(rows=batch.rows)
        reward = batch.rows[:, -3] if isinstance(batch, Rollout) else batch.reward
        return state.replace(reward=reward, updates=state.updates + 1)

    return Agent(
        init=lambda key, hparams: Seen(
            reward=jnp.zeros(BATCH), rows=jnp.zeros((BATCH, width)), updates=jnp.int32(0)
        ),
        begin_episode=lambda state, episode: state,
        act=lambda key, state, obs, explore: jnp.int32(0),
        update=update,
        buffer=replay_buffer(BATCH, 10),
        hparams=(),
        spec=AgentSpec(warmup_episodes=3, learns_from=2, action_repeat=2),
        env_action=jnp.negative,
    )


STUBS = {kind: stub_agent(kind) for kind in KINDS}


def curious(kind, agent=None):
    """The wrapped agent; discrete actions are indices, vectors are continuous."""
    return with_icm(agent or STUBS[kind], CONFIG, OBS_DIM, WIDTH, is_discrete=kind == "index")


def model_of(config):
    model = ICM(config, WIDTH)
    example = (np.zeros(OBS_DIM), np.zeros(WIDTH), np.zeros(OBS_DIM))
    variables = shapes_of(model.init, jax.random.key(1), *example)
    return model, random_like(variables), lambda flat: unraveled(flat, variables)


@pytest.fixture(scope="module")
def updates():
    """Jitted updates of the wrapped stub by kind, `(key, state, batch, number=1) -> state`."""

    def updates_of(kind):
        agent = curious(kind)

        @jax.jit
        def update(key, state, batch, number=1):
            return jax.lax.fori_loop(
                0, number, lambda _, state: agent.update(key, state, batch), state
            )

        return update

    return {kind: updates_of(kind) for kind in KINDS}


@functools.cache
def initial(kind):
    """A fresh state with the parameters that torch started from; nothing is compiled."""
    agent = curious(kind)
    state = shapes_of(agent.init, jax.random.key(1), agent.hparams)
    hparams = jax.tree.map(np.float32, agent.hparams.icm)
    return state.replace(params=np.load(GOLDEN)[f"{kind}/params/0"], hparams=hparams)


def fresh(kind, **hparams):
    """A wrapped stub with these hyperparameters."""
    state = initial(kind)
    numbers = {name: np.float32(x) for name, x in hparams.items()}
    return state.replace(hparams=state.hparams._replace(**numbers))


def bonus(state, batch):
    """The bonus that the wrapped stub's agent was shown."""
    return np.asarray(state.agent_state.reward) - np.asarray(batch.reward)


# --- the models and the loss, by hand ------------------------------------------------------------


def dense(params, x):
    kernel, bias = np.asarray(params["kernel"], np.float64), np.asarray(params["bias"])
    return np.array([sum(w * v for w, v in zip(row, x, strict=True)) for row in kernel]) + bias


def numpy_icm(params, obs, action, next_obs, num_layers, num_blocks):
    """Next features, predicted ones, and the inverse model's output for one transition."""
    features, next_features = (
        numpy_forward(params["features"], x, "leaky_relu", num_layers) for x in (obs, next_obs)
    )
    pair = np.concatenate([features, next_features])
    inverse = numpy_forward(params["inverse"], pair, "relu", num_layers)
    forward = params["forward"]
    pair = np.concatenate([features, action])
    x = numpy_forward(forward["MLP_0"], pair, "leaky_relu", num_layers)
    for i in range(num_blocks):
        hidden = dense(forward[f"Dense_{2 * i}"], np.concatenate([x, action]))
        hidden = np.where(hidden >= 0, hidden, 0.01 * hidden)
        x = x + dense(forward[f"Dense_{2 * i + 1}"], np.concatenate([hidden, action]))
    return next_features, numpy_forward(forward["MLP_1"], x, "leaky_relu", 1), inverse


def test_the_models_equal_numpy_loops():
    config = ICMConfig(**{**vars(CONFIG), "num_layers": 2, "num_residual_blocks": 2})
    model, variables, _ = model_of(config)
    batch = random_batch(0, "vector")
    got = jax.jit(model.apply)(variables, batch.obs, batch.action, batch.next_obs)
    got = jax.tree.map(np.asarray, got)
    for i in range(BATCH):
        columns = (np.asarray(x)[:, i] for x in (batch.obs, batch.action, batch.next_obs))
        expected = numpy_icm(variables["params"], *columns, num_layers=2, num_blocks=2)
        for whole, column in zip(got, expected, strict=True):
            np.testing.assert_allclose(whole[:, i], column, rtol=1e-4, atol=1e-6)


# Two features, two columns. Squared errors: (1 + 9) / 2 = 5 and (0 + 4) / 2 = 2.
OUTPUTS = ICMOutputs(
    next_features=np.float32([[1.0, 2.0], [3.0, 4.0]]),
    predicted_next_features=np.float32([[2.0, 2.0], [0.0, 6.0]]),
    predicted_action=np.float32([[0.0, 1.0], [0.0, 3.0], [np.log(2.0), 1.0]]),
)


loss_of = jax.jit(icm_loss)


def test_the_loss_of_index_actions_is_a_softmax_cross_entropy_and_a_squared_error():
    # Softmax: (1/4, 1/4, 1/2) and (1, e^2, 1) / (2 + e^2). The actions taken: 2 and 1.
    inverse = [np.log(2), np.log(2 + np.exp(2)) - 2]
    expected = np.mean([0.8 * inverse[0] + 0.2 * 5, 0.8 * inverse[1] + 0.2 * 2])
    got = loss_of(OUTPUTS, np.array([2, 1]), forward_weight=0.2)
    np.testing.assert_allclose(got, expected, rtol=1e-6)


def test_the_loss_of_vector_actions_is_two_squared_errors():
    action = np.float32([[1.0, 1.0], [2.0, 3.0], [np.log(2.0), 4.0]])
    # (1 + 4 + 0) / 3 and (0 + 0 + 9) / 3.
    expected = np.mean([0.8 * 5 / 3 + 0.2 * 5, 0.8 * 3 + 0.2 * 2])
    np.testing.assert_allclose(loss_of(OUTPUTS, action, 0.2), expected, rtol=1e-6)
    # The second column alone.
    got = loss_of(OUTPUTS, action, 0.2, weight=np.float32([0.0, 1.0]))
    np.testing.assert_allclose(got, 0.8 * 3 + 0.2 * 2, rtol=1e-6)


def test_large_logits_make_a_large_and_finite_loss():
    outputs = OUTPUTS._replace(predicted_action=np.float32([[1e4, -1e4], [-1e4, 1e4]]))
    np.testing.assert_allclose(loss_of(outputs, np.array([0, 0]), 0.0), 1e4)  # mean of 0 and 2e4


def test_the_forward_models_target_passes_a_gradient_on():
    gradient = jax.jit(
        jax.grad(lambda x: icm_loss(OUTPUTS._replace(next_features=x), np.array([0, 1]), 1.0))
    )
    # d/dt of (p - t)^2 / 4 is (t - p) / 2: mean over two features and two columns.
    expected = (OUTPUTS.next_features - OUTPUTS.predicted_next_features) / 2
    np.testing.assert_allclose(gradient(OUTPUTS.next_features), expected, rtol=1e-6)


# --- updates against torch -----------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_updates_and_bonuses_equal_torchs_on_the_same_batches(kind, updates):
    golden = np.load(GOLDEN)  # made by torch_icm.py
    state = fresh(kind)
    for number in range(1, 6):
        batch = random_batch(number, kind)
        state = updates[kind](KEY, state, batch)
        if number in (1, 5):
            expected = golden[f"{kind}/params/{number}"]
            np.testing.assert_allclose(state.params, expected, rtol=1e-5, atol=2e-6)
            expected = golden[f"{kind}/bonus/{number}"]  # by the models after this update
            np.testing.assert_allclose(bonus(state, batch), expected, rtol=1e-4, atol=1e-6)


# --- what the agent sees -------------------------------------------------------------------------


def test_the_bonus_shrinks_for_what_is_seen_often_and_is_larger_for_the_unseen(updates):
    state, update = fresh("index", forward_weight=0.5), updates["index"]
    seen, unseen = random_batch(1, "index"), random_batch(2, "index")
    unseen = unseen._replace(obs=unseen.obs + 3.0, next_obs=unseen.next_obs - 3.0)
    first = bonus(update(KEY, state, seen), seen)
    state = update(KEY, state, seen, 300)
    last = bonus(state, seen)
    frozen = state.replace(hparams=state.hparams._replace(learning_rate=np.float32(0)))
    strange = bonus(update(KEY, frozen, unseen), unseen)
    assert last.mean() < 0.1 * first.mean()
    assert strange.mean() > 10 * last.mean()


def test_the_inverse_model_learns_which_action_was_taken(updates):
    # The state moves up with action 1 and down with action 0.
    batch = random_batch(0, "index")
    move = np.where(batch.action == 1, 1.0, -1.0).astype(np.float32)
    batch = batch._replace(next_obs=batch.obs + move)
    state = updates["index"](KEY, fresh("index", forward_weight=0.0), batch, 200)
    _, _, unravel = model_of(CONFIG)
    params = unravel(state.params)["params"]
    for i, action in enumerate(batch.action):
        column = (batch.obs[:, i], np.eye(WIDTH)[action], batch.next_obs[:, i])
        _, _, logits = numpy_icm(params, *column, CONFIG.num_layers, CONFIG.num_residual_blocks)
        assert np.argmax(logits) == action


@functools.cache
def wrapped_ddqn_state():
    """A fresh state with random parameters; nothing is compiled."""
    agent = curious("index", make_ddqn(DDQN, OBS_DIM, WIDTH))
    state = shapes_of(agent.init, jax.random.key(2), agent.hparams)
    numbers = jax.tree.map(np.float32, agent.hparams)
    params, target_params = random_like([state.agent_state.params] * 2)
    inner = state.agent_state.replace(
        params=params, target_params=target_params, epsilon=np.float32(1), hparams=numbers.agent
    )
    return initial("index").replace(agent_state=inner, hparams=numbers.icm)


def test_a_wrapped_ddqn_learns_as_a_plain_one_from_the_rewards_with_the_bonus(updates):
    plain = make_ddqn(DDQN, OBS_DIM, WIDTH)
    agent = curious("index", plain)
    state, batch = wrapped_ddqn_state(), random_batch(3, "index")
    after = jax.jit(agent.update)(KEY, state, batch)
    stub_state = fresh("index").replace(params=state.params)
    rewards = np.asarray(updates["index"](KEY, stub_state, batch).agent_state.reward)
    assert (rewards > batch.reward).all()
    expected = jax.jit(plain.update)(KEY, state.agent_state, batch._replace(reward=rewards))
    np.testing.assert_allclose(after.agent_state.params, expected.params, rtol=1e-5, atol=1e-7)


def test_indices_and_their_one_hot_vectors_have_the_same_bonus(updates):
    # Discrete TD3 keeps vectors: they go to the forward model as they are.
    batch = random_batch(4, "index")
    state = fresh("index", learning_rate=0.0)
    one_hot = batch._replace(action=np.eye(WIDTH, dtype=np.float32)[:, batch.action])
    expected = bonus(updates["index"](KEY, state, batch), batch)
    got = bonus(updates["index"](KEY, state, one_hot), batch)
    np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-7)
    flipped = batch._replace(action=1 - batch.action)
    assert np.abs(bonus(updates["index"](KEY, state, flipped), batch) - expected).max() > 1e-4


def test_hyperparameters_are_traced_so_that_a_population_may_vary_them():
    agent, batch = curious("index"), random_batch(0, "index")

    start = initial("index")

    def shown(scale, rate):
        hparams = start.hparams._replace(reward_scale=scale, learning_rate=rate)
        after = agent.update(KEY, start.replace(hparams=hparams), batch)
        return after.agent_state.reward - batch.reward, after.params - start.params

    scales, rates = jnp.array([0.0, 1.0, 3.0]), jnp.array([0.1, 0.0, 0.0])
    bonuses, moved = jax.jit(jax.vmap(shown))(scales, rates)
    np.testing.assert_array_equal(bonuses[0], 0.0)
    np.testing.assert_allclose(bonuses[2], 3 * bonuses[1], rtol=1e-4, atol=1e-6)
    assert (np.abs(moved[0]) > 0.09).mean() > 0.5 and (moved[1:] == 0).all()


# --- rollouts ------------------------------------------------------------------------------------


pack_all = jax.jit(jax.vmap(pack, -1))


def as_rollout(batch, is_full=True):
    """The batch as a rollout's rows; the episode ended in the third step."""
    ended = np.float32(np.arange(BATCH) == 2)
    columns = (batch.obs, batch.next_obs, np.atleast_2d(batch.action), batch.reward[None],
               batch.discount[None], ended[None])  # fmt: skip
    rows = np.concatenate(columns).astype(np.float32).T
    np.testing.assert_array_equal(rows[:, :-1], pack_all(batch))
    return Rollout(rows=rows, is_full=np.bool_(is_full))


@pytest.mark.parametrize("kind", KINDS)
def test_a_full_rollout_gets_the_bonus_first_and_then_trains_the_models_once(kind, updates):
    batch, state = random_batch(1, kind), fresh(kind)
    rollout = as_rollout(batch)
    before = updates[kind](
        KEY, fresh(kind, learning_rate=0), batch
    )  # the bonus by the models as they were
    trained = updates[kind](KEY, state, batch)
    after = updates[kind](KEY, state, rollout)
    np.testing.assert_allclose(
        after.agent_state.reward, before.agent_state.reward, rtol=1e-5, atol=1e-6
    )
    np.testing.assert_allclose(after.params, trained.params, rtol=1e-5, atol=1e-6)
    assert np.abs(bonus(trained, batch) - bonus(before, batch)).max() > 1e-4
    assert after.agent_state.updates == 1
    changed = (np.asarray(after.agent_state.rows) != rollout.rows).any(axis=0)
    assert list(np.flatnonzero(changed)) == [rollout.rows.shape[1] - 3]  # the rewards alone


# --- the rest of the agent -----------------------------------------------------------------------


def test_a_fresh_module_has_the_configured_numbers():
    agent = curious("index")
    assert agent.hparams == ((), (0.01, 0.3, 0.5))
    assert agent.hparams.icm._fields == ("learning_rate", "forward_weight", "reward_scale")
    state = jax.jit(agent.init)(jax.random.key(1), agent.hparams)
    np.testing.assert_allclose(state.params, initial("index").params, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("field", ["train_every", "gradient_steps"])
def test_an_agent_that_does_not_learn_once_at_each_step_is_refused(field):
    task = envs.make("cartpole")
    with pytest.raises(ConfigError) as error:
        make_agent(DDQNConfig(**{field: 4}), task, ICMConfig())
    assert error.value.field == "exploration"
    assert make_agent(DDQNConfig(), task, ICMConfig()) and make_agent(
        DDQNConfig(**{field: 4}), task
    )


def test_a_curious_agent_trains_alone_on_a_core():
    # In lockstep the bonus' networks take 1.4 times as long, however small the agent's own are.
    task, small = envs.make("cartpole"), DDQNConfig(hidden_size=64, num_layers=1, batch_size=32)
    assert make_agent(small, task).spec.cpu_num_parallel > 1
    assert make_agent(small, task, ICMConfig()).spec.cpu_num_parallel == 1
