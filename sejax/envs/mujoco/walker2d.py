"""Walker2d-v5."""

import jax.numpy as jnp
from jaxtyping import Array, Bool

from sejax.envs.mujoco import hopper
from sejax.envs.mujoco.physics import Report


class Env(hopper.Env):
    r"""A planar body on two legs with six joints that is paid for walking and for not falling.

    .. math:: r = v_x + 1 - 0.001 \lVert a \rVert^2

    It has fallen, which terminates, outside heights of 0.8 to 2 m or at an angle beyond 1 rad.
    Observations are as the hopper's, `[17]`; actions torques, `[6]`.

    Source: Gymnasium 1.3, `walker2d_v5`.
    """

    gymnasium_id = "Walker2d-v5"
    file = "walker2d_v5.xml"

    def is_healthy(self, now: Report) -> Bool[Array, ""]:
        height, angle = now.qpos[1], now.qpos[2]
        return (height > 0.8) & (height < 2.0) & (jnp.abs(angle) < 1.0)
