"""benchmarks/torch_reference.py, the yardstick of the benchmarks: its updates are sejax's."""

import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from support import random_columns

from sejax.agents.buffers import Transition
from sejax.agents.dqn import DDQN, DDQNConfig

torch = pytest.importorskip("torch")
sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))

import torch_reference as reference  # noqa: E402

OBS_DIM, NUM_ACTIONS, BATCH = reference.OBS_DIM, reference.NUM_ACTIONS, 8
CONFIG = DDQNConfig(hidden_size=9, num_layers=2, batch_size=BATCH, learning_rate=0.01)


def torch_network(params):
    """sejax's parameters as the reference keeps them."""
    return reference.params_from_flax(params["params"])


def test_updates_equal_sejaxs_on_the_same_batches():
    agent = DDQN(CONFIG, OBS_DIM, NUM_ACTIONS).agent()
    state = jax.jit(agent.init)(jax.random.key(1), agent.hparams)
    update = jax.jit(agent.update)
    torch_state = reference.ddqn_state(torch_network(state.params))
    rng = np.random.default_rng(0)
    for _ in range(2):
        columns = random_columns(rng, OBS_DIM, BATCH)
        batch = Transition(action=np.int32(rng.integers(0, NUM_ACTIONS, BATCH)), **columns)
        state = update(jax.random.key(0), state, batch)
        reference.ddqn_update(torch_state, reference.batch_from_sejax(batch), CONFIG)
    networks = (state.params, torch_state.online.values), (state.target_params, torch_state.target)
    for ours, theirs in networks:
        torch.testing.assert_close(theirs, torch_network(ours), rtol=1e-4, atol=1e-6)
