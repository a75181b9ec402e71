"""sejax.agents.ppo: phases against torch, minibatches, lanes, and policies."""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import assert_shares, drawing, numpy_forward, paper_ppo, raveled, unraveled

from sejax.agents import buffers
from sejax.agents.buffers import Rollout, Transition
from sejax.agents.ppo import MIN_STD, PPO, ContinuousPPO, shuffled, std_of
from sejax.ops.scores import merged_moments

OBS_DIM, NUM_ACTIONS, ACTION_DIM, MAX_ACTION, MAX_STEPS = 3, 4, 2, 2.0, 6
STEPS = 13  # two episodes of full length, and one step
ENDS = (3, 4, 9)  # last steps of episodes; the rollout is cut within the fourth
GOLDEN = Path(__file__).parent / "golden" / "ppo_updates.npz"
CONFIG = paper_ppo(
    hidden_size=5, num_layers=2, activation="tanh", learning_rate=0.01, discount=0.9,
    update_episodes=2, epochs=3, clip_ratio=0.05, value_weight=0.7, entropy_weight=0.05,
)  # fmt: skip
# Three minibatches of four steps, so that each epoch leaves one out.
GAE = dataclasses.replace(
    CONFIG, advantages="gae", gae_lambda=0.8, rollout_steps=STEPS, num_minibatches=3,
    normalize_rewards=True, max_grad_norm=0.5, adam_eps=1e-5,
)  # fmt: skip
CONFIGS = {"discrete": CONFIG, "continuous": CONFIG, "gae": GAE}
KINDS = tuple(CONFIGS)  # the last one's actions are discrete
KEY = jax.random.key(0)


@functools.cache
def ppo(kind, config=None):
    config = config or CONFIGS[kind]
    length = config.rollout_length(MAX_STEPS)
    if kind == "continuous":
        return ContinuousPPO(config, OBS_DIM, ACTION_DIM, length, max_action=MAX_ACTION).agent()
    return PPO(config, OBS_DIM, NUM_ACTIONS, length).agent()


def random_steps(kind, seed):
    """`STEPS` random transitions, one in a row, and where episodes end."""
    rng = np.random.default_rng(seed)
    if kind != "continuous":
        action = np.int32(rng.integers(0, NUM_ACTIONS, STEPS))
    else:
        action = np.float32(rng.normal(scale=0.5, size=(STEPS, ACTION_DIM)))
    ended = np.zeros(STEPS, np.float32)
    ended[list(ENDS)] = 1.0
    steps = Transition(
        obs=np.float32(rng.normal(size=(STEPS, OBS_DIM))),
        action=action,
        reward=np.float32(rng.normal(size=STEPS)),
        discount=np.float32(rng.uniform(-0.2, 1.2, STEPS)),  # soft; must not matter to returns
        next_obs=np.float32(rng.normal(size=(STEPS, OBS_DIM))),
    )
    return steps, ended


def pack(steps, ended):
    """Rows as a rollout keeps them."""
    steps = steps._replace(weight=jnp.ones_like(ended))
    return jnp.concatenate([jax.vmap(buffers.pack)(steps), ended[:, None]], axis=1)


jit_pack = jax.jit(pack)


@functools.cache
def rollout(kind, seed=0):
    return Rollout(np.asarray(jit_pack(*random_steps(kind, seed))))


@functools.cache
def state_of(agent):
    return jax.jit(agent.init)(jax.random.key(1), agent.hparams)


@functools.cache
def update_of(agent):
    return jax.jit(agent.update)


every_kind = pytest.mark.parametrize("kind", KINDS)


# --- returns and minibatches ---------------------------------------------------------------------


def test_each_epoch_learns_from_each_step_once_and_in_an_order_of_its_own():
    order = np.asarray(jax.jit(shuffled, static_argnums=(1, 2, 3))(KEY, 400, 4, STEPS))
    assert order.shape == (1600, 3)
    epochs = np.sort(order.reshape(400, 12))
    assert (np.diff(epochs) > 0).all() and epochs.min() == 0 and epochs.max() == STEPS - 1
    # Every step is as often in any place: 400 / 13 times, within five standard deviations.
    for place in order.reshape(400, 12).T:
        assert np.abs(np.bincount(place, minlength=STEPS) - 400 / STEPS).max() < 5 * 5.4


# --- phases --------------------------------------------------------------------------------------


@every_kind
def test_learning_phases_equal_torchs(kind):
    golden = np.load(GOLDEN)  # made by torch_ppo.py
    state = state_of(ppo(kind))
    state = state.replace(params=unraveled(golden[f"{kind}/params/0"], state.params))
    for number in (1, 2):
        state = update_of(ppo(kind))(KEY, state, rollout(kind, number))
        expected = golden[f"{kind}/params/{number}"]
        np.testing.assert_allclose(raveled(state.params), expected, rtol=2e-5, atol=5e-6)


def test_the_spread_of_returns_far_from_zero_is_theirs():
    rows = np.float32(1000 + 0.1 * np.random.default_rng(0).normal(size=(15, 128)))
    moments = (jnp.zeros(()),) * 3
    for row in rows:
        moments = merged_moments(moments, (jnp.float32(128), row.mean(), 128 * row.var()))
    np.testing.assert_allclose(std_of(moments), rows.astype(float).std(), rtol=1e-3)


def test_rewards_that_never_differ_do_not_blow_up_where_they_are_normalized():
    agent, (steps, ended) = ppo("gae"), random_steps("gae", 0)
    always = np.asarray(jit_pack(steps._replace(reward=0 * ended + 3), 0 * ended + 1))
    after = update_of(agent)(KEY, state_of(agent), Rollout(always))
    assert np.isfinite(raveled(after.params)).all()


def test_the_std_stops_at_its_floor_and_can_grow_again():
    agent = ppo("continuous")

    def learn(state, entropy_weight):
        numbers = {"entropy_weight": entropy_weight, "learning_rate": 0.05}
        hparams = state.hparams.replace(**jax.tree.map(np.float32, numbers))
        return update_of(agent)(KEY, state.replace(hparams=hparams), rollout("continuous"))

    state = state_of(agent)
    params = {**state.params, "std": np.full(ACTION_DIM, 0.1, np.float32)}
    state = learn(state.replace(params=params), entropy_weight=-1000.0)
    np.testing.assert_array_equal(state.params["std"], np.float32(MIN_STD))
    for _ in range(3):
        state = learn(state, entropy_weight=1e5)
    assert (state.params["std"] > 2 * MIN_STD).all()


@pytest.mark.parametrize("update_episodes, action_repeat", [(10, 5), (2, 3), (1, 1), (3, 7)])
def test_a_rollout_is_as_long_as_the_authors(update_episodes, action_repeat):
    max_steps, decisions, time_step = 50, 0, 0
    while not time_step / max_steps > update_episodes:
        decisions, time_step = decisions + 1, time_step + action_repeat
    config = paper_ppo(update_episodes=update_episodes, action_repeat=action_repeat)
    assert config.rollout_length(max_steps) == decisions
    given = dataclasses.replace(config, rollout_steps=17)
    assert given.rollout_length(max_steps) == 17
    assert given.steps_before_learning(9, max_steps) == 17 * action_repeat
    assert given.steps_before_learning(1, max_steps) == 17  # a decision is one step


# --- policies ------------------------------------------------------------------------------------

OBS = np.float32([0.3, -0.2, 0.5])


def actor_outputs(state, scale):
    """The actor's outputs for `OBS`, and the state, with its last layer scaled."""
    last, params = f"Dense_{CONFIG.num_layers}", state.params["actor"]["params"]
    params = {**params, last: jax.tree.map(lambda x: np.float32(scale) * x, params[last])}
    outputs = numpy_forward(params, OBS, CONFIG.activation, CONFIG.num_layers)
    return outputs, state.replace(params={**state.params, "actor": {"params": params}})


def test_discrete_actions_follow_the_softmax_and_tests_its_mode():
    agent = ppo("discrete")
    outputs, state = actor_outputs(state_of(agent), scale=4.0)
    drawn, tested = drawing(agent)(state, OBS)
    expected = np.exp(outputs) / np.exp(outputs).sum()
    assert expected.max() > 1.5 * expected.min()
    assert_shares(drawn, expected)
    np.testing.assert_array_equal(tested, np.argmax(outputs))


def test_continuous_actions_are_normal_around_the_scaled_tanh_and_tests_take_the_mean():
    agent = ppo("continuous")
    outputs, state = actor_outputs(state_of(agent), scale=4.0)
    mean = MAX_ACTION * np.tanh(outputs)
    actions, tested = map(np.asarray, drawing(agent)(state, OBS))
    deviation = CONFIG.init_action_std / np.sqrt(len(actions))
    assert (np.abs(actions.mean(axis=0) - mean) <= 5 * deviation).all()
    assert (np.abs(actions.std(axis=0) - CONFIG.init_action_std) <= 5 * deviation).all()
    assert abs(np.corrcoef(actions.T)[0, 1]) <= 5 / np.sqrt(len(actions))
    np.testing.assert_allclose(tested, np.tile(mean, (4000, 1)), rtol=1e-5)


def test_continuous_actions_are_clipped_for_the_world_only():
    agent = ppo("continuous")
    state = state_of(agent)
    params = {**state.params, "std": np.full(ACTION_DIM, 5.0, np.float32)}
    actions, _ = drawing(agent)(state.replace(params=params), OBS)
    assert np.abs(actions).max() > 2 * MAX_ACTION  # remembered as drawn
    np.testing.assert_array_equal(
        agent.env_action(actions), np.clip(actions, -MAX_ACTION, MAX_ACTION)
    )
