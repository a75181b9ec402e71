"""Double DQN with soft target updates and Adam, with a plain or a dueling network.

Source: van Hasselt et al., "Deep RL with Double Q-learning" (2016); the paper's hyperparameter
tables; `docs/reference.md` 4.1 and 4.2.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from flax import struct
from jaxtyping import Array, Float

from sejax.agents import flat
from sejax.agents.agent import Agent, AgentOptions, traced
from sejax.agents.epsilon_greedy import decayed_epsilon, epsilon_greedy
from sejax.agents.memory import replay_memory
from sejax.agents.partial_batch import sum_over_batch
from sejax.agents.replay import Transition, num_columns
from sejax.networks import ACTIVATIONS, MLP, DuelingMLP, narrow
from sejax.options import counts, fraction, one_of, option, positive

MOVES = "the agent would not move"


@dataclass(frozen=True, kw_only=True)
class DDQNConfig(AgentOptions):
    """DDQN's hyperparameters; the defaults are the paper's "default agent hyperparameters"."""

    batch_size: int = option(128, counts(), varied="triple")
    buffer_size: int = option(100_000, counts())
    hidden_size: int = option(128, counts(), varied="triple")
    num_layers: int = option(2, counts(), varied="one_more_or_less")
    activation: str = option("relu", one_of(ACTIVATIONS))
    learning_rate: float = option(1e-3, positive(MOVES), traced=True, varied="triple")
    # tau: weight of the online network in the target's update
    target_update_rate: float = option(0.01, fraction(), traced=True)
    discount: float = option(0.99, fraction(), traced=True)  # gamma
    epsilon_init: float = option(1.0, fraction(), traced=True)
    epsilon_min: float = option(0.01, fraction(), traced=True)
    epsilon_decay: float = option(0.9, fraction(), traced=True)  # factor for each episode

    def make(self, task: Any) -> Agent:
        """The agent for a task's observations and actions."""
        return make_ddqn(self, task.obs_dim, task.num_actions)

    def network(self, num_actions: int) -> nn.Module:
        """Maps observations `[obs_dim, *batch]` to Q values `[num_actions, *batch]`."""
        return MLP(
            num_actions, self.hidden_size, self.num_layers, self.activation,
            learn_prelu_slope=True,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class DuelingDDQNConfig(DDQNConfig):
    """DDQN with a dueling network (paper, appendix, tables of DDQN and Dueling DDQN)."""

    feature_dim: int = option(128, counts())  # outputs of the part that both streams share
    # Hidden layers of the value and of the advantage stream.
    stream_num_layers: int = option(1, counts("it counts layers", least=0))
    stream_hidden_size: int = option(128, counts())

    def network(self, num_actions: int) -> nn.Module:
        return DuelingMLP(
            num_actions, self.feature_dim, self.hidden_size, self.num_layers,
            self.stream_hidden_size, self.stream_num_layers, self.activation,
        )  # fmt: skip


@struct.dataclass
class DDQNState:
    """One agent."""

    params: Float[Array, " num_params"]
    target_params: Float[Array, " num_params"]
    opt_state: optax.OptState
    epsilon: Array
    hparams: Any  # traced options, and hidden_size and batch_size in use or None


@functools.cache
def make_ddqn(config: DDQNConfig, obs_dim: int, num_actions: int) -> Agent:
    """Builds the agent for observations `[obs_dim]` and actions `0..num_actions-1`.

    A `DuelingDDQNConfig` makes its network a dueling one.

    Example:
      >>> agent = make_ddqn(DDQNConfig(), obs_dim=4, num_actions=2)
      >>> state = agent.init(jax.random.key(0), agent.hparams)
      >>> int(agent.act(jax.random.key(1), state, jnp.zeros(4), explore=False)) in (0, 1)
      True
    """
    network = config.network(num_actions)
    unflatten = flat.unflattener(network.init, jnp.zeros(obs_dim))

    def init(key: Array, hparams: Any) -> DDQNState:
        variables = network.init(key, jnp.zeros(obs_dim))
        if hparams.hidden_size is not None:
            variables = {"params": narrow(variables["params"], hparams.hidden_size)}
        params = flat.flatten(variables)
        hparams = jax.tree.map(jnp.float32, hparams)
        return DDQNState(
            params=params,
            target_params=params,
            opt_state=flat.ADAM.init(params),
            epsilon=jnp.float32(hparams.epsilon_init),
            hparams=hparams,
        )

    def act(key: Array, state: DDQNState, obs: Float[Array, " obs_dim"], explore: bool) -> Array:
        q_values: Any = network.apply(unflatten(state.params), obs)
        if not explore:
            return jnp.argmax(q_values).astype(jnp.int32)
        return epsilon_greedy(key, q_values, state.epsilon)

    return Agent(
        init=init,
        begin_episode=begin_episode,
        act=act,
        update=make_learning_step(network, unflatten),
        hparams=traced(config, hidden_size=None, batch_size=None),
        memory=replay_memory(config.batch_size, config.buffer_size),
        init_episodes=config.init_episodes,
        learns_from=config.init_episodes,
        batch_size=lambda state: state.hparams.batch_size,
    )


def begin_episode(state: DDQNState, episode: Array) -> DDQNState:
    """The share of random actions in the episode."""
    hp = state.hparams
    epsilon = decayed_epsilon(hp.epsilon_init, hp.epsilon_min, hp.epsilon_decay, episode)
    return state.replace(epsilon=epsilon)


def make_learning_step(
    network: nn.Module, unflatten: Callable[[Array], Any]
) -> Callable[[Array, DDQNState, Transition], DDQNState]:
    """Builds `update(key, state, batch) -> state`: Adam on the squared error to double-Q targets.

    Source: van Hasselt et al. (2016), eq. 4; `docs/reference.md` 4.1.
    """

    def sum_of_losses(params, target_params, discount, batch: Transition) -> Array:
        q_values = network.apply(params, batch.obs)  # [actions, batch]
        targets = double_q_targets(
            network.apply(params, batch.next_obs),
            network.apply(target_params, batch.next_obs),
            batch.reward,
            discount * batch.discount,
        )
        error = select_action(q_values, batch.action) - jax.lax.stop_gradient(targets)
        return jnp.sum(batch.weight * error**2)

    def update(key: Array, state: DDQNState, batch: Transition) -> DDQNState:
        hp = state.hparams
        params, target_params = unflatten(state.params), unflatten(state.target_params)

        def sum_of_gradients(batch: Transition) -> Array:
            return flat.flatten(jax.grad(sum_of_losses)(params, target_params, hp.discount, batch))

        gradient = sum_over_batch(sum_of_gradients, batch, hp.batch_size) / num_columns(batch)
        moved, opt_state = flat.adam_step(state.params, state.opt_state, gradient, hp.learning_rate)
        tau = hp.target_update_rate
        return state.replace(
            params=moved,
            target_params=tau * moved + (1 - tau) * state.target_params,
            opt_state=opt_state,
        )

    return update


def double_q_targets(
    online_next_q: Float[Array, "actions batch"],
    target_next_q: Float[Array, "actions batch"],
    reward: Float[Array, " batch"],
    discount: Float[Array, " batch"],
) -> Float[Array, " batch"]:
    r"""Targets :math:`r + \gamma\, Q'(s', \arg\max_a Q(s', a))`.

    Args:
      online_next_q: Q of the online network at the next states.
      target_next_q: Q' of the target network at the next states.
      reward: in the task's units.
      discount: gamma times the transition's own discount.

    Source: van Hasselt et al. (2016), eq. 4.
    """
    best = jnp.argmax(online_next_q, axis=0)
    return reward + discount * select_action(target_next_q, best)


def select_action(q_values: Float[Array, "actions batch"], action: Array) -> Float[Array, " batch"]:
    """Q of each column's action, by mask: gathers and their gradients are slow on CPU."""
    mask = jnp.arange(q_values.shape[0])[:, None] == action[None, :]
    return jnp.sum(jnp.where(mask, q_values, 0.0), axis=0)
