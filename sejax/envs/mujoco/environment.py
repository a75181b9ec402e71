"""What the MuJoCo tasks have in common: an environment on `Physics`."""

from typing import TYPE_CHECKING, ClassVar, Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, UInt32

from sejax.envs.environment import Environment, EnvParams, EnvState, Step
from sejax.envs.mujoco import physics
from sejax.envs.mujoco.physics import Report

if TYPE_CHECKING:
    from sejax.envs.mujoco.tasks import MujocoTask

Config = TypeVar("Config", bound="MujocoTask")
Scalars = dict[str, Float[Array, ""]]


@struct.dataclass
class MujocoState(EnvState):
    physics: UInt32[Array, " num_words"]  # as of `Physics`


class MujocoEnv(Environment[MujocoState, EnvParams], Generic[Config]):
    """A task of Gymnasium, equal to it step by step but for rounding to single precision.

    A subclass says what is in the class attributes and in the methods `rewards`, `is_healthy`,
    `more_info` and `observe_report`. As in Gymnasium, the reward is the sum of the parts
    that `info` lists, and actions beyond their bounds are clipped by MuJoCo and charged as they
    are.

    Attributes:
      config: the task's configuration, whose fields are Gymnasium's keyword arguments.
      physics: of its model.
    """

    file: ClassVar[str]  # of the model, among Gymnasium's
    frame_skip: ClassVar[int]
    num_hidden: ClassVar[int]  # positions that are not observed, the first ones
    with_forces: ClassVar[bool] = False  # whether external forces are needed
    normal_velocities: ClassVar[bool] = False  # those of a reset, else uniform

    def __init__(self, config: Config):
        super().__init__(config.spec)
        self.config = config
        self.physics = physics.of_gymnasium(self.file, self.frame_skip, self.with_forces)
        self._qpos0 = np.asarray(self.physics.model.qpos0, np.float32)

    def draw_start(self, key: Array) -> tuple[Float[Array, " nq"], Float[Array, " nv"]]:
        """Positions and velocities of a reset: the model's own pose at rest, and noise.

        Noise is uniform in +-`config.reset_noise_scale`, or normal with that deviation.
        """
        key_qpos, key_qvel = jax.random.split(key)
        nq, nv, scale = self.physics.model.nq, self.physics.model.nv, self.config.reset_noise_scale
        qpos = jax.random.uniform(key_qpos, (nq,), minval=-scale, maxval=scale) + self._qpos0
        if self.normal_velocities:
            return qpos, scale * jax.random.normal(key_qvel, (nv,))
        return qpos, jax.random.uniform(key_qvel, (nv,), minval=-scale, maxval=scale)

    def observe_report(self, now: Report) -> Float[Array, " obs_dim"]:
        """The observation: positions and velocities."""
        return jnp.concatenate([now.qpos[self.num_hidden :], now.qvel])

    def is_healthy(self, now: Report) -> Bool[Array, ""]:
        """Whether the episode can go on, for tasks that terminate."""
        return jnp.bool_(True)

    def rewards(
        self, now: Report, action: Float[Array, " nu"], healthy: Bool[Array, ""]
    ) -> Scalars:
        """The parts of the reward, by Gymnasium's names."""
        raise NotImplementedError

    def more_info(self, now: Report) -> Scalars:
        """What else is in `info`."""
        return {}

    def velocity(self, now: Report) -> Float[Array, " axes"]:
        """The body's velocity in the step along x and further axes, in m/s."""
        return now.qpos_change / self.physics.dt

    def reset_env(
        self, key: Array, params: EnvParams
    ) -> tuple[Float[Array, " obs_dim"], MujocoState]:
        state, now = self.physics.reset(*self.draw_start(key))
        return self.observe_report(now), MujocoState(physics=state, time=jnp.int32(0))

    def step_env(
        self, key: Array, state: MujocoState, action: Array, params: EnvParams
    ) -> Step[MujocoState]:
        """One control step of `physics.dt` seconds; the key has no effect."""
        action = jnp.asarray(action, jnp.float32)
        after, now = self.physics.step(state.physics, action)
        healthy = self.is_healthy(now)
        terminated = ~healthy & self.config.terminate_when_unhealthy
        rewards = self.rewards(now, action, healthy)
        info = {**self.more_info(now), **rewards, "discount": jnp.where(terminated, 0.0, 1.0)}
        reward = sum(rewards.values(), jnp.float32(0))
        state = MujocoState(physics=after, time=state.time + 1)
        return self.observe_report(now), state, reward, terminated, info


def control_cost(action: Float[Array, " nu"], weight: float) -> Float[Array, ""]:
    """The part of the reward that charges for control."""
    return -weight * jnp.sum(action**2)


def plane(position: Float[Array, " axes"], velocity: Float[Array, " axes"]) -> Scalars:
    """What Gymnasium's `info` has of a body that moves in a plane; x and y are the first axes."""
    return {
        "x_position": position[0],
        "y_position": position[1],
        "distance_from_origin": jnp.linalg.norm(position[:2]),
        "x_velocity": velocity[0],
        "y_velocity": velocity[1],
    }
