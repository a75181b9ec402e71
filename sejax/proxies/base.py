"""The contract of a proxy: an environment with weights that stands in for a real task.

A proxy is an `Environment` whose `EnvParams` hold the weights, so that an agent trains in
it as in any other environment. What the inner loop must know beside that is told by `is_real`,
`episode_limit` and `prepare`, of a proxy and of any other environment.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import jax
from flax import struct
from jaxtyping import Array, PyTree

from sejax.envs.base import Task
from sejax.envs.environment import Environment, EnvParams
from sejax.options import require
from sejax.proxies import ProxyConfig


@struct.dataclass
class ProxyParams(EnvParams):
    """Weights of a proxy, as from its `init_weights`, and the step limit of its episodes."""

    weights: Any = None
    max_steps_in_episode: int = 1


class ProxyEnv(Environment, ABC):
    """A proxy of a task; subclasses add `init_weights`, `reset_env` and `step_env`.

    `step_env` may put two entries into its `info`: "discount", what a target bootstraps with before
    the agent's gamma (1 minus terminated if it is not there), and "nonfinite", whether a number was
    met that is not finite, which ends the training.

    Attributes:
      task: the real task, whose spaces the proxy has.
      config: the configuration that it was made from.
      bare: the same without default params: one object for all stored proxies of a configuration.
      learned_config: what a stored proxy was learned with, nested plain values; None for others.

    Raises:
      ConfigError: for a configuration that does not derive from `ProxyConfig`.
    """

    def __init__(self, task: Task, config: ProxyConfig):
        name = type(config).__name__
        require(
            isinstance(config, ProxyConfig),
            "proxy",
            f"must derive from sejax.ProxyConfig; got {name}. Set class {name}(sejax.ProxyConfig).",
        )
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
        """`EnvParams` of the proxy with these weights.

        Args:
          weights: as from `init_weights`.
          discount: gamma of the agent that trains on it; most proxies have no use for it.
        """
        return ProxyParams(weights=weights, max_steps_in_episode=self.max_steps)

    def prepare(
        self,
        params: PyTree,
        discount: Array | float | None,
        limit_is_terminal: Array | bool = False,
    ) -> Any:
        """The same params for the whole training of one agent.

        Args:
          params: of the proxy.
          discount: the agent's gamma; None if it has none.
          limit_is_terminal: whether the agent does not bootstrap at the step limit.
        """
        return params

    @property
    def is_real(self) -> bool:
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

    def with_default_params(
        self, params: PyTree, learned_config: Mapping[str, Any] | None = None
    ) -> "ProxyEnv":
        """A copy for callers that rely on `default_params`, such as `gymnax.make`.

        Args:
          params: the default ones.
          learned_config: configuration that a stored proxy was learned with, nested plain values.
        """
        env = copy.copy(self)
        env._default_params, env.learned_config = params, learned_config
        return env

    @property
    def name(self) -> str:
        return f"{type(self).__name__.removesuffix('Env')}-{self.task.name}"


def is_real(env: Environment) -> bool:
    """Whether steps in an environment are steps of a real task."""
    return not isinstance(env, ProxyEnv) or env.is_real


def episode_limit(env: Environment) -> int | None:
    """Steps that an episode cannot exceed; None where only the params tell."""
    return env.max_steps if isinstance(env, ProxyEnv) else None


def prepare(
    env: Environment, params: PyTree, discount: Array | float | None, limit_is_terminal: bool
) -> Any:
    """An environment's params for the whole training of one agent; see `ProxyEnv.prepare`."""
    if not isinstance(env, ProxyEnv):
        return params
    return env.prepare(params, discount, limit_is_terminal)
