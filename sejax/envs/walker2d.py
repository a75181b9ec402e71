"""Walker2d-v5 on MuJoCo, 1000 steps; needs the extra `mujoco`."""

from dataclasses import dataclass

from sejax.envs import mujoco
from sejax.envs.base import Task
from sejax.envs.hopper import Hopper


@dataclass(frozen=True, kw_only=True)
class Walker2d(Hopper):
    """A planar body on two legs that is paid for walking forward without falling.

    Gymnasium has no reward threshold for it. The solved reward is our choice, below the 4,683 that
    TD3's authors report after 1e6 steps.

    Source: Gymnasium's registry (episode length); Fujimoto et al., 2018, table 1. Options are
    Gymnasium's, the same as Hopper's.
    """

    def make(self) -> Task:
        return mujoco.make_task("walker2d", self, solved_reward=4000.0)
