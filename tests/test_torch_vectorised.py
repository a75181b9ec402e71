"""benchmarks/torch_vectorised.py: each agent of many is one of benchmarks/torch_reference.py."""

import sys
from pathlib import Path

import pytest

from sejax.agents.dqn import DDQNConfig
from sejax.proxies.configs import SyntheticConfig

torch = pytest.importorskip("torch")
sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))

import torch_reference as reference  # noqa: E402
import torch_vectorised as vectorised  # noqa: E402

CONFIG = DDQNConfig(hidden_size=9, batch_size=8, learning_rate=0.01, activation="tanh", tau=0.1)


def batch(*shape):
    obs, next_obs = torch.randn(*shape, 4), torch.randn(*shape, 4)
    action, discount = torch.randint(2, (*shape, 1)), torch.rand(*shape, 1)
    return reference.Batch(obs, next_obs, action, torch.randn(*shape, 1), discount)


def test_updates_and_values_are_those_of_agents_alone():
    torch.manual_seed(0)
    networks = [reference.init_mlp([4, 9, 2], "tanh") for _ in range(3)]
    many = vectorised.Agents(networks, CONFIG, "cpu")
    alone = [reference.ddqn_state(each) for each in networks]
    for _ in range(3):
        batches = batch(3, 8)
        many.update(batches)
        for i, state in enumerate(alone):
            reference.ddqn_update(state, reference.Batch(*(x[i] for x in batches)), CONFIG)
    for i, state in enumerate(alone):
        torch.testing.assert_close([x[i] for x in many.online], state.online.values)
        torch.testing.assert_close([x[i] for x in many.target], state.target)
        obs = torch.randn(3, 4)
        q_values = reference.mlp(state.online.values, obs[i], "tanh")
        torch.testing.assert_close(many.values(obs)[i], q_values)


def test_the_se_gives_rows_what_it_gives_one():
    weights = {name: reference.params_to_flax(reference.init_mlp([6, 5, size], "leaky_relu"))
               for name, size in reference.HEADS.items()}  # fmt: skip
    config = SyntheticConfig(hidden_size=5, num_layers=1, activation="leaky_relu", done="soft")
    env = reference.SyntheticEnv(weights, config)
    obs, action = torch.randn(7, 4), torch.randint(2, (7,))
    rows = env.outputs(obs, action)
    for i in range(7):
        step = env.step(obs[i], int(action[i]))
        torch.testing.assert_close(rows[i, :4], step.obs)
        assert float(rows[i, 4]) == pytest.approx(step.reward, abs=1e-6)
    assert vectorised.train(env, CONFIG, 5, 30, "cpu") == 150
