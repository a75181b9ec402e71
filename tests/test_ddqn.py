"""sejax.agents.dqn: updates against torch, and exploration."""

from dataclasses import replace
from pathlib import Path
from typing import get_args

import jax
import numpy as np
import pytest
from support import assert_shares, batch_of, drawing, numpy_forward, raveled, shapes_of, unraveled

from sejax.agents.buffers import Transition
from sejax.agents.dqn import DDQN, DDQNConfig, DuelingDDQNConfig
from sejax.options import Activation

OBS_DIM, NUM_ACTIONS, BATCH = 3, 2, 7
GOLDEN = Path(__file__).parent / "golden" / "ddqn_updates.npz"
CONFIG = DDQNConfig(
    hidden_size=5, num_layers=2, activation="tanh", batch_size=BATCH,
    learning_rate=0.01, tau=0.1, discount=0.9,
)  # fmt: skip
EXACT = [activation for activation in get_args(Activation) if activation != "fast_tanh"]
CASES = {activation: replace(CONFIG, activation=activation) for activation in EXACT} | {
    "dqn": replace(CONFIG, double=False)
}
DUELING = DuelingDDQNConfig(
    hidden_size=5, num_layers=2, feature_dim=4, stream_hidden_size=6, stream_num_layers=1,
    activation="tanh", batch_size=BATCH, learning_rate=0.01, tau=0.1, discount=0.9,
)  # fmt: skip
# Layers in both streams, with a slope of each part; and streams that are their heads alone.
DUELING_CASES = {
    "dueling_prelu": replace(DUELING, activation="prelu", stream_num_layers=2),
    "dueling_no_streams": replace(DUELING, stream_num_layers=0),
}
GOLDEN_UPDATES = [
    *(CASES | DUELING_CASES).items(),
    ("tanh", replace(CONFIG, activation="fast_tanh")),
]


def random_batch(seed):
    rng = np.random.default_rng(seed)
    columns = batch_of(rng, OBS_DIM, BATCH)
    return Transition(action=np.int32(rng.integers(0, NUM_ACTIONS, BATCH)), **columns)


def state_with(agent, params, target_params):
    """A fresh state with these parameters, of vectors; nothing is compiled."""
    state = shapes_of(agent.init, jax.random.key(1), agent.hparams)
    return state.replace(
        params=unraveled(params, state.params),
        target_params=unraveled(target_params, state.params),
        hparams=jax.tree.map(np.float32, agent.hparams),
    )


# --- updates against torch -----------------------------------------------------------------------


@pytest.mark.parametrize(("case", "config"), GOLDEN_UPDATES)
def test_updates_equal_torchs_on_the_same_batches(case, config):
    golden = np.load(GOLDEN)  # made by torch_ddqn.py
    agent = DDQN(config, OBS_DIM, NUM_ACTIONS).agent()
    params = (golden[f"{case}/{name}/0"] for name in ("params", "target_params"))
    state, update = state_with(agent, *params), jax.jit(agent.update)
    for number in range(1, 6):
        state = update(jax.random.key(0), state, random_batch(number))
        if number in (1, 5):
            for name in ("params", "target_params"):
                expected = golden[f"{case}/{name}/{number}"]
                got = raveled(getattr(state, name))
                np.testing.assert_allclose(got, expected, rtol=1e-5, atol=2e-6)


# --- exploration ---------------------------------------------------------------------------------


def test_epsilon_by_steps_falls_linearly_whatever_the_episodes():
    config = replace(CONFIG, exploration_steps=4, epsilon_init=0.9, epsilon_min=0.1)
    agent = DDQN(config, OBS_DIM, NUM_ACTIONS).agent()
    learn = jax.jit(agent.update)
    state = shapes_of(agent.init, jax.random.key(1), agent.hparams)
    state = state.replace(hparams=jax.tree.map(np.float32, agent.hparams), epsilon=np.float32(0.9))
    epsilons = []
    for episode in range(6):  # of one step
        state = agent.begin_episode(state, np.int32(episode))
        epsilons.append(float(state.epsilon))
        state = learn(jax.random.key(0), state, random_batch(0))
    # From 0.9 to 0.1 in four steps of 0.2.
    np.testing.assert_allclose(epsilons, [0.9, 0.7, 0.5, 0.3, 0.1, 0.1], rtol=1e-5)


def test_actions_are_random_with_probability_epsilon_and_greedy_otherwise():
    agent, obs = DDQN(CONFIG, OBS_DIM, num_actions=3).agent(), np.float32([0.3, -0.2, 0.5])
    state = jax.jit(agent.init)(jax.random.key(0), agent.hparams).replace(epsilon=np.float32(0.3))
    drawn, tested = drawing(agent)(state, obs)
    params = state.params["params"]
    best = np.argmax(numpy_forward(params, obs, CONFIG.activation, CONFIG.num_layers))
    assert (tested == best).all()
    assert_shares(drawn, 0.1 + 0.7 * np.eye(3)[best])  # random ones are uniform
