"""Agents that see images through a convolution: `agent.torso=conv`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import sejax
from sejax.envs.environment import Environment, EnvState
from sejax.envs.spec import Box, Discrete, TaskSpec
from sejax.ops.networks import init_narrowed
from sejax.training import TrainingConfig, make_trainer

SMALL = {"torso": "conv", "num_filters": 4, "num_layers": 1, "hidden_size": 16}
AGENTS = {
    "ddqn": sejax.DDQNConfig(**SMALL, batch_size=16, warmup_episodes=20),
    "ppo": sejax.PPOConfig(**SMALL, rollout_steps=64),
}  # fmt: skip
IMAGE = (4, 5, 2)


@struct.dataclass
class PatternState(EnvState):
    kind: jax.Array
    image: jax.Array


class Patterns(Environment):
    """One step: a corner of 2 x 2 pixels lies somewhere; the action says which of two it is.

    The pattern may lie anywhere, so that what a filter learns in one place holds in all.
    """

    def reset_env(self, key, params):
        key_kind, key_row, key_column = jax.random.split(key, 3)
        kind = jax.random.bernoulli(key_kind).astype(jnp.int32)
        row = jax.random.randint(key_row, (), 0, IMAGE[0] - 1)
        column = jax.random.randint(key_column, (), 0, IMAGE[1] - 1)
        pattern = jnp.where(kind, jnp.eye(2), 1 - jnp.eye(2))[:, :, None]
        image = jax.lax.dynamic_update_slice(jnp.zeros(IMAGE), pattern, (row, column, 0))
        state = PatternState(time=jnp.int32(0), kind=kind, image=image.ravel())
        return state.image, state

    def step_env(self, key, state, action, params):
        reward = jnp.where(action == state.kind, 1.0, 0.0)
        state = state.replace(time=state.time + 1)
        return state.image, state, reward, jnp.bool_(True), {}


@pytest.fixture(scope="module")
def task():
    size = int(np.prod(IMAGE))
    spec = TaskSpec(
        observation=Box((0.0,) * size, (1.0,) * size, IMAGE), action=Discrete(2), max_steps=1
    )
    return sejax.Task.of(spec, name="patterns", env=Patterns(spec))


def test_gymnax_images_keep_their_shape():
    task = sejax.envs.make("gymnax/Breakout-MinAtar")
    assert task.image == (10, 10, 4) and task.obs_dim == 400
    assert TaskSpec.of_interface(task.interface).image == task.image  # as a file keeps it
    assert sejax.envs.make("cartpole").image == ()
    assert sejax.envs.make("cliff_walking").image == ()


@pytest.mark.parametrize("agent", AGENTS)
def test_an_agent_tells_patterns_apart(task, agent):
    made = sejax.make_agent(AGENTS[agent], task)
    limits = TrainingConfig(max_steps=1500, max_episodes=1500, stop_rule="never")
    train = jax.jit(make_trainer(made, task.env, limits))
    trained = train(jax.random.key(0), task.params)
    obs, states = jax.vmap(lambda key: task.env.reset_env(key, task.params))(
        jax.random.split(jax.random.key(1), 200)
    )
    act = jax.vmap(lambda x: made.act(jax.random.key(2), trained.agent_state, x, explore=False))
    assert np.mean(act(obs) == states.kind) > 0.9


@pytest.mark.parametrize("agent", ["ddqn", "ppo"])
def test_a_torso_needs_images(agent):
    with pytest.raises(sejax.ConfigError, match=r"agent\.torso must be null .* got conv\."):
        sejax.make_agent(AGENTS[agent], sejax.envs.make("cartpole"))
    with pytest.raises(sejax.ConfigError, match=r"agent\.num_filters must be left out .* got 4\."):
        type(AGENTS[agent])(num_filters=4)


def test_units_behind_a_torso_can_be_switched_off(task):
    net = AGENTS["ddqn"].with_torso(AGENTS["ddqn"].network(2), IMAGE)
    params = init_narrowed(net, jax.random.key(0), task.obs_dim, jnp.float32(10))["params"]
    layer = params["network"]["Dense_0"]
    assert not np.any(layer["bias"][10:]) and not np.any(layer["kernel"][10:])
    assert np.all(layer["bias"][:10] != 0) and np.all(params["filters"]["bias"] != 0)
