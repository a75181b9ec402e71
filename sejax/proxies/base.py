"""The contract of a proxy: a world with weights that stands in for a real task.

A proxy is an `Environment` whose `EnvParams` hold the weights, so that an agent never
knows which world it is in. What the inner loop must know of a world beside that is a `World`, which
a proxy states and any other environment has by default.
"""

import copy
from typing import Any, NamedTuple

import jax
from flax import struct
from jaxtyping import Array

from sejax.envs.base import Task
from sejax.envs.environment import Environment, EnvParams


class World(NamedTuple):
    """What the inner loop must know of a world.

    Attributes:
      is_real: whether its steps are steps of the real task: they are counted as such, and its time
        limit is one that agents may treat as terminal.
      max_steps: steps that an episode cannot exceed; None if params may say anything.
    """

    is_real: bool = True
    max_steps: int | None = None


@struct.dataclass
class ProxyParams(EnvParams):
    """Weights of a proxy, as from its `init_weights`, and the real task's step limit."""

    weights: Any = None
    max_steps_in_episode: int = 1


class ProxyEnv(Environment):
    """A proxy of a task; subclasses add the dynamics (`reset_env`, `step_env`).

    A subclass must give `init_weights`, `reset_env` and `step_env`. The latter may put
    into its `info` under "discount" what a target bootstraps with before the agent's gamma (1 minus
    terminated if it is not there), and under "nonfinite" whether a number was met that is not
    finite, which ends the training.

    Attributes:
      task: the real task.
      config: that it was made from, a dataclass.
      is_real: whether its dynamics are the real task's.
    """

    is_real = False

    def __init__(self, task: Task, config: Any):
        self.task = task
        self.config = config
        self._default_params: Any = None

    def init_weights(self, key: Array) -> Any:
        """Random weights, a nested dictionary of float32 arrays."""
        raise NotImplementedError

    def params(self, weights: Any, discount: Array | float = 1.0) -> Any:
        """`EnvParams` of the proxy with these weights and the real task's step limit.

        Args:
          weights: as from `init_weights`.
          discount: gamma of the agent that it is for; most proxies have no use for it.
        """
        return ProxyParams(weights=weights, max_steps_in_episode=self.task.max_steps)

    def prepared(
        self, params: Any, discount: Array | float | None, limit_is_terminal: Array | bool = False
    ) -> Any:
        """The same params for a whole training of an agent.

        Args:
          params: of the proxy.
          discount: the agent's; None if it has none.
          limit_is_terminal: whether the agent does not bootstrap at the step limit.
        """
        return params

    @property
    def world(self) -> World:
        """What the inner loop must know."""
        return World(is_real=self.is_real, max_steps=self.task.max_steps)

    @property
    def default_params(self) -> Any:
        """Random weights, or those given to `with_default_params`."""
        return self._default_params or self.params(self.init_weights(jax.random.key(0)))

    def with_default_params(self, params: Any) -> Any:
        """A copy for callers that rely on `default_params`, such as `gymnax.make`."""
        env = copy.copy(self)
        env._default_params = params
        return env

    @property
    def name(self) -> str:
        return f"{type(self).__name__.removesuffix('Env')}-{self.task.name}"

    @property
    def num_actions(self) -> int:
        return self.task.env.num_actions

    def action_space(self, params: Any = None) -> Any:
        return self.task.env.action_space(self.task.params)

    def observation_space(self, params: Any = None) -> Any:
        return self.task.env.observation_space(self.task.params)


def world_of(env: Any) -> World:
    """What the inner loop must know of an environment, a proxy or any other."""
    return getattr(env, "world", World())


def prepare(env: Any, params: Any, discount: Array | float | None, limit_is_terminal: bool) -> Any:
    """A world's params for a whole training: `ProxyEnv.prepared` if there is one."""
    prepared = getattr(env, "prepared", None)
    return params if prepared is None else prepared(params, discount, limit_is_terminal)
