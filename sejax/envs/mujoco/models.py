"""The environments of the MuJoCo tasks.

Source: Gymnasium 1.3, `gymnasium.envs.mujoco`, of each the version 5.
"""

from typing import TYPE_CHECKING, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sejax.envs.mujoco.environment import MujocoEnv, Scalars, control_cost, plane
from sejax.envs.mujoco.physics import Report

if TYPE_CHECKING:
    from sejax.envs.mujoco import tasks


class HalfCheetahEnv(MujocoEnv["tasks.HalfCheetah"]):
    r"""A planar cheetah with six joints that is paid for running forward and never terminates.

    .. math:: r = v_x - 0.1 \lVert a \rVert^2

    Observations are the positions without x and all velocities, `[17]`; actions torques, `[6]`.

    Differs: `info` has the name of v3, `reward_run`, for what v5 calls `reward_forward`, as sejax's
    other physics do.
    """

    file = "half_cheetah.xml"
    frame_skip = 5
    num_hidden = 1
    normal_velocities = True

    def rewards(self, now: Report, action: Array, healthy: Array) -> Scalars:
        return {"reward_run": self.velocity(now)[0], "reward_ctrl": control_cost(action, 0.1)}

    def more_info(self, now: Report) -> Scalars:
        return {"x_position": now.qpos[0], "x_velocity": self.velocity(now)[0]}


Runner = TypeVar("Runner", bound="tasks.Runner")


class RunnerEnv(MujocoEnv[Runner]):
    """What the tasks have in common that pay for moving along x."""

    def rewards(self, now: Report, action: Array, healthy: Array) -> Scalars:
        return {
            "reward_forward": self.config.forward_reward_weight * self.velocity(now)[0],
            "reward_ctrl": control_cost(action, self.config.ctrl_cost_weight),
        }


class HopperEnv(RunnerEnv["tasks.Hopper"]):
    r"""A planar leg with three joints that is paid for hopping forward and for not falling.

    .. math:: r = v_x + 1 - 0.001 \lVert a \rVert^2

    It has fallen, which terminates, below a height of 0.7 m, at an angle beyond 0.2 rad, or where
    another number of the state is beyond 100. Observations are the positions without x and all
    velocities, clipped to [-10, 10], `[11]`; actions torques, `[3]`.
    """

    file = "hopper.xml"
    frame_skip = 4

    def observe_report(self, now: Report) -> Float[Array, " obs_dim"]:
        return jnp.concatenate([now.qpos[1:], jnp.clip(now.qvel, -10, 10)])

    def is_healthy(self, now: Report) -> Bool[Array, ""]:
        height, angle = now.qpos[1], now.qpos[2]
        others = jnp.concatenate([now.qpos[2:], now.qvel])
        return (height > 0.7) & (jnp.abs(angle) < 0.2) & jnp.all(jnp.abs(others) < 100)

    def rewards(self, now: Report, action: Array, healthy: Array) -> Scalars:
        survive = healthy * self.config.healthy_reward
        return {**super().rewards(now, action, healthy), "reward_survive": survive}

    def more_info(self, now: Report) -> Scalars:
        return {
            "x_position": now.qpos[0],
            "x_velocity": self.velocity(now)[0],
            "z_distance_from_origin": now.qpos[1] - self._qpos0[1],
        }


class Walker2dEnv(HopperEnv):
    r"""A planar body on two legs with six joints that is paid for walking and for not falling.

    .. math:: r = v_x + 1 - 0.001 \lVert a \rVert^2

    It has fallen, which terminates, outside heights of 0.8 to 2 m or at an angle beyond 1 rad.
    Observations are as the hopper's, `[17]`; actions torques, `[6]`.
    """

    file = "walker2d_v5.xml"

    def is_healthy(self, now: Report) -> Bool[Array, ""]:
        height, angle = now.qpos[1], now.qpos[2]
        return (height > 0.8) & (height < 2.0) & (jnp.abs(angle) < 1.0)


class SwimmerEnv(RunnerEnv["tasks.Swimmer"]):
    r"""Three links in a viscous plane that are paid for swimming along x and never terminate.

    .. math:: r = v_x - 10^{-4} \lVert a \rVert^2

    Observations are the positions without x and y and all velocities, `[8]`; actions are torques,
    `[2]`.
    """

    file = "swimmer.xml"
    frame_skip = 4
    num_hidden = 2

    def more_info(self, now: Report) -> Scalars:
        return plane(now.qpos, self.velocity(now))


class InvertedPendulumEnv(MujocoEnv["tasks.InvertedPendulum"]):
    """A pole on a cart that is paid 1 for each step after which it stands.

    It has fallen, which terminates, at an angle beyond 0.2 rad. Observations are positions and
    velocities, `[4]`; the action is a force on the cart, `[1]` in [-3, 3].
    """

    file = "inverted_pendulum.xml"
    frame_skip = 2
    num_hidden = 0

    def is_healthy(self, now: Report) -> Bool[Array, ""]:
        return jnp.isfinite(self.observe_report(now)).all() & (jnp.abs(now.qpos[1]) <= 0.2)

    def rewards(self, now: Report, action: Array, healthy: Array) -> Scalars:
        return {"reward_survive": healthy.astype(jnp.float32)}


_TORSO = 1


class AntEnv(RunnerEnv["tasks.Ant"]):
    r"""A body on four legs with eight joints that is paid for walking along x and for its health.

    .. math:: r = v_x + 1 - 0.5 \lVert a \rVert^2 - 5 \cdot 10^{-4} \lVert F \rVert^2

    where F are the forces from without on all bodies, clipped to [-1, 1]. It terminates outside
    heights of 0.2 to 1 m. Observations are the positions without x and y, all velocities and, with
    `include_cfrc_ext_in_observation`, F, `[105]` or `[27]`; actions torques, `[8]`. As in
    Gymnasium, the velocity is that of the torso as MuJoCo computed it last, a part of a step ago.
    """

    file = "ant.xml"
    frame_skip = 5
    num_hidden = 2
    with_forces = True
    normal_velocities = True

    def observe_report(self, now: Report) -> Float[Array, " obs_dim"]:
        obs = super().observe_report(now)
        if not self.config.include_cfrc_ext_in_observation:
            return obs
        return jnp.concatenate([obs, _forces(now)[1:].ravel()])  # the world itself feels none

    def is_healthy(self, now: Report) -> Bool[Array, ""]:
        finite = jnp.isfinite(now.qpos).all() & jnp.isfinite(now.qvel).all()
        return finite & (now.qpos[2] >= 0.2) & (now.qpos[2] <= 1.0)

    def rewards(self, now: Report, action: Array, healthy: Array) -> Scalars:
        config = self.config
        return {
            **super().rewards(now, action, healthy),
            "reward_contact": -config.contact_cost_weight * jnp.sum(_forces(now) ** 2),
            "reward_survive": healthy * config.healthy_reward,
        }

    def more_info(self, now: Report) -> Scalars:
        return plane(now.qpos, self.velocity(now))

    def velocity(self, now: Report) -> Float[Array, "3"]:
        return now.xpos_change[_TORSO] / self.physics.dt


def _forces(now: Report) -> Float[Array, "nbody 6"]:
    return jnp.clip(now.cfrc_ext, -1, 1)


_RADIUS = 0.2  # m, of the disc that the target is in


class ReacherEnv(MujocoEnv["tasks.Reacher"]):
    r"""An arm with two joints that is charged for the distance of its tip x from a target.

    .. math:: r = -\lVert x - x_{target} \rVert - \lVert a \rVert^2

    It never terminates. Observations are cosine and sine of the joints' angles, the target, the
    joints' velocities, and what is between tip and target, `[10]`; actions torques, `[2]`.
    """

    file = "reacher.xml"
    frame_skip = 2

    def __init__(self, config: "tasks.Reacher"):
        super().__init__(config)
        self._tip, self._target = (self.physics.model.body(x).id for x in ("fingertip", "target"))

    def draw_start(self, key: Array) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
        key_arm, key_speed, key_distance, key_angle = jax.random.split(key, 4)
        # Uniform in the disc, where Gymnasium draws from the square until it has hit the disc.
        distance = _RADIUS * jnp.sqrt(jax.random.uniform(key_distance))
        angle = 2 * jnp.pi * jax.random.uniform(key_angle)
        target = distance * jnp.array([jnp.cos(angle), jnp.sin(angle)])
        arm = self._qpos0[:2] + jax.random.uniform(key_arm, (2,), minval=-0.1, maxval=0.1)
        speed = jax.random.uniform(key_speed, (2,), minval=-0.005, maxval=0.005)
        return jnp.concatenate([arm, target]), jnp.concatenate([speed, jnp.zeros(2)])

    def observe_report(self, now: Report) -> Float[Array, "10"]:
        angles, target = now.qpos[:2], now.qpos[2:]
        parts = [jnp.cos(angles), jnp.sin(angles), target, now.qvel[:2], self._miss(now)[:2]]
        return jnp.concatenate(parts)

    def rewards(self, now: Report, action: Array, healthy: Array) -> Scalars:
        config = self.config
        return {
            "reward_dist": -config.reward_dist_weight * jnp.linalg.norm(self._miss(now)),
            "reward_ctrl": control_cost(action, config.reward_control_weight),
        }

    def _miss(self, now: Report) -> Float[Array, "3"]:
        return now.xpos[self._tip] - now.xpos[self._target]
