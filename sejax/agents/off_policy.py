"""What the agents with a replay buffer share: DDQN, TD3 and SAC."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from sejax.agents.base import Agent, AgentOptions, AgentSpec, traced
from sejax.agents.buffers import num_columns, replay_buffer, sum_over_batch
from sejax.ops.networks import MLP
from sejax.options import (
    ACTIVATIONS,
    MOST_LAYERS,
    MOVES,
    counts,
    fraction,
    one_of,
    option,
    positive,
    require,
)


@dataclass(frozen=True, kw_only=True)
class OffPolicyOptions(AgentOptions):
    """Hyperparameters of an agent that learns at each step from a batch of earlier ones."""

    batch_size: int = option(128, counts(), varied="triple")  # transitions
    buffer_size: int = option(100_000, counts())  # steps
    hidden_size: int = option(128, counts(), varied="triple")  # units of each hidden layer
    num_layers: int = option(2, counts(most=MOST_LAYERS), varied="one_more_or_less")
    activation: str = option("relu", one_of(ACTIVATIONS))
    learning_rate: float = option(1e-3, positive(MOVES), traced=True, varied="triple")  # of Adam
    # Weight of the online network in the target's update.
    tau: float = option(0.01, fraction(), traced=True)
    discount: float = option(0.99, fraction(), traced=True)  # gamma

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.batch_size <= self.buffer_size,
            "agent.batch_size",
            "must be at most agent.buffer_size, because batches are drawn from the buffer; got "
            f"{self.batch_size} with agent.buffer_size={self.buffer_size}. Set "
            f"agent.batch_size={self.buffer_size}.",
        )

    def mlp(self, num_outputs: int, **more: Any) -> MLP:
        """A network with these hidden layers."""
        return MLP(
            num_outputs,
            self.hidden_size,
            self.num_layers,
            self.activation,
            learn_prelu_slope=True,
            **more,
        )


def off_policy_agent(
    config: OffPolicyOptions, *, spec: AgentSpec, batches: int = 1, **functions: Any
) -> Agent:
    """An agent that keeps its steps in a ring and learns from batches of them.

    Args:
      config: hyperparameters; the agent's state has the traced ones as `hparams`.
      spec: of the agent.
      batches: how many batches `update` takes, side by side.
      **functions: `init`, `act`, `update` and others of `Agent`.
    """

    def batch_size(state: Any) -> Array | None:
        in_use = state.hparams.batch_size
        return None if in_use is None else in_use * batches

    return Agent(
        buffer=replay_buffer(config.batch_size * batches, config.buffer_size),
        hparams=traced(config, hidden_size=None, batch_size=None),
        spec=spec,
        discount=lambda hparams: hparams.discount,
        batch_size=batch_size,
        **functions,
    )


def warming_up(config: OffPolicyOptions) -> Callable[[Any, Array], Any]:
    """Builds `begin_episode` of an agent that acts at random in its first episodes."""

    def begin_episode(state: Any, episode: Array) -> Any:
        return state.replace(is_warming_up=jnp.asarray(episode < config.warmup_episodes))

    return begin_episode


def mean_over_batch(
    sum_fn: Callable[..., Array], columns: tuple[Any, ...], batch_size: Array | None
) -> Array:
    """A sum over a batch's columns as their mean, at the cost of those in use.

    Args:
      sum_fn: `(*columns) -> Array`, such as the gradient of a sum of losses.
      columns: a batch of `Transition`s, and what else has its columns.
      batch_size: columns in use, `[]`; None for all.
    """
    total = sum_over_batch(lambda columns: sum_fn(*columns), columns, batch_size)
    return total / num_columns(columns[0])
