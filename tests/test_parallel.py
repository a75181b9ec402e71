"""sejax.ops.parallel: the same results in the same order, however the work is spread."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import assert_close, assert_equal

from sejax.ops.networks import MLP
from sejax.ops.parallel import in_batches_on_cpu, spread_groups_over_devices, spread_over_devices


def spread(fn, num_devices, num_parallel=None):
    return spread_over_devices(fn, num_devices=num_devices, num_parallel=num_parallel)


def work(key, x):
    """Something that depends on both arguments and takes a different time for each element."""
    steps = jnp.int32(jnp.abs(x[0])) + 1
    walked = jax.lax.fori_loop(0, steps, lambda i, y: jnp.sin(y) + i, x)
    return {"walked": walked, "noise": jax.random.normal(key), "steps": steps}


alone = jax.jit(work)


def inputs(seed, size):
    xs = np.arange(2.0 * size, dtype=np.float32).reshape(size, 2)
    return jax.random.split(jax.random.key(seed), size), xs


def assert_each_is_as_alone(results, keys, xs):
    expected = [alone(key, x) for key, x in zip(keys, xs, strict=True)]
    assert_close(results, jax.tree.map(lambda *x: np.stack(x), *expected), rtol=1e-6)


@pytest.mark.parametrize(("num_devices", "num_parallel"), [(1, 3), (2, 1), (2, 100), (None, None)])
@pytest.mark.parametrize("size", [1, 2, 5])
def test_results_come_back_in_order_for_every_size(num_devices, num_parallel, size):
    arguments = inputs(0, size)
    results = jax.jit(spread(work, num_devices, num_parallel))(*arguments)
    assert_each_is_as_alone(results, *arguments)


NET = MLP(1, 8, 1, "tanh")
INPUTS = np.random.default_rng(0).normal(size=(5, 16)).astype(np.float32)


def train_network(key):
    """Weights after a few steps of gradient descent, which are made of products that round."""

    def loss(params, inputs):
        return jnp.mean((NET.apply(params, inputs) - jnp.sin(inputs[:1])) ** 2)

    def step(params, _):
        slopes = jax.grad(loss)(params, jnp.asarray(INPUTS))
        return jax.tree.map(lambda x, slope: x - 0.3 * slope, params, slopes), None

    return jax.lax.scan(step, NET.init(key, INPUTS[:, 0]), length=10)[0]


@pytest.mark.parametrize(("size", "num_parallel"), [(5, 1), (5, 4), (2, 4)])
def test_the_number_of_devices_changes_no_bit_of_a_trained_network(size, num_parallel):
    # Neither 5 trainings nor the shares of two devices, 3 and 1 of them, are whole batches.
    keys = jax.random.split(jax.random.key(0), size)
    one, two = (jax.jit(spread(train_network, n, num_parallel))(keys) for n in (1, 2))
    assert_equal(one, two)
    by_itself = jax.jit(train_network)(keys[-1])
    assert_close(jax.tree.map(lambda x: np.asarray(x)[-1], one), by_itself, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("num_devices", [1, 2])
@pytest.mark.parametrize("num_parallel", [None, 2])
def test_groups_have_a_function_a_size_and_a_width_each(num_devices, num_parallel):
    first, (_, xs), last = (inputs(seed, size) for seed, size in enumerate((5, 1, 4)))
    functions, widths = [work, lambda x: {"scaled": 3 * x}, work], [1, None, 3]
    counts = {"num_devices": num_devices, "num_parallel": num_parallel}
    results = jax.jit(spread_groups_over_devices(functions, widths, **counts))([first, (xs,), last])
    assert_each_is_as_alone(results[0], *first)
    np.testing.assert_array_equal(results[1]["scaled"], 3 * xs)
    assert_each_is_as_alone(results[2], *last)


def test_two_devices_share_the_work():
    lowered = jax.jit(spread(lambda x: x + 1, 2)).lower(np.ones((4, 2), np.float32))
    assert "num_partitions=2" in lowered.compile().as_text().splitlines()[0]


@pytest.mark.parametrize("width", [1, 2, 100, None])
def test_a_vmap_in_batches_equals_the_plain_one(width):
    def scaled(key, x, scale, nothing):
        return work(key, scale * x) | {"nothing": nothing}

    def in_two_axes(fn):
        inner = jax.vmap(fn, (None, 0, None, 0))
        return jax.jit(jax.vmap(inner, (0, None, None, None)))

    arguments = *inputs(0, 5), 2.0, np.zeros((5, 0))  # the scale is the same for all
    in_batches = in_batches_on_cpu(scaled, width)
    results, expected = (
        jax.jit(jax.vmap(fn, (0, 0, None, 0)))(*arguments) for fn in (in_batches, scaled)
    )
    assert_close(results, expected, rtol=1e-6)
    assert_close(in_two_axes(in_batches)(*arguments), in_two_axes(scaled)(*arguments), rtol=1e-6)
