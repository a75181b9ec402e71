"""The synthetic environment (SE): three small networks in the place of a real task.

Source: paper, section "Learning Synthetic Environments"; `docs/reference.md` 1.
"""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from flax import struct
from gymnax.environments import environment
from jaxtyping import Array, Float

from sejax.envs.task import Task
from sejax.networks import MLP
from sejax.proxies.proxy import ABSURD, ProxyEnv, ProxyParams

if TYPE_CHECKING:  # which makes it
    from sejax.proxies.configs import SyntheticConfig


@struct.dataclass
class SyntheticState(environment.EnvState):
    vector: Array  # [obs_dim]: what the networks see and predict
    time: Array | int


class SyntheticEnv(ProxyEnv):
    """A task whose dynamics, reward and termination are networks; a gymnax 1.x `Environment`.

    Each network maps the action (one-hot if discrete) and the state to the next state, the reward
    or the done output d. Where states are discrete, the networks' state is a vector with an entry
    for each of them, one-hot at first and then whatever the network makes of it; the agent observes
    the index of its largest entry. The episode terminates where d > 0.5; initial states are the
    real task's. `info["discount"]` is what a target should bootstrap with: 1 - d itself if
    `done="soft"` (a learned discount, not confined to [0, 1]), or 1 - terminated if
    `done="threshold"`.

    An output that is not finite, or absurd, ends the episode: the state stays where it was, the
    reward is 0, and `info["nonfinite"]` says whether it was not even a number.
    """

    def __init__(self, task: Task, config: "SyntheticConfig"):
        super().__init__(task, config)
        outputs = {"state": task.obs_dim, "reward": 1, "done": 1}
        self._nets = {
            head: MLP(size, config.hidden_size, config.num_layers, config.activation)
            for head, size in outputs.items()
        }

    def init_weights(self, key: Array) -> Any:
        """Random weights of the three networks, `{"state", "reward", "done"}`."""
        example = jnp.zeros(self.task.action_dim + self.task.obs_dim)
        keys = jax.random.split(key, len(self._nets))
        return {
            head: net.init(k, example)["params"]
            for k, (head, net) in zip(keys, self._nets.items(), strict=True)
        }

    def predict(
        self, weights: Any, vector: Float[Array, " obs_dim"], action: Array
    ) -> tuple[Float[Array, " obs_dim"], Float[Array, ""], Float[Array, ""]]:
        """The networks' raw outputs: next state, reward and done output d."""
        if self.task.num_actions is not None:
            action = jax.nn.one_hot(action, self.task.num_actions)
        x = jnp.concatenate([action, vector])
        out = {head: net.apply({"params": weights[head]}, x) for head, net in self._nets.items()}
        return out["state"], out["reward"][0], out["done"][0]

    def reset_env(self, key: Array, params: ProxyParams) -> tuple[Array, SyntheticState]:
        obs, _ = self.task.env.reset_env(key, self.task.params)
        if self.task.num_states is not None:
            obs = jax.nn.one_hot(obs, self.task.num_states)
        state = SyntheticState(vector=obs, time=jnp.int32(0))
        return self.get_obs(state), state

    def step_env(
        self, key: Array, state: SyntheticState, action: Any, params: ProxyParams
    ) -> tuple[Array, SyntheticState, Array, Array, dict[Any, Any]]:
        vector, reward, done = self.predict(params.weights, state.vector, action)
        size = jnp.maximum(jnp.max(jnp.abs(vector)), jnp.maximum(jnp.abs(reward), jnp.abs(done)))
        sane = size < ABSURD  # False for nan
        vector = jnp.where(sane, vector, state.vector)
        reward = jnp.where(sane, reward, 0.0)
        terminated = (done > 0.5) | ~sane
        discount = 1.0 - done if self.config.done == "soft" else 1.0 - terminated
        info = {
            "discount": jnp.where(sane, discount, 0.0),
            "nonfinite": ~jnp.isfinite(size),
        }
        state = SyntheticState(vector=vector, time=state.time + 1)
        return self.get_obs(state), state, reward, terminated, info

    def get_obs(self, state: SyntheticState, params: Any = None, key: Any = None) -> Array:
        if self.task.num_states is not None:
            return jnp.argmax(state.vector).astype(jnp.int32)
        return state.vector

    def observation_space(self, params: ProxyParams | None = None) -> Any:
        """The real task's, a box without its bounds: a learned world need not respect them."""
        from gymnax.environments import spaces

        if self.task.num_states is not None:
            return spaces.Discrete(self.task.num_states)
        return spaces.Box(-ABSURD, ABSURD, (self.task.obs_dim,), jnp.float32)
