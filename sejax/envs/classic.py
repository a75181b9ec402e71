"""Gymnasium's classic control tasks in JAX: their dynamics, and the tasks.

gymnax 1.0 has the same dynamics, to the last bit but for MountainCarContinuous
(`tests/test_envs.py`); importing it takes 1.3 CPU s, which each command would spend. Angles are in
rad, velocities of the cars per step, and others per second.

Source: Gymnasium 1.3, `gymnasium.envs.classic_control`; gymnax 1.0,
`gymnax.environments.classic_control`. Step limits and solved rewards of cartpole, acrobot and
mountain_car_continuous: paper, appendix, fixed hyperparameters. Of the others:
Gymnasium's registry.
"""

import math
from dataclasses import dataclass
from typing import ClassVar, TypeVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from sejax.envs.base import Task
from sejax.envs.environment import Environment, EnvParams, EnvState, Step
from sejax.envs.spec import Box, Discrete, TaskSpec

# --- CartPole ------------------------------------------------------------------------------------


@struct.dataclass
class CartPoleState(EnvState):
    x: Array  # m
    x_dot: Array
    theta: Array
    theta_dot: Array


@struct.dataclass
class CartPoleParams(EnvParams):
    gravity: float = 9.8
    masspole: float = 0.1
    total_mass: float = 1.0 + 0.1  # of cart and pole
    length: float = 0.5  # half of the pole's
    polemass_length: float = 0.05  # masspole * length
    force_mag: float = 10.0
    tau: float = 0.02  # s of a step
    theta_threshold_radians: float = 12 * 2 * jnp.pi / 360
    x_threshold: float = 2.4


class CartPoleEnv(Environment[CartPoleState, CartPoleParams]):
    """A pole on a cart that is pushed left (action 0) or right (1)."""

    params_class = CartPoleParams

    def start(self, key: Array) -> CartPoleState:
        x, x_dot, theta, theta_dot = jax.random.uniform(key, (4,), minval=-0.05, maxval=0.05)
        return CartPoleState(x=x, x_dot=x_dot, theta=theta, theta_dot=theta_dot, time=0)

    def step_env(
        self, key: Array, state: CartPoleState, action: Array, params: CartPoleParams
    ) -> Step[CartPoleState]:
        was_terminal = self.is_terminated(state, params)
        force = params.force_mag * action - params.force_mag * (1 - action)
        cos, sin = jnp.cos(state.theta), jnp.sin(state.theta)
        push = (force + params.polemass_length * state.theta_dot**2 * sin) / params.total_mass
        theta_acc = (params.gravity * sin - cos * push) / (
            params.length * (4.0 / 3.0 - params.masspole * cos**2 / params.total_mass)
        )
        x_acc = push - params.polemass_length * theta_acc * cos / params.total_mass
        state = CartPoleState(
            x=state.x + params.tau * state.x_dot,
            x_dot=state.x_dot + params.tau * x_acc,
            theta=state.theta + params.tau * state.theta_dot,
            theta_dot=state.theta_dot + params.tau * theta_acc,
            time=state.time + 1,
        )
        return self.after(state, jnp.array(1.0 - was_terminal), params)

    def observe(self, state: CartPoleState) -> Array:
        return jnp.array([state.x, state.x_dot, state.theta, state.theta_dot])

    def is_terminated(self, state: CartPoleState, params: CartPoleParams) -> Bool[Array, ""]:
        is_off = (state.x < -params.x_threshold) | (state.x > params.x_threshold)
        limit = params.theta_threshold_radians
        return is_off | ((state.theta < -limit) | (state.theta > limit))


# --- Acrobot -------------------------------------------------------------------------------------


@struct.dataclass
class AcrobotState(EnvState):
    joint_angle1: Array
    joint_angle2: Array
    velocity_1: Array
    velocity_2: Array


@struct.dataclass
class AcrobotParams(EnvParams):
    available_torque: Array = struct.field(default_factory=lambda: jnp.array([-1.0, 0.0, 1.0]))
    dt: float = 0.2  # s of a step
    link_length_1: float = 1.0
    link_mass_1: float = 1.0
    link_mass_2: float = 1.0
    link_com_pos_1: float = 0.5
    link_com_pos_2: float = 0.5
    link_moi: float = 1.0
    max_vel_1: float = 4 * jnp.pi
    max_vel_2: float = 9 * jnp.pi
    torque_noise_max: float = 0.0


class AcrobotEnv(Environment[AcrobotState, AcrobotParams]):
    """Two links of which the second joint is turned by a torque of -1, 0 or 1."""

    params_class = AcrobotParams

    def start(self, key: Array) -> AcrobotState:
        angle1, angle2, *velocities = jax.random.uniform(key, (4,), minval=-0.1, maxval=0.1)
        return AcrobotState(
            joint_angle1=angle1,
            joint_angle2=angle2,
            velocity_1=velocities[0],
            velocity_2=velocities[1],
            time=jnp.int32(0),
        )

    def step_env(
        self, key: Array, state: AcrobotState, action: Array, params: AcrobotParams
    ) -> Step[AcrobotState]:
        noise = params.torque_noise_max
        torque = params.available_torque[action]
        torque = torque + jax.random.uniform(key, shape=(), minval=-noise, maxval=noise)
        angles = [state.joint_angle1, state.joint_angle2]
        before = jnp.array([*angles, state.velocity_1, state.velocity_2, torque])
        after = _runge_kutta(before, params)
        state = AcrobotState(
            joint_angle1=_wrap(after[0], -jnp.pi, jnp.pi),
            joint_angle2=_wrap(after[1], -jnp.pi, jnp.pi),
            velocity_1=jnp.clip(after[2], -params.max_vel_1, params.max_vel_1),
            velocity_2=jnp.clip(after[3], -params.max_vel_2, params.max_vel_2),
            time=jnp.int32(state.time + 1),
        )
        return self.after(state, -1.0 * (1 - self.is_terminated(state, params)), params)

    def observe(self, state: AcrobotState) -> Array:
        angles = [state.joint_angle1, state.joint_angle2]
        sides = [f(angle) for angle in angles for f in (jnp.cos, jnp.sin)]
        return jnp.array([*sides, state.velocity_1, state.velocity_2])

    def is_terminated(self, state: AcrobotState, params: AcrobotParams) -> Bool[Array, ""]:
        angle = state.joint_angle1
        return -jnp.cos(angle) - jnp.cos(state.joint_angle2 + angle) > 1.0


def _runge_kutta(y: Float[Array, "5"], params: AcrobotParams) -> Float[Array, "5"]:
    """Both angles, both velocities and the torque, a step later."""
    half = params.dt / 2.0
    k1 = _derivative(y, params)
    k2 = _derivative(y + half * k1, params)
    k3 = _derivative(y + half * k2, params)
    k4 = _derivative(y + params.dt * k3, params)
    return y + params.dt / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)


def _derivative(y: Float[Array, "5"], params: AcrobotParams) -> Float[Array, "5"]:
    """Of the "book" version of the equations, Gymnasium's default."""
    m1, m2 = params.link_mass_1, params.link_mass_2
    l1 = params.link_length_1
    lc1, lc2 = params.link_com_pos_1, params.link_com_pos_2
    i1, i2 = params.link_moi, params.link_moi
    g = 9.8
    theta1, theta2, dtheta1, dtheta2 = y[:-1]
    torque = y[-1]
    d1 = m1 * lc1**2 + m2 * (l1**2 + lc2**2 + 2 * l1 * lc2 * jnp.cos(theta2)) + i1 + i2
    d2 = m2 * (lc2**2 + l1 * lc2 * jnp.cos(theta2)) + i2
    phi2 = m2 * lc2 * g * jnp.cos(theta1 + theta2 - jnp.pi / 2.0)
    phi1 = (
        -m2 * l1 * lc2 * dtheta2**2 * jnp.sin(theta2)
        - 2 * m2 * l1 * lc2 * dtheta2 * dtheta1 * jnp.sin(theta2)
        + (m1 * lc1 + m2 * l1) * g * jnp.cos(theta1 - jnp.pi / 2)
        + phi2
    )
    ddtheta2 = (torque + d2 / d1 * phi1 - m2 * l1 * lc2 * dtheta1**2 * jnp.sin(theta2) - phi2) / (
        m2 * lc2**2 + i2 - d2**2 / d1
    )
    ddtheta1 = -(d2 * ddtheta2 + phi1) / d1
    return jnp.array([dtheta1, dtheta2, ddtheta1, ddtheta2, 0.0])


def _wrap(x: Array, low: float, high: float) -> Array:
    """An angle moved into [low, high) by whole turns."""
    turn = high - low
    is_below, is_above = x < low, x >= high
    num_turns = is_below * jnp.ceil((low - x) / turn) + is_above * jnp.floor((x - high) / turn + 1)
    return x - num_turns * turn * is_above + num_turns * turn * is_below


# --- the cars ------------------------------------------------------------------------------------


@struct.dataclass
class CarState(EnvState):
    position: Array
    velocity: Array


@struct.dataclass
class CarParams(EnvParams):
    min_position: float = -1.2
    max_position: float = 0.6
    max_speed: float = 0.07
    goal_position: float = 0.5
    goal_velocity: float = 0.0
    gravity: float = 0.0025


Params = TypeVar("Params", bound=CarParams)


class CarEnv(Environment[CarState, Params]):
    """What both cars have in common: an underpowered car in a valley, and a goal on a hill."""

    def start(self, key: Array) -> CarState:
        position = jax.random.uniform(key, minval=-0.6, maxval=-0.4)
        return CarState(position=position, velocity=jnp.array(0.0), time=0)

    def observe(self, state: CarState) -> Array:
        return jnp.array([state.position, state.velocity])

    def is_terminated(self, state: CarState, params: Params) -> Bool[Array, ""]:
        is_there = state.position >= params.goal_position
        return is_there * (state.velocity >= params.goal_velocity)


@struct.dataclass
class MountainCarParams(CarParams):
    force: float = 0.001


class MountainCarEnv(CarEnv[MountainCarParams]):
    """A car that is pushed left (0), not at all (1) or right (2)."""

    params_class = MountainCarParams

    def step_env(
        self, key: Array, state: CarState, action: Array, params: MountainCarParams
    ) -> Step[CarState]:
        velocity = (
            state.velocity
            + (action - 1) * params.force
            - jnp.cos(3 * state.position) * params.gravity
        )
        velocity = jnp.clip(velocity, -params.max_speed, params.max_speed)
        position = state.position + velocity
        position = jnp.clip(position, params.min_position, params.max_position)
        velocity = velocity * (1 - (position == params.min_position) * (velocity < 0))
        state = CarState(position=position, velocity=velocity, time=state.time + 1)
        return self.after(state, jnp.array(-1.0), params)


@struct.dataclass
class MountainCarContinuousParams(CarParams):
    goal_position: float = 0.45
    min_action: float = -1.0
    max_action: float = 1.0
    power: float = 0.0015


class MountainCarContinuousEnv(CarEnv[MountainCarContinuousParams]):
    r"""A car with an engine that is costly to use.

    .. math::
        v' &= clip(v + 0.0015\, clip(a, -1, 1) - 0.0025 \cos 3x,\ \pm 0.07) \\
        x' &= clip(x + v',\ -1.2,\ 0.6) \\
        r &= 100 [x' \ge 0.45 \wedge v' \ge 0] - 0.1 a^2

    The left wall stops the car: v' = 0 where x' = -1.2 and v' < 0. The goal terminates. The action
    `[1]` or `[]` is charged as given, before it is clipped, as in Gymnasium.

    Differs: gymnax's has no stop at that wall, and stops a car that rolls back over the goal.
    """

    params_class = MountainCarContinuousParams

    def step_env(
        self, key: Array, state: CarState, action: Array, params: MountainCarContinuousParams
    ) -> Step[CarState]:
        action = jnp.reshape(action, ())
        force = jnp.clip(action, params.min_action, params.max_action)
        acceleration = params.power * force - params.gravity * jnp.cos(3 * state.position)
        velocity = jnp.clip(state.velocity + acceleration, -params.max_speed, params.max_speed)
        position = state.position + velocity
        position = jnp.clip(position, params.min_position, params.max_position)
        is_at_wall = (position <= params.min_position) & (velocity < 0)
        velocity = jnp.where(is_at_wall, 0.0, velocity)
        state = CarState(position=position, velocity=velocity, time=state.time + 1)
        reward = jnp.where(self.is_terminated(state, params), 100.0, 0.0) - 0.1 * action**2
        return self.after(state, reward, params)


# --- Pendulum ------------------------------------------------------------------------------------


@struct.dataclass
class PendulumState(EnvState):
    theta: Array  # 0 upright
    theta_dot: Array


@struct.dataclass
class PendulumParams(EnvParams):
    max_speed: float = 8.0
    max_torque: float = 2.0
    dt: float = 0.05  # s of a step
    g: float = 10.0
    m: float = 1.0
    l: float = 1.0  # noqa: E741 (Gymnasium's name)


class PendulumEnv(Environment[PendulumState, PendulumParams]):
    """A pendulum that is turned by a torque, `[1]` or `[]`; it never terminates."""

    params_class = PendulumParams

    def start(self, key: Array) -> PendulumState:
        high = jnp.array([jnp.pi, 1])
        theta, theta_dot = jax.random.uniform(key, (2,), minval=-high, maxval=high)
        return PendulumState(theta=theta, theta_dot=theta_dot, time=0)

    def step_env(
        self, key: Array, state: PendulumState, action: Array, params: PendulumParams
    ) -> Step[PendulumState]:
        torque = jnp.reshape(jnp.clip(action, -params.max_torque, params.max_torque), ())
        angle = (state.theta + jnp.pi) % (2 * jnp.pi) - jnp.pi
        reward = -(angle**2 + 0.1 * state.theta_dot**2 + 0.001 * torque**2)
        theta_dot = (
            state.theta_dot
            + (
                3 * params.g / (2 * params.l) * jnp.sin(state.theta)
                + 3.0 / (params.m * params.l**2) * torque
            )
            * params.dt
        )
        theta_dot = jnp.clip(theta_dot, -params.max_speed, params.max_speed)
        theta = state.theta + theta_dot * params.dt
        state = PendulumState(theta=theta, theta_dot=theta_dot, time=state.time + 1)
        return self.after(state, reward, params)

    def observe(self, state: PendulumState) -> Array:
        return jnp.array([jnp.cos(state.theta), jnp.sin(state.theta), state.theta_dot])

    def is_terminated(self, state: PendulumState, params: PendulumParams) -> Bool[Array, ""]:
        return jnp.array(False)


# --- the tasks -----------------------------------------------------------------------------------

_NONE = 3.4028234663852886e38  # how CartPole writes that a number has no bound
_CARTPOLE = Box.symmetric(4.8, _NONE, math.radians(24), _NONE)
_CAR = Box(low=(-1.2, -0.07), high=(0.6, 0.07))  # position and velocity


@dataclass(frozen=True)
class ClassicTask:
    """A task without options.

    Attributes:
      name: of the task.
      dynamics: class of its environment.
      spec: what is known of it.
    """

    name: ClassVar[str]
    dynamics: ClassVar[type[Environment]]
    spec: ClassVar[TaskSpec]

    def make(self) -> Task:
        return Task.of(self.spec, name=self.name, env=self.dynamics(self.spec))


class CartPole(ClassicTask):
    """A pole on a cart; each step that it stands is rewarded with 1. CartPole-v0."""

    name = "cartpole"
    dynamics = CartPoleEnv
    spec = TaskSpec(observation=_CARTPOLE, action=Discrete(2), max_steps=200, solved_reward=195.0)


class CartPoleV1(ClassicTask):
    """`cartpole` with a longer episode. CartPole-v1."""

    name = "cartpole_v1"
    dynamics = CartPoleEnv
    spec = TaskSpec(observation=_CARTPOLE, action=Discrete(2), max_steps=500, solved_reward=475.0)


class Acrobot(ClassicTask):
    """A double pendulum that must swing its tip above a line; each step costs 1. Acrobot-v1."""

    name = "acrobot"
    dynamics = AcrobotEnv
    spec = TaskSpec(
        observation=Box.symmetric(1.0, 1.0, 1.0, 1.0, 4 * math.pi, 9 * math.pi),
        action=Discrete(3),
        max_steps=500,
        solved_reward=-100.0,
    )


class MountainCar(ClassicTask):
    """An underpowered car that must reach a hilltop; each step costs 1. MountainCar-v0."""

    name = "mountain_car"
    dynamics = MountainCarEnv
    spec = TaskSpec(observation=_CAR, action=Discrete(3), max_steps=200, solved_reward=-110.0)


class MountainCarContinuous(ClassicTask):
    """The car with a force to choose, which is charged; the hilltop is worth 100.

    MountainCarContinuous-v0.
    """

    name = "mountain_car_continuous"
    dynamics = MountainCarContinuousEnv
    spec = TaskSpec(observation=_CAR, action=Box.symmetric(1.0), max_steps=999, solved_reward=90.0)


class Pendulum(ClassicTask):
    """A pendulum to be swung up and held; distance from upright, speed and torque are charged.

    Pendulum-v1. The solved reward is our choice: neither the paper nor Gymnasium defines one.
    """

    name = "pendulum"
    dynamics = PendulumEnv
    spec = TaskSpec(
        observation=Box.symmetric(1.0, 1.0, 8.0),
        action=Box.symmetric(2.0),
        max_steps=200,
        solved_reward=-250.0,
    )
