"""Reacher-v5."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sejax.envs.mujoco.environment import MujocoEnv, control_cost
from sejax.envs.mujoco.physics import Report

RADIUS = 0.2  # m, of the disc that the target is in


class Env(MujocoEnv):
    r"""An arm with two joints that is charged for the distance of its tip x from a target.

    .. math:: r = -\lVert x - x_{target} \rVert - \lVert a \rVert^2

    It never terminates. Observations are cosine and sine of the joints' angles, the target, the
    joints' velocities, and what is between tip and target, `[10]`; actions torques, `[2]`.

    Source: Gymnasium 1.3, `reacher_v5`.
    """

    gymnasium_id = "Reacher-v5"
    file = "reacher.xml"
    frame_skip = 2
    info_keys = ("reward_dist", "reward_ctrl")

    def __init__(self, config: object):
        super().__init__(config)
        self._tip, self._target = (self.physics.model.body(x).id for x in ("fingertip", "target"))

    def draw_start(self, key: Array) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
        key_arm, key_speed, key_distance, key_angle = jax.random.split(key, 4)
        # Uniform in the disc, where Gymnasium draws from the square until it has hit the disc.
        distance = RADIUS * jnp.sqrt(jax.random.uniform(key_distance))
        angle = 2 * jnp.pi * jax.random.uniform(key_angle)
        target = distance * jnp.array([jnp.cos(angle), jnp.sin(angle)])
        arm = self._qpos0[:2] + jax.random.uniform(key_arm, (2,), minval=-0.1, maxval=0.1)
        speed = jax.random.uniform(key_speed, (2,), minval=-0.005, maxval=0.005)
        return jnp.concatenate([arm, target]), jnp.concatenate([speed, jnp.zeros(2)])

    def observe(self, now: Report) -> Float[Array, "10"]:
        angles, target = now.qpos[:2], now.qpos[2:]
        parts = [jnp.cos(angles), jnp.sin(angles), target, now.qvel[:2], self._miss(now)[:2]]
        return jnp.concatenate(parts)

    def rewards(
        self, now: Report, action: Float[Array, "2"], healthy: Bool[Array, ""]
    ) -> dict[str, Float[Array, ""]]:
        config = self.config
        return {
            "reward_dist": -config.reward_dist_weight * jnp.linalg.norm(self._miss(now)),
            "reward_ctrl": control_cost(action, config.reward_control_weight),
        }

    def _miss(self, now: Report) -> Float[Array, "3"]:
        return now.xpos[self._tip] - now.xpos[self._target]
