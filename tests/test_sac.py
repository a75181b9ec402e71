"""sejax.agents.sac: updates against torch, a density by hand, acting."""

import functools
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import assert_shares, batch_of, drawing, numpy_forward, raveled, shapes_of, unraveled

from sejax.agents.buffers import Transition
from sejax.agents.sac import SAC, DiscreteSAC, LearningNoise, SACConfig, squashed_gaussian

OBS_DIM, ACTION_DIM, BATCH, MAX_ACTION = 3, 2, 7, 2.0
GOLDEN = Path(__file__).parent / "golden" / "sac_updates.npz"
CONFIG = SACConfig(
    hidden_size=5, num_layers=1, activation="tanh", batch_size=BATCH, learning_rate=0.01,
    tau=0.1, discount=0.9, warmup_episodes=3, init_alpha=0.3, target_entropy=-0.7,
    target_entropy_fraction=0.4,
)  # fmt: skip
# Kind of actions, configuration.
CASES = {
    "continuous": (False, CONFIG),
    "discrete": (True, CONFIG),
    "fixed_alpha": (True, replace(CONFIG, alpha=0.2, num_layers=2, activation="prelu")),
}
KINDS = pytest.mark.parametrize("case", ["continuous", "discrete"])
NAMES = ("params", "target_critics")
CHECKED_UPDATES = (1, 3)
WEIGHT = np.float32(np.arange(BATCH) < BATCH - 1)


@functools.cache
def sac_of(case):
    discrete, config = CASES[case]
    kind = DiscreteSAC if discrete else SAC
    return kind(config, OBS_DIM, ACTION_DIM, MAX_ACTION)


@functools.cache
def agent_of(case):
    return sac_of(case).agent()


@functools.cache
def learn_of(case):
    """The jitted learning step, `(state, batch, noise) -> state`."""
    return jax.jit(sac_of(case).learn)


@functools.cache
def state_of(case):
    """A state whose networks all differ, so that it shows which is used where."""
    agent = agent_of(case)
    state = shapes_of(agent.init, jax.random.key(1), agent.hparams)
    rng = np.random.default_rng(2)
    drawn = {}
    for name in NAMES:
        like = getattr(state, name)
        drawn[name] = unraveled(np.float32(0.5 * rng.normal(size=raveled(like).size)), like)
    drawn["params"] = drawn["params"]._replace(log_alpha=np.float32(np.log(0.3)))
    return state.replace(**drawn, hparams=jax.tree.map(np.float32, agent.hparams))


def case_batch(case, seed):
    """A random batch whose last column does not count."""
    rng = np.random.default_rng(seed)
    action = rng.uniform(-1, 1, (ACTION_DIM, BATCH))
    action = np.int32(action[0] > 0) if CASES[case][0] else np.float32(action)
    return Transition(action=action, weight=WEIGHT, **batch_of(rng, OBS_DIM, BATCH))


def case_noise(case, seed):
    if CASES[case][0]:
        return LearningNoise(None, None)
    rng = np.random.default_rng([seed, 1])
    return LearningNoise(*np.float32(rng.normal(size=(2, ACTION_DIM, BATCH))))


# --- updates against torch -----------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES)
def test_updates_equal_torchs_on_the_same_batches_and_noise(case):
    golden = np.load(GOLDEN)  # made by torch_sac.py
    state = state_of(case)
    for number in range(1, max(CHECKED_UPDATES) + 1):
        state = learn_of(case)(state, case_batch(case, number), case_noise(case, number))
        if number in CHECKED_UPDATES:
            for name in NAMES:
                got, expected = getattr(state, name), golden[f"{case}/{name}/{number}"]
                np.testing.assert_allclose(raveled(got), expected, rtol=2e-5, atol=4e-6)


# --- by hand -------------------------------------------------------------------------------------


def test_a_squashed_gaussians_density_by_hand():
    # Mean 0.5, std e^-1, noise 0.2: u = 0.573576, a = tanh u = 0.518086.
    # log N = -0.02 + 1 - 0.918939 = 0.061061; log(1 - a^2) = -0.312477; difference 0.373538.
    action, log_p = squashed_gaussian(np.float32([0.5, -1.0]), np.float32([0.2]))
    np.testing.assert_allclose(action, [np.tanh(0.5 + 0.2 / np.e)], rtol=1e-6)
    u = 0.5 + 0.2 / np.e
    expected = -0.02 + 1 - 0.5 * np.log(2 * np.pi) - np.log(1 - np.tanh(u) ** 2)
    np.testing.assert_allclose(log_p, expected, rtol=1e-5)
    # Far out the slope's logarithm is 2 (ln 2 - |u|), where 1 - tanh^2 is 0 in float32, and the log
    # std is at most 2.
    action, log_p = squashed_gaussian(np.float32([30.0, 9.0]), np.float32([0.0]))
    expected = -2 - 0.5 * np.log(2 * np.pi) - 2 * (np.log(2) - 30)
    np.testing.assert_allclose([action[0], log_p], [1.0, expected], rtol=1e-6)


def test_target_critics_start_as_copies_and_the_critics_apart():
    agent = agent_of("discrete")
    fresh = jax.jit(agent.init)(jax.random.key(1), agent.hparams)
    assert (raveled(fresh.target_critics) == raveled(fresh.params.critics)).all()
    np.testing.assert_allclose(fresh.params.log_alpha, np.log(0.3), rtol=1e-6)
    assert not np.allclose(*fresh.params.critics["params"]["Dense_0"]["kernel"])


# --- acting --------------------------------------------------------------------------------------

OBS = np.float32([0.3, -0.2, 0.5])


def drawn_actions(case, episode):
    """Actions of 4000 keys, exploring and testing."""
    state = agent_of(case).begin_episode(state_of(case), np.int32(episode))
    return [np.asarray(x, np.float64) for x in drawing(agent_of(case))(state, OBS)]


def actor_outputs(case):
    return numpy_forward(state_of(case).params.actor["params"], OBS, "tanh", 1)


def test_exploring_draws_from_the_policy_and_tests_take_its_mode():
    mean, log_std = np.split(actor_outputs("continuous"), 2)
    drawn, tested = drawn_actions("continuous", episode=3)
    u = np.arctanh(drawn)
    assert (np.abs(u.mean(0) - mean) < 5 * np.exp(log_std) / np.sqrt(4000)).all()
    np.testing.assert_allclose(u.std(0), np.exp(log_std), rtol=0.06)  # 5 / sqrt(2 * 4000)
    np.testing.assert_allclose(tested, np.tile(np.tanh(mean), (4000, 1)), rtol=1e-5)
    logits = actor_outputs("discrete")
    drawn, tested = drawn_actions("discrete", episode=3)
    assert_shares(np.int32(drawn), np.exp(logits) / np.exp(logits).sum())
    assert (tested == np.argmax(logits)).all()


@KINDS
def test_the_first_episodes_are_for_warming_up_uniformly(case):
    drawn, _ = drawn_actions(case, episode=2)
    bins = 2 if CASES[case][0] else 4
    edges = (0, 1) if CASES[case][0] else (-1, 1)
    for column in np.reshape(drawn, (4000, -1)).T:
        share = np.histogram(column, bins=bins, range=edges)[0] / 4000
        assert np.abs(share - 1 / bins).max() < 5 * np.sqrt(0.25 / 4000)


def test_the_world_takes_continuous_actions_in_its_own_units():
    action = agent_of("continuous").env_action(jnp.float32([0.5, -1.0]))
    np.testing.assert_array_equal(action, [1.0, -2.0])
