"""Hopper-v5 on MuJoCo, 1000 steps; needs the extra `mujoco`."""

from dataclasses import dataclass
from typing import ClassVar

from sejax.envs import mujoco
from sejax.envs.base import Facts, Task
from sejax.options import Options, finite, not_negative, option


@dataclass(frozen=True, kw_only=True)
class Hopper(Options):
    """A planar leg that is paid for hopping forward without falling.

    Source: Gymnasium's registry (episode length and reward threshold); options are Gymnasium's.
    """

    group: ClassVar[str] = "env"
    facts: ClassVar[Facts] = Facts(
        "vector", "continuous", max_steps=1000, has_info=True, has_vector=True
    )

    forward_reward_weight: float = option(1.0, finite("it weighs a reward"))
    ctrl_cost_weight: float = option(1e-3, not_negative("it weighs a cost"))
    healthy_reward: float = option(1.0, finite("it is a reward"))
    terminate_when_unhealthy: bool = True
    reset_noise_scale: float = option(5e-3, not_negative("it is a range"))

    def make(self) -> Task:
        return mujoco.make_task("hopper", self, solved_reward=3800.0)
