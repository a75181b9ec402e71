"""Learned stand-ins for real tasks, as gymnax environments whose params are weights.

This module has the contract of a proxy's configuration, `sejax.proxies.base` that of the proxy.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from sejax.envs.base import Task
from sejax.envs.spec import TaskSpec
from sejax.options import Options

if TYPE_CHECKING:
    from sejax.proxies.base import ProxyEnv

# A reward or an entry of a state that networks make ends the episode beyond this; what is the real
# task's own may be larger. It is far outside what networks of sane weights make, and small enough
# for its square to stay finite in float32.
MAX_ABS_VALUE = 1e6


@dataclass(frozen=True, kw_only=True)
class ProxyConfig(Options, ABC):
    """What a proxy's configuration declares; configurations of your own derive from it.

    Attributes:
      default_objective: name of the objective that `python -m sejax.run proxy=...` takes.
      has_real_dynamics: whether agents step the real task. Their steps then count as real ones, and
        the task's step limit is one that agents may treat as terminal.
    """

    group: ClassVar[str] = "proxy"
    default_objective: ClassVar[str] = "max_reward"
    has_real_dynamics: ClassVar[bool] = False

    @property
    def needs_task(self) -> bool:
        """Whether the real task must run where the proxy is used.

        If not, the spaces and the step limit in a proxy's file are enough to load it.
        """
        return True

    @property
    def needs_discount(self) -> bool:
        """Whether rewards depend on the agent's discount, which a file must then hold."""
        return False

    @property
    def sees_bounds(self) -> bool:
        """Whether the bounds of the task's observations are part of the proxy."""
        return False

    @property
    def reaches_step_limit(self) -> bool:
        """Whether episodes of nearly all proxies of this kind last to their step limit."""
        return False

    def max_steps(self, task_max_steps: int) -> int:
        """Maximum number of steps of an episode, given the real task's."""
        return task_max_steps

    def require_task(self, spec: TaskSpec, task_name: str) -> None:
        """Checks that a proxy of this kind is possible for a task.

        Raises:
          ConfigError: if it is not.
        """

    @abstractmethod
    def make(self, task: Task) -> "ProxyEnv":
        """The proxy of a task."""
