"""The synthetic environment (SE): three small networks in the place of a real task.

Source: paper, section "Learning Synthetic Environments"; `reference_details.md` 1.
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
from sejax.configs import SyntheticConfig
from sejax.networks import MLP

# A state or reward beyond this is no world that an agent could learn from: the episode ends. It is
# far outside every task's range and small enough for its square to stay finite in float32.
ABSURD = 1e6


@struct.dataclass
class SyntheticState(environment.EnvState):
    obs: Array  # [obs_dim]
    time: Array | int


@struct.dataclass
class SyntheticParams(environment.EnvParams):
    weights: Any = None  # {"state", "reward", "done"}: variables of one MLP each
    max_steps_in_episode: int = 1


class SyntheticEnv(environment.Environment[SyntheticState, SyntheticParams]):
    """A task whose dynamics, reward and termination are networks; a gymnax 1.x `Environment`.

    Each network maps the one-hot action and the state to the next state, the reward or the done
    output d. The episode terminates where d > 0.5; initial states are the real task's.
    `info["discount"]` is what a target should bootstrap with: 1 - d itself if `done="soft"`
    (a learned discount, not confined to [0, 1]), or 1 - terminated if `done="threshold"`.

    An output that is not finite, or absurd, ends the episode: the state stays where it was, the
    reward is 0, and `info["nonfinite"]` says whether it was not even a number.
    """

    def __init__(self, task: envs.Task, config: SyntheticConfig):
        super().__init__()
        self.task = task
        self.config = config
        self._default_params: SyntheticParams | None = None
        outputs = {"state": task.obs_dim, "reward": 1, "done": 1}
        self._nets = {
            head: MLP(size, config.hidden_size, config.num_layers, config.activation)
            for head, size in outputs.items()
        }

    def init_weights(self, key: Array) -> Any:
        """Random weights of the three networks, `{"state", "reward", "done"}`."""
        example = jnp.zeros(self.task.num_actions + self.task.obs_dim)
        keys = jax.random.split(key, len(self._nets))
        return {
            head: net.init(k, example)["params"]
            for k, (head, net) in zip(keys, self._nets.items(), strict=True)
        }

    def params(self, weights: Any) -> SyntheticParams:
        """`EnvParams` of the SE with these weights and the real task's step limit."""
        return SyntheticParams(weights=weights, max_steps_in_episode=self.task.max_steps)

    @property
    def default_params(self) -> SyntheticParams:
        """Random weights, or those given to `with_default_params`."""
        return self._default_params or self.params(self.init_weights(jax.random.key(0)))

    def with_default_params(self, params: SyntheticParams) -> "SyntheticEnv":
        """A copy for callers that rely on `default_params`, such as `gymnax.make`."""
        env = copy.copy(self)
        env._default_params = params
        return env

    def predict(
        self, weights: Any, obs: Float[Array, " obs_dim"], action: Array
    ) -> tuple[Float[Array, " obs_dim"], Float[Array, ""], Float[Array, ""]]:
        """The networks' raw outputs: next state, reward and done output d."""
        x = jnp.concatenate([jax.nn.one_hot(action, self.task.num_actions), obs])
        out = {head: net.apply({"params": weights[head]}, x) for head, net in self._nets.items()}
        return out["state"], out["reward"][0], out["done"][0]

    def reset_env(self, key: Array, params: SyntheticParams) -> tuple[Array, SyntheticState]:
        obs, _ = self.task.env.reset_env(key, self.task.params)
        return obs, SyntheticState(obs=obs, time=jnp.int32(0))

    def step_env(
        self, key: Array, state: SyntheticState, action: Any, params: SyntheticParams
    ) -> tuple[Array, SyntheticState, Array, Array, dict[Any, Any]]:
        next_obs, reward, done = self.predict(params.weights, state.obs, action)
        size = jnp.maximum(jnp.max(jnp.abs(next_obs)), jnp.maximum(jnp.abs(reward), jnp.abs(done)))
        sane = size < ABSURD  # False for nan
        next_obs = jnp.where(sane, next_obs, state.obs)
        reward = jnp.where(sane, reward, 0.0)
        terminated = (done > 0.5) | ~sane
        discount = 1.0 - done if self.config.done == "soft" else 1.0 - terminated
        info = {
            "discount": jnp.where(sane, discount, 0.0),
            "nonfinite": ~jnp.isfinite(size),
        }
        return (
            next_obs,
            SyntheticState(obs=next_obs, time=state.time + 1),
            reward,
            terminated,
            info,
        )

    def get_obs(self, state: SyntheticState, params: Any = None, key: Any = None) -> Array:
        return state.obs

    @property
    def name(self) -> str:
        return f"Synthetic-{self.task.name}"

    @property
    def num_actions(self) -> int:
        return self.task.num_actions

    def action_space(self, params: SyntheticParams | None = None) -> Any:
        return self.task.env.action_space(self.task.params)

    def observation_space(self, params: SyntheticParams | None = None) -> Any:
        """The real task's box without its bounds: a learned world need not respect them."""
        from gymnax.environments import spaces

        return spaces.Box(-ABSURD, ABSURD, (self.task.obs_dim,), jnp.float32)


@functools.cache
def make_synthetic(task: envs.Task, config: SyntheticConfig) -> SyntheticEnv:
    """The SE for a task, built once for each configuration (a new instance would recompile)."""
    return SyntheticEnv(task, config)
