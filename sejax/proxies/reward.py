"""The reward network (RN): the real task with a learned reward in the place of its own.

Source: paper, section "Learning Reward Networks" (table "Overview of Reward Network variants");
`reference_details.md` 5.
"""

import copy
import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from gymnax.environments import environment
from jaxtyping import Array, Float

from sejax import envs
from sejax.configs import RewardConfig
from sejax.networks import MLP
from sejax.proxies.synthetic import ABSURD


@struct.dataclass
class RewardState(environment.EnvState):
    world: Any  # the real task's state
    obs: Array  # what the agent saw last
    time: Array | int


@struct.dataclass
class RewardParams(environment.EnvParams):
    weights: Any = None  # {"potential": variables of an MLP}
    discount: Array | float = 1.0  # gamma; a trainer puts that of the agent here
    max_steps_in_episode: int = 1


class RewardEnv(environment.Environment[RewardState, RewardParams]):
    r"""A task whose reward is shaped by a network :math:`\Phi`; a gymnax 1.x `Environment`.

    Dynamics, termination and observations are the real task's. With r the real reward, the agent
    gets

    ========================= =====================================
    `variant`                 reward
    ========================= =====================================
    `additive_potential`      :math:`r + \gamma \Phi(s') - \Phi(s)`
    `exclusive_potential`     :math:`\gamma \Phi(s') - \Phi(s)`
    `additive_non_potential`  :math:`r + \Phi(s')`
    `exclusive_non_potential` :math:`\Phi(s')`
    ========================= =====================================

    where gamma is the agent's discount. A discrete state is one-hot to the network. With
    `zero_at_terminal` :math:`\Phi` is 0 where the episode terminates, which is what leaves the
    optimal policy as it is (Ng et al., 1999); the authors' code keeps the network's value.

    `info["real_reward"]` is r. A reward that is not finite, or absurd, is 0 and ends the episode;
    `info["nonfinite"]` says whether it was not even a number.
    """

    def __init__(self, task: envs.Task, config: RewardConfig):
        super().__init__()
        self.task = task
        self.config = config
        self._default_params: RewardParams | None = None
        self._net = MLP(1, config.hidden_size, config.num_layers, config.activation)

    def init_weights(self, key: Array) -> Any:
        """Random weights of the network, `{"potential"}`."""
        return {"potential": self._net.init(key, jnp.zeros(self.task.obs_dim))["params"]}

    def params(self, weights: Any, discount: Array | float = 1.0) -> RewardParams:
        """`EnvParams` of the RN with these weights and the real task's step limit."""
        return RewardParams(
            weights=weights, discount=discount, max_steps_in_episode=self.task.max_steps
        )

    @property
    def default_params(self) -> RewardParams:
        """Random weights, or those given to `with_default_params`."""
        return self._default_params or self.params(self.init_weights(jax.random.key(0)))

    def with_default_params(self, params: RewardParams) -> "RewardEnv":
        """A copy for callers that rely on `default_params`, such as `gymnax.make`."""
        env = copy.copy(self)
        env._default_params = params
        return env

    def potential(self, weights: Any, obs: Array) -> Float[Array, ""]:
        """The network's output for an observation of the task."""
        if self.task.num_states is not None:
            obs = jax.nn.one_hot(obs, self.task.num_states)
        return self._net.apply({"params": weights["potential"]}, obs)[0]

    def shape(
        self, params: RewardParams, obs: Array, next_obs: Array, reward: Any, terminated: Any
    ) -> Float[Array, ""]:
        """What the agent gets for a transition with real reward `reward`."""
        after = self.potential(params.weights, next_obs)
        if self.config.zero_at_terminal:
            after = jnp.where(terminated, 0.0, after)
        bonus = after
        if not self.config.variant.endswith("non_potential"):
            bonus = params.discount * after - self.potential(params.weights, obs)
        return reward + bonus if self.config.variant.startswith("additive") else bonus

    def reset_env(self, key: Array, params: RewardParams) -> tuple[Array, RewardState]:
        obs, world = self.task.env.reset_env(key, self.task.params)
        return obs, RewardState(world=world, obs=obs, time=jnp.int32(0))

    def step_env(
        self, key: Array, state: RewardState, action: Any, params: RewardParams
    ) -> tuple[Array, RewardState, Array, Array, dict[Any, Any]]:
        obs, world, real_reward, terminated, info = self.task.env.step_env(
            key, state.world, action, self.task.params
        )
        reward = self.shape(params, state.obs, obs, real_reward, terminated)
        sane = jnp.abs(reward) < ABSURD  # False for nan
        info = {
            **info,
            "real_reward": jnp.float32(real_reward),
            "nonfinite": ~jnp.isfinite(reward),
        }
        state = RewardState(world=world, obs=obs, time=state.time + 1)
        return obs, state, jnp.where(sane, reward, 0.0), terminated | ~sane, info

    def get_obs(self, state: RewardState, params: Any = None, key: Any = None) -> Array:
        return state.obs

    @property
    def name(self) -> str:
        return f"Reward-{self.task.name}"

    @property
    def num_actions(self) -> int:
        return self.task.env.num_actions

    def action_space(self, params: RewardParams | None = None) -> Any:
        return self.task.env.action_space(self.task.params)

    def observation_space(self, params: RewardParams | None = None) -> Any:
        return self.task.env.observation_space(self.task.params)


@functools.cache
def make_reward(task: envs.Task, config: RewardConfig) -> RewardEnv:
    """The RN for a task, built once for each configuration (a new instance would recompile)."""
    return RewardEnv(task, config)
