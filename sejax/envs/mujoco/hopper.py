"""Hopper-v5."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sejax.envs.mujoco.environment import MujocoEnv, control_cost
from sejax.envs.mujoco.physics import Report


class Env(MujocoEnv):
    r"""A planar leg with three joints that is paid for hopping forward and for not falling.

    .. math:: r = v_x + 1 - 0.001 \lVert a \rVert^2

    It has fallen, which terminates, below a height of 0.7 m, at an angle beyond 0.2 rad, or where
    another number of the state is beyond 100. Observations are the positions without x and all
    velocities, clipped to [-10, 10], `[11]`; actions torques, `[3]`.

    Source: Gymnasium 1.3, `hopper_v5`.
    """

    gymnasium_id = "Hopper-v5"
    file = "hopper.xml"
    frame_skip = 4
    info_keys = (
        "x_position",
        "x_velocity",
        "z_distance_from_origin",
        "reward_forward",
        "reward_ctrl",
        "reward_survive",
    )
    augmented_keys = ("x_position", "x_velocity")

    def draw_start(self, key: Array) -> tuple[Float[Array, " nq"], Float[Array, " nv"]]:
        return self.noisy_start(key, self.config.reset_noise_scale)

    def observe(self, now: Report) -> Float[Array, " obs_dim"]:
        return jnp.concatenate([now.qpos[1:], jnp.clip(now.qvel, -10, 10)])

    def is_healthy(self, now: Report) -> Bool[Array, ""]:
        height, angle = now.qpos[1], now.qpos[2]
        others = jnp.concatenate([now.qpos[2:], now.qvel])
        return (height > 0.7) & (jnp.abs(angle) < 0.2) & jnp.all(jnp.abs(others) < 100)

    def rewards(
        self, now: Report, action: Float[Array, " nu"], healthy: Bool[Array, ""]
    ) -> dict[str, Float[Array, ""]]:
        config = self.config
        return {
            "reward_forward": config.forward_reward_weight * self.velocity(now.qpos_change[0]),
            "reward_ctrl": control_cost(action, config.ctrl_cost_weight),
            "reward_survive": healthy * config.healthy_reward,
        }

    def tells(self, now: Report) -> dict[str, Float[Array, ""]]:
        return {
            "x_position": now.qpos[0],
            "x_velocity": self.velocity(now.qpos_change[0]),
            "z_distance_from_origin": now.qpos[1] - self._qpos0[1],
        }
