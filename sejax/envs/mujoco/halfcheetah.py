"""HalfCheetah-v5."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sejax.envs.mujoco.environment import MujocoEnv, control_cost
from sejax.envs.mujoco.physics import Report


class Env(MujocoEnv):
    r"""A planar cheetah with six joints that is paid for running forward and never terminates.

    .. math:: r = v_x - 0.1 \lVert a \rVert^2

    Observations are the positions without x and all velocities, `[17]`; actions torques, `[6]`.

    Source: Gymnasium 1.3, `half_cheetah_v5`. Differs: `info` has the name of v3, `reward_run`, for
    what v5 calls `reward_forward`, as sejax's other physics do.
    """

    gymnasium_id = "HalfCheetah-v5"
    file = "half_cheetah.xml"
    frame_skip = 5
    info_keys = ("x_position", "x_velocity", "reward_run", "reward_ctrl")
    augmented_keys = ("x_position", "x_velocity")

    def draw_start(self, key: Array) -> tuple[Float[Array, "9"], Float[Array, "9"]]:
        return self.noisy_start(key, 0.1, normal_velocities=True)

    def observe(self, now: Report) -> Float[Array, "17"]:
        return jnp.concatenate([now.qpos[1:], now.qvel])

    def rewards(
        self, now: Report, action: Float[Array, "6"], healthy: Bool[Array, ""]
    ) -> dict[str, Float[Array, ""]]:
        run = self.velocity(now.qpos_change[0])
        return {"reward_run": run, "reward_ctrl": control_cost(action, 0.1)}

    def tells(self, now: Report) -> dict[str, Float[Array, ""]]:
        return {"x_position": now.qpos[0], "x_velocity": self.velocity(now.qpos_change[0])}
