"""sejax.ops.loops: every element gets what it would get alone, at any depth of vmap."""

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


def test_a_single_loop_runs_until_it_is_inactive():
    log, state = jax.jit(count_to)(4)
    assert_counted(log, state.number, 4)
    assert not state.active


@pytest.mark.parametrize("shape", [(4,), (2, 2), (1, 2, 2)])
def test_elements_that_stop_at_different_times_equal_single_loops(shape):
    loop = count_to
    for _ in shape:
        loop = jax.vmap(loop)
    limits = np.int32([3, 1, 6, 2])
    log, state = jax.jit(loop)(limits.reshape(shape))
    log, state = jax.tree.map(np.asarray, (log, state))
    for element, limit in enumerate([3, 1, 6, 2]):
        index = np.unravel_index(element, shape)
        assert_counted(log[index], state.number[index], limit)


@pytest.mark.parametrize("shape", [(4,), (2, 2)])
def test_blocks_of_steps_that_gpus_run_change_nothing(monkeypatch, shape):
    ran = []

    def on_a_gpu(carry, *, cpu, default):
        ran.append(default)
        return default(carry)

    monkeypatch.setattr(jax.lax, "platform_dependent", on_a_gpu)
    test_elements_that_stop_at_different_times_equal_single_loops(shape)
    assert ran


def test_arguments_that_all_elements_share_need_no_axis():
    loop = jax.jit(jax.vmap(count_to, in_axes=(None, 0)))
    log, state = jax.tree.map(np.asarray, loop(3, np.array([True, False, True])))
    assert_counted(log[0], state.number[0], 3)
    assert_counted(log[1], state.number[1], 0)  # was never active
    assert_counted(log[2], state.number[2], 3)


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
