"""Tabular Q-learning and SARSA: one value for each pair of a state and an action.

Source: Watkins, "Learning from Delayed Rewards" (1989); Rummery and Niranjan, "On-Line Q-Learning
Using Connectionist Systems" (1994); paper, appendix, tables of Cliff Walking;
`docs/reference.md` 4.6.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from sejax.agents.base import Agent, AgentOptions, AgentSpec, Algorithm, Hparams
from sejax.agents.buffers import BufferMaker, Transition, no_buffer
from sejax.agents.policies import decayed_epsilon, epsilon_greedy
from sejax.envs.base import Task
from sejax.options import Fraction, Positive, WholeNumber, option


@dataclass(frozen=True, kw_only=True)
class QLearningConfig(AgentOptions):
    r"""Tabular Q-learning (paper, appendix "Cliff Walking").

    .. math:: Q(s, a) \leftarrow Q(s, a) + \alpha (r + \gamma d \max_{a'} Q(s', a') - Q(s, a))

    with the transition's own discount d. Q starts at 0. The agent learns from each step once, right
    after the step.

    Differs: in an SE with `done="soft"` d is the learned 1 - done. The authors' tabular agents
    bootstrap in full if done < 0.5 and else not at all, as with `done="threshold"`.
    """

    states: ClassVar[str | None] = "discrete"

    warmup_episodes: WholeNumber = 0
    learning_rate: Positive = option(1.0, traced=True, varied="tenth_to_one")
    discount: Fraction = option(0.8, traced=True, varied="tenth_to_one")
    epsilon_init: Fraction = option(0.1, traced=True)
    epsilon_min: Fraction = option(0.1, traced=True)
    epsilon_decay: Fraction = option(0.0, traced=True)

    def spec(self) -> AgentSpec:
        return replace(super().spec(), cpu_num_parallel=None)

    def make(self, task: Task) -> Agent:
        """The agent for a task's numbers of states and actions."""
        assert task.num_states is not None and task.num_actions is not None
        return Tabular(self, task.num_states, task.num_actions).agent()

    def next_value(
        self, key: Array, q_row: Float[Array, " num_actions"], epsilon: Array
    ) -> Float[Array, ""]:
        """The next state's value in the target, given the state's row of Q."""
        return jnp.max(q_row)


@dataclass(frozen=True, kw_only=True)
class SARSAConfig(QLearningConfig):
    r"""Tabular SARSA; the same hyperparameters.

    .. math:: Q(s, a) \leftarrow Q(s, a) + \alpha (r + \gamma d \, Q(s', a') - Q(s, a))

    As in the authors' code, the learning step draws a' from the epsilon-greedy policy. The agent
    does not execute a': it draws its next action anew, after this update.

    Differs: in SEs, as Q-learning does.
    """

    def next_value(
        self, key: Array, q_row: Float[Array, " num_actions"], epsilon: Array
    ) -> Float[Array, ""]:
        action = epsilon_greedy(key, q_row, epsilon)
        return jnp.sum(jnp.where(jnp.arange(q_row.size) == action, q_row, 0.0))


class TabularState(struct.PyTreeNode):
    """One agent."""

    q_values: Float[Array, "num_states num_actions"]
    epsilon: Array
    hparams: Hparams


class Tabular(Algorithm):
    """The agent for observations `0..num_states-1` and actions `0..num_actions-1`.

    Example:
      >>> import jax
      >>> agent = Tabular(SARSAConfig(), num_states=48, num_actions=4).agent()
      >>> state = agent.init(jax.random.key(0), agent.hparams)
      >>> int(agent.act(jax.random.key(1), state, jnp.int32(36), explore=False))
      0
    """

    config: QLearningConfig

    def __init__(self, config: QLearningConfig, num_states: int, num_actions: int):
        self.config = config
        self.shape = (num_states, num_actions)

    def buffer(self) -> BufferMaker:
        return no_buffer()

    def init(self, key: Array, hparams: Hparams) -> TabularState:
        return TabularState(
            q_values=jnp.zeros(self.shape, jnp.float32),
            epsilon=hparams.epsilon_init,
            hparams=hparams,
        )

    def begin_episode(self, state: TabularState, episode: Array) -> TabularState:
        return state.replace(epsilon=decayed_epsilon(state.hparams, episode))

    def act(self, key: Array, state: TabularState, obs: Int[Array, ""], explore: bool) -> Array:
        return epsilon_greedy(key, row_of(state.q_values, obs), state.epsilon, explore)

    def update(self, key: Array, state: TabularState, batch: Transition) -> TabularState:
        hp = state.hparams
        value = self.config.next_value(key, row_of(state.q_values, batch.next_obs), state.epsilon)
        target = batch.reward + hp.discount * batch.discount * value
        is_visited = mask_of(batch.obs, batch.action, self.shape)
        moved = state.q_values + hp.learning_rate * (target - state.q_values)
        return state.replace(q_values=jnp.where(is_visited, moved, state.q_values))


# Tables are read by index and written by mask. Under `vmap` on a CPU, reading by a mask over the
# whole table would make a training step three times as long. Writing by a mask joins the trainer's
# own selects over the table; a scatter would be one more operation.


def row_of(table: Array, state: Int[Array, ""]) -> Array:
    """A state's entries of a table `[num_states, num_actions]`, `[num_actions]`."""
    return table.at[state].get(mode="promise_in_bounds")


def mask_of(state: Int[Array, ""], action: Int[Array, ""], shape: tuple[int, int]) -> Array:
    """True at one entry of a table of this shape, `[num_states, num_actions]` bool."""
    num_states, num_actions = shape
    entry = jnp.arange(num_states * num_actions, dtype=jnp.int32).reshape(shape)
    return entry == state.astype(jnp.int32) * num_actions + action
