"""benchmarks/torch_vectorised.py: each agent of many is one of benchmarks/torch_reference.py."""

import sys
from pathlib import Path

import pytest
from support import paper_se

from sejax.agents.dqn import DDQNConfig

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


@pytest.mark.parametrize("done", ["soft", "threshold"])
def test_a_step_of_many_is_that_of_each(done):
    torch.manual_seed(1)
    weights = {name: reference.params_to_flax(reference.init_mlp([6, 5, size], "leaky_relu"))
               for name, size in reference.HEADS.items()}  # fmt: skip
    weights["done"]["Dense_1"]["bias"] += 0.5  # some end, some do not
    config = paper_se(hidden_size=5, num_layers=1, activation="leaky_relu", done=done)
    env = reference.SyntheticEnv(weights, config)
    obs, action = torch.randn(20, 4), torch.randint(2, (20,))
    obs[3], obs[4, 0] = 1e9, float("nan")  # absurd
    many = vectorised.take(env, obs, action)
    rows = vectorised.packed(obs, action, many)
    assert 2 < many.terminated.sum() < 20 and many.terminated[3] and many.terminated[4]
    for i in range(20):
        step = env.step(obs[i], int(action[i]))
        torch.testing.assert_close(many.next_obs[i], step.obs, equal_nan=True)
        found = [float(x[i]) for x in (many.reward, many.discount, many.terminated)]
        wanted = [step.reward, step.discount, float(step.terminated)]
        assert found == pytest.approx(wanted, abs=1e-6)
        assert rows[i, 8:10].tolist() == pytest.approx([int(action[i]), step.reward], abs=1e-6)
    assert len({round(float(x), 4) for x in many.discount}) > (5 if done == "soft" else 1)
    assert vectorised.train(env, CONFIG, 5, 30, "cpu") == 150
    with pytest.raises(ValueError, match="only these hyperparameters are built"):
        vectorised.train(env, DDQNConfig(double=False), 5, 30, "cpu")


def test_a_batch_has_each_agents_own_rows():
    stored = torch.arange(4 * 3 * 11.0).reshape(4, 3, 11)
    batches = vectorised.drawn(stored, 2, 50)
    for agent in range(3):
        first = batches.obs[agent, :, 0]
        assert set(first.tolist()) == {float(stored[i, agent, 0]) for i in range(2)}
        torch.testing.assert_close(batches.next_obs[agent, :, 0], first + 4)
        assert batches.action[agent, :, 0].tolist() == (first + 8).long().tolist()
        torch.testing.assert_close(batches.discount[agent, :, 0], first + 10)
