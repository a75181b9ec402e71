"""sejax.ops.counters: counts beyond 32 bits are those of Python's integers."""

import jax
import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from sejax.ops.counters import exact, wide_add, wide_sum, wide_zeros

LENGTH = 9
number = st.integers(0, 2**31 - 1)
rows = st.lists(st.lists(number, min_size=LENGTH, max_size=LENGTH), min_size=2, max_size=2)

jit_sum, jit_add = jax.jit(wide_sum), jax.jit(wide_add)


def is_normal(count):
    return count.dtype == np.int32 and (count[..., 1] >= 0).all() and (count[..., 1] < 2**16).all()


@given(rows)
@example([[2**31 - 1] * LENGTH, [0] * LENGTH])
@example([[2**16 - 1] * LENGTH, [2**16] * LENGTH])
def test_sums_are_pythons_far_beyond_32_bits(numbers):
    count = np.asarray(jit_sum(np.array(numbers, np.int32)))  # [2, 2]
    assert is_normal(count)
    assert exact(count).dtype == np.int64
    assert exact(count).tolist() == [sum(row) for row in numbers]


@given(rows, st.integers(1, 40))
@example([[2**31 - 1] * LENGTH] * 2, 40)
def test_sums_of_sums_are_pythons(numbers, times):
    step = jit_sum(np.array(numbers, np.int32))
    total = wide_zeros(2)
    for _ in range(times):
        total = jit_add(total, step)
    assert is_normal(np.asarray(total))
    assert exact(total).tolist() == [times * sum(row) for row in numbers]


def test_as_many_numbers_as_a_sum_may_have_are_summed_exactly():
    numbers = np.full(2**15, 2**31 - 1, np.int32)
    assert exact(wide_sum(numbers)) == 2**15 * (2**31 - 1)


def test_zeros_have_the_shape_that_is_asked_for():
    assert wide_zeros(3, 2).shape == (3, 2, 2)
    np.testing.assert_array_equal(exact(wide_zeros(3, 2)), np.zeros((3, 2)))
    assert exact(wide_zeros()) == 0
