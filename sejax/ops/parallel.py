"""Spreading independent elements of work over devices, and over vmapped batches on each.

Plain form: `jax.lax.map(fn, args)`, one element after the other on one device. Results are equal to
the bit for any number of devices, and up to rounding for any width of a batch
(`tests/test_parallel.py`).
"""

import functools
from collections.abc import Callable, Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_batching import custom_vmap
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree

from sejax.options import Count, checked, require

T = TypeVar("T")


@functools.cache
def compiler_options() -> dict[str, int] | None:
    """XLA's options for whole trainings; None for the defaults.

    On a CPU that has them, vectors of 512 bits; the default is 256. On an AMD EPYC a generation
    takes 0.71 of the time with the paper's DDQN and 0.88 with the default one. Sums of wider
    vectors round differently, so that numbers differ in their last bits.
    """
    options = {"xla_cpu_prefer_vector_width": 512}
    if not on_cpu():
        return None
    try:
        jax.jit(lambda: jnp.int32(0), compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError:  # a version of XLA that has no such option
        return None
    return options


def spread_over_devices(
    fn: Callable[..., PyTree],
    *,
    num_devices: int | None = None,
    num_parallel: int | None = None,
    cpu_num_parallel: int | None = 1,
) -> Callable[..., PyTree]:
    """Maps `fn` over the leading axis of its arguments, on several devices.

    Args:
      fn: a function of one element.
      num_devices: None for all.
      num_parallel: elements in one vmapped batch of a device; a batch is filled up with copies.
        None for `cpu_num_parallel` on a CPU and for all elements elsewhere.
      cpu_num_parallel: None for all elements; 1 if elements of a batch would wait for each other.

    Returns:
      A function of the arguments, each with a leading axis. Devices take the elements in turn (0,
      1, 0, 1, ...), so that each gets its share of long and short ones. The result does not depend
      on the number of devices: to the bit if `num_parallel` is 1 or a power of two, else up to
      rounding, because a CPU computes elements that do not fill its vectors differently.

    Raises:
      ConfigError: if there are fewer than `num_devices` devices.
    """
    spread = spread_groups_over_devices(
        [fn], [cpu_num_parallel], num_devices=num_devices, num_parallel=num_parallel
    )
    return lambda *args: spread([args])[0]


def copy_to_devices(tree: PyTree, num_devices: int | None = None) -> PyTree:
    """A copy of a pytree's arrays on each device, in the form of spread functions' results.

    Without it a jitted loop is compiled twice: its state comes back from devices on which it did
    not start, or is strongly typed where it was weakly typed.
    """
    # Copies, because a state whose arrays are shared cannot be donated; a given dtype is strong.
    tree = jax.tree.map(lambda x: jnp.array(x, jnp.result_type(x)), tree)
    mesh = _mesh(num_devices)
    if mesh.size == 1:
        return tree
    return jax.lax.with_sharding_constraint(tree, NamedSharding(mesh, PartitionSpec()))


def _mesh(num_devices: int | None) -> Mesh:
    """The first devices; all of them for None."""
    available = jax.devices()
    num_devices = checked(num_devices, Count, "devices", None)
    is_fit = num_devices is None or num_devices <= len(available)
    require(is_fit, "devices", f"must be at most {len(available)}", got=num_devices, use="null")
    devices = available[:num_devices]
    return jax.make_mesh((len(devices),), ("device",), (AxisType.Auto,), devices=devices)


def spread_groups_over_devices(
    fns: Sequence[Callable[..., PyTree]],
    cpu_num_parallel: Sequence[int | None],
    *,
    num_devices: int | None = None,
    num_parallel: int | None = None,
) -> Callable[[Sequence[tuple[PyTree, ...]]], list[PyTree]]:
    """As `spread_over_devices` for several functions with a group of elements each.

    A device goes from its share of one group to its share of the next without waiting for others.

    Args:
      fns: a function of one element of each group.
      cpu_num_parallel: as in `spread_over_devices`, for each group.
      num_devices: as in `spread_over_devices`.
      num_parallel: as in `spread_over_devices`.

    Returns:
      A function of the arguments: a tuple for each group, with a leading axis over its elements.
    """
    num_parallel = checked(num_parallel, Count, "num_parallel", None)
    mesh = _mesh(num_devices)
    widths = [num_parallel or (width if on_cpu() else None) for width in cpu_num_parallel]

    def map_groups(groups: Sequence[tuple[PyTree, ...]]) -> list[PyTree]:
        return [map_in_batches(*group) for group in zip(fns, widths, groups, strict=True)]

    if mesh.size == 1:
        return map_groups
    axis = PartitionSpec("device")
    mapped = jax.shard_map(map_groups, mesh=mesh, in_specs=axis, out_specs=axis, check_vma=False)

    def map_spread(groups: Sequence[tuple[PyTree, ...]]) -> list[PyTree]:
        dealt = [jax.tree.map(lambda x: _deal(x, mesh.size), args) for args in groups]
        return [
            jax.tree.map(functools.partial(_gather, num_devices=mesh.size, size=_size(args)), out)
            for args, out in zip(groups, mapped(dealt), strict=True)
        ]

    return map_spread


def on_cpu() -> bool:
    """Whether trainings are computed on CPU cores."""
    return jax.devices()[0].platform == "cpu"


def _size(args: PyTree) -> int:
    """Number of elements."""
    return jax.tree.leaves(args)[0].shape[0]


def map_in_batches(
    fn: Callable[..., PyTree], width: int | None, args: tuple[PyTree, ...]
) -> PyTree:
    """Maps a function of one element on one device; `width` None puts all into one batch."""
    size = _size(args)
    width = width or size
    if width == 1:
        return jax.lax.map(lambda args: fn(*args), args)
    if width == size:
        return jax.vmap(fn)(*args)
    # The last batch is filled up with copies: products of another width round differently, and a
    # result must not depend on the number of elements on a device.
    num_batches = -(-size // width)
    indices = np.arange(num_batches * width) % size
    batches = jax.tree.map(lambda x: x[indices].reshape(num_batches, width, *x.shape[1:]), args)
    out = jax.lax.map(jax.vmap(lambda args: fn(*args)), batches)
    return jax.tree.map(lambda x: x.reshape(num_batches * width, *x.shape[2:])[:size], out)


def in_batches_on_cpu(fn: Callable[..., T], width: int | None) -> Callable[..., T]:
    """`fn`; but on a CPU its `vmap` takes only `width` elements at a time.

    Plain form: `fn`, equal up to rounding (`tests/test_parallel.py`). Its `vmap` steps all elements
    at once and passes through all their memory in each step: TD3 with two layers of 256 units takes
    1.7 times as long.

    Args:
      fn: a function of one element.
      width: elements in one vmapped batch; None for all.

    Example:
      >>> square = in_batches_on_cpu(jnp.square, 1)
      >>> jax.vmap(square)(jnp.arange(3)).tolist()
      [0, 1, 4]
    """
    one = custom_vmap(lambda *args: fn(*args))  # by itself `fn` would have its defaults traced

    @one.def_vmap
    def _(size: int, in_batched: list[PyTree], *args: PyTree) -> tuple[T, PyTree]:
        def all_of_them(*args: PyTree) -> T:
            # None, which is no leaf, stands for an array that all elements share.
            varied = jax.tree.map(lambda x, varies: x if varies else None, [*args], in_batched)

            def or_shared(x: Array | None, shared: Array) -> Array:
                return shared if x is None else x

            def run(*element: PyTree) -> T:
                return fn(*jax.tree.map(or_shared, element, args, is_leaf=lambda x: x is None))

            return map_in_batches(run, min(width or size, size), varied)

        outer_width = None if width is None else 1  # under a second `vmap` maps follow one another
        out = in_batches_on_cpu(all_of_them, outer_width)(*args)
        return out, jax.tree.map(lambda _: True, out)

    return lambda *args: one(*args) if on_cpu() else fn(*args)


def _deal(x: Array, num_devices: int) -> Array:
    """Elements in the order of their devices, 0, 2, ..., 1, 3, ..., filled up with copies."""
    size = -(-x.shape[0] // num_devices) * num_devices
    x = x[jnp.arange(size) % x.shape[0]] if size > x.shape[0] else x
    return x.reshape(-1, num_devices, *x.shape[1:]).swapaxes(0, 1).reshape(size, *x.shape[1:])


def _gather(x: Array, num_devices: int, size: int) -> Array:
    """Inverse of `_deal`."""
    return x.reshape(num_devices, -1, *x.shape[1:]).swapaxes(0, 1).reshape(x.shape)[:size]
