"""The yardstick of the benchmarks: the updates of its agent and of its outer loop are sejax's."""

import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from support import batch_of

from sejax.agents.buffers import Transition
from sejax.agents.dqn import DDQN, DDQNConfig
from sejax.es.nes import NESConfig

torch = pytest.importorskip("torch")
sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))

import torch_nes  # noqa: E402
import torch_reference as reference  # noqa: E402

OBS_DIM, NUM_ACTIONS, BATCH = reference.OBS_DIM, reference.NUM_ACTIONS, 8
NUM_DIMS, MEMBERS = 7, 5
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
        columns = batch_of(rng, OBS_DIM, BATCH)
        batch = Transition(action=np.int32(rng.integers(0, NUM_ACTIONS, BATCH)), **columns)
        state = update(jax.random.key(0), state, batch)
        reference.ddqn_update(torch_state, reference.batch_from_sejax(batch), CONFIG)
    networks = (state.params, torch_state.online.values), (state.target_params, torch_state.target)
    for ours, theirs in networks:
        torch.testing.assert_close(theirs, torch_network(ours), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("changes", [{}, {"update_rule": "authors", "weight_decay": 0.1},
                                     {"step_size": 0.3, "noise_std": 0.5}], ids=str)  # fmt: skip
@pytest.mark.parametrize("scores", ["some better", "none better", "not finite"])
def test_an_update_equals_sejaxs_on_the_same_noise_and_scores(changes, scores):
    config = NESConfig(population_size=MEMBERS, score_transform="all_better_2", **changes)
    rng = np.random.default_rng(0)
    psi = rng.normal(size=NUM_DIMS).astype(np.float32)
    noise = (config.noise_std * rng.normal(size=(MEMBERS, NUM_DIMS))).astype(np.float32)
    signed, incumbent = rng.normal(size=2 * MEMBERS), rng.normal(size=3)
    if scores == "none better":
        incumbent += 100
    if scores == "not finite":
        signed[[0, 5, 7]] = np.nan, np.nan, np.inf
    strategy = config.make(NUM_DIMS)
    state = strategy.init(jax.random.key(0), psi)
    members = jax.numpy.concatenate([psi + noise, psi - noise])
    moved = strategy.tell(jax.random.key(0), members, jax.numpy.float32(signed),
                          jax.numpy.float32(incumbent.mean()), state)  # fmt: skip
    got = torch_nes.nes_update(psi, noise, np.concatenate([signed, incumbent]), config)
    np.testing.assert_allclose(got, strategy.incumbent(moved), rtol=1e-4, atol=1e-5)
    assert (got != psi).any() == (scores != "none better" or config.weight_decay > 0)
