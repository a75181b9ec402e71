"""Reacher-v5 on MuJoCo, 50 steps; needs the extra `mujoco`."""

from dataclasses import dataclass
from typing import ClassVar

from sejax.envs import mujoco
from sejax.envs.base import Facts, Task
from sejax.options import Options, not_negative, option


@dataclass(frozen=True, kw_only=True)
class Reacher(Options):
    """An arm of two links whose tip is to reach a target, charged for its distance and for torque.

    Source: Gymnasium's registry (episode length and reward threshold); options are Gymnasium's.
    """

    group: ClassVar[str] = "env"
    facts: ClassVar[Facts] = Facts(
        "vector", "continuous", max_steps=50, has_info=True, has_vector=False
    )

    reward_dist_weight: float = option(1.0, not_negative("it weighs a cost"))
    reward_control_weight: float = option(1.0, not_negative("it weighs a cost"))

    def make(self) -> Task:
        return mujoco.make_task("reacher", self, solved_reward=-3.75)
