"""HalfCheetah, 1000 steps; needs the extra `mujoco`, or `brax` for other physics."""

import io
import warnings
from contextlib import redirect_stdout
from dataclasses import dataclass
from typing import ClassVar

from sejax.envs import mujoco
from sejax.envs.base import Facts, Task
from sejax.errors import ConfigError
from sejax.options import Options, one_of, option

SOLVED_REWARD = 3000.0
# The first is the default: the paper's physics, at a tenth of what MuJoCo's algorithm costs in JAX
# on a CPU. The others are brax's, of which only mjx moves like MuJoCo (docs/halfcheetah.md).
BACKENDS = ("mujoco", "mjx", "spring", "positional", "generalized")


@dataclass(frozen=True, kw_only=True)
class HalfCheetah(Options):
    """A planar cheetah that is paid for running and charged for torque.

    Source: paper, appendix, fixed hyperparameters (episode length and solved reward).
    """

    group: ClassVar[str] = "env"
    facts: ClassVar[Facts] = Facts(
        "vector", "continuous", max_steps=1000, has_info=True, has_vector=True
    )

    backend: str = option(BACKENDS[0], one_of(BACKENDS))  # physics

    def make(self) -> Task:
        if self.backend == "mujoco":
            return mujoco.make_task("halfcheetah", self, SOLVED_REWARD, ", or set env.backend=mjx")
        try:
            # On import brax tells at length of other physics, and that its envs lack maintainers.
            with warnings.catch_warnings(action="ignore"), redirect_stdout(io.StringIO()):
                from sejax.envs.dynamics.halfcheetah import INFO_KEYS, CheetahParams, HalfCheetahEnv

                env = HalfCheetahEnv(self.backend)
        except ImportError as error:
            raise ConfigError(
                f"env.backend={self.backend} needs brax, because its physics are brax's; it is not "
                f"installed ({error}). Install it with pip install 'sejax[brax]'."
            ) from error
        return Task(
            name="halfcheetah",
            env=env,
            params=CheetahParams(),
            max_steps=self.facts.max_steps,
            solved_reward=SOLVED_REWARD,
            info_keys=INFO_KEYS,
            augmented_keys=("x_position", "x_velocity"),
        )
