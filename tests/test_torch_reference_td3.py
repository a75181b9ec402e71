"""benchmarks/torch_reference_td3.py, the yardstick: its updates are sejax's."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from support import paper_se

from sejax import envs
from sejax.agents.buffers import Transition
from sejax.agents.td3 import (
    LearningNoise,
    TD3Config,
    make_learning_step,
    make_networks,
    make_td3,
    tanh_policy,
)
from sejax.ops.networks import MLP

torch = pytest.importorskip("torch")
sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))

import torch_reference as reference  # noqa: E402
import torch_reference_td3 as torch_td3  # noqa: E402

OBS_DIM, ACTION_DIM, MAX_ACTION = torch_td3.OBS_DIM, torch_td3.ACTION_DIM, torch_td3.MAX_ACTION
BATCH, NUM_UPDATES = 8, 3
CONFIG = TD3Config(
    hidden_size=9, num_layers=2, batch_size=BATCH, learning_rate=0.01, tau=0.1,
    discount=0.9, target_noise_std=0.4,
)  # fmt: skip


def nested(flat, num_inputs, num_outputs):
    """A network's flat parameters as flax nests them."""
    mlp = MLP(num_outputs, CONFIG.hidden_size, CONFIG.num_layers, CONFIG.activation)
    template = mlp.init(jax.random.key(0), jnp.zeros(num_inputs))
    return ravel_pytree(template)[1](flat)["params"]


def torch_networks(actor, critics):
    """The same parameters as the reference keeps them: the actor's and both critics'."""
    params = [reference.params_from_flax(nested(critic, OBS_DIM + ACTION_DIM, 1))
              for critic in critics]  # fmt: skip
    return (
        reference.params_from_flax(nested(actor, OBS_DIM, ACTION_DIM)),
        torch_td3.stack_critics(params),
    )


def random_batch(rng):
    arrays = {
        "obs": rng.normal(size=(OBS_DIM, BATCH)),
        "action": rng.uniform(-MAX_ACTION, MAX_ACTION, (ACTION_DIM, BATCH)),
        "reward": rng.normal(size=BATCH),
        "discount": rng.uniform(-0.2, 1.2, BATCH),
        "next_obs": rng.normal(size=(OBS_DIM, BATCH)),
    }
    return Transition(**{name: jnp.float32(x) for name, x in arrays.items()})


def test_updates_equal_sejaxs_on_the_same_batches_and_noise():
    policy = tanh_policy(ACTION_DIM, MAX_ACTION)
    agent = make_td3(CONFIG, OBS_DIM, policy)
    networks = make_networks(CONFIG, OBS_DIM, ACTION_DIM)
    learn = jax.jit(make_learning_step(CONFIG, networks, policy))
    state = jax.jit(agent.init)(jax.random.key(1), agent.hparams)
    torch_state = torch_td3.td3_state(*torch_networks(state.actor, state.critics))
    rng = np.random.default_rng(0)
    for _ in range(NUM_UPDATES):  # the second moves the actor and the targets
        batch, smoothing = random_batch(rng), rng.normal(size=(ACTION_DIM, BATCH))
        state = learn(state, batch, LearningNoise(jnp.float32(smoothing), None, None))
        torch_td3.td3_update(
            torch_state, reference.batch_from_sejax(batch), torch.tensor(smoothing.T).float(),
            CONFIG,
        )  # fmt: skip
    expected = [*torch_networks(state.actor, state.critics),
                *torch_networks(state.target_actor, state.target_critics)]  # fmt: skip
    got = [torch_state.actor.values, torch_state.critics.values, torch_state.target_actor,
           torch_state.target_critics]  # fmt: skip
    for ours, theirs in zip(expected, got, strict=True):
        torch.testing.assert_close(theirs, ours, rtol=1e-4, atol=1e-6)


def test_the_critics_stacked_are_the_critics():
    critics = [reference.init_mlp([4, 5, 5, 1], "relu") for _ in range(2)]
    obs, action = torch.randn(6, 3), torch.randn(6, 1)
    rows = torch.cat([obs, action], dim=1)
    expected = torch.stack([reference.mlp(critic, rows, "relu") for critic in critics])
    stacked = torch_td3.stack_critics(critics)
    torch.testing.assert_close(torch_td3.q_values(stacked, obs, action, "relu"), expected)


def test_the_se_takes_continuous_actions_as_sejaxs_does():
    env = paper_se(hidden_size=6).make(envs.make("pendulum"))
    weights = env.init_weights(jax.random.key(0))
    obs, action = np.float32([0.6, -0.8, 0.3]), np.float32([1.5])
    step = reference.SyntheticEnv(weights, env.config).step(*map(torch.tensor, (obs, action)))
    next_obs, reward, done = env.predict(weights, obs, action)
    np.testing.assert_allclose(step.obs, next_obs, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose([step.reward, step.discount], [reward, 1 - done], rtol=1e-5)
