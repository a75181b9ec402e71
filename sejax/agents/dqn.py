"""Double DQN with soft target updates and Adam, with a plain or a dueling network; DQN.

Source: van Hasselt et al., "Deep RL with Double Q-learning" (2016); Mnih et al., "Human-level
control through deep reinforcement learning" (2015); the paper's hyperparameter tables;
`docs/reference.md` 4.1 and 4.2.
"""

from dataclasses import dataclass, replace
from typing import Annotated, cast

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from flax import struct
from jaxtyping import Array, Float, Int, PyTree
from pydantic import Field

from sejax.agents.base import Agent, AgentSpec, Hparams
from sejax.agents.buffers import Transition
from sejax.agents.off_policy import OffPolicy, OffPolicyOptions, adam_step
from sejax.agents.policies import decayed_epsilon, epsilon_greedy, value_of_action
from sejax.envs.base import Task
from sejax.ops import cpu
from sejax.ops.networks import DuelingMLP, init_narrowed
from sejax.ops.optimizers import ADAM
from sejax.options import Count, Fraction, option


@dataclass(frozen=True, kw_only=True)
class DDQNConfig(OffPolicyOptions):
    """DDQN's hyperparameters.

    Attributes:
      epsilon_init: share of random actions
      epsilon_decay: factor for each episode
      exploration_steps: If given, epsilon falls linearly over this many steps after the agent first
        learns, and not by episodes: for environments with episodes of one or two steps.
      double: the online network chooses the action in a target; else the target network does
    """

    epsilon_init: Fraction = option(1.0, traced=True)
    epsilon_min: Fraction = option(0.01, traced=True)
    epsilon_decay: Fraction = option(0.9, traced=True)
    exploration_steps: Count | None = option(1000, traced=True)
    double: bool = True

    def spec(self) -> AgentSpec:
        is_small = self.num_layers == 1 and self.hidden_size * self.batch_size <= cpu.SMALL_PRODUCT
        width = cpu.SMALL_NUM_PARALLEL if is_small else 1
        return replace(super().spec(), cpu_num_parallel=width)

    def make(self, task: Task) -> Agent:
        """The agent for a task's observations and actions."""
        assert task.num_actions is not None
        return DDQN(self, task.obs_dim, task.num_actions).agent()

    def network(self, num_actions: int) -> nn.Module:
        """Maps observations `[obs_dim, *batch]` to Q values `[num_actions, *batch]`."""
        return self.mlp(num_actions)


@dataclass(frozen=True, kw_only=True)
class DuelingDDQNConfig(DDQNConfig):
    """DDQN with a dueling network (paper, appendix, tables of DDQN and Dueling DDQN).

    Attributes:
      feature_dim: outputs of the part that both streams share
      stream_num_layers: Hidden layers of the value and of the advantage stream.
    """

    feature_dim: Count = 64
    stream_num_layers: Annotated[int, Field(ge=0, le=100)] = 1
    stream_hidden_size: Count = 32

    def network(self, num_actions: int) -> nn.Module:
        stream = self.mlp(1).clone(
            hidden_size=self.stream_hidden_size, num_layers=self.stream_num_layers
        )
        return DuelingMLP(
            features=self.mlp(self.feature_dim),
            value=stream,
            advantage=stream.clone(num_outputs=num_actions),
        )

    def spec(self) -> AgentSpec:
        # Under vmap its two streams make a step 1.5 times as long.
        return replace(super().spec(), cpu_num_parallel=1)


@dataclass(frozen=True, kw_only=True)
class DQNConfig(DDQNConfig):
    """DQN: without double Q-learning."""

    double: bool = False
    epsilon_min: Fraction = 0.05


class DDQNState(struct.PyTreeNode):
    """One agent."""

    params: PyTree
    target_params: PyTree
    opt_state: optax.OptState
    epsilon: Array
    num_updates: Int[Array, ""]  # learning steps so far
    hparams: Hparams


class DDQN(OffPolicy):
    """The agent for observations `[obs_dim]` and actions `0..num_actions-1`.

    A `DuelingDDQNConfig` makes its network a dueling one.

    Example:
      >>> agent = DDQN(DDQNConfig(), obs_dim=4, num_actions=2).agent()
      >>> state = agent.init(jax.random.key(0), agent.hparams)
      >>> int(agent.act(jax.random.key(1), state, jnp.zeros(4), explore=False)) in (0, 1)
      True
    """

    config: DDQNConfig

    def __init__(self, config: DDQNConfig, obs_dim: int, num_actions: int):
        self.config = config
        self.obs_dim = obs_dim
        self.network = config.network(num_actions)

    def init(self, key: Array, hparams: Hparams) -> DDQNState:
        params = init_narrowed(self.network, key, self.obs_dim, hparams.hidden_size)
        return DDQNState(
            params=params,
            target_params=params,
            opt_state=ADAM.init(params),
            epsilon=hparams.epsilon_init,
            num_updates=jnp.int32(0),
            hparams=hparams,
        )

    def begin_episode(self, state: DDQNState, episode: Array) -> DDQNState:
        """Sets the share of random actions in the episode, unless it falls with steps."""
        if state.hparams.exploration_steps is not None:
            return state
        return state.replace(epsilon=decayed_epsilon(state.hparams, episode))

    def q_values(self, params: PyTree, obs: Array) -> Float[Array, "actions *batch"]:
        return cast(Array, self.network.apply(params, obs))

    def act(self, key: Array, state: DDQNState, obs: Array, explore: bool) -> Array:
        return epsilon_greedy(key, self.q_values(state.params, obs), state.epsilon, explore)

    def update(self, key: Array, state: DDQNState, batch: Transition) -> DDQNState:
        r"""A step of Adam on the error to double-Q targets; then the target network follows.

        .. math:: r + \gamma d\, Q'(s', \arg\max_a Q(s', a))

        with the target network Q' and the transition's own discount d. With Q' in place of the
        online network Q the targets are DQN's.

        Source: van Hasselt et al. (2016), eq. 4; `docs/reference.md` 4.1.
        """
        hp = state.hparams

        def sum_of_losses(params: PyTree, batch: Transition) -> Array:
            # [actions, batch]
            target_next_q = self.q_values(state.target_params, batch.next_obs)
            next_q = self.q_values(params, batch.next_obs) if self.config.double else target_next_q
            discount = hp.discount * batch.discount
            next_action = jnp.argmax(next_q, axis=0)
            targets = batch.reward + discount * value_of_action(target_next_q, next_action)
            predicted = value_of_action(self.q_values(params, batch.obs), batch.action)
            return jnp.sum(batch.weight * (predicted - jax.lax.stop_gradient(targets)) ** 2)

        params, opt_state = adam_step(sum_of_losses, state.params, state.opt_state, (batch,), hp)
        num_updates = state.num_updates + 1
        steps_decide = hp.exploration_steps is not None
        return state.replace(
            params=params,
            target_params=optax.incremental_update(params, state.target_params, hp.tau),
            opt_state=opt_state,
            num_updates=num_updates,
            epsilon=linear_epsilon(hp, num_updates) if steps_decide else state.epsilon,
        )


def linear_epsilon(hparams: Hparams, num_updates: Array) -> Array:
    """The share of random actions after `num_updates` learning steps, `[]`.

    It falls from `hparams.epsilon_init` to `epsilon_min` in `exploration_steps`, and stays there.

    Source: Mnih et al. (2015), extended data table 1 (final exploration frame).
    """
    progress = jnp.minimum(num_updates / hparams.exploration_steps, 1.0)
    return hparams.epsilon_init + progress * (hparams.epsilon_min - hparams.epsilon_init)
