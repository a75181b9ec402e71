"""ICM: updates against torch, and what the agent sees."""

import functools
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from support import assert_close, assert_equal, batch_of, raveled, shapes_of, unraveled

from sejax.agents.base import Agent, AgentSpec
from sejax.agents.buffers import Rollout, Transition, pack, replay_buffer
from sejax.agents.exploration import ICMConfig, ICMOutputs, icm_loss

OBS_DIM, WIDTH, BATCH = 3, 2, 7  # WIDTH: actions to choose from, or length of an action
GOLDEN = Path(__file__).parent / "golden" / "icm_updates.npz"
KINDS = ("index", "vector")
CONFIG = ICMConfig(
    learning_rate=0.01, forward_weight=0.3, reward_scale=0.5, feature_dim=4, hidden_size=6,
    num_layers=2, num_residual_blocks=2,
)  # fmt: skip
KEY = jax.random.key(0)


def random_batch(seed, kind):
    rng = np.random.default_rng(seed)
    action = rng.integers(0, WIDTH, BATCH) if kind == "index" else rng.normal(size=(WIDTH, BATCH))
    action = np.int32(action) if kind == "index" else np.float32(action)
    columns = batch_of(rng, OBS_DIM, BATCH)
    return Transition(action=action, weight=np.ones(BATCH, np.float32), **columns)


@struct.dataclass
class Seen:
    """State of an agent that learns nothing and keeps what it was shown."""

    batch: Transition
    rows: jax.Array  # of a rollout
    updates: jax.Array


def stub_agent(kind):
    width = 2 * OBS_DIM + (1 if kind == "index" else WIDTH) + 3

    def update(key, state, batch):
        if isinstance(batch, Rollout):
            state = state.replace(rows=batch.rows)
            batch = state.batch._replace(reward=batch.rows[:, -3])
        return state.replace(batch=batch, updates=state.updates + 1)

    return Agent(
        init=lambda key, hparams: Seen(
            batch=jax.tree.map(jnp.zeros_like, random_batch(0, kind)),
            rows=jnp.zeros((BATCH, width)),
            updates=jnp.int32(0),
        ),
        begin_episode=lambda state, episode: state,
        act=lambda key, state, obs, explore: jnp.int32(0),
        update=update,
        buffer=replay_buffer(BATCH, 10),
        hparams=(),
        spec=AgentSpec(stops_from=3, learns_from=2, action_repeat=2),
        env_action=jnp.negative,
    )


STUBS = {kind: stub_agent(kind) for kind in KINDS}


def curious(kind):
    """The wrapped agent; discrete actions are indices, vectors are continuous."""
    num_actions = WIDTH if kind == "index" else None
    task = SimpleNamespace(obs_dim=OBS_DIM, action_dim=WIDTH, num_actions=num_actions)
    return CONFIG.make(STUBS[kind], task)


@functools.cache
def update_of(kind):
    """The wrapped stub's jitted update."""
    return jax.jit(curious(kind).update)


def fresh(kind, **hparams):
    """A wrapped stub with the parameters that torch started from; nothing is compiled."""
    agent = curious(kind)
    state = shapes_of(agent.init, jax.random.key(1), agent.hparams)
    hparams = jax.tree.map(np.float32, agent.hparams.replace(agent=None, **hparams))
    with np.load(GOLDEN) as golden:
        params = unraveled(golden[f"{kind}/params/0"], state.params)
    return state.replace(params=params, hparams=hparams)


def bonus(state, batch):
    """The bonus that the wrapped stub's agent was shown."""
    return np.asarray(state.agent_state.batch.reward) - np.asarray(batch.reward)


# --- updates against torch -----------------------------------------------------------------------


def test_large_logits_make_a_large_and_finite_loss():
    features, logits = np.zeros((2, 2), np.float32), np.float32([[1e4, -1e4], [-1e4, 1e4]])
    loss = icm_loss(ICMOutputs(features, features, logits), np.array([0, 0]), 0.0)
    np.testing.assert_allclose(loss, 1e4)  # mean of 0 and 2e4


@pytest.mark.parametrize("kind", KINDS)
def test_updates_and_bonuses_equal_torchs_on_the_same_batches(kind):
    golden = np.load(GOLDEN)  # made by torch_icm.py
    state = fresh(kind)
    for number in range(1, 6):
        batch = random_batch(number, kind)
        state = update_of(kind)(KEY, state, batch)
        if number in (1, 5):
            expected = golden[f"{kind}/params/{number}"]
            np.testing.assert_allclose(raveled(state.params), expected, rtol=1e-5, atol=2e-6)
            expected = golden[f"{kind}/bonus/{number}"]  # by the models after this update
            np.testing.assert_allclose(bonus(state, batch), expected, rtol=1e-4, atol=1e-6)
        seen = state.agent_state.batch  # nothing but the reward is another
        assert_equal(seen._replace(reward=batch.reward), batch)


# --- what the agent sees -------------------------------------------------------------------------


def test_indices_and_their_one_hot_vectors_have_the_same_bonus():
    # Discrete TD3 keeps vectors: they go to the forward model as they are.
    batch = random_batch(4, "index")
    state = fresh("index", learning_rate=0.0)
    one_hot = batch._replace(action=np.eye(WIDTH, dtype=np.float32)[:, batch.action])
    expected = bonus(update_of("index")(KEY, state, batch), batch)
    keeping = state.replace(agent_state=state.agent_state.replace(batch=one_hot))
    got = bonus(update_of("index")(KEY, keeping, one_hot), batch)
    np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-7)
    flipped = batch._replace(action=1 - batch.action)
    assert np.abs(bonus(update_of("index")(KEY, state, flipped), batch) - expected).max() > 1e-4


# --- rollouts ------------------------------------------------------------------------------------


pack_all = jax.jit(jax.vmap(pack, -1))


def as_rollout(batch):
    """The batch as a rollout's rows; the episode ended in the third step."""
    ended = np.float32(np.arange(BATCH) == 2)
    return Rollout(np.concatenate([pack_all(batch), ended[:, None]], axis=1))


def test_a_rollout_gets_the_bonus_first_and_then_trains_the_models_once():
    batch, state = random_batch(1, "vector"), fresh("vector")
    rollout = as_rollout(batch)
    # The bonus by the models as they were.
    before = update_of("vector")(KEY, fresh("vector", learning_rate=0), batch)
    trained = update_of("vector")(KEY, state, batch)
    after = update_of("vector")(KEY, state, rollout)
    np.testing.assert_allclose(bonus(after, batch), bonus(before, batch), rtol=1e-5, atol=1e-5)
    assert_close(after.params, trained.params, rtol=1e-5, atol=1e-6)
    assert np.abs(bonus(trained, batch) - bonus(before, batch)).max() > 1e-4
    assert after.agent_state.updates == 1
    changed = (np.asarray(after.agent_state.rows) != rollout.rows).any(axis=0)
    assert list(np.flatnonzero(changed)) == [rollout.rows.shape[1] - 3]  # the rewards alone
