r"""What every agent strives for in a one-step SE, without training one.

An SE whose episodes are one step is a contextual bandit, and for a bandit the policy that maximises
reward plus `temperature` times entropy is known:

.. math:: \pi(a \mid s) \propto \exp(r(s, a) / \tau)

Where trainings are the inner loop's whole cost, SEs can be learned with this policy in their place.
It is what soft actor-critic tends to, and a stern examiner: it plays at random between actions
whose rewards lie within the temperature of each other, so an SE has to tell them apart clearly.

Source: Ziebart, "Modeling Purposeful Adaptive Behavior with the Principle of Maximum Causal
Entropy" (2010); Haarnoja et al., "Reinforcement Learning with Deep Energy-Based Policies" (2017),
theorem 1, of which a bandit is the case without a next state.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from gymnax.environments.environment import Environment
from jaxtyping import Array, Float, PyTree

from sejax.agents.base import Agent, AgentConfig, Hparams, traced
from sejax.agents.buffers import no_buffer
from sejax.envs.base import Task
from sejax.options import counts, option, positive, require

MOST_DIMS = 2  # of continuous actions: there are num_points to the power of these


@dataclass(frozen=True, kw_only=True)
class BoltzmannConfig(AgentConfig):
    """The Boltzmann policy of a one-step SE's rewards."""

    states: ClassVar[str | None] = "vector"
    is_solved_for: ClassVar[bool] = True

    # What a nat of entropy is worth, in the SE's rewards.
    temperature: float = option(
        0.3,
        positive("a policy without entropy is told nothing of how clear rewards are"),
        traced=True,
    )
    # Values of each number of a continuous action, evenly spaced over its range.
    num_points: int = option(33, counts("a policy chooses", least=2))

    def make(self, task: Task) -> Agent:
        """The agent for a task's actions.

        Raises:
          ConfigError: for continuous actions of more than two numbers.
        """
        if task.num_actions is not None:
            return make_boltzmann(self, jnp.arange(task.num_actions))
        require(
            task.action_dim <= MOST_DIMS,
            "agent",
            f"must be one that learns where actions have more than {MOST_DIMS} numbers; got "
            f"boltzmann for {task.action_dim} of them. Set agent=sac.",
        )
        points = np.linspace(-task.max_action, task.max_action, self.num_points, dtype=np.float32)
        grid = np.meshgrid(*[points] * task.action_dim, indexing="ij")
        return make_boltzmann(self, jnp.stack([x.ravel() for x in grid], axis=1))


class BoltzmannState(struct.PyTreeNode):
    """One agent: the rewards of its environment, and how it weighs them."""

    reward: Callable[[Array, Array], Array]  # `(obs, action) -> []`, a pytree
    hparams: Hparams


def make_boltzmann(config: BoltzmannConfig, actions: Array) -> Agent:
    """The policy over some actions, `[num_actions]` indices or `[num_actions, action_dim]`.

    It takes no step of training: `Agent.solve` reads the rewards of the environment, an SE with
    `proxy.horizon=1`. Tests play the policy as it is, at random.

    Example:
      >>> import sejax
      >>> env, params = sejax.load("cartpole")
      >>> agent = sejax.make_agent(BoltzmannConfig(), env.task)
      >>> state = agent.solve(env, params, agent.hparams)
      >>> int(agent.act(jax.random.key(0), state, jnp.zeros(4), explore=False)) in (0, 1)
      True
    """

    def solve(env: Environment, env_params: PyTree, hparams: Hparams) -> BoltzmannState:
        require(
            getattr(env, "is_bandit", False),
            "agent",
            "must be one that learns, or the proxy an SE whose episodes are one step; got "
            f"boltzmann in {env.name}. Set agent=ddqn, or proxy.horizon=1.",
        )
        reward = jax.tree_util.Partial(env.bandit_reward, env_params.weights)
        return BoltzmannState(reward=reward, hparams=jax.tree.map(jnp.float32, hparams))

    def act(key: Array, state: BoltzmannState, obs: Array, explore: bool) -> Array:
        return actions[jax.random.categorical(key, log_weights(state, obs, actions))]

    return Agent(
        init=_needs_no_training,
        act=act,
        update=_needs_no_training,
        buffer=no_buffer(),
        hparams=traced(config),
        discount=lambda hparams: 1.0,
        solve=solve,
    )


def log_weights(
    state: BoltzmannState, obs: Float[Array, " obs_dim"], actions: Array
) -> Float[Array, " num_actions"]:
    """Logarithms of the actions' probabilities, but for a constant."""
    return jax.vmap(state.reward, (None, 0))(obs, actions) / state.hparams.temperature


def _needs_no_training(*_: PyTree) -> NoReturn:
    raise NotImplementedError("the Boltzmann policy is solved for, not trained: Agent.solve")
