"""InvertedPendulum-v5."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sejax.envs.mujoco.environment import MujocoEnv
from sejax.envs.mujoco.physics import Report


class Env(MujocoEnv):
    """A pole on a cart that is paid 1 for each step after which it stands.

    It has fallen, which terminates, at an angle beyond 0.2 rad. Observations are positions and
    velocities, `[4]`; the action is a force on the cart, `[1]` in [-3, 3].

    Source: Gymnasium 1.3, `inverted_pendulum_v5`.
    """

    gymnasium_id = "InvertedPendulum-v5"
    file = "inverted_pendulum.xml"
    frame_skip = 2

    def draw_start(self, key: Array) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        return self.noisy_start(key, self.config.reset_noise_scale)

    def observe(self, now: Report) -> Float[Array, "4"]:
        return jnp.concatenate([now.qpos, now.qvel])

    def is_healthy(self, now: Report) -> Bool[Array, ""]:
        return jnp.isfinite(self.observe(now)).all() & (jnp.abs(now.qpos[1]) <= 0.2)

    def rewards(
        self, now: Report, action: Float[Array, "1"], healthy: Bool[Array, ""]
    ) -> dict[str, Float[Array, ""]]:
        return {"reward_survive": healthy.astype(jnp.float32)}
