"""A `while_loop` that may be vmapped without copying what is large.

Under `vmap`, JAX turns a `while_loop` whose predicate is batched into one that selects over its
whole carry in each iteration; with replay buffers in the carry that is the whole run time. Here
the batched loop runs until no lane is active, a lane that has stopped keeps its small state by a
select, and the body drops that lane's write to the large arrays itself.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

Body = Callable[..., tuple[Any, Any]]


def while_any_active(body: Body, large: Any, small: Any, consts: Any) -> tuple[Any, Any]:
    """Runs `large, small = body(large, small, consts, masked)` while `small.active`.

    Args:
      body: one iteration of one lane. Its last argument is a Python bool: if it is set, the lane
        may already have stopped, and then it must leave `large` as it is, without a select.
      large: pytree of arrays that must be updated in place (a replay buffer).
      small: dataclass pytree with a bool scalar `active`; cheap to select over.
      consts: pytree that the body only reads.

    Returns:
      The last `large` and `small`. Any nesting of `vmap` gives each lane what it would get alone.
    """
    return _while_any_active(body, 0)(large, small, consts)


@functools.cache
def _while_any_active(body: Body, depth: int) -> Callable[..., tuple[Any, Any]]:
    """The loop under `depth` vmaps, which makes itself one deeper when it is vmapped."""

    @custom_vmap
    def loop(large: Any, small: Any, consts: Any) -> tuple[Any, Any]:
        step = body
        for _ in range(depth):
            step = jax.vmap(step, in_axes=(0, 0, 0, None))

        def masked_step(carry: tuple[Any, Any]) -> tuple[Any, Any]:
            large, small = carry
            large, stepped = step(large, small, consts, depth > 0)
            if depth > 0:
                stepped = jax.tree.map(functools.partial(_select, small.active), stepped, small)
            return large, stepped

        return jax.lax.while_loop(
            lambda carry: jnp.any(carry[1].active), masked_step, (large, small)
        )

    @loop.def_vmap
    def _(axis_size: int, in_batched: Any, large: Any, small: Any, consts: Any):
        def broadcast(batched: bool, x: Any) -> Any:
            return x if batched else jnp.broadcast_to(x, (axis_size, *jnp.shape(x)))

        args = jax.tree.map(broadcast, in_batched, [large, small, consts])
        out = _while_any_active(body, depth + 1)(*args)
        return out, jax.tree.map(lambda _: True, out)

    return loop


def _select(active: jax.Array, new: jax.Array, old: jax.Array) -> jax.Array:
    return jnp.where(active.reshape(active.shape + (1,) * (new.ndim - active.ndim)), new, old)
