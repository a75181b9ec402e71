"""The dueling network by hand, an update of its agent against torch, and CartPole solved."""

import functools
from pathlib import Path

import jax
import numpy as np
import pytest
from support import numpy_forward, random_like, shapes_of, unraveled
from test_ddqn import BATCH, OBS_DIM, assert_updates_equal_torchs

from sejax.agents.dqn import DDQNConfig, DuelingDDQNConfig, make_ddqn
from sejax.ops.networks import DuelingMLP

NUM_ACTIONS = 2  # as in the batches of test_ddqn
GOLDEN = Path(__file__).parent / "golden" / "dueling_updates.npz"
ACTIVATIONS = ("tanh", "prelu")
CONFIG = DuelingDDQNConfig(
    hidden_size=5, num_layers=2, feature_dim=4, stream_hidden_size=6, stream_num_layers=1,
    activation="tanh", batch_size=BATCH, learning_rate=0.01, tau=0.1, discount=0.9,
)  # fmt: skip


def config_with(activation):
    return DuelingDDQNConfig(**{**vars(CONFIG), "activation": activation})


def nested_params(config):
    """Turns the agent's flat parameters into the network's nested ones."""
    init = config.network(NUM_ACTIONS).init
    template = shapes_of(init, jax.random.key(0), np.zeros(OBS_DIM))
    return lambda flat: unraveled(flat, template)["params"]


@functools.cache
def dueling(activation="tanh", num_actions=3, stream_num_layers=2):
    """The jitted network, and random parameters for it."""
    net = DuelingMLP(
        num_actions, feature_dim=4, hidden_size=5, num_layers=1, stream_hidden_size=6,
        stream_num_layers=stream_num_layers, activation=activation,
    )  # fmt: skip
    variables = shapes_of(net.init, jax.random.key(1), np.zeros(OBS_DIM))
    return jax.jit(net.apply), random_like(variables)


# --- the network ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("activation", "stream_layers"), [("tanh", 2), ("prelu", 2), ("tanh", 0)])
def test_forward_equals_a_numpy_loop(activation, stream_layers):
    apply, variables = dueling(activation, stream_num_layers=stream_layers)
    params = variables["params"]
    slopes = {}
    if activation == "prelu":  # a slope for each part: a mix-up would be seen
        slopes = {"features": 0.6, "value": -0.3, "advantage": 1.7}
        params = {
            part: {**params[part], "prelu_slope": np.float32(slope)}
            for part, slope in slopes.items()
        }
    assert set(params) == {"features", "value", "advantage"}
    for x in np.random.default_rng(0).normal(size=(4, OBS_DIM)) * 2:

        def part(name, x, num_layers):
            return numpy_forward(params[name], x, activation, num_layers, slopes.get(name))

        features = part("features", x, 1)
        value, advantage = (part(name, features, stream_layers) for name in ("value", "advantage"))
        expected = [value[0] + advantage[a] - sum(advantage) / 3 for a in range(3)]
        got = apply({"params": params}, np.float32(x))
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)


# --- the agent -----------------------------------------------------------------------------------


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_updates_equal_torchs_on_the_same_batches(activation):
    agent = make_ddqn(config_with(activation), OBS_DIM, NUM_ACTIONS)
    assert_updates_equal_torchs(np.load(GOLDEN), activation, agent)  # made by torch_dueling.py


def test_one_trains_alone_on_a_core():
    # In lockstep its streams' products take longer; DDQN of the same size gains by it.
    small = {"hidden_size": 64, "num_layers": 1, "batch_size": 32}
    assert make_ddqn(DuelingDDQNConfig(**small), 4, 2).spec.cpu_num_parallel == 1
    assert make_ddqn(DDQNConfig(**small), 4, 2).spec.cpu_num_parallel > 1
