"""The contract of an agent: a bundle of pure functions over one agent's state.

From a configuration to a training:

================= ==================================================================================
`AgentConfig`     the options of an algorithm, such as `DDQNConfig`; its `make(task)` builds the
                  `Algorithm`, and returns `Algorithm.agent()`. `AgentOptions` are those that all of
                  sejax's algorithms with warm-up share
`Algorithm`       an algorithm's methods for a task's sizes, such as `DDQN`
`Agent`           these methods as plain functions, with the `AgentSpec`: what a training loop must
                  know, such as when learning begins
`make_agent`      checks that configuration and task fit, calls `make`, adds an exploration bonus,
                  and returns the same object for equal arguments
`Hparams`         the numbers of the options that may vary between agents of one program; the
                  agent's state holds them
================= ==================================================================================
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields
from types import SimpleNamespace
from typing import ClassVar, NamedTuple, NoReturn, Protocol, Self, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PyTree

from sejax.agents.buffers import BufferMaker
from sejax.envs.base import Task
from sejax.envs.spec import Space, sizes_of
from sejax.options import Options, WholeNumber, marks, require
from sejax.options.registry import require_part

AgentState: TypeAlias = PyTree  # what the agent needs; only the agent reads it
T = TypeVar("T")


@jax.tree_util.register_pytree_node_class
class Hparams(SimpleNamespace):
    """Hyperparameters that an agent reads from its state, a pytree; see `traced`.

    They are arguments of a compiled program if they vary, and else its constants. An agent's own
    names are attributes of the instance, and leaves. The two below are class attributes: only where
    they vary does an instance have them, and a leaf for them.

    Attributes:
      hidden_size: units in use; None for all.
      batch_size: columns of a batch in use; None for all.
    """

    hidden_size: Array | None = None
    batch_size: Array | None = None

    def replace(self, **values: PyTree) -> Self:
        """The same hyperparameters but for these."""
        return type(self)(**vars(self) | values)

    def replace_innermost(self, **values: PyTree) -> Self:
        """As `replace`; of an agent with an intrinsic reward, for the agent inside, at `agent`."""
        if hasattr(self, "agent"):
            return self.replace(agent=self.agent.replace_innermost(**values))
        return self.replace(**values)

    def tree_flatten(self) -> tuple[tuple[PyTree, ...], tuple[str, ...]]:
        return tuple(vars(self).values()), tuple(vars(self))

    @classmethod
    def tree_unflatten(cls, names: tuple[str, ...], values: tuple[PyTree, ...]) -> Self:
        return cls(**dict(zip(names, values, strict=True)))


class ActFn(Protocol):
    """The action for one observation; `explore` is a Python bool.

    The key must come from `split` or `fold_in`: the words of `jax.random.key(n)` are not random.
    """

    def __call__(self, key: Array, state: AgentState, obs: Array, /, explore: bool) -> Array: ...


@dataclass(frozen=True, kw_only=True)
class AgentSpec:
    """What is known of an agent before it is compiled.

    Attributes:
      stops_from: first episode, counted from 0, with which a stop rule may end the training.
      learns_from: first episode, counted from 0, in which the agent learns.
      action_repeat: environment steps for each decision.
      cpu_num_parallel: agents in a vmapped batch of a CPU core, unless the user sets
        `num_parallel`; None for all of them. One wide network keeps a core busy; a table, or a
        narrow network, does not.
      sizes: `sizes_of` the spaces that the agent is made for, set by `sejax.make_agent`; None if
        unknown.
    """

    stops_from: int = 0
    learns_from: int = 0
    action_repeat: int = 1
    cpu_num_parallel: int | None = 1
    sizes: tuple[tuple[str, int], ...] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Agent:
    """The functions of an agent for the inner loop. All are pure and act on one agent.

    Build an agent once: compiled programs are kept by the identity of the object.

    Attributes:
      init: `(key, hparams) -> state`.
      act: `(key, state, obs, explore) -> action`, as the buffer keeps it. `explore` is a Python
        bool, passed by its name. `obs` is `[obs_dim]` float32, or an index `[]` int32 on a task
        with numbered states. A discrete action is an index `[]` int32.
      update: `(key, state, batch) -> state`; one learning step on a batch from `buffer`.
      buffer: how steps are kept, from `sejax.agents.buffers`.
      hparams: the default hyperparameters of `init`, a pytree of floats.
      spec: what is known before it is compiled.
      begin_episode: `(state, episode) -> state`; applies schedules that move with episodes.
      env_action: `action -> action` as the environment takes it.
      discount: `hparams -> []`, gamma, which a potential-based reward needs; None if the agent has
        none.
      batch_size: `state -> []`, columns of a batch in use if hyperparameters vary; None for all.
      varied: how hyperparameters are drawn for each training; None if they are not.
    """

    init: Callable[[Array, Hparams], AgentState]
    act: ActFn
    update: Callable[[Array, AgentState, PyTree], AgentState]
    buffer: BufferMaker
    hparams: Hparams
    spec: AgentSpec = AgentSpec()
    begin_episode: Callable[[AgentState, Int[Array, ""]], AgentState] = lambda state, episode: state
    env_action: Callable[[Array], Array] = lambda action: action
    discount: Callable[[Hparams], Array | float | None] = lambda hparams: None
    batch_size: Callable[[AgentState], Array | None] = lambda state: None
    varied: "Varied | None" = None

    def __reduce__(self) -> NoReturn:
        fix = "Send its configuration to the other process, and call sejax.make_agent there."
        raise TypeError(f"An agent holds functions and cannot be pickled. {fix}")

    def with_hparams(self, make_run: Callable[["Agent"], Callable[..., T]]) -> Callable[..., T]:
        """Builds `run(key, *args)` with the agent's hyperparameters, or with drawn ones.

        Args:
          make_run: builds `run(key, *args, hparams)` for one agent.

        Returns:
          The run of this agent with its own hyperparameters. If hyperparameters are varied, the run
          draws them from `key` and uses the variant with room for them.
        """
        if self.varied is None:
            run_self = make_run(self)
            return lambda key, *args: run_self(key, *args, self.hparams)
        draw = self.varied.draw
        runs = [make_run(agent) for agent in self.varied.agents]

        def run(key: Array, *args: PyTree) -> T:
            drawn = draw(key)
            return jax.lax.switch(drawn.variant, runs, key, *args, drawn.hparams)

        return run

    def drawn_values(self, key: Array) -> dict[str, Array]:
        """The hyperparameters that `with_hparams` draws for a training with this key, by name."""
        return {} if self.varied is None else self.varied.draw(key).values


class Drawn(NamedTuple):
    """Hyperparameters drawn for one training.

    Attributes:
      variant: index of its agent among `Varied.agents`, `[]` int32.
      hparams: its traced hyperparameters, for this agent's `init`.
      values: the drawn values, `[]` each, by field of the configuration.
    """

    variant: Array
    hparams: Hparams
    values: dict[str, Array]


class Varied(NamedTuple):
    """Hyperparameters that are drawn for each training; see `sejax.agents.varied`.

    Attributes:
      agents: agents of several sizes; each training takes one of them.
      draw: `key -> Drawn`, for the key of a training.
    """

    agents: tuple[Agent, ...]
    draw: Callable[[Array], Drawn]


def require_agent(agent: Agent, observation: Space, action: Space) -> None:
    """Checks that it is an agent, and made for these spaces.

    Raises:
      ConfigError: if it is not.
    """
    fix = "Set agent=sejax.make_agent(config, task) with this task."
    require_part("agent", Agent, agent, fix)
    sizes = agent.spec.sizes
    in_task = sizes_of(observation, action)
    require(sizes in (None, in_task), "agent", f"must be made for {in_task}", got=sizes, fix=fix)


@dataclass(frozen=True, kw_only=True)
class AgentConfig(Options):
    """An agent's configuration: which tasks it fits, and how it is made. Each agent has a subclass.

    Attributes:
      states: kind of observations that it fits, "vector" or "discrete"; None for both.
      actions: kinds of actions that it fits: "discrete", "continuous" or both.
    """

    group: ClassVar[str] = "agent"
    states: ClassVar[str | None] = None
    actions: ClassVar[tuple[str, ...]] = ("discrete", "continuous")

    def make(self, task: Task) -> Agent:
        """The agent for a task's observations and actions."""
        raise NotImplementedError

    def steps_before_learning(self, max_episode_steps: int, task_max_steps: int) -> int:
        """Training steps before the agent first learns.

        Args:
          max_episode_steps: steps of each training episode.
          task_max_steps: step limit of the task that the agent was made for.
        """
        return 0


@dataclass(frozen=True, kw_only=True)
class AgentOptions(AgentConfig):
    """What the configurations of sejax's learning agents share.

    Attributes:
      warmup_episodes: Episodes before learning starts and before a stop rule may judge.
    """

    states: ClassVar[str | None] = "vector"
    actions: ClassVar[tuple[str, ...]] = ("discrete",)

    warmup_episodes: WholeNumber = 1

    def steps_before_learning(self, max_episode_steps: int, task_max_steps: int) -> int:
        return self.warmup_episodes * max_episode_steps

    def spec(self) -> AgentSpec:
        """The spec of an agent that learns once it has warmed up."""
        return AgentSpec(stops_from=self.warmup_episodes, learns_from=self.warmup_episodes)


@dataclass(frozen=True, kw_only=True)
class ExplorationConfig(Options):
    """The configuration of an intrinsic reward: which agents it fits, and how it is added.

    Attributes:
      states: kind of observations of fitting agents, "vector" or "discrete"; None for both.
    """

    group: ClassVar[str] = "exploration"
    states: ClassVar[str | None] = None

    def make(self, agent: Agent, task: Task) -> Agent:
        """The agent with the intrinsic reward."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class NoExploration(ExplorationConfig):
    """No intrinsic reward."""

    def make(self, agent: Agent, task: Task) -> Agent:
        return agent


def traced(config: Options) -> Hparams:
    """A configuration's values that may be traced, still Python's numbers, by their fields.

    Example:
      >>> from sejax.agents.tabular import QLearningConfig
      >>> traced(QLearningConfig()).discount
      0.8
    """
    cls = type(config)
    names = [field.name for field in fields(cls) if marks(cls, field.name).get("traced")]
    return Hparams(**{name: getattr(config, name) for name in names})


class Algorithm(ABC):
    """The pure functions of an agent; `agent` bundles them. Each algorithm is a subclass.

    The agent's state has the traced hyperparameters as `hparams`.

    Attributes:
      config: its configuration; has a traced option `discount`.
    """

    config: AgentOptions

    @abstractmethod
    def init(self, key: Array, hparams: Hparams) -> AgentState:
        """A fresh agent.

        Args:
          key: of its networks.
          hparams: traced hyperparameters, each a float32 array; `agent` sees to that. The state
            keeps them.
        """

    @abstractmethod
    def act(self, key: Array, state: AgentState, obs: Array, explore: bool) -> Array:
        """The action for one observation."""

    @abstractmethod
    def update(self, key: Array, state: AgentState, batch: PyTree) -> AgentState:
        """One learning step."""

    def begin_episode(self, state: AgentState, episode: Array) -> AgentState:
        """Applies schedules that move with episodes."""
        return state

    def env_action(self, action: Array) -> Array:
        """An action as the environment takes it."""
        return action

    @abstractmethod
    def buffer(self) -> BufferMaker:
        """How steps are kept."""

    def agent(self) -> Agent:
        """The bundle of these functions."""
        return Agent(
            init=lambda key, hparams: self.init(key, jax.tree.map(jnp.float32, hparams)),
            act=self.act,
            update=self.update,
            buffer=self.buffer(),
            hparams=traced(self.config),
            spec=self.config.spec(),
            begin_episode=self.begin_episode,
            env_action=self.env_action,
            discount=lambda hparams: hparams.discount,
            batch_size=lambda state: state.hparams.batch_size,
        )
