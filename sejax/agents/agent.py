"""The contract of an agent: a bundle of pure functions over one agent's state."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Agent:
    """What the inner loop needs of an agent. All functions are pure and act on one agent.

    Attributes:
      init: `(key, hparams) -> state`. `hparams` are the agent's traced numbers, kept in its state.
      begin_episode: `(state, episode) -> state`; applies schedules that move with episodes.
      act: `(key, state, obs, explore) -> action`; `explore` is a Python bool.
      update: `(key, state, batch) -> state`; one learning step on a `replay.Transition` batch.
      hparams: the default traced hyperparameters, a pytree of floats.
      init_episodes: episodes at the start in which nothing is learned.
      batch_size: transitions in a batch.
      buffer_size: capacity of the replay buffer.
    """

    init: Callable[..., Any]
    begin_episode: Callable[..., Any]
    act: Callable[..., Any]
    update: Callable[..., Any]
    hparams: Any
    init_episodes: int
    batch_size: int
    buffer_size: int
