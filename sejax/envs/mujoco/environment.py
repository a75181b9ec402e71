"""What the MuJoCo tasks have in common: their configuration, and an environment on `Physics`."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, UInt32

from sejax.envs.base import Task
from sejax.envs.environment import Environment, EnvParams, EnvState, Step
from sejax.envs.spec import TaskSpec
from sejax.options import ConfigError, Options

if TYPE_CHECKING:  # it imports mujoco
    from sejax.envs.mujoco.physics import Physics, Report

Scalars = dict[str, Float[Array, ""]]


@dataclass(frozen=True, kw_only=True)
class MujocoTask(Options):
    """A task of Gymnasium: its options, which are keyword arguments there, and its equations.

    A subclass sets the class attributes, defines `rewards`, and overrides what else differs.

    Attributes:
      name: the task's name.
      spec: what is known of the task.
      file: the model's file, one of Gymnasium's.
      frame_skip: MuJoCo's steps in one step.
      num_hidden: how many positions, from the first on, are not observed.
      with_forces: whether external forces are needed.
      normal_velocities: whether a reset draws normal velocities; else they are uniform.
      otherwise: for messages: what helps if MuJoCo cannot be used.
      terminate_when_unhealthy: whether an unhealthy state ends the episode; an option of some tasks
      reset_noise_scale: range or deviation of a reset's noise; an option of some tasks
    """

    group: ClassVar[str] = "env"
    name: ClassVar[str]
    spec: ClassVar[TaskSpec]
    file: ClassVar[str]
    frame_skip: ClassVar[int]
    num_hidden: ClassVar[int] = 1
    with_forces: ClassVar[bool] = False
    normal_velocities: ClassVar[bool] = False
    otherwise: ClassVar[str] = ""
    terminate_when_unhealthy = True
    reset_noise_scale = 0.1

    def make(self) -> Task:
        """The task.

        Raises:
          ConfigError: without the extra `mujoco`, a C++ compiler that works or a CPU as jax's
            default device.
        """
        try:
            import gymnasium  # noqa: F401, whose models are read
            import mujoco  # noqa: F401

            from sejax.envs.mujoco import library

            library.load()
        except (ImportError, ConfigError) as error:
            why = str(error)
            if isinstance(error, ImportError):
                why = f"needs the extra; {error}. Type pip install '.[mujoco]'"
            rule = f"cannot be {self.name}, which {why}{self.otherwise}."
            raise ConfigError("env", rule) from error
        return Task.of(self.spec, name=self.name, env=MujocoEnv(self))

    @property
    def physics(self) -> "Physics":
        """The physics of the task's model."""
        from sejax.envs.mujoco.physics import of_gymnasium

        return of_gymnasium(self.file, self.frame_skip, self.with_forces)

    def draw_start(self, key: Array) -> tuple[Float[Array, " nq"], Float[Array, " nv"]]:
        """Positions and velocities of a reset: the model's own pose at rest, plus noise.

        Noise is uniform in +-`reset_noise_scale`, or normal with that deviation.
        """
        key_qpos, key_qvel = jax.random.split(key)
        model = self.physics.model
        scale = self.reset_noise_scale
        noise = jax.random.uniform(key_qpos, (model.nq,), minval=-scale, maxval=scale)
        qpos = noise + np.float32(model.qpos0)
        if self.normal_velocities:
            return qpos, scale * jax.random.normal(key_qvel, (model.nv,))
        return qpos, jax.random.uniform(key_qvel, (model.nv,), minval=-scale, maxval=scale)

    def observe(self, now: "Report") -> Float[Array, " obs_dim"]:
        """The observation: positions and velocities."""
        return jnp.concatenate([now.qpos[self.num_hidden :], now.qvel])

    def is_healthy(self, now: "Report") -> Bool[Array, ""]:
        """Whether the episode can go on, for tasks that terminate."""
        return jnp.bool_(True)

    def rewards(self, now: "Report", action: Array, healthy: Array) -> Scalars:
        """The parts of the reward, by Gymnasium's names; actions are `[nu]`, `healthy` is `[]`."""
        raise NotImplementedError

    def more_info(self, now: "Report") -> Scalars:
        """More entries of `info`."""
        return {}

    def velocity(self, now: "Report") -> Float[Array, " axes"]:
        """The body's velocity in the step along x and further axes, in m/s."""
        return now.qpos_change / self.physics.dt


@struct.dataclass
class MujocoState(EnvState):
    physics: UInt32[Array, " num_words"]  # a state of `Physics`


class MujocoEnv(Environment[MujocoState, EnvParams]):
    """A task of Gymnasium, equal to it step by step but for rounding to single precision.

    As in Gymnasium, the reward is the sum of the parts that `info` lists. MuJoCo clips actions
    beyond their bounds; the reward charges them unclipped.
    """

    def __init__(self, task: MujocoTask):
        super().__init__(task.spec)
        self.task = task
        self.physics = task.physics

    def reset_env(
        self, key: Array, params: EnvParams
    ) -> tuple[Float[Array, " obs_dim"], MujocoState]:
        state, now = self.physics.reset(*self.task.draw_start(key))
        return self.task.observe(now), MujocoState(physics=state, time=jnp.int32(0))

    def step_env(
        self, key: Array, state: MujocoState, action: Array, params: EnvParams
    ) -> Step[MujocoState]:
        """One control step of `physics.dt` seconds; the key has no effect."""
        action = jnp.asarray(action, jnp.float32)
        after, now = self.physics.step(state.physics, action)
        healthy = self.task.is_healthy(now)
        terminated = ~healthy & self.task.terminate_when_unhealthy
        rewards = self.task.rewards(now, action, healthy)
        info = {**self.task.more_info(now), **rewards, "discount": jnp.where(terminated, 0.0, 1.0)}
        reward = sum(rewards.values(), jnp.float32(0))
        state = MujocoState(physics=after, time=state.time + 1)
        return self.task.observe(now), state, reward, terminated, info
