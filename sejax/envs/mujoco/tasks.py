"""Gymnasium's MuJoCo tasks, v5. Their environments are `sejax.envs.mujoco.models`.

Step limits and solved rewards are those of Gymnasium's registry where nothing else is said; options
are Gymnasium's keyword arguments. MuJoCo, its extra `mujoco` and a C++ compiler are needed when a
task is made.
"""

import io
import math
import warnings
from contextlib import redirect_stdout
from dataclasses import dataclass
from typing import ClassVar

from sejax.envs import mujoco
from sejax.envs.base import Task
from sejax.envs.spec import Box, TaskSpec
from sejax.options import ConfigError, Options, finite, not_negative, one_of, option

# Physics of halfcheetah, the default first. The others are brax's, of which only mjx moves like
# MuJoCo, at ten times its cost on a CPU (docs/mujoco.md).
BACKENDS = ("mujoco", "mjx", "spring", "positional", "generalized")

# The entries of `info` that describe the state alone; an observation has no position along x or y.
_STATE_KEYS = ("x_position", "y_position", "x_velocity", "y_velocity")
_ON_A_LINE = ("x_position", "x_velocity")
_REWARD_KEYS = ("reward_forward", "reward_ctrl")
_INFO_OF_WALKERS = (*_ON_A_LINE, "z_distance_from_origin", *_REWARD_KEYS, "reward_survive")
_INFO_IN_A_PLANE = (*_STATE_KEYS[:2], "distance_from_origin", *_STATE_KEYS[2:], *_REWARD_KEYS)


def _spec(
    obs_dim: int,
    action_dim: int,
    *,
    solved_reward: float,
    max_action: float = 1.0,
    max_steps: int = 1000,
    info_keys: tuple[str, ...] = (),
) -> TaskSpec:
    return TaskSpec(
        observation=Box.symmetric(*[math.inf] * obs_dim),
        action=Box.symmetric(*[max_action] * action_dim),
        max_steps=max_steps,
        solved_reward=solved_reward,
        info_keys=info_keys,
        augmented_keys=tuple(key for key in info_keys if key in _STATE_KEYS),
    )


@dataclass(frozen=True, kw_only=True)
class MujocoTask(Options):
    """What the tasks have in common.

    Attributes:
      name: of the task.
      model: class of `sejax.envs.mujoco.models`.
      terminate_when_unhealthy: whether an unhealthy state ends the episode; an option of some.
      reset_noise_scale: range or deviation of what is drawn at a reset; an option of some.
    """

    group: ClassVar[str] = "env"
    name: ClassVar[str]
    model: ClassVar[str]
    terminate_when_unhealthy = True
    reset_noise_scale = 0.1

    @property
    def spec(self) -> TaskSpec:
        """What is known of the task."""
        raise NotImplementedError

    def make(self) -> Task:
        return Task.of(self.spec, name=self.name, env=mujoco.make_env(self))


@dataclass(frozen=True, kw_only=True)
class HalfCheetah(MujocoTask):
    """A planar cheetah that is paid for running and charged for torque.

    Attributes:
      backend: physics

    Source: paper, appendix, fixed hyperparameters (episode length and solved reward).
    """

    name = "halfcheetah"
    model = "HalfCheetahEnv"
    spec = _spec(17, 6, solved_reward=3000.0, info_keys=(*_ON_A_LINE, "reward_run", "reward_ctrl"))

    backend: str = option("mujoco", one_of(BACKENDS))

    def make(self) -> Task:
        if self.backend == "mujoco":
            env = mujoco.make_env(self, ", or set env.backend=mjx")
            return Task.of(self.spec, name=self.name, env=env)
        try:
            # On import brax prints notes on other physics and warns of its own envs.
            with warnings.catch_warnings(action="ignore"), redirect_stdout(io.StringIO()):
                from sejax.envs.mujoco.brax import BraxHalfCheetahEnv

                brax_env = BraxHalfCheetahEnv(self)
        except ImportError as error:
            raise ConfigError(
                f"env.backend must be mujoco without brax; got {self.backend} ({error}). "
                "Install brax with pip install 'sejax[brax]'.",
                "env.backend",
            ) from error
        return Task.of(self.spec, name=self.name, env=brax_env)


@dataclass(frozen=True, kw_only=True)
class Runner(MujocoTask):
    """What the tasks have in common that pay for moving along x and charge for torque."""

    forward_reward_weight: float = option(1.0, finite("it weighs a reward"))
    ctrl_cost_weight: float = option(1e-3, not_negative("it weighs a cost"))
    reset_noise_scale: float = option(0.1, not_negative("it is a range"))


@dataclass(frozen=True, kw_only=True)
class Hopper(Runner):
    """A planar leg that is paid for hopping forward without falling."""

    name = "hopper"
    model = "HopperEnv"
    spec = _spec(11, 3, solved_reward=3800.0, info_keys=_INFO_OF_WALKERS)

    healthy_reward: float = option(1.0, finite("it is a reward"))
    terminate_when_unhealthy: bool = True
    reset_noise_scale: float = 5e-3


class Walker2d(Hopper):
    """A planar body on two legs that is paid for walking forward without falling.

    Gymnasium has no reward threshold for it. The solved reward is our choice, below the 4,683 that
    TD3's authors report after 1e6 steps (Fujimoto et al., 2018, table 1).
    """

    name = "walker2d"
    model = "Walker2dEnv"
    spec = _spec(17, 6, solved_reward=4000.0, info_keys=_INFO_OF_WALKERS)


@dataclass(frozen=True, kw_only=True)
class Swimmer(Runner):
    """Three links in a viscous plane that are paid for swimming in one direction."""

    name = "swimmer"
    model = "SwimmerEnv"
    spec = _spec(8, 2, solved_reward=360.0, info_keys=_INFO_IN_A_PLANE)

    ctrl_cost_weight: float = 1e-4


@dataclass(frozen=True, kw_only=True)
class InvertedPendulum(MujocoTask):
    """A pole on a cart, pushed by a force, that is paid 1 for each step after which it stands."""

    name = "inverted_pendulum"
    model = "InvertedPendulumEnv"
    spec = _spec(4, 1, max_action=3.0, solved_reward=950.0)

    reset_noise_scale: float = option(0.01, not_negative("it is a range"))


@dataclass(frozen=True, kw_only=True)
class Ant(Runner):
    """A body on four legs that is paid for walking in one direction and for its health.

    Attributes:
      include_cfrc_ext_in_observation: external forces on each body
    """

    name = "ant"
    model = "AntEnv"

    ctrl_cost_weight: float = 0.5
    contact_cost_weight: float = option(5e-4, not_negative("it weighs a cost"))
    healthy_reward: float = option(1.0, finite("it is a reward"))
    terminate_when_unhealthy: bool = True
    include_cfrc_ext_in_observation: bool = True

    @property
    def spec(self) -> TaskSpec:
        return _spec(
            105 if self.include_cfrc_ext_in_observation else 27,
            8,
            solved_reward=6000.0,
            info_keys=(*_INFO_IN_A_PLANE, "reward_contact", "reward_survive"),
        )


@dataclass(frozen=True, kw_only=True)
class Reacher(MujocoTask):
    """An arm of two links whose tip must reach a target; its distance and torque are charged."""

    name = "reacher"
    model = "ReacherEnv"
    spec = _spec(10, 2, max_steps=50, solved_reward=-3.75, info_keys=("reward_dist", "reward_ctrl"))

    reward_dist_weight: float = option(1.0, not_negative("it weighs a cost"))
    reward_control_weight: float = option(1.0, not_negative("it weighs a cost"))
