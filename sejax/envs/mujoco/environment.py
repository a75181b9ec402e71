"""What the MuJoCo tasks have in common: an environment on `Physics`."""

from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, UInt32

from sejax.envs.environment import Environment, EnvParams, EnvState
from sejax.envs.mujoco import physics
from sejax.envs.mujoco.physics import Report

if TYPE_CHECKING:
    from sejax.envs.mujoco.tasks import MujocoTask

Rewards = dict[str, Float[Array, ""]]


@struct.dataclass
class MujocoState(EnvState):
    physics: UInt32[Array, " num_words"]  # as of `Physics`
    time: Array | int


@struct.dataclass
class MujocoParams(EnvParams):
    max_steps_in_episode: int = 1000


class MujocoEnv(Environment):
    """A task of Gymnasium, equal to it step by step but for rounding to single precision.

    A subclass says what is in the class attributes and in the methods `draw_start`, `observe`,
    `is_healthy`, `rewards` and `tells`. As in Gymnasium, the reward is the sum of the parts that
    `info` lists, and actions beyond their bounds are clipped by MuJoCo and charged as they are.

    Attributes:
      config: the task's configuration, whose fields are Gymnasium's keyword arguments.
      physics: of its model.
    """

    gymnasium_id: ClassVar[str]
    file: ClassVar[str]  # of the model, among Gymnasium's
    frame_skip: ClassVar[int]
    with_forces: ClassVar[bool] = False  # whether external forces are needed

    def __init__(self, config: "MujocoTask"):
        self.config: Any = config  # a subclass reads its own options
        self.spaces = config.spec.observation, config.spec.action
        self.physics = physics.of_gymnasium(self.file, self.frame_skip, self.with_forces)
        self._qpos0 = np.asarray(self.physics.model.qpos0, np.float32)

    def draw_start(self, key: Array) -> tuple[Float[Array, " nq"], Float[Array, " nv"]]:
        """Positions and velocities of a reset."""
        raise NotImplementedError

    def observe(self, now: Report) -> Float[Array, " obs_dim"]:
        """The observation."""
        raise NotImplementedError

    def is_healthy(self, now: Report) -> Bool[Array, ""]:
        """Whether the episode can go on, for tasks that terminate."""
        return jnp.bool_(True)

    def rewards(self, now: Report, action: Array, healthy: Array) -> Rewards:
        """The parts of the reward of an action `[nu]`, by Gymnasium's names."""
        raise NotImplementedError

    def tells(self, now: Report) -> dict[str, Float[Array, ""]]:
        """What else is in `info`."""
        return {}

    def noisy_start(
        self, key: Array, scale: float, normal_velocities: bool = False
    ) -> tuple[Float[Array, " nq"], Float[Array, " nv"]]:
        """The model's own pose at rest and noise: uniform in +-`scale`, or with that deviation."""
        key_qpos, key_qvel = jax.random.split(key)
        nq, nv = self.physics.model.nq, self.physics.model.nv
        qpos = jax.random.uniform(key_qpos, (nq,), minval=-scale, maxval=scale) + self._qpos0
        if normal_velocities:
            return qpos, scale * jax.random.normal(key_qvel, (nv,))
        return qpos, jax.random.uniform(key_qvel, (nv,), minval=-scale, maxval=scale)

    def velocity(self, change: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Of something that changed in a step."""
        return change / self.physics.dt

    @property
    def default_params(self) -> MujocoParams:
        return MujocoParams()

    def reset_env(
        self, key: Array, params: MujocoParams
    ) -> tuple[Float[Array, " obs_dim"], MujocoState]:
        state, now = self.physics.reset(*self.draw_start(key))
        return self.observe(now), MujocoState(physics=state, time=jnp.int32(0))

    def step_env(
        self, key: Array | None, state: MujocoState, action: Array, params: MujocoParams
    ) -> tuple[Float[Array, " obs_dim"], MujocoState, Array, Array, dict[Any, Any]]:
        """One control step of `physics.dt` seconds; the key has no effect."""
        action = jnp.asarray(action, jnp.float32)
        after, now = self.physics.step(state.physics, action)
        healthy = self.is_healthy(now)
        terminated = ~healthy & self.config.terminate_when_unhealthy
        rewards = self.rewards(now, action, healthy)
        discount = jnp.where(terminated, 0.0, 1.0)
        info = {**self.tells(now), **rewards, "discount": discount}
        reward = sum(rewards.values(), jnp.float32(0))
        state = MujocoState(physics=after, time=state.time + 1)
        return self.observe(now), state, reward, terminated, info

    def is_terminated(self, state: MujocoState, params: MujocoParams) -> Array:
        """False: whether a step terminates is known when it is made."""
        return jnp.bool_(False)

    @property
    def name(self) -> str:
        return self.gymnasium_id


def control_cost(action: Float[Array, " nu"], weight: float) -> Float[Array, ""]:
    """The part of the reward that charges for control."""
    return -weight * jnp.sum(action**2)


def plane(position: Float[Array, "2"], velocity: Float[Array, "2"]) -> dict[str, Float[Array, ""]]:
    """What Gymnasium tells of a body that moves in a plane."""
    return {
        "x_position": position[0],
        "y_position": position[1],
        "distance_from_origin": jnp.linalg.norm(position),
        "x_velocity": velocity[0],
        "y_velocity": velocity[1],
    }
