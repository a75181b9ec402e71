"""Spreading independent pieces of work over devices and lanes."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import AxisType, PartitionSpec

from sejax.errors import require


def spread_over_devices(
    fn: Callable[..., Any],
    num_devices: int | None = None,
    lanes: int | None = None,
    cpu_lanes: int | None = 1,
) -> Callable[..., Any]:
    """Maps `fn` over the leading axis of its arguments, over devices and in lanes.

    Args:
      fn: a function of one element.
      num_devices: None for all.
      lanes: elements that run in lockstep on one device. None for `cpu_lanes` on a CPU and for all
        elsewhere.
      cpu_lanes: None for all; 1 where a lane would only wait for the others.

    Devices take the elements in turn (0, 1, 0, 1, ...), so that each gets its share of long and
    short ones. The result does not depend on the number of devices.

    Raises:
      ConfigError: if there are fewer than `num_devices` devices.
    """
    available = jax.devices()
    require(num_devices is None or num_devices <= len(available), "devices",
            f"be at most {len(available)}", "that is how many there are", num_devices,
            "devices=null")  # fmt: skip
    count = num_devices or len(available)

    def map_here(*args: Any) -> Any:
        def one(args: Any) -> Any:
            return fn(*args)

        size = jax.tree.leaves(args)[0].shape[0]
        batch_size = lanes or (cpu_lanes if available[0].platform == "cpu" else None) or size
        if batch_size >= size:
            return jax.vmap(one)(args) if size > 1 else jax.lax.map(one, args)
        return jax.lax.map(one, args, batch_size=batch_size if batch_size > 1 else None)

    if count == 1:
        return map_here
    mesh = jax.make_mesh(
        (count,), ("device",), axis_types=(AxisType.Auto,), devices=available[:count]
    )
    axis = PartitionSpec("device")
    mapped = jax.shard_map(map_here, mesh=mesh, in_specs=axis, out_specs=axis, check_vma=False)

    def map_spread(*args: Any) -> Any:
        size = jax.tree.leaves(args)[0].shape[0]
        padded = -(-size // count) * count

        def deal(x: Array) -> Array:
            x = x[jnp.arange(padded) % size] if padded > size else x
            return x.reshape(-1, count, *x.shape[1:]).swapaxes(0, 1).reshape(padded, *x.shape[1:])

        def gather(x: Array) -> Array:
            x = x.reshape(count, -1, *x.shape[1:]).swapaxes(0, 1).reshape(padded, *x.shape[1:])
            return x[:size]

        return jax.tree.map(gather, mapped(*jax.tree.map(deal, args)))

    return map_spread
