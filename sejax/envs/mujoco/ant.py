"""Ant-v5."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sejax.envs.mujoco.environment import MujocoEnv, control_cost, plane
from sejax.envs.mujoco.physics import Report

TORSO = 1


class Env(MujocoEnv):
    r"""A body on four legs with eight joints that is paid for walking along x and for its health.

    .. math:: r = v_x + 1 - 0.5 \lVert a \rVert^2 - 5 \cdot 10^{-4} \lVert F \rVert^2

    where F are the forces from without on all bodies, clipped to [-1, 1]. It terminates outside
    heights of 0.2 to 1 m. Observations are the positions without x and y, all velocities and, with
    `include_cfrc_ext_in_observation`, F, `[105]` or `[27]`; actions torques, `[8]`. As in
    Gymnasium, the velocity is that of the torso as MuJoCo computed it last, a part of a step ago.

    Source: Gymnasium 1.3, `ant_v5`.
    """

    gymnasium_id = "Ant-v5"
    file = "ant.xml"
    frame_skip = 5
    with_forces = True
    info_keys = (
        "x_position",
        "y_position",
        "distance_from_origin",
        "x_velocity",
        "y_velocity",
        "reward_forward",
        "reward_ctrl",
        "reward_contact",
        "reward_survive",
    )
    augmented_keys = ("x_position", "y_position", "x_velocity", "y_velocity")

    def draw_start(self, key: Array) -> tuple[Float[Array, "15"], Float[Array, "14"]]:
        return self.noisy_start(key, self.config.reset_noise_scale, normal_velocities=True)

    def observe(self, now: Report) -> Float[Array, " obs_dim"]:
        parts = [now.qpos[2:], now.qvel]
        if self.config.include_cfrc_ext_in_observation:
            parts.append(_forces(now)[1:].ravel())  # the world itself feels none
        return jnp.concatenate(parts)

    def is_healthy(self, now: Report) -> Bool[Array, ""]:
        finite = jnp.isfinite(now.qpos).all() & jnp.isfinite(now.qvel).all()
        return finite & (now.qpos[2] >= 0.2) & (now.qpos[2] <= 1.0)

    def rewards(
        self, now: Report, action: Float[Array, "8"], healthy: Bool[Array, ""]
    ) -> dict[str, Float[Array, ""]]:
        config = self.config
        return {
            "reward_forward": config.forward_reward_weight * self._velocity(now)[0],
            "reward_ctrl": control_cost(action, config.ctrl_cost_weight),
            "reward_contact": -config.contact_cost_weight * jnp.sum(_forces(now) ** 2),
            "reward_survive": healthy * config.healthy_reward,
        }

    def tells(self, now: Report) -> dict[str, Float[Array, ""]]:
        return plane(now.qpos[:2], self._velocity(now))

    def _velocity(self, now: Report) -> Float[Array, "2"]:
        return self.velocity(now.xpos_change[TORSO, :2])


def _forces(now: Report) -> Float[Array, "nbody 6"]:
    return jnp.clip(now.cfrc_ext, -1, 1)
