"""sejax.agents.td3: updates against torch, noise, exploration, Gumbel-Softmax."""

import functools
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import assert_equal, batch_of, drawing, numpy_forward, shapes_of, unraveled

from sejax.agents.buffers import Transition
from sejax.agents.td3 import (
    TD3,
    DiscreteTD3,
    DiscreteTD3Config,
    LearningNoise,
    TD3Config,
    annealed_temperature,
    gumbel_softmax,
)

OBS_DIM, ACTION_DIM, BATCH, MAX_ACTION = 3, 2, 7, 2.0
GOLDEN = Path(__file__).parent / "golden" / "td3_updates.npz"
CONFIG = TD3Config(
    hidden_size=5, num_layers=2, activation="relu", batch_size=BATCH, learning_rate=0.01,
    tau=0.1, discount=0.9, warmup_episodes=3, target_noise_std=0.4,
)  # fmt: skip
DISCRETE = DiscreteTD3Config(
    hidden_size=5, num_layers=3, activation="tanh", batch_size=BATCH, learning_rate=0.01,
    tau=0.1, discount=0.9, warmup_episodes=3, target_noise_std=0.4, temperature=2.0,
    final_temperature=0.25, temperature_steps=4,
)  # fmt: skip
CASES = {
    "relu": CONFIG,
    "prelu_every_step": replace(CONFIG, activation="prelu", policy_delay=1),
    "layer_norm": DISCRETE,
    "one_hot": replace(
        DISCRETE, one_hot_actions=True, layer_norm=False, activation="leaky_relu", num_layers=1
    ),
}
NAMES = ("actor", "critics", "target_actor", "target_critics")
CHECKED_UPDATES = (1, 2, 5)
WEIGHT = np.float32(np.arange(BATCH) < BATCH - 1)


def is_discrete(config):
    return isinstance(config, DiscreteTD3Config)


@functools.cache
def td3_of(config):
    if is_discrete(config):
        return DiscreteTD3(config, OBS_DIM, ACTION_DIM, 1.0)
    return TD3(config, OBS_DIM, ACTION_DIM, MAX_ACTION)


@functools.cache
def agent_of(config):
    return td3_of(config).agent()


@functools.cache
def state_of(config):
    agent = agent_of(config)
    return jax.jit(agent.init)(jax.random.key(1), agent.hparams)


def state_with(config, params):
    """A fresh state with these parameters (as in `NAMES`); nothing is compiled."""
    agent = agent_of(config)
    state = shapes_of(agent.init, jax.random.key(1), agent.hparams)
    hparams = jax.tree.map(np.float32, agent.hparams)
    return state.replace(**params, hparams=hparams)


@functools.cache
def learn_of(config):
    """The jitted learning step, `(state, batch, noise) -> state`."""
    return jax.jit(td3_of(config).learn)


def case_batch(config, seed):
    """A random batch whose last column does not count."""
    rng = np.random.default_rng(seed)
    action = rng.uniform(-MAX_ACTION, MAX_ACTION, (ACTION_DIM, BATCH))
    if is_discrete(config):
        action = np.eye(ACTION_DIM)[rng.integers(0, ACTION_DIM, BATCH)].T + 0.1 * action
    columns = batch_of(rng, OBS_DIM, BATCH)
    return Transition(action=np.float32(action), weight=WEIGHT, **columns)


def case_noise(config, seed):
    rng = np.random.default_rng([seed, 1])
    shape = (ACTION_DIM, BATCH)
    # Some of the smoothing noise is beyond the clip, which is 0.5 / 0.4 = 1.25 standard deviations.
    smoothing = np.float32(rng.normal(size=shape))
    if not is_discrete(config):
        return LearningNoise(smoothing, None, None)
    return LearningNoise(smoothing, *(np.float32(rng.gumbel(size=shape)) for _ in range(2)))


def initial_params(config):
    """Random parameters by `NAMES`, all different, so that it shows which are used where."""
    # A seed with which no gradient is as small as Adam's epsilon: rounding would decide its step.
    rng = np.random.default_rng(2)
    agent = agent_of(config)
    state = shapes_of(agent.init, jax.random.key(1), agent.hparams)

    def drawn(name):
        like = getattr(state, name)
        vector = np.float32(0.5 * rng.normal(size=vectors(name, like).shape))
        if "critics" in name:
            one = jax.tree.map(lambda x: x[0], like)
            pair = [unraveled(row, one)["params"] for row in vector]
            params = jax.tree.map(lambda *x: np.stack(x), *pair)
        else:
            params = unraveled(vector, like)["params"]
        if "width" in params:  # no weight: the number of units
            params["width"] = np.full_like(params["width"], config.hidden_size)
        return {"params": params}

    return {name: drawn(name) for name in NAMES}


def vectors(name, params):
    """Parameters of one of `NAMES` as a vector; the critics' as the rows of a matrix."""
    lead = (2,) if "critics" in name else ()
    return np.concatenate([np.reshape(x, (*lead, -1)) for x in jax.tree.leaves(params)], axis=-1)


def actor_outputs(config, state, obs):
    """The actor's outputs for one observation, by plain loops; networks without layer norm."""
    return numpy_forward(state.actor["params"], obs, config.activation, config.num_layers)


# --- updates against torch -----------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES)
def test_updates_equal_torchs_on_the_same_batches_and_noise(case):
    golden = np.load(GOLDEN)  # made by torch_td3.py
    config = CASES[case]
    state = state_with(config, initial_params(config))
    for number in range(1, max(CHECKED_UPDATES) + 1):
        state = learn_of(config)(state, case_batch(config, number), case_noise(config, number))
        if number in CHECKED_UPDATES:
            for name in NAMES:
                got, expected = getattr(state, name), golden[f"{case}/{name}/{number}"]
                np.testing.assert_allclose(vectors(name, got), expected, rtol=2e-5, atol=4e-6)


def test_noise_is_normal_and_gumbel_and_drawn_independently():
    n = 20_000
    noise = td3_of(DISCRETE).learning_noise(jax.random.key(0), (1, n))
    x = np.concatenate(noise)  # [3, n]
    # Standard Gumbel: mean 0.5772, variance pi^2 / 6.
    variance = np.array([1.0, np.pi**2 / 6, np.pi**2 / 6])
    assert (np.abs(x.mean(1) - [0.0, 0.57722, 0.57722]) < 5 * np.sqrt(variance / n)).all()
    np.testing.assert_allclose(x.var(1), variance, rtol=0.1)
    assert np.abs(np.corrcoef(x)[np.triu_indices(3, 1)]).max() < 5 / np.sqrt(n)
    assert td3_of(CONFIG).learning_noise(jax.random.key(0), (1, 2)).policy is None


@pytest.mark.parametrize("config", [CONFIG, DISCRETE], ids=["continuous", "discrete"])
def test_targets_start_as_copies_and_the_critics_apart(config):
    state = state_of(config)
    assert_equal(state.target_actor, state.actor)
    assert_equal(state.target_critics, state.critics)
    assert not np.allclose(*vectors("critics", state.critics))


# --- the Gumbel-Softmax --------------------------------------------------------------------------


def test_a_final_temperature_of_zero_gives_finite_samples_and_gradients():
    hparams = agent_of(DISCRETE).hparams.replace(final_temperature=0.0)
    gumbel, logits = np.float32([-2.0, 17.0, 0.0]), np.float32([30.0, -30.0, 1.0])

    def sample(logits):
        return gumbel_softmax(logits, gumbel, annealed_temperature(hparams, 9, 4), False)

    sampled, jacobian = sample(logits), jax.jit(jax.jacrev(sample))(logits)
    np.testing.assert_array_equal(sampled, [1.0, 0.0, 0.0])
    assert np.isfinite(jacobian).all()


# --- acting --------------------------------------------------------------------------------------

PLAIN = replace(DISCRETE, layer_norm=False, num_layers=2)
OBS = np.float32([0.3, -0.2, 0.5])


def acting_state_of(config):
    """The state of the plainest agent of the same networks: with equal parameters."""
    plain = {"one_hot_actions": False} if is_discrete(config) else {}
    return state_of(replace(config, **plain))


def drawn_actions(config, explore, warming_up=False, action_noise_std=0.01):
    """Actions of 4000 keys, `[4000, action_dim]`."""
    state, agent = acting_state_of(config), agent_of(config)
    hparams = state.hparams.replace(action_noise_std=np.float32(action_noise_std))
    state = agent.begin_episode(state.replace(hparams=hparams), np.int32(2 if warming_up else 3))
    return np.asarray(drawing(agent)(state, OBS)[0 if explore else 1])


def test_warm_up_actions_are_uniform_in_the_range():
    drawn = drawn_actions(CONFIG, explore=True, warming_up=True)
    assert np.abs(drawn).max() <= MAX_ACTION
    # U(-2, 2) has variance 16 / 12, and a quarter of the draws lies in each quarter of the range.
    assert (np.abs(drawn.mean(0)) < 5 * np.sqrt(16 / 12 / 4000)).all()
    for dim in range(ACTION_DIM):
        share = np.histogram(drawn[:, dim], bins=4, range=(-2, 2))[0] / 4000
        assert np.abs(share - 0.25).max() < 5 * np.sqrt(0.25 * 0.75 / 4000)
    assert abs(np.corrcoef(drawn.T)[0, 1]) < 5 / np.sqrt(4000)


def test_discrete_warm_up_actions_are_exact_one_hots_drawn_uniformly():
    drawn = drawn_actions(PLAIN, explore=True, warming_up=True)
    assert ((drawn == 0) | (drawn == 1)).all() and (drawn.sum(1) == 1).all()
    assert np.abs(drawn.mean(0) - 0.5).max() < 5 * 0.5 / np.sqrt(4000)


def test_exploring_adds_noise_of_the_configured_size_within_the_range():
    drawn = drawn_actions(CONFIG, explore=True)
    expected = MAX_ACTION * np.tanh(actor_outputs(CONFIG, state_of(CONFIG), OBS))
    std = 0.01 * MAX_ACTION
    assert (np.abs(drawn.mean(0) - expected) < 5 * std / np.sqrt(4000)).all()
    np.testing.assert_allclose(drawn.std(0), std, rtol=0.06)  # 5 / sqrt(2 * 4000)
    assert np.abs(drawn_actions(CONFIG, explore=True, action_noise_std=1.0)).max() == MAX_ACTION


def test_discrete_exploring_adds_noise_to_a_gumbel_softmax_sample():
    one_hot = replace(PLAIN, one_hot_actions=True)
    drawn = drawn_actions(one_hot, explore=True)
    sample = np.round(drawn)
    assert (sample.sum(1) == 1).all()
    np.testing.assert_allclose((drawn - sample).std(0), 0.01, rtol=0.06)
    assert drawn.min() < 0 and drawn.max() > 1  # not clamped
    probabilities = np.exp(actor_outputs(one_hot, acting_state_of(one_hot), OBS))
    probabilities /= probabilities.sum()
    assert np.abs(sample.mean(0) - probabilities).max() < 5 * 0.5 / np.sqrt(4000)


def test_relaxed_samples_have_the_temperature_of_the_last_learning_step():
    drawn = drawn_actions(PLAIN, explore=True, action_noise_std=0.0)
    # log(a_1 / a_0) = (difference of logits + logistic noise) / temperature, and the standard
    # logistic distribution has variance pi^2 / 3. Before any learning step the temperature is 2.
    log_ratio = np.log(drawn[:, 1] / drawn[:, 0])
    logits = actor_outputs(PLAIN, state_of(PLAIN), OBS)
    std = np.pi / np.sqrt(3) / 2.0
    assert abs(log_ratio.mean() - (logits[1] - logits[0]) / 2.0) < 5 * std / np.sqrt(4000)
    np.testing.assert_allclose(log_ratio.std(), std, rtol=0.1)


def test_tests_are_without_noise():
    outputs = actor_outputs(CONFIG, state_of(CONFIG), OBS)
    drawn = drawn_actions(CONFIG, explore=False)
    np.testing.assert_allclose(drawn, np.tile(MAX_ACTION * np.tanh(outputs), (4000, 1)), rtol=1e-5)
    drawn = drawn_actions(PLAIN, explore=False)
    best = int(np.argmax(actor_outputs(PLAIN, state_of(PLAIN), OBS)))
    index = jax.jit(jax.vmap(agent_of(PLAIN).env_action))(drawn)
    assert index.dtype == jnp.int32 and (np.asarray(index) == best).all()
