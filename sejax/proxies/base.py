"""The contract of a proxy: an environment with weights that stands in for a real task.

A proxy is an `Environment` whose `EnvParams` hold the weights, so that an agent trains in
it as in any other environment. The inner loop also needs `ProxyEnv.has_real_dynamics`,
`ProxyEnv.max_steps` and `ProxyEnv.prepare`.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
from flax import struct
from jaxtyping import Array, PyTree

from sejax.envs import Task, TaskSpec
from sejax.envs.environment import Environment, EnvParams
from sejax.envs.wrappers import Wrapper
from sejax.options import ConfigError, Options, as_text, shortened

# An episode ends if a network's reward or entry of a state is beyond this. The real task's own
# values may be larger. Networks of sane weights stay far below it; its square is finite in float32.
MAX_ABS_VALUE = 1e6


@dataclass(frozen=True, kw_only=True)
class ProxyConfig(Options, ABC):
    """What a proxy's configuration declares; configurations of your own derive from it.

    Attributes:
      default_objective: name of the objective that `python -m sejax.run proxy=...` takes.
      has_real_dynamics: whether agents step the real task. Then their steps count as real steps,
        and agents may treat the task's step limit as terminal.
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
    def reaches_step_limit(self) -> bool:
        """Whether episodes of nearly all proxies of this kind last to their step limit."""
        return False

    def max_steps(self, task_max_steps: int) -> int:
        """Maximum number of steps of an episode, given that of the real task."""
        return task_max_steps

    def require_task(self, spec: TaskSpec, task_name: str) -> None:
        """Checks that a proxy of this kind is possible for a task.

        Raises:
          ConfigError: if it is not.
        """

    def _error(self, name: str, value: object, tail: str) -> ConfigError:
        """Error for a field with one allowed value; in the message `tail` follows that value."""
        only = as_text(value)
        rule = f"must be {only} {shortened(tail, 120)}"
        return ConfigError(f"{self.group}.{name}", rule, got=as_text(getattr(self, name)), use=only)

    @abstractmethod
    def make(self, task: Task) -> "ProxyEnv":
        """The proxy of a task."""


@struct.dataclass
class ProxyParams(EnvParams):
    """Weights of a proxy, in the form of its `init_weights`, and the step limit of its episodes."""

    weights: Any = None


class ProxyEnv(Environment, ABC):
    """A proxy of a task; subclasses add `init_weights`, `reset_env` and `step_env`.

    `step_env` may put two entries into its `info`. "discount" is the discount of a target, before
    the agent's gamma; by default it is 1 minus terminated. "nonfinite" says whether the step met a
    number that is not finite, which ends the training.

    Attributes:
      task: the real task, whose spaces the proxy has.
      config: the configuration that it was made from.
      bare: the same without default params. Stored proxies of one configuration share this object.
      learned_config: configuration that a stored proxy was learned with, nested plain values; None
        for others.
    """

    def __init__(self, task: Task, config: ProxyConfig):
        self.spaces = task.observation, task.action
        self.task = task
        self.config: Any = config  # of the class that made it, with its own fields
        self.bare = self
        self.learned_config: Mapping[str, Any] | None = None
        self._default_params: Any = None

    @abstractmethod
    def init_weights(self, key: Array) -> Any:
        """Random weights, a nested dictionary of float32 arrays."""

    def params(self, weights: PyTree, discount: Array | float = 1.0) -> Any:
        """`EnvParams` of the proxy with these weights, as a user holds and stores them.

        A trainer passes them through `prepare`, once for each training.

        Args:
          weights: in the form of `init_weights`.
          discount: gamma of the agent that trains on it; most proxies ignore it.
        """
        return ProxyParams(weights=weights, max_steps_in_episode=self.max_steps)

    def prepare(
        self, params: PyTree, discount: Array | float | None, limit_is_terminal: bool = False
    ) -> Any:
        """Params for the whole training of one agent, prepared once.

        Only a proxy whose steps depend on the agent, or repeat work that the weights alone decide,
        overrides it. `step_env` must take params that were not prepared, too: other libraries'
        loops pass those.

        Args:
          params: of the proxy.
          discount: the agent's gamma; None if it has none.
          limit_is_terminal: whether the agent does not bootstrap at the step limit.
        """
        return params

    @property
    def has_real_dynamics(self) -> bool:
        """Whether its dynamics are the real task's."""
        return self.config.has_real_dynamics

    @property
    def max_steps(self) -> int:
        """Maximum number of steps of an episode."""
        return self.config.max_steps(self.task.max_steps)

    @property
    def default_params(self) -> Any:
        """Random weights, or those given to `with_default_params`."""
        return self._default_params or self.params(self.init_weights(jax.random.key(0)))

    def with_default_params(self, params: PyTree, learned_config: Mapping[str, Any]) -> "ProxyEnv":
        """A copy for callers that rely on `default_params`, such as `gymnax.make`.

        Args:
          params: the default ones.
          learned_config: configuration that a stored proxy was learned with, nested plain values.
        """
        env = copy.copy(self)
        env._default_params = params
        env.learned_config = learned_config
        return env

    @property
    def name(self) -> str:
        return f"{type(self).__name__.removesuffix('Env')}-{self.task.name}"


def proxy_in(env: Environment) -> ProxyEnv | None:
    """The proxy that an environment is, or wraps; None for a real task."""
    while isinstance(env, Wrapper) and not isinstance(env, ProxyEnv):
        env = env.env
    return env if isinstance(env, ProxyEnv) else None


def steps_are_real(env: Environment) -> bool:
    """Whether steps in an environment are steps of a real task."""
    return (proxy := proxy_in(env)) is None or proxy.has_real_dynamics
