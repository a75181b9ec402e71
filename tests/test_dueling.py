"""The dueling agent: its network and its updates against torch."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_ddqn import BATCH, OBS_DIM, assert_updates_equal_torchs

from sejax.agents.dqn import DDQNConfig, DuelingDDQNConfig, make_ddqn

NUM_ACTIONS = 2  # as in the batches of test_ddqn
GOLDEN = Path(__file__).parent / "golden" / "dueling_updates.npz"
CONFIG = DuelingDDQNConfig(
    hidden_size=5, num_layers=2, feature_dim=4, stream_hidden_size=6, stream_num_layers=1,
    activation="tanh", batch_size=BATCH, learning_rate=0.01, tau=0.1, discount=0.9,
)  # fmt: skip
# Layers in both streams, with a slope of each part; and streams that are their heads alone.
CASES = {
    "prelu": replace(CONFIG, activation="prelu", stream_num_layers=2),
    "no_streams": replace(CONFIG, stream_num_layers=0),
}


@pytest.mark.parametrize("case", CASES)
def test_updates_equal_torchs_on_the_same_batches(case):
    agent = make_ddqn(CASES[case], OBS_DIM, NUM_ACTIONS)
    assert_updates_equal_torchs(np.load(GOLDEN), case, agent)  # made by torch_dueling.py


def test_one_trains_alone_on_a_core():
    # In lockstep its streams' products take longer; DDQN of the same size gains by it.
    small = {"hidden_size": 64, "num_layers": 1, "batch_size": 32}
    assert make_ddqn(DuelingDDQNConfig(**small), 4, 2).spec.cpu_num_parallel == 1
    assert make_ddqn(DDQNConfig(**small), 4, 2).spec.cpu_num_parallel > 1
