"""sejax.ops.loops: every element gets what it would get alone, at any depth of vmap."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from sejax.ops.loops import while_any_active


@struct.dataclass
class Count:
    active: jax.Array
    number: jax.Array


def body(log, state, limit, masked):
    """Logs 1, 2, ... up to the limit, one entry for each iteration."""
    number = state.number + 1
    index = jnp.where(state.active, state.number, log.shape[0]) if masked else state.number
    log = log.at[index].set(number, mode="drop")
    return log, Count(active=number < limit, number=number)


def count_to(limit, active=True):
    state = Count(active=jnp.asarray(active), number=jnp.int32(0))
    return while_any_active(body, jnp.zeros(6, jnp.int32), state, limit)


def assert_counted(log, number, limit):
    assert number == limit
    np.testing.assert_array_equal(log, [*range(1, limit + 1)] + [0] * (6 - limit))


@pytest.mark.parametrize("on_gpu", [False, True])
@pytest.mark.parametrize("shape", [(), (4,), (1, 2, 2)])
def test_elements_that_stop_at_different_times_equal_single_loops(monkeypatch, shape, on_gpu):
    blocks = []

    def of_gpu(carry, *, cpu, default):
        blocks.append(default)
        return default(carry)

    if on_gpu:  # which runs blocks of steps
        monkeypatch.setattr(jax.lax, "platform_dependent", of_gpu)
    loop = count_to
    for _ in shape:
        loop = jax.vmap(loop)
    limits = np.int32([3, 1, 6, 2][: math.prod(shape)])
    log, state = jax.tree.map(np.asarray, jax.jit(loop)(limits.reshape(shape)))
    assert not state.active.any() and bool(blocks) == (on_gpu and shape != ())
    for element, limit in enumerate(limits):
        index = np.unravel_index(element, shape)
        assert_counted(log[index], state.number[index], limit)


def test_arguments_that_all_elements_share_need_no_axis():
    loop = jax.jit(jax.vmap(count_to, in_axes=(None, 0)))
    log, state = jax.tree.map(np.asarray, loop(3, np.array([True, False, True])))
    for element, limit in enumerate((3, 0, 3)):  # one was never active
        assert_counted(log[element], state.number[element], limit)


def test_elements_in_a_cond_may_read_arrays_that_the_body_closes_over():
    squares = jnp.arange(7) ** 2

    def squaring(log, state, limit, masked):
        log, state = body(log, state, limit, masked)
        return log, state.replace(number=jnp.sqrt(squares[state.number]).astype(jnp.int32))

    def count_if(wanted, limit):
        state = Count(active=jnp.bool_(True), number=jnp.int32(0))
        none = (jnp.zeros(6, jnp.int32), state)
        return jax.lax.cond(wanted, lambda: while_any_active(squaring, *none, limit), lambda: none)

    counted = jax.jit(jax.vmap(count_if))(np.array([True, False]), np.int32([4, 5]))
    log, state = jax.tree.map(np.asarray, counted)
    assert_counted(log[0], state.number[0], 4)
    assert not log[1].any()
