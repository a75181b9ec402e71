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
      discount: `hparams -> []`, gamma, which a potential-based reward needs.
      batch_size: `state -> []` or None: columns of a batch in use, where hyperparameters vary.
      cpu_lanes: agents that best train in lockstep on a CPU core; None for as many as there are.
        A network keeps a core busy alone, a table does not.
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
    discount: Callable[[Any], Any] = lambda hparams: hparams.discount
    batch_size: Callable[[Any], Any] = lambda state: None
    cpu_lanes: int | None = 1


def hparams_of(hparams: type, config: Any) -> Any:
    """The traced hyperparameters that have no default, with a configuration's values."""
    fields: Any = hparams
    names = [name for name in fields._fields if name not in fields._field_defaults]
    return hparams(**{name: getattr(config, name) for name in names})
