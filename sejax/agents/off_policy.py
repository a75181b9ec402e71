"""The frame of the agents that learn from a replay buffer: DDQN, TD3 and SAC.

It has their options, their warm-up, how a batch is drawn, and the step of Adam on its mean loss.
Each agent's own file has its networks, its loss and its targets.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PyTree

from sejax.agents.base import AgentOptions, AgentSpec, AgentState, Algorithm, Hparams
from sejax.agents.buffers import BufferMaker, Transition, num_columns, replay_buffer, sum_over_batch
from sejax.ops.networks import MLP, init_narrowed
from sejax.ops.optimizers import Params, apply_gradient
from sejax.options import Activation, Count, Depth, Fraction, Positive, option, require


@dataclass(frozen=True, kw_only=True)
class OffPolicyOptions(AgentOptions):
    """Hyperparameters of an agent that learns at each step from a batch of earlier steps.

    The defaults make small agents that learn within 2,000 steps (`docs/agents.md`); `preset=paper`
    has the paper's.

    Attributes:
      batch_size: transitions
      buffer_size: steps
      hidden_size: units of each hidden layer
      learning_rate: of Adam
      tau: Weight of the online network in the target's update.
      discount: gamma
    """

    batch_size: Count = option(64, varied="triple")
    buffer_size: Count = 100_000
    hidden_size: Count = option(64, varied="triple")
    num_layers: Depth = option(1, varied="one_more_or_less")
    activation: Activation = "relu"
    learning_rate: Positive = option(1e-3, traced=True, varied="triple")
    tau: Fraction = option(0.01, traced=True)
    discount: Fraction = option(0.99, traced=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        size = self.buffer_size
        least = self.batch_size
        require(size >= least, "agent.buffer_size", "must hold a batch", got=size, use=least)

    def mlp(self, num_outputs: int) -> MLP:
        """A network with these hidden layers."""
        hidden = (self.hidden_size, self.num_layers, self.activation)
        return MLP(num_outputs, *hidden, learn_prelu_slope=True)


@dataclass(frozen=True, kw_only=True)
class ActorCriticOptions(OffPolicyOptions):
    """Hyperparameters that TD3 and SAC share. Actions are uniformly random in the warm-up.

    Attributes:
      learning_rate: of the actor, the critics and the temperature
      action_repeat: environment steps for each decision
    """

    learning_rate: Positive = 3e-3  # traced and varied, as in the base class
    action_repeat: Count = 1

    def spec(self) -> AgentSpec:
        return replace(super().spec(), action_repeat=self.action_repeat)


class OffPolicy(Algorithm):
    """An agent that keeps its steps in a ring and learns from batches of them."""

    config: OffPolicyOptions

    def buffer(self) -> BufferMaker:
        return replay_buffer(self.config.batch_size, self.config.buffer_size)


@dataclass(eq=False)
class ActorCritic(OffPolicy):
    """An off-policy agent that acts at random while its state's `is_warming_up` is set.

    Args:
      config: hyperparameters.
      obs_dim: length of an observation.
      action_dim: length of an action, or the number of discrete actions.
      max_action: the largest continuous action.
    """

    config: ActorCriticOptions
    obs_dim: int
    action_dim: int
    max_action: float = 1.0

    def __post_init__(self) -> None:
        num_outputs, self.num_action_inputs, num_values = self.network_sizes()
        self.actor = self.config.mlp(num_outputs)
        self.critic = self.config.mlp(num_values)

    def network_sizes(self) -> tuple[int, int, int]:
        """Outputs of the actor, inputs of a critic beside the observation, and its outputs.

        Here for an actor with a number for each action, and critics that see the action and give
        one value. Where a critic has an output for each action, it sees none.
        """
        return self.action_dim, self.action_dim, 1

    def init_networks(self, key: Array, hparams: Hparams) -> tuple[Any, Any]:
        """Parameters of the actor, and of two critics, `[2, ...]`."""
        key_actor, key_critics = jax.random.split(key)
        num_inputs = self.obs_dim + self.num_action_inputs
        size = hparams.hidden_size
        init_critics = jax.vmap(lambda key: init_narrowed(self.critic, key, num_inputs, size))
        actor = init_narrowed(self.actor, key_actor, self.obs_dim, size)
        return actor, init_critics(jax.random.split(key_critics))

    def actor_outputs(self, actor: PyTree, obs: Array) -> Float[Array, "outputs *batch"]:
        """The actor's outputs."""
        return cast(Array, self.actor.apply(actor, obs))

    def begin_episode(self, state: AgentState, episode: Array) -> AgentState:
        return state.replace(is_warming_up=jnp.asarray(episode < self.config.warmup_episodes))


def adam_step(
    sum_of_losses: Callable[..., Array],
    params: Params,
    opt_state: optax.OptState,
    columns: tuple[Transition, *tuple[PyTree, ...]],
    hparams: Hparams,
) -> tuple[Params, optax.OptState]:
    """One step of Adam on a batch's mean loss; only blocks with columns in use cost time.

    Args:
      sum_of_losses: `(params, *columns) -> []`, the losses of the columns times their weights.
      params: the parameters to move.
      opt_state: of `sejax.ops.optimizers.ADAM`.
      columns: a batch, and other arrays with the same columns, such as noise.
      hparams: `learning_rate`, and `batch_size` in use or None.
    """
    total = sum_over_batch(
        lambda block: jax.grad(sum_of_losses)(params, *block), columns, hparams.batch_size
    )
    count = num_columns(columns[0])
    gradient = jax.tree.map(lambda x: x / count, total)
    return apply_gradient(params, opt_state, gradient, hparams.learning_rate)
