"""The synthetic environment (SE): small networks in place of a real task.

Source: paper, section "Learning Synthetic Environments"; `docs/reference.md` 1. One-step episodes
and learned initial states: Liesen et al., "Discovering Minimal Reinforcement Learning Environments"
(2024).
"""

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, PyTree
from numpy.typing import ArrayLike

from sejax.envs import Box, Task, TaskSpec
from sejax.envs.environment import EnvState
from sejax.ops.networks import MLP
from sejax.options import Activation, Count, Depth
from sejax.proxies.base import MAX_ABS_VALUE, ProxyConfig, ProxyEnv, ProxyParams

START_HIDDEN_SIZE = 32  # units of the network that makes initial states

Vector = TypeVar("Vector", np.ndarray, Array)


class Units(NamedTuple):
    """Units in which an SE's networks see and make states; by default the task's own.

    Attributes:
      center: `[obs_dim]` float32, the state that is 0 for the networks; None for the task's units.
      scale: `[obs_dim]` float32, the difference that is 1 for them.
    """

    center: np.ndarray | None = None
    scale: np.ndarray | float = 1.0

    def encode(self, vector: Vector) -> Vector:
        """States `[*batch, obs_dim]` in these units; of NumPy or JAX."""
        return vector if self.center is None else (vector - self.center) / self.scale

    def decode(self, vector: Vector) -> Vector:
        """Inverse of `encode`: states that networks or noise made, in the task's units."""
        return vector if self.center is None else vector * self.scale + self.center


@dataclass(frozen=True, kw_only=True)
class SyntheticConfig(ProxyConfig):
    """The SE's networks, where its episodes begin, and how they end.

    The default is the contextual bandit of Liesen et al. (2024): any agent sees everything about
    it. The paper's SE is `initial_state=real horizon=null done=soft`.

    Attributes:
      done: How the done output d ends an episode. soft: at d > 0.5, but targets bootstrap with 1 -
        d (the authors'); threshold: at d > 0.5; bernoulli: with probability clip(d, 0, 1). With
        soft, agents outside of sejax do not see 1 - d.
      min_steps: First step of an episode at which d may end it; targets before it bootstrap with
        1. If episodes last a step or two, the SE is a one-step SE, whatever its networks could do.
      initial_state: real: the task's initial states; learned: standard normal noise plus a
        network's output for it; noise: noise alone, in the units of `state_units`.
      state_units: Units in which the networks see and make states. raw: the task's own; bounds: 0
        is the middle of a bounded observation and 1 is half of the way to its bound. A car's
        velocity lies in [-0.07, 0.07]; there noise of 1 would be far too large.
      horizon: Steps of an episode; the last step terminates it. null: the task's limit, which
        truncates it. 1: a one-step SE, which has neither a next-state nor a done network.
      reward_form: Output of a one-step SE's reward network. network: the reward of an action;
        distance: the best continuous action, in units of the bound. The reward is then minus the
        sum of the distances from it, so that the best policy is known.
    """

    hidden_size: Count = 128
    num_layers: Depth = 1
    activation: Activation = "leaky_relu"
    done: Literal["soft", "threshold", "bernoulli"] = "threshold"
    min_steps: Count = 1
    initial_state: Literal["real", "learned", "noise"] = "learned"
    state_units: Literal["raw", "bounds"] = "raw"
    horizon: Count | None = 1
    reward_form: Literal["network", "distance"] = "network"
    start_hidden_size: Count = START_HIDDEN_SIZE

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.horizon is not None and self.min_steps > self.horizon:
            raise self._error("min_steps", self.horizon, "or less, with a horizon of as many steps")
        if self.reward_form != "network" and not self.is_bandit:
            raise self._error("reward_form", "network", "but with proxy.horizon=1")

    @property
    def is_bandit(self) -> bool:
        """Whether an episode is one step: a contextual bandit."""
        return self.horizon == 1

    @property
    def needs_task(self) -> bool:
        return self.initial_state == "real"

    def require_task(self, spec: TaskSpec, task_name: str) -> None:
        """Checks that the form of the reward fits the task's actions.

        Raises:
          ConfigError: if it does not fit.
        """
        if self.reward_form != "network" and spec.num_actions is not None:
            raise self._error("reward_form", "network", f"for discrete actions, as of {task_name}")

    @property
    def reaches_step_limit(self) -> bool:
        return self.is_bandit or (self.done == "soft" and self.horizon is None)

    def max_steps(self, task_max_steps: int) -> int:
        return task_max_steps if self.horizon is None else self.horizon

    def networks(self, obs_dim: int, action_dim: int) -> dict[str, list[int]]:
        """Number of inputs and of each layer's units, by network.

        Example:
          >>> SyntheticConfig(hidden_size=8).networks(obs_dim=4, action_dim=2)
          {'reward': [6, 8, 1], 'start': [4, 32, 4]}
        """
        outputs = {"reward": 1} if self.is_bandit else {"state": obs_dim, "reward": 1, "done": 1}
        hidden = [self.hidden_size] * self.num_layers
        networks = {name: [action_dim + obs_dim, *hidden, size] for name, size in outputs.items()}
        if self.reward_form != "network":
            networks["reward"] = [obs_dim, *hidden, action_dim]
        if self.initial_state == "learned":
            networks["start"] = [obs_dim, self.start_hidden_size, obs_dim]
        return networks

    def units(self, low: ArrayLike, high: ArrayLike) -> Units:
        """Units of states between two bounds.

        An entry without bounds keeps its own unit; some spaces write "none" as a huge number.

        Example:
          >>> SyntheticConfig(state_units="bounds").units([-1.5, -np.inf], [0.5, np.inf])
          Units(center=array([-0.5,  0. ], dtype=float32), scale=array([0.5, 1. ], dtype=float32))
        """
        if self.state_units == "raw":
            return Units()
        low, high = np.asarray(low, np.float32), np.asarray(high, np.float32)
        bounded = (np.abs(low) < MAX_ABS_VALUE) & (np.abs(high) < MAX_ABS_VALUE)
        low, high = np.where(bounded, low, -2), np.where(bounded, high, 2)
        center = (low + high) / 2
        scale = np.where(low < high, high - low, 4) / 4
        return Units(center.astype(np.float32), scale.astype(np.float32))

    def make(self, task: Task) -> "SyntheticEnv":
        """The SE of a task.

        Raises:
          ConfigError: if the form of the reward does not fit the task's actions.
        """
        self.require_task(task, task.name)
        return BanditEnv(task, self) if self.is_bandit else SyntheticEnv(task, self)


@struct.dataclass
class SyntheticState(EnvState):
    vector: Array  # [obs_dim]: what the networks see and predict


class SyntheticEnv(ProxyEnv):
    r"""A task whose dynamics, reward and termination are networks; a gymnax 1.x `Environment`.

    Each network maps the action (one-hot if discrete) and the state to the next state, the reward
    or the done output d. If states are discrete, the networks' state is a vector with an entry for
    each state. At first it is one-hot; later it is the next-state network's output. The agent
    observes the index of the largest entry.

    The configuration chooses how episodes begin and end:

    - `initial_state`: the real task's; or standard normal noise; or learned: noise plus a network's
      output for it, so that the initial states of a fresh SE surround the origin.
    - `done`: how d terminates an episode. Targets bootstrap with `info["discount"]`. With "soft" it
      is 1 - d: a learned discount, not confined to [0, 1], which agents outside of sejax do not
      see. Else it is 1 - terminated. "bernoulli" shows the soft discount, clipped to [0, 1], to any
      agent: episodes end with probability 1 - clip(1 - d, 0, 1) = clip(d, 0, 1), so that targets
      are the same on average. Rewards cannot replace the discount: it takes :math:`\gamma d V(s')`
      from a target, and this depends on the agent's own values.
    - `min_steps`: the first step at which d may end an episode.
    - `horizon`: steps of an episode. The last one terminates it. At the task's own limit, with no
      horizon, the episode is truncated.

    Continuous actions are clipped to the task's bounds, as by the task itself.

    An output that is not finite, or beyond `MAX_ABS_VALUE`, ends the episode: the state stays where
    it was, the reward is 0, and `info["nonfinite"]` says whether the output was not finite.
    """

    config: SyntheticConfig

    def __init__(self, task: Task, config: SyntheticConfig):
        super().__init__(task, config)
        self._networks = config.networks(task.obs_dim, task.action_dim)
        self._units = Units()
        if isinstance(task.observation, Box):
            self._units = config.units(task.observation.low, task.observation.high)
            # Without the task's bounds: a learned state need not respect them.
            self.spaces = Box.symmetric(*[MAX_ABS_VALUE] * task.obs_dim), task.action

    def init_weights(self, key: Array) -> dict[str, Any]:
        """Random weights of each network that the SE has: "state", "reward", "done", "start"."""
        # "start" always takes a key, so that stored runs keep their numbers.
        keys = jax.random.split(key, len(self._networks.keys() | {"start"}))
        return {
            name: self._net(name).init(network_key, jnp.zeros(widths[0]))["params"]
            for network_key, (name, widths) in zip(keys, self._networks.items(), strict=False)
        }

    def _net(self, name: str) -> MLP:
        _, *hidden, num_outputs = self._networks[name]
        return MLP(num_outputs, hidden[0], len(hidden), self.config.activation)

    def _apply(self, weights: PyTree, name: str, inputs: Array) -> Any:
        return self._net(name).apply({"params": weights[name]}, inputs)

    def predict(
        self, weights: PyTree, vector: Float[Array, " obs_dim"], action: Array
    ) -> tuple[Float[Array, " obs_dim"], Float[Array, ""], Float[Array, ""]]:
        """The networks' raw outputs: next state, reward and done output d."""
        inputs = self._inputs(vector, action)
        state, reward, done = (self._apply(weights, x, inputs) for x in ("state", "reward", "done"))
        return self._units.decode(state), reward[0], done[0]

    def _inputs(self, vector: Float[Array, " obs_dim"], action: Array) -> Float[Array, " inputs"]:
        """What the networks of a step see: the action, then the state in their units."""
        if self.task.num_actions is not None:
            action = jax.nn.one_hot(action, self.task.num_actions)
        return jnp.concatenate([action, self._units.encode(vector)])

    def reset_env(self, key: Array, params: ProxyParams) -> tuple[Array, SyntheticState]:
        if self.config.initial_state == "real":
            vector, _ = self.task.env.reset_env(key, self.task.params)
            count = self.task.num_states
            vector = jnp.float32(vector) if count is None else jax.nn.one_hot(vector, count)
        else:
            vector = noise = jax.random.normal(key, (self.task.obs_dim,), jnp.float32)
            if self.config.initial_state == "learned":
                vector = noise + self._apply(params.weights, "start", noise)
            # Clipped to the limit, not beyond: a one-step SE, whose state stays, ends there.
            vector = jnp.clip(self._units.decode(vector), -MAX_ABS_VALUE, MAX_ABS_VALUE)
        state = SyntheticState(vector=jnp.float32(vector), time=jnp.int32(0))
        return self.observe(state), state

    def step_env(
        self, key: Array, state: SyntheticState, action: Array, params: ProxyParams
    ) -> tuple[Array, SyntheticState, Array, Array, dict[Any, Any]]:
        if self.task.num_actions is None:  # the networks never learned beyond the bounds
            action = jnp.clip(action, -self.task.max_action, self.task.max_action)
        vector, reward, done = map(jnp.float32, self.predict(params.weights, state.vector, action))
        largest = jnp.maximum(jnp.max(jnp.abs(vector)), jnp.maximum(jnp.abs(reward), jnp.abs(done)))
        is_sane = largest < MAX_ABS_VALUE  # False for nan
        state = SyntheticState(vector=jnp.where(is_sane, vector, state.vector), time=state.time + 1)
        may_end = state.time >= self.config.min_steps
        ends = (self.ends(key, done) & may_end) | ~is_sane
        at_horizon = (self.config.horizon is not None) & (state.time >= params.max_steps_in_episode)
        soft = jnp.where(may_end, 1.0 - done, 1.0)
        discount = soft if self.config.done == "soft" else 1.0 - ends
        info = {
            "discount": jnp.where(is_sane & ~at_horizon, discount, 0.0),
            "nonfinite": ~jnp.isfinite(largest),
        }
        return self.observe(state), state, jnp.where(is_sane, reward, 0.0), ends | at_horizon, info

    def ends(self, key: Array, done: Float[Array, ""]) -> Bool[Array, ""]:
        """Whether the done output ends the episode."""
        if self.config.done == "bernoulli":
            return jax.random.uniform(key) < done  # in [0, 1): never for d <= 0, always for d >= 1
        return done > 0.5

    def is_truncated(self, state: SyntheticState, params: ProxyParams) -> Array:
        """Whether the episode is at its limit. Never with a horizon, which terminates instead."""
        if self.config.horizon is not None:
            return jnp.bool_(False)
        return super().is_truncated(state, params)

    def observe(self, state: SyntheticState) -> Array:
        if self.task.num_states is not None:
            return jnp.argmax(state.vector).astype(jnp.int32)
        return state.vector


class BanditEnv(SyntheticEnv):
    r"""An SE with `horizon=1`, a contextual bandit: its one network makes the reward.

    Its only step terminates the episode and leaves the state as it is. With `reward_form=distance`
    the network's output u(s), in units of the bound b, is the best action:

    .. math:: r(s, a) = -\sum_i |a_i - b\, \mathrm{clip}(u_i(s), -1, 1)|

    Source: this form of the reward: ours.
    """

    def predict(
        self, weights: PyTree, vector: Float[Array, " obs_dim"], action: Array
    ) -> tuple[Float[Array, " obs_dim"], Float[Array, ""], Float[Array, ""]]:
        """The state as it is, the network's reward, and 1."""
        if self.config.reward_form == "network":
            reward = self._apply(weights, "reward", self._inputs(vector, action))
            return vector, reward[0], jnp.float32(1)
        best = self._apply(weights, "reward", self._units.encode(vector))
        difference = action - self.task.max_action * jnp.clip(best, -1.0, 1.0)
        return vector, -jnp.abs(difference).sum(), jnp.float32(1)
