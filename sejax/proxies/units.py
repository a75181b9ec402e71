"""Units in which an SE's networks see states, by the bounds of the task's observations.

NumPy alone, for `sejax.gym` too.
"""

from typing import Any, NamedTuple

import numpy as np

from sejax.proxies import ABSURD


class Units(NamedTuple):
    """What is 0 for a network, and what is 1 more than that; `[obs_dim]` float32 each."""

    middle: np.ndarray
    one: np.ndarray

    def encode(self, vector: Any) -> Any:
        """A state, in these units."""
        return (vector - self.middle) / self.one

    def decode(self, vector: Any) -> Any:
        """Inverse of `encode`."""
        return vector * self.one + self.middle


def units_of(low: Any, high: Any, obs_dim: int) -> Units:
    """Units by the bounds of a box: one is half of the way from the middle to a bound.

    A number without bounds stays as it is; some spaces write "none" as a huge number.

    Example:
      >>> units_of([-1.2, -np.inf], [0.6, np.inf], 2).one.tolist()
      [0.44999998807907104, 1.0]
    """
    low, high = (np.broadcast_to(np.asarray(x, np.float32), (obs_dim,)) for x in (low, high))
    bounded = (np.abs(low) < ABSURD) & (np.abs(high) < ABSURD)
    low, high = np.where(bounded, low, -2), np.where(bounded, high, 2)
    return Units(((low + high) / 2).astype(np.float32), ((high - low) / 4).astype(np.float32))
