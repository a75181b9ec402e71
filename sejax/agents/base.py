"""The contract of an agent: a bundle of pure functions over one agent's state."""

import collections
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
from jaxtyping import Array

from sejax.agents.memory import MemoryMaker
from sejax.options import Options, counts, option, traced_options


@dataclass(frozen=True, kw_only=True, eq=False)
class Agent:
    """What the inner loop needs of an agent. All functions are pure and act on one agent.

    Build an agent once: what is compiled for it is kept by identity.

    Attributes:
      init: `(key, hparams) -> state`. `hparams` are the agent's traced numbers, kept in its state.
      begin_episode: `(state, episode) -> state`; applies schedules that move with episodes.
      act: `(key, state, obs, explore) -> action`, as the agent remembers it; `explore` is a Python
        bool.
      update: `(key, state, batch) -> state`; one learning step on what `memory` hands out.
      memory: how steps are kept, from `sejax.agents.memory`.
      hparams: the default traced hyperparameters, a pytree of floats.
      warmup_episodes: episodes at the start of which no stop rule may judge.
      learns_from: first episode, counted from 0, in which the agent learns.
      env_action: `action -> action` as the world takes it.
      action_repeat: steps of the world for each decision.
      discount: `hparams -> []`, gamma, which a potential-based reward needs; None if there is none.
      batch_size: `state -> []` or None: columns of a batch in use, where hyperparameters vary.
      cpu_num_parallel: agents that best train in lockstep on a CPU core; None for all of them.
        A network keeps a core busy alone, a table does not.
      variants: agents of other sizes, of which each training takes one, if hyperparameters are
        drawn for each (`sejax.agents.varied`); empty if they are not.
      draw: `key -> Draw`, which one and with which hyperparameters.
      solve: `(env, env_params, hparams) -> state`, the trained agent, where a world's optimum is
        known; then nothing is trained. None for agents that learn.
    """

    init: Callable[..., Any]
    begin_episode: Callable[..., Any] = lambda state, episode: state
    act: Callable[..., Any]
    update: Callable[..., Any]
    memory: MemoryMaker
    hparams: Any
    warmup_episodes: int = 0
    learns_from: int = 0
    env_action: Callable[[Any], Any] = lambda action: action
    action_repeat: int = 1
    discount: Callable[[Any], Any] = lambda hparams: getattr(hparams, "discount", None)
    batch_size: Callable[[Any], Any] = lambda state: None
    cpu_num_parallel: int | None = 1
    variants: tuple["Agent", ...] = ()
    draw: Callable[[Array], "Draw"] | None = None
    solve: Callable[[Any, Any, Any], Any] | None = None

    def fresh(self, make_run: Callable[["Agent"], Callable[..., Any]]) -> Callable[..., Any]:
        """Builds `run(key, *args)` for a fresh agent, whose hyperparameters may be drawn first.

        Args:
          make_run: builds `run(key, *args, hparams)` for one agent.

        Returns:
          The run of this agent with its own hyperparameters; or, if they are drawn, of the variant
          that has room for those drawn from `key`.
        """
        if self.draw is None:
            run_self = make_run(self)
            return lambda key, *args: run_self(key, *args, self.hparams)
        draw, runs = self.draw, [make_run(agent) for agent in self.variants]

        def run(key: Array, *args: Any) -> Any:
            drawn = draw(drawing_key(key))
            return jax.lax.switch(drawn.variant, runs, key, *args, drawn.hparams)

        return run

    def drawn_values(self, key: Array) -> dict[str, Array]:
        """The hyperparameters that `fresh` draws for a training with this key, by name."""
        return {} if self.draw is None else self.draw(drawing_key(key)).values


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Draw:
    """Hyperparameters of one training.

    Attributes:
      variant: index of the agent in `Agent.variants`, `[]` int32.
      hparams: its traced hyperparameters.
      values: what was drawn, `[]` each, by the names of the configuration's fields.
    """

    variant: Array
    hparams: Any
    values: dict[str, Array]


def drawing_key(key: Array) -> Array:
    """The part of a training's key that its hyperparameters are drawn from."""
    return jax.random.fold_in(key, 0x48_50)  # training and test keys are splits of the key


@dataclass(frozen=True, kw_only=True)
class AgentOptions(Options):
    """What the configurations of sejax's agents share.

    Class attributes say which tasks an agent fits: `states` is "vector" or "discrete", `actions`
    lists "discrete" and "continuous". A configuration without them fits all.
    """

    group: ClassVar[str] = "agent"
    states: ClassVar[str] = "vector"
    actions: ClassVar[tuple[str, ...]] = ("discrete",)

    # Episodes before learning starts and before a stop rule may judge.
    warmup_episodes: int = option(10, counts("it counts episodes", least=0))

    def steps_before_learning(self, max_episode_steps: int, task_max_steps: int) -> int:
        """Training steps before the agent first learns.

        Args:
          max_episode_steps: of the episodes that it trains on, which last so long.
          task_max_steps: limit of the task that it was made for.
        """
        return self.warmup_episodes * max_episode_steps


def traced(config: Any, **more: Any) -> Any:
    """A configuration's traced hyperparameters, a named tuple of floats.

    Args:
      config: a dataclass, some of whose options are `traced`.
      **more: further numbers, such as the units in use of a network with room for more; None where
        there is nothing to say.

    Example:
      >>> from sejax.agents.tabular import QLearningConfig
      >>> traced(QLearningConfig()).discount
      0.8
    """
    values = {**traced_options(config), **more}
    return _hparams_type(f"{type(config).__name__}Hparams", tuple(values))(**values)


@functools.cache
def _hparams_type(name: str, fields: tuple[str, ...]) -> Any:
    return collections.namedtuple(name, fields)


@dataclass(frozen=True, kw_only=True)
class NoExploration(Options):
    """No intrinsic reward."""

    group: ClassVar[str] = "exploration"

    def make(self, agent: Agent, task: Any) -> Agent:
        return agent


def with_hparams(hparams: Any, values: dict[str, Array]) -> Any:
    """Traced hyperparameters with these values; those of a wrapped agent are its field `agent`."""
    if "agent" in hparams._fields:
        return hparams._replace(agent=with_hparams(hparams.agent, values))
    return hparams._replace(**values)
