"""Gymnasium's MuJoCo tasks, v5.

Step limits and solved rewards are those of Gymnasium's registry unless a task says otherwise.
Options are Gymnasium's keyword arguments. Making a task needs MuJoCo, from the extra `mujoco`, and
a C++ compiler.

Source: Gymnasium 1.3, `gymnasium.envs.mujoco`, version 5 of each task.
"""

import io
import math
import warnings
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sejax.envs.base import Task
from sejax.envs.mujoco.environment import MujocoTask, Scalars
from sejax.envs.spec import Box, TaskSpec
from sejax.options import ConfigError, Finite, NonNegative

if TYPE_CHECKING:  # it imports mujoco
    from sejax.envs.mujoco.physics import Report

# The entries of `info` that describe only the state; an observation has no position along x or y.
_STATE_KEYS = ("x_position", "y_position", "x_velocity", "y_velocity")
_ON_A_LINE = ("x_position", "x_velocity")
_REWARD_KEYS = ("reward_forward", "reward_ctrl")
_INFO_OF_WALKERS = (*_ON_A_LINE, "z_distance_from_origin", *_REWARD_KEYS, "reward_survive")
_INFO_IN_A_PLANE = (*_STATE_KEYS[:2], "distance_from_origin", *_STATE_KEYS[2:], *_REWARD_KEYS)


def _spec(
    obs_dim: int, action_dim: int, *, solved_reward: float, info_keys: tuple[str, ...] = ()
) -> TaskSpec:
    return TaskSpec(
        observation=Box.symmetric(*[math.inf] * obs_dim),
        action=Box.symmetric(*[1.0] * action_dim),
        max_steps=1000,
        solved_reward=solved_reward,
        info_keys=info_keys,
        augmented_keys=tuple(key for key in info_keys if key in _STATE_KEYS),
    )


def _control_cost(action: Float[Array, " nu"], weight: float) -> Float[Array, ""]:
    """The part of the reward that charges for control."""
    return -weight * jnp.sum(action**2)


@dataclass(frozen=True, kw_only=True)
class HalfCheetah(MujocoTask):
    r"""A planar cheetah with six joints that is paid for running forward and never terminates.

    .. math:: r = v_x - 0.1 \lVert a \rVert^2

    Observations are the positions without x and all velocities, `[17]`; actions torques, `[6]`.

    Attributes:
      backend: physics

    Source: paper, appendix, fixed hyperparameters (episode length and solved reward).

    Differs: in `info`, `reward_forward` of v5 is called `reward_run`, as in v3 and in sejax's other
    physics.
    """

    name = "halfcheetah"
    file = "half_cheetah.xml"
    frame_skip = 5
    normal_velocities = True
    otherwise = ", or set env.backend=mjx"
    spec = _spec(17, 6, solved_reward=3000.0, info_keys=(*_ON_A_LINE, "reward_run", "reward_ctrl"))

    backend: Literal["mujoco", "mjx", "spring"] = "mujoco"

    def make(self) -> Task:
        if self.backend == "mujoco":
            return super().make()
        try:
            # On import brax prints notes on other physics and warns of its own envs.
            with warnings.catch_warnings(action="ignore"), redirect_stdout(io.StringIO()):
                from sejax.envs.mujoco.brax import BraxHalfCheetahEnv

                brax_env = BraxHalfCheetahEnv(self)
        except ImportError as error:
            needs = f"needs brax ({error}). Run pip install '.[brax]'."
            raise ConfigError("env.backend", needs) from error
        return Task.of(self.spec, name=self.name, env=brax_env)

    def rewards(self, now: "Report", action: Array, healthy: Array) -> Scalars:
        return {"reward_run": self.velocity(now)[0], "reward_ctrl": _control_cost(action, 0.1)}

    def more_info(self, now: "Report") -> Scalars:
        return {"x_position": now.qpos[0], "x_velocity": self.velocity(now)[0]}


@dataclass(frozen=True, kw_only=True)
class Runner(MujocoTask):
    """The common part of tasks that pay for moving along x and charge for torque."""

    forward_reward_weight: Finite = 1.0
    ctrl_cost_weight: NonNegative = 1e-3
    reset_noise_scale: NonNegative = 0.1

    def rewards(self, now: "Report", action: Array, healthy: Array) -> Scalars:
        return {
            "reward_forward": self.forward_reward_weight * self.velocity(now)[0],
            "reward_ctrl": _control_cost(action, self.ctrl_cost_weight),
        }

    def more_info(self, now: "Report") -> Scalars:
        """The entries for a body that moves in a plane; x and y are the first axes."""
        velocity = self.velocity(now)
        return {
            "x_position": now.qpos[0],
            "y_position": now.qpos[1],
            "distance_from_origin": jnp.linalg.norm(now.qpos[:2]),
            "x_velocity": velocity[0],
            "y_velocity": velocity[1],
        }


@dataclass(frozen=True, kw_only=True)
class Hopper(Runner):
    r"""A planar leg with three joints that is paid for hopping forward and for not falling.

    .. math:: r = v_x + 1 - 0.001 \lVert a \rVert^2

    A fall terminates: a height below 0.7 m, an angle beyond 0.2 rad, or another number of the state
    beyond 100. Observations are the positions without x and all velocities, clipped to [-10, 10],
    `[11]`; actions torques, `[3]`.
    """

    name = "hopper"
    file = "hopper.xml"
    frame_skip = 4
    spec = _spec(11, 3, solved_reward=3800.0, info_keys=_INFO_OF_WALKERS)

    healthy_reward: Finite = 1.0
    terminate_when_unhealthy: bool = True
    reset_noise_scale: NonNegative = 5e-3

    def observe(self, now: "Report") -> Float[Array, " obs_dim"]:
        return jnp.concatenate([now.qpos[1:], jnp.clip(now.qvel, -10, 10)])

    def is_healthy(self, now: "Report") -> Bool[Array, ""]:
        height, angle = now.qpos[1], now.qpos[2]
        others = jnp.concatenate([now.qpos[2:], now.qvel])
        return (height > 0.7) & (jnp.abs(angle) < 0.2) & jnp.all(jnp.abs(others) < 100)

    def rewards(self, now: "Report", action: Array, healthy: Array) -> Scalars:
        reward_survive = healthy * self.healthy_reward
        return {**super().rewards(now, action, healthy), "reward_survive": reward_survive}

    def more_info(self, now: "Report") -> Scalars:
        return {
            "x_position": now.qpos[0],
            "x_velocity": self.velocity(now)[0],
            "z_distance_from_origin": now.qpos[1] - np.float32(self.physics.model.qpos0[1]),
        }


class Walker2d(Hopper):
    r"""A planar body on two legs with six joints that is paid for walking and for not falling.

    .. math:: r = v_x + 1 - 0.001 \lVert a \rVert^2

    A fall terminates: a height outside of 0.8 to 2 m, or an angle beyond 1 rad.
    Observations are as the hopper's, `[17]`; actions torques, `[6]`.

    Gymnasium has no reward threshold for it. The solved reward is our choice, below the 4,683 that
    TD3's authors report after 1e6 steps (Fujimoto et al., 2018, table 1).
    """

    name = "walker2d"
    file = "walker2d_v5.xml"
    spec = _spec(17, 6, solved_reward=4000.0, info_keys=_INFO_OF_WALKERS)

    def is_healthy(self, now: "Report") -> Bool[Array, ""]:
        height, angle = now.qpos[1], now.qpos[2]
        return (height > 0.8) & (height < 2.0) & (jnp.abs(angle) < 1.0)


@dataclass(frozen=True, kw_only=True)
class Swimmer(Runner):
    r"""Three links in a viscous plane that are paid for swimming along x and never terminate.

    .. math:: r = v_x - 10^{-4} \lVert a \rVert^2

    Observations are the positions without x and y and all velocities, `[8]`; actions are torques,
    `[2]`.
    """

    name = "swimmer"
    file = "swimmer.xml"
    frame_skip = 4
    num_hidden = 2
    spec = _spec(8, 2, solved_reward=360.0, info_keys=_INFO_IN_A_PLANE)

    ctrl_cost_weight: NonNegative = 1e-4


@dataclass(frozen=True, kw_only=True)
class InvertedPendulum(MujocoTask):
    """A pole on a cart that is paid 1 for each step after which it stands.

    A fall terminates: an angle beyond 0.2 rad. Observations are positions and velocities, `[4]`;
    the action is a force on the cart, `[1]` in [-3, 3].
    """

    name = "inverted_pendulum"
    file = "inverted_pendulum.xml"
    frame_skip = 2
    num_hidden = 0
    spec = replace(_spec(4, 1, solved_reward=950.0), action=Box.symmetric(3.0))

    reset_noise_scale: NonNegative = 0.01

    def is_healthy(self, now: "Report") -> Bool[Array, ""]:
        return jnp.isfinite(self.observe(now)).all() & (jnp.abs(now.qpos[1]) <= 0.2)

    def rewards(self, now: "Report", action: Array, healthy: Array) -> Scalars:
        return {"reward_survive": healthy.astype(jnp.float32)}


_TORSO = 1


@dataclass(frozen=True, kw_only=True)
class Ant(Runner):
    r"""A body on four legs with eight joints that is paid for walking along x and for its health.

    .. math:: r = v_x + 1 - 0.5 \lVert a \rVert^2 - 5 \cdot 10^{-4} \lVert F \rVert^2

    where F are the external forces on all bodies, clipped to [-1, 1]. It terminates outside heights
    of 0.2 to 1 m. Observations are the positions without x and y and all velocities, `[27]`; with
    `include_cfrc_ext_in_observation` also F, `[105]`. Actions are torques, `[8]`. As in Gymnasium,
    the velocity is that of the torso as MuJoCo computed it last, a part of a step ago.

    Attributes:
      include_cfrc_ext_in_observation: external forces on each body
    """

    name = "ant"
    file = "ant.xml"
    frame_skip = 5
    num_hidden = 2
    with_forces = True
    normal_velocities = True

    ctrl_cost_weight: NonNegative = 0.5
    contact_cost_weight: NonNegative = 5e-4
    healthy_reward: Finite = 1.0
    terminate_when_unhealthy: bool = True
    include_cfrc_ext_in_observation: bool = True

    @property
    def spec(self) -> TaskSpec:  # type: ignore[override]
        obs_dim = 105 if self.include_cfrc_ext_in_observation else 27
        info_keys = (*_INFO_IN_A_PLANE, "reward_contact", "reward_survive")
        return _spec(obs_dim, 8, solved_reward=6000.0, info_keys=info_keys)

    def observe(self, now: "Report") -> Float[Array, " obs_dim"]:
        obs = super().observe(now)
        if not self.include_cfrc_ext_in_observation:
            return obs
        return jnp.concatenate([obs, _forces(now)[1:].ravel()])  # the first body is the world

    def is_healthy(self, now: "Report") -> Bool[Array, ""]:
        is_finite = jnp.isfinite(now.qpos).all() & jnp.isfinite(now.qvel).all()
        return is_finite & (now.qpos[2] >= 0.2) & (now.qpos[2] <= 1.0)

    def rewards(self, now: "Report", action: Array, healthy: Array) -> Scalars:
        return {
            **super().rewards(now, action, healthy),
            "reward_contact": -self.contact_cost_weight * jnp.sum(_forces(now) ** 2),
            "reward_survive": healthy * self.healthy_reward,
        }

    def velocity(self, now: "Report") -> Float[Array, "3"]:
        return now.xpos_change[_TORSO] / self.physics.dt


def _forces(now: "Report") -> Float[Array, "nbody 6"]:
    return jnp.clip(now.cfrc_ext, -1, 1)


_RADIUS = 0.2  # m, of the disc that the target is in


@dataclass(frozen=True, kw_only=True)
class Reacher(MujocoTask):
    r"""An arm with two joints that is charged for the distance of its tip x from a target.

    .. math:: r = -\lVert x - x_{target} \rVert - \lVert a \rVert^2

    It never terminates. Observations are cosine and sine of the joints' angles, the target, the
    joints' velocities, and the vector from target to tip, `[10]`; actions torques, `[2]`.
    """

    name = "reacher"
    file = "reacher.xml"
    frame_skip = 2
    spec = replace(
        _spec(10, 2, solved_reward=-3.75, info_keys=("reward_dist", "reward_ctrl")), max_steps=50
    )

    reward_dist_weight: NonNegative = 1.0
    reward_control_weight: NonNegative = 1.0

    def draw_start(self, key: Array) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
        key_arm, key_speed, key_distance, key_angle = jax.random.split(key, 4)
        # Uniform in the disc; Gymnasium draws from the square until it hits the disc.
        distance = _RADIUS * jnp.sqrt(jax.random.uniform(key_distance))
        angle = 2 * jnp.pi * jax.random.uniform(key_angle)
        target = distance * jnp.array([jnp.cos(angle), jnp.sin(angle)])
        pose = np.float32(self.physics.model.qpos0[:2])
        arm = pose + jax.random.uniform(key_arm, (2,), minval=-0.1, maxval=0.1)
        speed = jax.random.uniform(key_speed, (2,), minval=-0.005, maxval=0.005)
        return jnp.concatenate([arm, target]), jnp.concatenate([speed, jnp.zeros(2)])

    def observe(self, now: "Report") -> Float[Array, "10"]:
        angles, target = now.qpos[:2], now.qpos[2:]
        parts = [jnp.cos(angles), jnp.sin(angles), target, now.qvel[:2], self._miss(now)[:2]]
        return jnp.concatenate(parts)

    def rewards(self, now: "Report", action: Array, healthy: Array) -> Scalars:
        return {
            "reward_dist": -self.reward_dist_weight * jnp.linalg.norm(self._miss(now)),
            "reward_ctrl": _control_cost(action, self.reward_control_weight),
        }

    def _miss(self, now: "Report") -> Float[Array, "3"]:
        tip, target = (self.physics.model.body(name).id for name in ("fingertip", "target"))
        return now.xpos[tip] - now.xpos[target]
