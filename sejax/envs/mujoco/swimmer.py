"""Swimmer-v5."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sejax.envs.mujoco.environment import MujocoEnv, control_cost, plane
from sejax.envs.mujoco.physics import Report


class Env(MujocoEnv):
    r"""Three links in a viscous plane that are paid for swimming along x and never terminate.

    .. math:: r = v_x - 10^{-4} \lVert a \rVert^2

    Observations are the positions without x and y and all velocities, `[8]`; actions are torques,
    `[2]`.

    Source: Gymnasium 1.3, `swimmer_v5`.
    """

    gymnasium_id = "Swimmer-v5"
    file = "swimmer.xml"
    frame_skip = 4
    info_keys = (
        "x_position",
        "y_position",
        "distance_from_origin",
        "x_velocity",
        "y_velocity",
        "reward_forward",
        "reward_ctrl",
    )
    augmented_keys = ("x_position", "y_position", "x_velocity", "y_velocity")

    def draw_start(self, key: Array) -> tuple[Float[Array, "5"], Float[Array, "5"]]:
        return self.noisy_start(key, self.config.reset_noise_scale)

    def observe(self, now: Report) -> Float[Array, "8"]:
        return jnp.concatenate([now.qpos[2:], now.qvel])

    def rewards(
        self, now: Report, action: Float[Array, "2"], healthy: Bool[Array, ""]
    ) -> dict[str, Float[Array, ""]]:
        config = self.config
        return {
            "reward_forward": config.forward_reward_weight * self.velocity(now.qpos_change[0]),
            "reward_ctrl": control_cost(action, config.ctrl_cost_weight),
        }

    def tells(self, now: Report) -> dict[str, Float[Array, ""]]:
        return plane(now.qpos[:2], self.velocity(now.qpos_change[:2]))
