"""What commands share: from the words that a user types to typed, validated dataclasses.

A word is `group=choice`, `group.field=value` or `field=value`. `sejax.runs.words` makes a tree of
the words. `CommandConfig.layers_of` puts choices and presets below it. `sejax.options.plain` makes
dataclasses of the merged layers, and reads each value by its field's type. The dataclasses check
themselves.

Example:
  >>> from sejax.runs.config import LearnConfig
  >>> words = ["agent.learning_rate=1e-3"]
  >>> trees_of(words, LearnConfig.groups())
  ({'agents': {}}, {'agents': {}, 'agent': {'learning_rate': '1e-3'}})
  >>> layers = LearnConfig.layers_of(words)  # each lies over those before it
  >>> list(layers), layers["typed"]
  (['default', 'preset=best', 'typed'], {'agents': {'ddqn': {'learning_rate': '1e-3'}}})
  >>> LearnConfig.of_tree(merge(*layers.values())).agents["ddqn"].learning_rate
  0.001
"""

import dataclasses
import hashlib
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Self

from sejax import agents, envs
from sejax.agents.base import Agent, AgentConfig, ExplorationConfig
from sejax.envs.spec import TaskSpec
from sejax.ops.files import as_file_name
from sejax.options import Count, Options, WholeNumber, errors_of, old, registry, require, shortened
from sejax.options.plain import (
    flatten,
    from_plain,
    merge,
    plugin,
    require_typed,
    to_plain,
    unknown_field,
)
from sejax.proxies import ProxyConfig
from sejax.runs.words import Tree, by_agent, expand, trees_of, typed_name
from sejax.training import TrainingConfig, require_reachable

PLACES = ("devices", "machines", "run_dir", "out_dir")  # fields that say where, not what


@dataclass(frozen=True, kw_only=True)
class CommandConfig(Options, ABC):
    """What all commands share but the search.

    Attributes:
      folder_field: the field that names the folder of the command's files.
      named_by: fields that the default folder is named by.
      help_words: words that `--help` adds, as the command needs them.
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
    help_words: ClassVar[Sequence[str]] = ()

    agents: dict[str, AgentConfig] = field(default_factory=dict, metadata={"plugin": "agent"})
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
    def default_layers(cls, typed: Tree) -> dict[str, Tree]:
        """The layers below a user's words, by their names; each lies over those before it.

        Args:
          typed: the tree of the words; see `sejax.runs.words.trees_of`.

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
        """The configuration of each run of a sweep, without repetitions.

        Each has a folder named by its words: within the folder that the words name, or beside the
        default one.

        Raises:
          ConfigError: as `of_words`, or if two that differ share a folder.
        """
        by_name = {override.partition("=")[0]: override for override in overrides}
        overrides = [*by_name.values()]  # of words with one name the last counts
        runs = expand(overrides)
        by_folder: dict[Path, Self] = {}
        for of_run in runs:
            config = cls.of_words(of_run)
            folder = getattr(config, cls.folder_field)
            known = (cls.folder_field,) if folder else cls.named_by
            words = [word for word, values in zip(of_run, overrides, strict=True) if word != values]
            name = as_file_name(",".join(x for x in words if x.partition("=")[0] not in known))
            name = name if len(name) <= 120 else hashlib.sha256(name.encode()).hexdigest()[:16]
            if name:
                folder = f"{folder}/{name}" if folder else f"{config.default_folder}_{name}"
            elif len(runs) > 1:
                folder = folder or config.default_folder
            config = dataclasses.replace(config, **{cls.folder_field: folder})
            first = by_folder.setdefault(config.folder, config)
            require(str(first) == str(config), cls.folder_field, "must differ by run", got=folder)
        return [*by_folder.values()]

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
        file, words = trees_of(overrides, cls.groups())
        typed = merge(file, words)
        require_typed(typed, words)
        layers = cls.default_layers(typed)
        below = merge(*layers.values())
        require_typed(below, words)
        keys = below["agents"]
        return layers | {"typed": merge(by_agent(file, keys), by_agent(words, keys))}

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
        unknown = {k: x for k, x in tree.items() if k not in known and not old.is_gone(k, x)}
        if unknown:
            name = next(iter(flatten(unknown) or unknown))
            is_known = name.partition(".")[0] in registry.GROUPS
            require(not is_known, shortened(name, 40), "is of other commands. Leave it out.")
            raise unknown_field(name, config.in_words(config.plain()))
        return config

    @property
    def agent(self) -> Any:
        """The configuration of the only agent."""
        (agent,) = self.agents.values()
        return agent

    def group_of(self, key: str) -> str:
        """The group of an agent's fields in words: `agent`, or `agents.KEY` of several."""
        return typed_name(f"agents.{key}", self.agents)

    def agent_for(self, key: str, task: envs.Task, is_varied: bool) -> Agent:
        """The agent of a key, with the exploration, for a task; see `sejax.make_agent`."""
        with errors_of("agent", self.group_of(key)):
            return agents.make_agent(self.agents[key], task, self.exploration, is_varied)

    def plain(self) -> dict[str, Any]:
        """Nested plain values, as in `config.yaml`; `sejax.save` keeps them with a proxy."""
        return to_plain(self)  # type: ignore[no-any-return]

    def in_words(self, tree: Tree) -> dict[str, Any]:
        """Nested plain values by their names in words; a choice's value is the plugin's name."""
        flat = {typed_name(name, self.agents): x for name, x in flatten(tree).items()}
        return {name.removesuffix(".name"): x for name, x in flat.items()}

    def require_agents(self, env: registry.Makes[envs.Task], proxy: ProxyConfig) -> None:
        """Checks that each agent fits a task, and learns something on a proxy of it.

        Raises:
          ConfigError: if one does not.
        """
        spec = envs.spec_of(env)
        task_name = registry.name_of("env", env)
        for key, agent in self.agents.items():
            agents.require_fit(agent, self.exploration, spec, task_name, self.group_of(key))
            self.require_learning(key, "training", self.training, proxy, spec)

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
        longest = proxy.max_steps(spec.max_steps)
        require_reachable(group, training, longest)
        judge = training.solved_by
        is_tested = training.stop_rule != "solved" or judge == "test"
        require(is_tested, f"{group}.solved_by", "must be test on a proxy", got=judge, use="test")
        # The shortest episodes: of other proxies they may have one step.
        shortest = longest if proxy.reaches_step_limit else 1
        for name, length, unit in (("max_steps", shortest, 1), ("max_episodes", longest, longest)):
            least = self.agents[key].steps_before_learning(length, spec.max_steps) // unit
            limit = getattr(training, name)
            is_longer = limit is None or limit > least
            rule = f"must exceed {least}, where {shortened(key)} begins to learn"
            require(is_longer, f"{group}.{name}", rule, got=limit, use=4 * least)
