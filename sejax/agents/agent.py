"""The contract of an agent: a bundle of pure functions over one agent's state."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sejax.agents.memory import MemoryMaker


@dataclass(frozen=True, kw_only=True)
class Agent:
    """What the inner loop needs of an agent. All functions are pure and act on one agent.

    Attributes:
      init: `(key, hparams) -> state`. `hparams` are the agent's traced numbers, kept in its state.
      begin_episode: `(state, episode) -> state`; applies schedules that move with episodes.
      act: `(key, state, obs, explore) -> action`, as the agent remembers it; `explore` is a Python
        bool.
      update: `(key, state, batch) -> state`; one learning step on what `memory` hands out.
      memory: how steps are kept, from `sejax.agents.memory`.
      hparams: the default traced hyperparameters, a pytree of floats.
      init_episodes: episodes at the start of which no stop rule may judge.
      learns_from: first episode, counted from 0, in which the agent learns.
      env_action: `action -> action` as the world takes it.
      action_repeat: steps of the world for each decision.
    """

    init: Callable[..., Any]
    begin_episode: Callable[..., Any]
    act: Callable[..., Any]
    update: Callable[..., Any]
    memory: MemoryMaker
    hparams: Any
    init_episodes: int
    learns_from: int
    env_action: Callable[[Any], Any] = lambda action: action
    action_repeat: int = 1
