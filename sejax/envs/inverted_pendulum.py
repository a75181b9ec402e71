"""InvertedPendulum-v5 on MuJoCo, 1000 steps; needs the extra `mujoco`."""

from dataclasses import dataclass
from typing import ClassVar

from sejax.envs import mujoco
from sejax.envs.base import Facts, Task
from sejax.options import Options, not_negative, option


@dataclass(frozen=True, kw_only=True)
class InvertedPendulum(Options):
    """A pole on a cart, pushed by a force, that is paid 1 for each step after which it stands.

    Source: Gymnasium's registry (episode length and reward threshold); options are Gymnasium's.
    """

    group: ClassVar[str] = "env"
    facts: ClassVar[Facts] = Facts("vector", "continuous", max_steps=1000)

    reset_noise_scale: float = option(0.01, not_negative("it is a range"))

    def make(self) -> Task:
        return mujoco.make_task("inverted_pendulum", self, solved_reward=950.0)
