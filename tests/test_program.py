"""What the compiler made of the inner loop: what is large is written in place."""

import dataclasses
import functools
import json
import sys
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import pytest
from support import assert_equal, large_ops_in_loops, paper_se, paper_training, printed

from sejax import envs
from sejax.agents.dqn import DDQN, DDQNConfig
from sejax.options import registry
from sejax.proxies.reward import RewardConfig
from sejax.training import TrainingConfig, make_trainer

ROOT = Path(__file__).parents[1]
CAPACITY = 7919  # rows of the replay buffer
MAX_EPISODES = 8009  # rows of the learning curve; nothing else in the program is nearly as long


@pytest.fixture(scope="module")
def case():
    """The traced-at-most-once training of a tiny agent in a tiny SE, and how to call it."""
    env = registry.make("proxy", paper_se(hidden_size=4), envs.make("cartpole"))
    network = {"hidden_size": 4, "num_layers": 1, "batch_size": 4}
    agent = DDQN(DDQNConfig(**network, warmup_episodes=1, buffer_size=CAPACITY), 4, 2).agent()
    spec = dataclasses.replace(agent.spec, cpu_num_parallel=None)  # a vmap's agents step together
    agent = dataclasses.replace(agent, spec=spec)
    train = make_trainer(agent, env, paper_training(max_episodes=MAX_EPISODES, window=2))
    params = env.params(env.init_weights(jax.random.key(0)))
    return train, agent, params.replace(max_steps_in_episode=jnp.int32(5))


@pytest.fixture(scope="module")
def once(case):
    """The training, which may be traced once."""
    chex.clear_trace_counter()
    return jax.jit(chex.assert_max_traces(case[0], n=1))


def arguments(case, seed=0):
    _, agent, params = case
    shift = jax.tree.map(lambda w: w + 0.1 * seed, params.weights)
    return (
        jax.random.key(seed),
        params.replace(weights=shift, max_steps_in_episode=jnp.int32(2 + seed)),
        jax.tree.map(lambda h: jnp.float32(h * (1 + 0.1 * seed)), agent.hparams),
        jnp.bool_(seed < 2),
    )


def assert_in_place(hlo, *lengths):
    """Nothing as large as the buffer or the curve is copied or selected over."""
    assert all(str(length) in hlo for length in (CAPACITY, *lengths))
    copies = large_ops_in_loops(hlo, num_elements=CAPACITY)
    assert not copies, "\n".join(line[:200] for _, line in copies)


def test_a_single_training_neither_copies_nor_selects_its_buffer_and_its_curve(case, once):
    assert_in_place(once.lower(*arguments(case)).compile().as_text(), MAX_EPISODES)


def test_vmapped_trainings_neither_copy_nor_select_their_buffers_and_curves(case):
    train, _, params = case
    keys = jax.random.split(jax.random.key(0), 3)
    vmapped = jax.jit(jax.vmap(train, (0, None))).lower(keys, params)
    assert_in_place(vmapped.compile().as_text(), MAX_EPISODES)


def test_the_checker_finds_the_select_of_a_plainly_vmapped_loop():
    def plain(last):
        def body(carry):
            rows, step = carry
            return rows.at[step % CAPACITY].set(1.0), step + 1

        carry = (jnp.zeros((CAPACITY, 11)), 0)
        return jax.lax.while_loop(lambda carry: carry[1] < last, body, carry)

    lasts = jnp.array([3, 5, 7])
    hlo = jax.jit(jax.vmap(plain)).lower(lasts).compile().as_text()
    assert "select" in {op for op, _ in large_ops_in_loops(hlo, CAPACITY)}
    # The same loop alone writes in place: the checker does not cry wolf.
    assert_in_place(jax.jit(plain).lower(lasts[0]).compile().as_text())


@pytest.mark.slow
def test_vmapped_trainings_of_wide_networks_are_mapped_ones_to_the_bit():
    task, units = envs.make("cartpole"), 24  # more than columns in a batch
    config = DDQNConfig(num_layers=2, hidden_size=units, batch_size=16, warmup_episodes=1)
    train = make_trainer(
        registry.make("agent", config, task), task.env, TrainingConfig(max_steps=99)
    )
    keys = jax.random.split(jax.random.key(0), (2, 2))
    in_turn = vmapped = lambda key: train(key, task.params)
    for _ in keys.shape:
        in_turn = functools.partial(jax.lax.map, in_turn)
        vmapped = jax.vmap(vmapped)
    compiled = jax.jit(vmapped).lower(keys).compile()
    assert_equal(compiled(keys), jax.jit(in_turn)(keys))
    large = {op for op, _ in large_ops_in_loops(compiled.as_text(), units * units)}
    assert "dot" in large and "select" not in large  # no training waits for another


def test_a_training_is_traced_once_for_all_values_of_its_arguments(case, once):
    steps = {int(once(*arguments(case, seed)).train_steps) for seed in range(3)}
    assert len(steps) == 3 and 0 in steps


def test_a_buffer_holds_no_more_steps_than_a_training_on_a_proxy_can_have():
    # An RN's agent of the paper has room for a million, of which its training can fill 20,000.
    task = envs.make("cartpole")
    env = RewardConfig().make(task)
    agent = registry.make("agent", DDQNConfig(buffer_size=1_000_000), task)
    train = make_trainer(agent, env, paper_training(max_episodes=100, stop_rule="never"))
    program = str(jax.make_jaxpr(train)(jax.random.key(0), env.default_params))
    assert "f32[20000," in program and "f32[1000000," not in program


@pytest.mark.slow
def test_the_benchmark_of_gpus_measures_and_writes_its_result(tmp_path):
    path = tmp_path / "gpu.json"
    said = printed(sys.executable, ROOT / "benchmarks/gpu.py", "--quick", "--json", path)
    result = json.loads(path.read_text())
    zeros = "largest_difference_of_weights", "visits_of_the_host", "copies_of_large_arrays"
    assert result["checks"] == dict.fromkeys(zeros, 0)
    (row,) = result["figures"]
    assert row["agents"] == 16 and row["steps"] == 16 * 64 and row["steps_per_s"] > 0
    assert "quick DDQN trains" in said
