"""A command's configuration: from the words that a user types to typed, validated dataclasses.

A word is `group=choice`, `group.field=value` or `field=value`. `sejax.runs.compose` makes a tree of
the words. `CommandConfig.layers_of` puts choices and presets below it. `sejax.options.plain` makes
dataclasses of the merged layers, and reads each value by its field's type. The dataclasses check
themselves.

Example:
  >>> words = ["agent.learning_rate=1e-3"]
  >>> compose.trees_of(words, LearnConfig.groups())
  [{'agents': {}, 'agent': {'learning_rate': '1e-3'}}]
  >>> layers = LearnConfig.layers_of(words)  # each lies over those before it
  >>> list(layers), layers["typed"]
  (['default', 'preset=best', 'typed'], {'agents': {'ddqn': {'learning_rate': '1e-3'}}})
  >>> LearnConfig.of_tree(merge(*layers.values())).agents["ddqn"].learning_rate
  0.001
"""

import contextlib
import dataclasses
import hashlib
import itertools
import textwrap
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, TypeVar

from sejax import agents, envs
from sejax.agents.base import Agent, AgentConfig, ExplorationConfig
from sejax.agents.mixture import Mixture, MixtureConfig
from sejax.envs.spec import TaskSpec
from sejax.es.base import Strategy
from sejax.objectives import Objective
from sejax.ops.files import as_file_name
from sejax.options import (
    ConfigError,
    Count,
    Options,
    WholeNumber,
    errors_of,
    field_lines,
    old,
    registry,
    require,
    shortened,
)
from sejax.options.plain import (
    configure,
    flatten,
    from_plain,
    merge,
    plugin,
    plugins,
    to_plain,
    unknown_field,
)
from sejax.proxies import ProxyConfig
from sejax.runs import agent_words, compose
from sejax.runs.agent_words import Tree
from sejax.runs.trackers import Tracker
from sejax.training import TrainingConfig, require_reachable

if TYPE_CHECKING:  # which imports this module
    from sejax.runs.chunks import Chunks, Pool

PLACES = ("devices", "machines", "run_dir", "out_dir")  # fields that say where, not what
# On the real task.
REAL_TRAINING = TrainingConfig(stop_rule="solved", max_steps=None, max_episodes=1000)


# --- configurations ------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class CommandConfig(Options, ABC):
    """What all commands share but the search.

    Attributes:
      folder_field: the field that names the folder of the command's files.
      named_by: fields that the default folder is named by.
      granted: words that `--help` adds, as the command needs them.
      free: fields and groups that may change when the command is repeated, which goes on with what
        the folder holds.
      agents: configurations by key, in the keys' order; `agent=ddqn` has the key `ddqn`.
      exploration: intrinsic reward of the agents
      training: training on proxies
      num_parallel: Agents that train side by side on one device; null: what suits the agent and
        the device.
      devices: null: all
    """

    folder_field: ClassVar[str] = "run_dir"
    named_by: ClassVar[Collection[str]] = ()
    free: ClassVar[Collection[str]] = ()
    granted: ClassVar[Sequence[str]] = ()

    agents: dict[str, AgentConfig] = plugins("agent")
    exploration: ExplorationConfig = plugin("exploration")
    training: TrainingConfig = TrainingConfig()
    seed: WholeNumber = 0
    num_parallel: Count | None = None
    devices: Count | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.agents, "agents", "must have at least one", use="[ddqn]")

    @classmethod
    def groups(cls) -> list[str]:
        """The groups of plugins that the command's fields hold, each one; not the agents'."""
        return [x.name for x in dataclasses.fields(cls) if x.metadata.get("plugin") == x.name]

    @classmethod
    @abstractmethod
    def layers_below(cls, typed: Tree) -> dict[str, Tree]:
        """The layers below a user's words, by their names; each lies over those before it.

        Args:
          typed: the tree of the words; see `sejax.runs.compose.trees_of`.

        Raises:
          ConfigError: for an unknown choice or preset.
        """

    @property
    @abstractmethod
    def default_folder(self) -> str:
        """The folder, if no field names it."""

    @property
    def folder(self) -> Path:
        """The folder of the command's files."""
        return Path(getattr(self, self.folder_field) or self.default_folder)

    @classmethod
    def of_sweep(cls, overrides: Sequence[str]) -> list[Self]:
        """The configuration of each run of a sweep.

        Each has a folder named by its words: within the folder that the words name, or beside the
        default one.

        Raises:
          ConfigError: as `of_words`.
        """
        by_name = {override.partition("=")[0]: override for override in overrides}
        overrides, configs = [*by_name.values()], []  # of words with one name the last counts
        for of_run in compose.expand(overrides):
            config = cls.of_words(of_run)
            folder = getattr(config, cls.folder_field)
            known = (cls.folder_field,) if folder else cls.named_by
            words = [word for word, values in zip(of_run, overrides, strict=True) if word != values]
            name = as_file_name(",".join(x for x in words if x.partition("=")[0] not in known))
            name = name if len(name) <= 120 else hashlib.sha256(name.encode()).hexdigest()[:16]
            if name:
                folder = f"{folder}/{name}" if folder else f"{config.default_folder}_{name}"
            configs.append(dataclasses.replace(config, **{cls.folder_field: folder}))
        return configs

    @classmethod
    def of_words(cls, overrides: Sequence[str]) -> Self:
        """The configuration that the words after the command describe.

        Raises:
          ConfigError: for an unknown group, choice or field, or a value out of range.
        """
        return cls.of_tree(merge(*cls.layers_of(overrides).values()))

    @classmethod
    def layers_of(cls, overrides: Sequence[str]) -> dict[str, Tree]:
        """The layers that words make, by their names; the words themselves are the last one."""
        trees = compose.trees_of(overrides, cls.groups())
        typed, imports = merge(*trees), registry.code_names(trees[-1])
        for name, value in flatten(typed).items():
            name = agent_words.as_typed(name, typed["agents"]).removesuffix(".name")
            registry.require_typed(name, value, imports)
        layers = cls.layers_below(typed)
        names = agent_words.names_of(merge(*layers.values())["agents"])
        settled = [agent_words.settled(tree, names) for tree in reversed(trees)]
        return layers | {"typed": merge(*reversed(settled))}

    @classmethod
    def of_tree(cls, tree: Tree) -> Self:
        """The configuration that nested plain values describe.

        Raises:
          ConfigError: for an unknown, missing or bad field, or parts that cannot work together.
        """
        known = {field.name for field in dataclasses.fields(cls)}
        by_key: Any = tree.get("agents") or ()
        is_map = isinstance(by_key, Mapping) and all(x == registry.key_of(str(x)) for x in by_key)
        require(is_map, "agents", "must be agents by their keys", got=by_key, use="[ddqn,ppo]")
        config = from_plain(cls, {k: x for k, x in tree.items() if k in known}, "")
        unknown = {k: x for k, x in tree.items() if k not in known and old.GONE.get(k, tree) != x}
        for name in flatten(unknown) or unknown:
            raise unknown_field(name, config.named(config.plain()))
        return config

    @property
    def agent(self) -> Any:
        """The configuration of the only agent."""
        (agent,) = self.agents.values()
        return agent

    def field_of(self, key: str) -> str:
        """The group of an agent's fields in words: `agent`, or `agents.KEY` of several."""
        return agent_words.as_typed(f"agents.{key}", self.agents)

    def agent_for(self, key: str, task: envs.Task, is_varied: bool) -> Agent:
        """The agent of a key, with the exploration, for a task; see `sejax.make_agent`."""
        with errors_of("agent", self.field_of(key)):
            return agents.make_agent(self.agents[key], task, self.exploration, is_varied)

    def plain(self) -> dict[str, Any]:
        """Nested plain values, as in `config.yaml`; `sejax.save` keeps them with a proxy."""
        return to_plain(self)  # type: ignore[no-any-return]

    def named(self, tree: Tree) -> dict[str, Any]:
        """Nested plain values by their names in words; a choice's value is the plugin's name."""
        flat = {agent_words.as_typed(name, self.agents): x for name, x in flatten(tree).items()}
        return {name.removesuffix(".name"): x for name, x in flat.items()}

    def require_learning(
        self, key: str, group: str, training: TrainingConfig, proxy: ProxyConfig, spec: TaskSpec
    ) -> None:
        """Checks that an agent learns something on a proxy.

        Episodes of one-step SEs, and of most SEs with soft ends, last to their limit. On such a
        proxy a step budget must be long enough for the agent to learn. Training must not stop as
        solved by the proxy's own returns.

        Args:
          key: the agent's key.
          group: the group of its training's fields.
          training: how long it trains.
          proxy: the proxy's configuration.
          spec: the real task's spec.

        Raises:
          ConfigError: if it would learn nothing.
        """
        longest, got = proxy.max_steps(spec.max_steps), training.solved_by
        require_reachable(group, training, longest)
        is_tested = training.stop_rule != "solved" or got == "test"
        require(is_tested, f"{group}.solved_by", "must be test on a proxy", got=got, use="test")
        # The shortest episodes: of other proxies they may have one step.
        shortest = longest if proxy.reaches_step_limit else 1
        for name, length, unit in (("max_steps", shortest, 1), ("max_episodes", longest, longest)):
            least = self.agents[key].steps_before_learning(length, spec.max_steps) // unit
            limit, field = getattr(training, name), f"{group}.{name}"
            must = f"must exceed {least}, where {shortened(key)} begins to learn"
            require(limit is None or limit > least, field, must, got=limit, use=4 * least)


Config = TypeVar("Config", bound=CommandConfig)


@dataclass(frozen=True, kw_only=True)
class MachinesConfig(Options, ABC):
    """Where agents train.

    Attributes:
      is_elsewhere: whether other processes train them.
    """

    group: ClassVar[str] = "machines"
    is_elsewhere: ClassVar[bool] = False

    @abstractmethod
    def make(self, config: "LearnConfig") -> AbstractContextManager["Chunks"]:
        """The compiled generations of a run."""

    def pool(self) -> AbstractContextManager["Pool"]:
        """A context that gives a `Pool`; by default one that calls here, one after the other."""
        return contextlib.nullcontext(itertools.starmap)


@dataclass(frozen=True, kw_only=True)
class LearnConfig(CommandConfig):
    """A whole bilevel optimisation, as `sejax.run` and `sejax.make_learner` take it.

    Attributes:
      mixture: how several agents share a generation
      preset: settings that were measured (best) or published (paper)
      env: the real task
      proxy: what is learned: a synthetic environment (se) or a reward network (rn)
      es: the evolution strategy of the outer loop
      objective: what the outer loop maximises
      tracker: another tool that follows the run, beside its files
      machines: where agents train
      agent_hparams: default: the agent's; varied: learning rate, batch and network are drawn for
        each training.
      generations: n_o: steps of the outer loop.
      num_seeds: Independent runs, with seeds seed, seed + 1, ...
      stop_when_solved: End a run when the search mean first reaches the solved score.
      checkpoint_every: generations between checkpoints
      run_dir: null: runs/<env>-<proxy>-<agent>[_<exploration>][_varied]-s<seed>

    Raises:
      ConfigError: for parts that cannot work together.
    """

    named_by = ("env", "proxy", "agent", "agents", "exploration", "agent_hparams", "seed")
    # How long it runs, and how it is computed.
    free = ("generations", "stop_when_solved", "checkpoint_every", *PLACES, "tracker")

    mixture: MixtureConfig = MixtureConfig()
    preset: str = "best"
    env: registry.Makes[envs.Task] = plugin("env")
    proxy: ProxyConfig = plugin("proxy")
    es: registry.Makes[Strategy] = plugin("es")
    objective: registry.Makes[Objective] = plugin("objective")
    tracker: registry.Makes[Tracker] = plugin("tracker")
    machines: MachinesConfig = plugin("machines")
    agent_hparams: Literal["default", "varied"] = "default"
    generations: Count = 100
    num_seeds: Count = 1
    stop_when_solved: bool = False
    checkpoint_every: Count = 1
    run_dir: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        is_here = self.devices is None or not self.machines.is_elsewhere
        require(is_here, "devices", "must be left out with machines. Set machines.workers=N.")
        spec, task_name = envs.spec_of(self.env), registry.name_of("env", self.env)
        self.proxy.require_task(spec, task_name)
        is_alone, given = len(self.agents) == 1, self.mixture.weights
        is_idle = is_alone and self.mixture != MixtureConfig()
        require(not is_idle, "mixture", "must come with several agents. Set agents=[ddqn,ppo].")
        for key in given.keys() - self.agents.keys():
            known = [f"mixture.weights.{x}" for x in self.agents]
            raise unknown_field(f"mixture.weights.{shortened(key)}", known)
        weights = {} if is_alone else {key: given.get(key, 1.0) for key in self.agents}
        are_some = is_alone or any(weights.values())
        require(are_some, "mixture.weights", "must have one above 0. Leave one of them out.")
        object.__setattr__(self, "mixture", dataclasses.replace(self.mixture, weights=weights))
        for key, agent in self.agents.items():
            agents.require_fit(agent, self.exploration, spec, task_name, self.field_of(key))
            self.require_learning(key, "training", self.training, self.proxy, spec)

    def name(self, group: str) -> str:
        """The name of a group's choice; of agents their keys, as `ddqn+ppo`."""
        if group == "agent":
            return "+".join(self.agents)
        return registry.name_of(group, getattr(self, group))

    def task(self) -> envs.Task:
        """The real task; it is built once."""
        return envs.make_from(self.env)

    def parts(self) -> dict[str, Any]:
        """The arguments of `sejax.make_learner`: objects, or configurations that make them."""
        task, is_varied = self.task(), self.agent_hparams == "varied"
        learners = tuple(self.agent_for(key, task, is_varied) for key in self.agents)
        mixture = Mixture(
            agents=learners,
            names=tuple(self.agents),
            weights=tuple(self.mixture.weights.values()),
            aggregate=self.mixture.aggregate,
        )
        return {
            "task": task,
            "agent": mixture if len(learners) > 1 else learners[0],
            "proxy": registry.make("proxy", self.proxy, task),
            "es": self.es,
            "objective": self.objective,
            "training": self.training,
            "stop_when_solved": self.stop_when_solved,
            "devices": self.devices,
            "num_parallel": self.num_parallel,
        }

    @classmethod
    def layers_below(cls, typed: Tree) -> dict[str, Tree]:
        """The choice of agents, and the preset."""
        agent_names = agent_words.names_of(typed["agents"])
        if not agent_names:
            default = default_agent(typed.get("env", {}))
            agent_names = {default: default}
        of_agents = {"agents": {key: {"name": name} for key, name in agent_names.items()}}
        preset = compose.preset_of(merge(of_agents, typed))
        return {"default": of_agents, f"preset={preset['preset']}": preset}

    @property
    def default_folder(self) -> str:
        """The run directory, named by the fields of `named_by`."""
        name = "-".join(map(self.name, ("env", "proxy", "agent")))
        explored, varied = self.name("exploration"), self.agent_hparams
        name += f"_{explored}" if explored != "none" else ""
        name += f"_{varied}" if varied != "default" else ""
        return f"runs/{as_file_name(f'{name}-s{self.seed}')}"


# --- from words ----------------------------------------------------------------------------------


def config(overrides: Sequence[str] = ()) -> LearnConfig:
    """The configuration of a run, from the words after `python -m sejax.run`.

    Raises:
      ConfigError: for an unknown group, choice or field, or a value out of range.

    Example:
      >>> config(["env=acrobot", "generations=7"]).generations
      7
    """
    return LearnConfig.of_words(overrides)


def apart(configs: Sequence[Config]) -> list[Config]:
    """Configurations without repetitions, each with a folder of its own.

    Raises:
      ConfigError: if two that differ share a folder.
    """
    by_folder = {str(config.folder): config for config in configs}
    must, got = "must differ for each run in letters or digits", next(iter(by_folder), "")
    are_apart = len(by_folder) == len({str(config) for config in configs})
    require(are_apart, configs[0].folder_field, must, got=got)
    return [*by_folder.values()]


def default_agent(env: Tree) -> str:
    """The default agent of a task, of which plain values are given."""
    with contextlib.suppress(ConfigError):  # making the task raises it again
        return agents.default_for(envs.spec_of(env_in(env)))
    return agents.DEFAULTS[0]


def env_in(env: Tree) -> Any:
    """The configuration of a task, of which plain values are given.

    Raises:
      ConfigError: if they describe no task that may be made.
    """
    return configure("env", {"name": compose.choice(env, "env")} | env)


def help_of(command: type[CommandConfig], about: str | None) -> Callable[[Sequence[str]], str]:
    """What `--help` prints: what the command is about, and the `help_text` of its words."""
    return lambda overrides: f"{about}\n{help_text(command, overrides)}"


def help_text(command: type[CommandConfig], overrides: Sequence[str]) -> str:
    """The choices of each group, then the fields of the words' choices.

    If a value is not the default, the layer that sets it stands beside it.
    """
    overrides = [*command.granted, *compose.expand(overrides)[0]]  # the first run of a sweep
    layers, choices = command.layers_of(overrides), ("agent", *command.groups())
    tree = merge(*layers.values())
    config = command.of_tree(tree)
    lines = ["Choices (group=choice):"]
    for group in choices:
        prefixes = ["gymnax/ID"] if group == "env" else []
        names = ", ".join([*registry.names(group), *prefixes, "module:attribute"])
        lines += [textwrap.fill(f"  {group}: {names}", 98, subsequent_indent=" " * 6)]
    lines += ["  agents: [agent,agent,...]"]
    if "preset" in vars(config):
        known = compose.sections_of(*(compose.choice(tree.get(x, {}), x) for x in ("env", "proxy")))
        lines += [f"  preset: {', '.join([*known, 'FILE.yaml'])}"]
    lines += ["", "Fields of these choices (field=value), with their values:"]
    classes = [("", command), *((name, type(x)) for name, x in vars(config).items())]
    classes += [(config.field_of(key), type(x)) for key, x in config.agents.items()]
    sources = dict[str, str]()
    for layer, tree in layers.items():
        sources |= dict.fromkeys(config.named(tree), "" if layer == "default" else f" ({layer})")
    named = (*choices, *map(config.field_of, config.agents))
    fields = {name: x for name, x in config.named(config.plain()).items() if name not in named}
    return "\n".join([*lines, field_lines(fields, classes, sources)])


# --- from plain values ---------------------------------------------------------------------------


def learn_config(values: Mapping[str, Any], typed: Collection[str] = ()) -> LearnConfig:
    """The configuration of a run from plain values, as `config.yaml` and proxy files hold them.

    Args:
      values: nested plain values. One agent may stand as `agent`.
      typed: each `module:attribute` that may be imported.

    Raises:
      ConfigError: for an unknown, missing or bad field, or parts that cannot work together.
    """
    for name, value in flatten(values).items():
        registry.require_typed(name.removesuffix(".name"), value, typed)
    return LearnConfig.of_tree(old.of_today(values))
