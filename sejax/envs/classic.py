"""The classic control tasks: gymnax's dynamics, and our own for the continuous mountain car.

Source: Gymnasium 1.3, `gymnasium.envs.classic_control`; gymnax 1.0,
`gymnax.environments.classic_control`. Step limits and solved rewards of cartpole, acrobot and
mountain_car_continuous: paper, appendix, fixed hyperparameters. Those of the other tasks:
Gymnasium's registry.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool

from sejax.envs.base import Task
from sejax.envs.environment import Environment, EnvParams, EnvState, Step
from sejax.envs.spec import Box, Discrete, TaskSpec
from sejax.envs.wrappers import Wrapper


class GymnaxEnv(Wrapper[EnvState, EnvParams]):
    """An environment of gymnax, with the spaces and the step limit of a spec."""

    def __init__(self, env: Environment, spec: TaskSpec):
        self.env = env
        Environment.__init__(self, spec, env.default_params)

    default_params = Environment.default_params

    def step_env(
        self, key: Array, state: EnvState, action: Array, params: EnvParams
    ) -> Step[EnvState]:
        return self.env.step_env(key, state, jnp.reshape(action, ()), params)  # it may be `[1]`


@struct.dataclass
class CarState(EnvState):
    position: Array
    velocity: Array  # per step


@struct.dataclass
class CarParams(EnvParams):
    min_position: float = -1.2
    max_position: float = 0.6
    max_speed: float = 0.07
    goal_position: float = 0.45
    goal_velocity: float = 0.0
    gravity: float = 0.0025
    min_action: float = -1.0
    max_action: float = 1.0
    power: float = 0.0015


class MountainCarContinuousEnv(Environment[CarState, CarParams]):
    r"""A car with an engine that is costly to use.

    .. math::
        v' &= clip(v + 0.0015\, clip(a, -1, 1) - 0.0025 \cos 3x,\ \pm 0.07) \\
        x' &= clip(x + v',\ -1.2,\ 0.6) \\
        r &= 100 [x' \ge 0.45 \wedge v' \ge 0] - 0.1 a^2

    The left wall stops the car: v' = 0 where x' = -1.2 and v' < 0. The goal terminates. As in
    Gymnasium the action, `[1]` or `[]`, is charged before it is clipped.

    Differs: gymnax does not stop the car at that wall, and stops a car that rolls back over the
    goal.
    """

    def step_env(
        self, key: Array, state: CarState, action: Array, params: CarParams
    ) -> Step[CarState]:
        action = jnp.reshape(action, ())
        force = jnp.clip(action, params.min_action, params.max_action)
        acceleration = params.power * force - params.gravity * jnp.cos(3 * state.position)
        velocity = jnp.clip(state.velocity + acceleration, -params.max_speed, params.max_speed)
        position = jnp.clip(state.position + velocity, params.min_position, params.max_position)
        velocity = jnp.where((position <= params.min_position) & (velocity < 0), 0.0, velocity)
        state = CarState(position=position, velocity=velocity, time=state.time + 1)
        reward = jnp.where(self.is_terminated(state, params), 100.0, 0.0) - 0.1 * action**2
        return self.after(state, reward, params)

    def start(self, key: Array) -> CarState:
        position = jax.random.uniform(key, minval=-0.6, maxval=-0.4)
        return CarState(position=position, velocity=jnp.array(0.0), time=0)

    def observe(self, state: CarState) -> Array:
        return jnp.array([state.position, state.velocity])

    def is_terminated(self, state: CarState, params: CarParams) -> Bool[Array, ""]:
        return (state.position >= params.goal_position) * (state.velocity >= params.goal_velocity)


# --- the tasks -----------------------------------------------------------------------------------

_NONE = 3.4028234663852886e38  # how CartPole writes that a number has no bound
_CARTPOLE = Box.symmetric(4.8, _NONE, math.radians(24), _NONE)
_ACROBOT = Box.symmetric(1.0, 1.0, 1.0, 1.0, 4 * math.pi, 9 * math.pi)
_PENDULUM = Box.symmetric(1.0, 1.0, 8.0)
_TORQUE = Box.symmetric(2.0)
_CAR = Box(low=(-1.2, -0.07), high=(0.6, 0.07))  # position and velocity


@dataclass(frozen=True)
class ClassicTask:
    """A task without options.

    Attributes:
      name: the task's name.
      gymnax_id: gymnax's id of the dynamics.
      spec: the task's spec.
    """

    name: ClassVar[str]
    gymnax_id: ClassVar[str]
    spec: ClassVar[TaskSpec]

    def make(self) -> Task:
        import gymnax  # a second of CPU time, which bad input should not cost

        env, _ = gymnax.make(self.gymnax_id)
        return Task.of(self.spec, name=self.name, env=GymnaxEnv(env, self.spec))


class CartPole(ClassicTask):
    """A pole on a cart; each step that it stands is rewarded with 1. CartPole-v0."""

    name = "cartpole"
    gymnax_id = "CartPole-v1"
    spec = TaskSpec(observation=_CARTPOLE, action=Discrete(2), max_steps=200, solved_reward=195.0)


class CartPoleV1(CartPole):
    """`cartpole` with a longer episode. CartPole-v1."""

    name = "cartpole_v1"
    spec = TaskSpec(observation=_CARTPOLE, action=Discrete(2), max_steps=500, solved_reward=475.0)


class Acrobot(ClassicTask):
    """A double pendulum that must swing its tip above a line; each step costs 1. Acrobot-v1."""

    name = "acrobot"
    gymnax_id = "Acrobot-v1"
    spec = TaskSpec(observation=_ACROBOT, action=Discrete(3), max_steps=500, solved_reward=-100.0)


class MountainCar(ClassicTask):
    """An underpowered car that must reach a hilltop; each step costs 1. MountainCar-v0."""

    name = "mountain_car"
    gymnax_id = "MountainCar-v0"
    spec = TaskSpec(observation=_CAR, action=Discrete(3), max_steps=200, solved_reward=-110.0)


class MountainCarContinuous(ClassicTask):
    """The car with a continuous force, which is charged; the hilltop is worth 100.

    MountainCarContinuous-v0.
    """

    name = "mountain_car_continuous"
    spec = TaskSpec(observation=_CAR, action=Box.symmetric(1.0), max_steps=999, solved_reward=90.0)

    def make(self) -> Task:
        env = MountainCarContinuousEnv(self.spec, CarParams())
        return Task.of(self.spec, name=self.name, env=env)


class Pendulum(ClassicTask):
    """A pendulum to be swung up and held; distance from upright, speed and torque are charged.

    Pendulum-v1. The solved reward is our choice: neither the paper nor Gymnasium defines one.
    """

    name = "pendulum"
    gymnax_id = "Pendulum-v1"
    spec = TaskSpec(observation=_PENDULUM, action=_TORQUE, max_steps=200, solved_reward=-250.0)
