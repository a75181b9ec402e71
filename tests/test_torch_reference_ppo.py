"""benchmarks/torch_reference_ppo.py, the yardstick: its learning phase is sejax's."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from support import paper_se, paper_training

from sejax.agents import buffers
from sejax.agents.buffers import Rollout, Transition
from sejax.agents.policies import softmax
from sejax.agents.ppo import PPOConfig, make_ppo
from sejax.ops.networks import MLP

torch = pytest.importorskip("torch")
sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))

import torch_reference as reference  # noqa: E402
import torch_reference_ppo as torch_ppo  # noqa: E402

OBS_DIM, NUM_ACTIONS = reference.OBS_DIM, reference.NUM_ACTIONS
STEPS = 12
CONFIG = PPOConfig.paper(
    hidden_size=9, num_layers=2, learning_rate=0.01, discount=0.9, update_episodes=1, epochs=3,
    clip_ratio=0.02, value_weight=0.7, entropy_weight=0.05,
)  # fmt: skip


def torch_networks(params):
    """sejax's flat parameters as the reference keeps them: the actor's and the critic's."""
    actor, critic = (
        MLP(size, CONFIG.hidden_size, CONFIG.num_layers, CONFIG.activation)
        for size in (NUM_ACTIONS, 1)
    )
    obs = jnp.zeros(OBS_DIM)
    template = {
        "actor": actor.init(jax.random.key(0), obs),
        "critic": critic.init(jax.random.key(0), obs),
        "std": jnp.zeros(0),
    }
    tree = ravel_pytree(template)[1](params)
    return [reference.params_from_flax(tree[name]["params"]) for name in ("actor", "critic")]


def test_a_learning_phase_equals_sejaxs_on_the_same_rollout():
    agent = make_ppo(CONFIG, OBS_DIM, softmax(NUM_ACTIONS), STEPS)
    state = jax.jit(agent.init)(jax.random.key(1), agent.hparams)
    torch_state = torch_ppo.ppo_state(*torch_networks(state.params))
    rng = np.random.default_rng(0)
    steps = Transition(
        obs=jnp.float32(rng.normal(size=(STEPS, OBS_DIM))),
        action=jnp.int32(rng.integers(0, NUM_ACTIONS, STEPS)),
        reward=jnp.float32(rng.normal(size=STEPS)),
        discount=jnp.ones(STEPS),
        next_obs=jnp.zeros((STEPS, OBS_DIM)),
        weight=jnp.ones(STEPS),
    )
    ended = np.isin(np.arange(STEPS), (3, 9))
    rows = jnp.concatenate([jax.vmap(buffers.pack)(steps), jnp.float32(ended)[:, None]], axis=1)
    rollout = Rollout(rows=rows, is_full=jnp.bool_(True))
    state = jax.jit(agent.update)(jax.random.key(0), state, rollout)
    torch_ppo.ppo_phase(
        torch_state, torch.tensor(np.array(steps.obs)),
        torch.tensor(np.array(steps.action)).long()[:, None],
        steps.reward.tolist(), ended.tolist(), CONFIG,
    )  # fmt: skip
    actor, critic = torch_networks(state.params)
    torch.testing.assert_close(torch_state.networks.values, [*actor, *critic], rtol=1e-4, atol=1e-6)


def test_it_learns_when_the_rollout_is_full():
    length = torch_ppo.rollout_length(CONFIG)
    assert length == CONFIG.rollout_length(reference.MAX_STEPS)
    heads = {name: reference.params_to_flax(reference.init_mlp([6, 5, size], "leaky_relu"))
             for name, size in reference.HEADS.items()}  # fmt: skip
    env = reference.SyntheticEnv(heads, paper_se(hidden_size=5))

    def actor_after(num_steps):
        training = paper_training(stop_rule="never", max_steps=num_steps)
        result = torch_ppo.train(env, CONFIG, training, seed=0)
        assert result.train_steps == num_steps
        return result.agent.state.networks.values

    before, still, after = (actor_after(n) for n in (1, length - 1, length))
    assert all(torch.equal(a, b) for a, b in zip(before, still, strict=True))
    assert not any(torch.equal(a, b) for a, b in zip(before, after, strict=True))
