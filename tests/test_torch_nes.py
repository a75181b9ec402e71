"""benchmarks/torch_nes.py, the outer loop that benchmarks compare with: its updates are sejax's."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sejax.es.nes import NESConfig

pytest.importorskip("torch")
sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))

import torch_nes

NUM_DIMS, MEMBERS = 7, 5


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
    members = jnp.concatenate([psi + noise, psi - noise])
    told = strategy.tell(jax.random.key(0), members, jnp.float32(signed),
                         jnp.float32(incumbent.mean()), state)  # fmt: skip
    got = torch_nes.nes_update(psi, noise, np.concatenate([signed, incumbent]), config)
    np.testing.assert_allclose(got, strategy.incumbent(told), rtol=1e-4, atol=1e-5)
    assert (got != psi).any() == (scores != "none better" or config.weight_decay > 0)
