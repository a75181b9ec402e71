"""Double DQN with soft target updates and Adam, with a plain or a dueling network.

Source: van Hasselt et al., "Deep RL with Double Q-learning" (2016); the paper's hyperparameter
tables; `reference_details.md` 4.1 and 4.2.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from flax import struct
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from sejax.agents.agent import Agent, hparams_of
from sejax.agents.blocks import sum_over_batch
from sejax.agents.configs import DDQNConfig, DuelingDDQNConfig
from sejax.agents.epsilon_greedy import decayed_epsilon, epsilon_greedy
from sejax.agents.memory import replay_memory
from sejax.agents.replay import Transition, num_columns
from sejax.networks import MLP, DuelingMLP, narrow


class DDQNHparams(NamedTuple):
    """The traced hyperparameters, scalars that a population of agents may vary."""

    learning_rate: Array | float
    target_update_rate: Array | float
    discount: Array | float
    epsilon_init: Array | float
    epsilon_min: Array | float
    epsilon_decay: Array | float
    hidden_size: Array | None = None  # units in use, if fewer than the network has
    batch_size: Array | None = None  # columns in use, if fewer than a batch has


@struct.dataclass
class DDQNState:
    """One agent. Parameters are flat vectors: Adam over one array costs a fifth of four."""

    params: Float[Array, " num_params"]
    target_params: Float[Array, " num_params"]
    opt_state: optax.OptState
    epsilon: Array
    hparams: DDQNHparams


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
    network = q_network(config, num_actions)
    template = jax.eval_shape(network.init, jax.random.key(0), jnp.zeros(obs_dim))
    _, unravel = ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape), template))
    adam = optax.scale_by_adam()

    def init(key: Array, hparams: DDQNHparams) -> DDQNState:
        variables = network.init(key, jnp.zeros(obs_dim))
        if hparams.hidden_size is not None:
            variables = {"params": narrow(variables["params"], hparams.hidden_size)}
        params, _ = ravel_pytree(variables)
        hparams = jax.tree.map(jnp.float32, hparams)
        return DDQNState(
            params=params,
            target_params=params,
            opt_state=adam.init(params),
            epsilon=jnp.float32(hparams.epsilon_init),
            hparams=hparams,
        )

    def begin_episode(state: DDQNState, episode: Array) -> DDQNState:
        hp = state.hparams
        epsilon = decayed_epsilon(hp.epsilon_init, hp.epsilon_min, hp.epsilon_decay, episode)
        return state.replace(epsilon=epsilon)

    def act(key: Array, state: DDQNState, obs: Float[Array, " obs_dim"], explore: bool) -> Array:
        q_values: Any = network.apply(unravel(state.params), obs)
        if not explore:
            return jnp.argmax(q_values).astype(jnp.int32)
        return epsilon_greedy(key, q_values, state.epsilon)

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
        params, target_params = unravel(state.params), unravel(state.target_params)

        def sum_of_gradients(batch: Transition) -> Array:
            gradient = jax.grad(sum_of_losses)(params, target_params, hp.discount, batch)
            return ravel_pytree(gradient)[0]

        gradient = sum_over_batch(sum_of_gradients, batch, hp.batch_size) / num_columns(batch)
        direction, opt_state = adam.update(gradient, state.opt_state)
        params = state.params - hp.learning_rate * direction
        tau = hp.target_update_rate
        return state.replace(
            params=params,
            target_params=tau * params + (1 - tau) * state.target_params,
            opt_state=opt_state,
        )

    return Agent(
        init=init,
        begin_episode=begin_episode,
        act=act,
        update=update,
        hparams=hparams_of(DDQNHparams, config),
        memory=replay_memory(config.batch_size, config.buffer_size),
        init_episodes=config.init_episodes,
        learns_from=config.init_episodes,
        batch_size=lambda state: state.hparams.batch_size,
    )


def q_network(config: DDQNConfig, num_actions: int) -> nn.Module:
    """Maps observations `[obs_dim, *batch]` to Q values `[num_actions, *batch]`."""
    if isinstance(config, DuelingDDQNConfig):
        return DuelingMLP(
            num_actions, config.feature_dim, config.hidden_size, config.num_layers,
            config.stream_hidden_size, config.stream_num_layers, config.activation,
        )  # fmt: skip
    return MLP(
        num_actions, config.hidden_size, config.num_layers, config.activation,
        learn_prelu_slope=True,
    )  # fmt: skip


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
