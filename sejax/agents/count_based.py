"""Count-based exploration: a bonus for actions that a tabular agent has rarely learned from.

Source: Strehl and Littman, "An Analysis of Model-Based Interval Estimation for Markov Decision
Processes" (2008); paper, section "Experiments with Reward Networks", paragraph "Baselines", and
appendix, table of count-based Q-learning; `docs/reference.md` 4.7.
"""

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Int

from sejax.agents.base import Agent
from sejax.agents.replay import Transition
from sejax.agents.tabular import entry_of, mask_of
from sejax.options import Options, not_negative, option, positive


@dataclass(frozen=True, kw_only=True)
class CountBasedConfig(Options):
    r"""A bonus :math:`\beta / n(s, a)^p` for rarely taken actions."""

    group: ClassVar[str] = "exploration"
    states: ClassVar[str] = "discrete"  # of the agents that it is made for

    reward_scale: float = option(0.1, not_negative("it scales a bonus"))  # beta
    # p: 1 in the paper's text, 0.5 in the authors' code
    count_power: float = option(1.0, positive("the bonus would not fade"))

    def make(self, agent: Agent, task: Any) -> Agent:
        """The agent with the bonus."""
        return with_count_bonus(agent, self, task.num_states, task.num_actions)


class CountingHparams(NamedTuple):
    """Traced hyperparameters of a counting agent: those of the agent inside, and the bonus's."""

    agent: Any
    reward_scale: Array | float  # beta


@struct.dataclass
class CountingState:
    """One counting agent: the state of the agent inside, and the learning steps on each pair."""

    agent_state: Any
    counts: Int[Array, "num_states num_actions"]
    reward_scale: Array


@functools.cache
def with_count_bonus(
    agent: Agent, config: CountBasedConfig, num_states: int, num_actions: int
) -> Agent:
    r"""The same agent, learning from rewards with a bonus for rare pairs of state and action.

    .. math:: n(s, a) \leftarrow n(s, a) + 1, \quad r \leftarrow r + \beta / n(s, a)^p

    for the step at hand, before the learning step of the agent inside. The power p is 1 in the
    paper's text and 1/2 in the authors' code.

    Args:
      agent: one that learns from single steps with indices as observations and actions, from
        `sejax.agents.tabular`.
      config: beta, in reward units, and the power.
      num_states: number of different observations.
      num_actions: number of different actions.

    Example:
      >>> import jax
      >>> from sejax.agents.tabular import QLearningConfig, make_q_learning
      >>> plain = make_q_learning(QLearningConfig(), num_states=48, num_actions=4)
      >>> agent = with_count_bonus(plain, CountBasedConfig(), num_states=48, num_actions=4)
      >>> state = agent.init(jax.random.key(0), agent.hparams)
      >>> int(agent.act(jax.random.key(1), state, jnp.int32(36), explore=False))
      0
    """

    def init(key: Array, hparams: CountingHparams) -> CountingState:
        return CountingState(
            agent_state=agent.init(key, hparams.agent),
            counts=jnp.zeros((num_states, num_actions), jnp.int32),
            reward_scale=jnp.float32(hparams.reward_scale),
        )

    def begin_episode(state: CountingState, episode: Array) -> CountingState:
        return state.replace(agent_state=agent.begin_episode(state.agent_state, episode))

    def act(key: Array, state: CountingState, obs: Int[Array, ""], explore: bool) -> Array:
        return agent.act(key, state.agent_state, obs, explore)

    def update(key: Array, state: CountingState, transition: Transition) -> CountingState:
        obs, action = transition.obs, transition.action
        count = entry_of(state.counts, obs, action) + 1
        is_visited = mask_of(obs, action, (num_states, num_actions))
        bonus = state.reward_scale * count.astype(jnp.float32) ** -config.count_power
        transition = transition._replace(reward=transition.reward + bonus)
        return state.replace(
            agent_state=agent.update(key, state.agent_state, transition),
            counts=jnp.where(is_visited, count, state.counts),
        )

    return dataclasses.replace(
        agent,
        init=init,
        begin_episode=begin_episode,
        act=act,
        update=update,
        hparams=CountingHparams(agent=agent.hparams, reward_scale=config.reward_scale),
        discount=lambda hparams: agent.discount(hparams.agent),
    )
