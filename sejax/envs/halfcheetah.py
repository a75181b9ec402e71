"""HalfCheetah with brax's physics, 1000 steps; needs the extra `brax`."""

import io
import warnings
from contextlib import redirect_stdout
from dataclasses import dataclass
from typing import ClassVar

from sejax.envs.task import Facts, Task
from sejax.errors import ConfigError
from sejax.options import Options, one_of, option

# The first is the default: nearly MuJoCo at less than twice the cost of the cheapest, where no
# other one moves like MuJoCo at all (docs/halfcheetah.md).
BACKENDS = ("mjx", "spring", "positional", "generalized")


@dataclass(frozen=True, kw_only=True)
class HalfCheetah(Options):
    """A planar cheetah that is paid for running and charged for torque.

    Source: paper, appendix, fixed hyperparameters (episode length and solved reward).
    """

    group: ClassVar[str] = "env"
    facts: ClassVar[Facts] = Facts("vector", "continuous", max_steps=1000, has_info=True)

    backend: str = option(BACKENDS[0], one_of(BACKENDS))  # physics

    def make(self) -> Task:
        try:
            # On import brax tells at length of other physics, and that its envs lack maintainers.
            with warnings.catch_warnings(action="ignore"), redirect_stdout(io.StringIO()):
                from sejax.envs.dynamics.halfcheetah import INFO_KEYS, CheetahParams, HalfCheetahEnv

                env = HalfCheetahEnv(self.backend)
        except ImportError as error:
            raise ConfigError(
                "env=halfcheetah needs brax, because its physics are brax's; it is not installed "
                f"({error}). Install it with pip install 'sejax[brax]'."
            ) from error
        return Task(
            name="halfcheetah", env=env, params=CheetahParams(), max_steps=self.facts.max_steps,
            solved_reward=3000.0, info_keys=INFO_KEYS,
            augmented_keys=("x_position", "x_velocity"),
        )  # fmt: skip
