"""sejax.agents.ppo: phases against torch, minibatches, lanes, and policies."""

import dataclasses
import functools
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from support import (
    assert_close,
    assert_equal,
    assert_shares,
    drawing,
    numpy_forward,
    raveled,
    refused,
    shapes_of,
    unraveled,
)

from sejax.agents import buffers
from sejax.agents.buffers import Rollout, Transition
from sejax.agents.ppo import MIN_STD, PPO, ContinuousPPO, PPOConfig, shuffled
from sejax.ops.networks import MLP

OBS_DIM, NUM_ACTIONS, ACTION_DIM, MAX_ACTION, MAX_STEPS = 3, 4, 2, 2.0, 6
STEPS = 13  # two episodes of full length, and one step
ENDS = (3, 4, 9)  # last steps of episodes; the rollout is cut within the fourth
GOLDEN = Path(__file__).parent / "golden" / "ppo_updates.npz"
CONFIG = PPOConfig.paper(
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


def networks(kind, config=CONFIG):
    """The actor, the critic, and the function from flat parameters to the nested ones."""
    num_outputs, std_dim = (ACTION_DIM,) * 2 if kind == "continuous" else (NUM_ACTIONS, 0)
    actor, critic = (
        MLP(size, config.hidden_size, config.num_layers, config.activation, learn_prelu_slope=True)
        for size in (num_outputs, 1)
    )
    example = {
        "actor": shapes_of(actor.init, KEY, np.zeros(OBS_DIM)),
        "critic": shapes_of(critic.init, KEY, np.zeros(OBS_DIM)),
        "std": np.zeros(std_dim),
    }
    return actor, critic, lambda flat: unraveled(flat, example)


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
def rollout(kind, seed=0, is_full=True):
    rows = np.asarray(jit_pack(*random_steps(kind, seed)))
    return Rollout(rows=rows, is_full=np.bool_(is_full))


@functools.cache
def state_of(agent):
    return jax.jit(agent.init)(jax.random.key(1), agent.hparams)


@functools.cache
def update_of(agent):
    return jax.jit(agent.update)


every_kind = pytest.mark.parametrize("kind", KINDS)


def adam_steps(state):
    return optax.tree.get(state.opt_state, "count")


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
    state = state_of(ppo(kind)).replace(params=golden[f"{kind}/params/0"])
    for number in (1, 2):
        state = update_of(ppo(kind))(KEY, state, rollout(kind, number))
        expected = golden[f"{kind}/params/{number}"]
        np.testing.assert_allclose(state.params, expected, rtol=2e-5, atol=5e-6)


def test_rewards_that_never_differ_do_not_blow_up_where_they_are_normalized():
    agent, (steps, ended) = ppo("gae"), random_steps("gae", 0)
    always = np.asarray(jit_pack(steps._replace(reward=0 * ended + 3), 0 * ended + 1))
    after = update_of(agent)(KEY, state_of(agent), Rollout(always, np.bool_(True)))
    assert np.isfinite(after.params).all()


@every_kind
def test_a_lane_whose_rollout_is_not_full_waits_for_the_others(kind):
    agent, state = ppo(kind), state_of(ppo(kind))
    rollouts = [rollout(kind, seed, seed != 1) for seed in range(3)]
    stacked = jax.tree.map(lambda *x: np.stack(x), *rollouts)
    together = jax.jit(jax.vmap(agent.update, (None, None, 0)))(KEY, state, stacked)
    for lane, own in enumerate(rollouts):
        got, alone = jax.tree.map(lambda x: x[lane], together), update_of(agent)(KEY, state, own)  # noqa: B023
        assert_close(got, alone, rtol=1e-4, atol=1e-6)
        assert (lane == 1) == bool((got.params == state.params).all())


@pytest.mark.parametrize("kind, epochs", [("discrete", 10**9), ("gae", 7)])
def test_a_step_without_a_phase_does_none_of_its_work(kind, epochs):
    # Were any of a thousand million epochs made, this test would not end.
    agent = ppo(kind, dataclasses.replace(CONFIGS[kind], epochs=epochs))
    states = jax.tree.map(lambda x: np.stack([x, x]), state_of(ppo(kind)))
    rollouts = jax.tree.map(lambda x: np.stack([x, x]), rollout(kind, is_full=False))
    compiled = jax.jit(jax.vmap(agent.update, (None, 0, 0))).lower(KEY, states, rollouts).compile()
    assert_equal(compiled(KEY, states, rollouts), states)
    # Nor has the compiler moved anything that is as long as the rollout out of the phase.
    entry = compiled.as_text().split("\nENTRY ")[1]
    long = [line for line in entry.splitlines() if re.search(rf"= \w+\[[\d,]*\b{STEPS}\b", line)]
    assert long and all(" parameter(" in line for line in long), "\n".join(long)


def test_the_std_stops_at_its_floor_and_can_grow_again():
    agent = ppo("continuous")
    _, _, unravel = networks("continuous")

    def learn(state, entropy_weight):
        numbers = {"entropy_weight": entropy_weight, "learning_rate": 0.05}
        hparams = state.hparams.replace(**jax.tree.map(np.float32, numbers))
        return update_of(agent)(KEY, state.replace(hparams=hparams), rollout("continuous"))

    state = state_of(agent)
    params = {**unravel(state.params), "std": np.full(ACTION_DIM, 0.1, np.float32)}
    state = learn(state.replace(params=raveled(params)), entropy_weight=-1000.0)
    np.testing.assert_array_equal(unravel(state.params)["std"], np.float32(MIN_STD))
    for _ in range(3):
        state = learn(state, entropy_weight=1e5)
    assert (unravel(state.params)["std"] > 2 * MIN_STD).all()


@every_kind
def test_a_phase_starts_with_the_step_that_fills_the_rollout(kind):
    agent = ppo(kind)
    state, obs, zero = state_of(agent), np.zeros(OBS_DIM, np.float32), np.float32(0)
    action = jax.eval_shape(functools.partial(agent.act, explore=True), KEY, state, obs)
    example = Transition(obs, np.zeros(action.shape, action.dtype), zero, zero, obs)
    buffer = agent.buffer(example, 10_000)
    assert jax.eval_shape(buffer.init).shape[0] == STEPS

    def step(carry, number):
        rows, state = carry
        key, key_reward = jax.random.split(jax.random.fold_in(KEY, number))
        action = agent.act(key, state, obs, True)
        transition = example._replace(action=action, reward=jax.random.normal(key_reward))
        rows = buffer.store(rows, number, transition, number % 5 == 4, True)
        batch = buffer.batch(key, rows, number + 1, transition, None)
        state = agent.update(key, state, batch)
        return (rows, state), adam_steps(state)

    run = jax.jit(lambda state: jax.lax.scan(step, (buffer.init(), state),
                                             np.arange(2 * STEPS + 3))[1])  # fmt: skip
    counts = run(state)
    phase = CONFIG.epochs * (3 if kind == "gae" else 1)
    expected = [0] * (STEPS - 1) + [phase] * STEPS + [2 * phase] * 4
    np.testing.assert_array_equal(counts, expected)


@pytest.mark.parametrize("update_episodes, action_repeat", [(10, 5), (2, 3), (1, 1), (3, 7)])
def test_a_rollout_is_as_long_as_the_authors(update_episodes, action_repeat):
    max_steps, decisions, time_step = 50, 0, 0
    while not time_step / max_steps > update_episodes:
        decisions, time_step = decisions + 1, time_step + action_repeat
    config = PPOConfig.paper(update_episodes=update_episodes, action_repeat=action_repeat)
    assert config.rollout_length(max_steps) == decisions
    given = dataclasses.replace(config, rollout_steps=17)
    assert given.rollout_length(max_steps) == 17
    assert given.steps_before_learning(1, max_steps) == 17 * action_repeat
    assert config.steps_before_learning(1, max_steps) == decisions * action_repeat


def test_a_minibatch_has_at_least_two_steps():
    config = dataclasses.replace(GAE, num_minibatches=7)
    assert refused(ppo, "gae", config) == "agent.num_minibatches"


# --- policies ------------------------------------------------------------------------------------

OBS = np.float32([0.3, -0.2, 0.5])


def actor_outputs(kind, state, scale=1.0):
    """The actor's outputs for `OBS`, and the state with its last layer scaled."""
    _, _, unravel = networks(kind)
    params = unravel(state.params)
    last = params["actor"]["params"][f"Dense_{CONFIG.num_layers}"]
    last.update({name: np.float32(scale) * value for name, value in last.items()})
    outputs = numpy_forward(params["actor"]["params"], OBS, CONFIG.activation, CONFIG.num_layers)
    return outputs, state.replace(params=raveled(params))


def test_discrete_actions_follow_the_softmax_and_tests_its_mode():
    agent = ppo("discrete")
    outputs, state = actor_outputs("discrete", state_of(agent), scale=4.0)
    drawn, tested = drawing(agent)(state, OBS)
    expected = np.exp(outputs) / np.exp(outputs).sum()
    assert expected.max() > 1.5 * expected.min()
    assert_shares(drawn, expected)
    np.testing.assert_array_equal(tested, np.argmax(outputs))


def test_continuous_actions_are_normal_around_the_scaled_tanh_and_tests_take_the_mean():
    agent = ppo("continuous")
    outputs, state = actor_outputs("continuous", state_of(agent), scale=4.0)
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
    _, _, unravel = networks("continuous")
    params = {**unravel(state.params), "std": np.full(ACTION_DIM, 5.0, np.float32)}
    wide = state.replace(params=raveled(params))
    actions, _ = drawing(agent)(wide, OBS)
    assert np.abs(actions).max() > 2 * MAX_ACTION  # remembered as drawn
    np.testing.assert_array_equal(
        agent.env_action(actions), np.clip(actions, -MAX_ACTION, MAX_ACTION)
    )
