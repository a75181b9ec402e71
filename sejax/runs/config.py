"""The configuration of a bilevel optimisation: what `sejax.run` and `sejax.make_learner` take."""

import contextlib
import itertools
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

from sejax import agents, envs
from sejax.agents.mixture import Mixture, MixtureConfig
from sejax.es.base import Strategy
from sejax.objectives import Objective
from sejax.ops.files import as_file_name
from sejax.options import ConfigError, Count, Options, old, registry, require
from sejax.options.plain import configure, merge, plugin, require_typed, unknown_field
from sejax.proxies import ProxyConfig
from sejax.runs.command_config import PLACES, CommandConfig
from sejax.runs.presets import preset_of
from sejax.runs.trackers import Tracker
from sejax.runs.words import Tree, agent_names

if TYPE_CHECKING:  # which imports this module
    from sejax.runs.chunks import Chunks, Pool


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
    stop_when_solved: bool = False
    checkpoint_every: Count = 1
    run_dir: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        is_here = self.devices is None or not self.machines.is_elsewhere
        require(is_here, "devices", "must be left out with machines. Set machines.workers=N.")
        self.proxy.require_task(envs.spec_of(self.env), registry.name_of("env", self.env))
        given = self.mixture.weights
        if len(self.agents) == 1:
            is_idle = self.mixture != MixtureConfig()
            require(not is_idle, "mixture", "must come with several agents. Set agents=[ddqn,ppo].")
        elif unknown := given.keys() - self.agents.keys():
            known = [f"mixture.weights.{x}" for x in self.agents]
            raise unknown_field(f"mixture.weights.{min(unknown)}", known)
        else:
            weights = {key: given.get(key, 1.0) for key in self.agents}
            rule = "must have one above 0. Leave one of them out."
            require(any(weights.values()), "mixture.weights", rule)
            object.__setattr__(self, "mixture", replace(self.mixture, weights=weights))
        self.require_agents(self.env, self.proxy)

    @classmethod
    def of_stored(cls, values: Mapping[str, Any], typed: Mapping[str, Any] | None = None) -> Self:
        """The configuration that `config.yaml` and proxy files hold, as plain values.

        Args:
          values: nested plain values. One agent may stand as `agent`.
          typed: nested plain values of the user, whose code may be imported.

        Raises:
          ConfigError: for an unknown, missing or bad field, or parts that cannot work together.
        """
        require_typed(values, typed)
        return cls.of_tree(old.upgraded(values))

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
        task = self.task()
        is_varied = self.agent_hparams == "varied"
        learners = tuple(self.agent_for(key, task, is_varied) for key in self.agents)
        mixture = Mixture(
            agents=learners,
            names=tuple(self.agents),
            weights=tuple(self.mixture.weights.values()),  # `__post_init__` gave them this order
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
    def default_layers(cls, typed: Tree) -> dict[str, Tree]:
        """The choice of agents, and the preset."""
        names = agent_names(typed["agents"])
        if not names:
            default = default_agent(typed.get("env", {}))
            names = {default: default}
        of_agents = {"agents": {key: {"name": name} for key, name in names.items()}}
        preset = preset_of(merge(of_agents, typed))
        return {"default": of_agents, f"preset={preset['preset']}": preset}

    @property
    def default_folder(self) -> str:
        """The run directory, named by the fields of `named_by`."""
        name = "-".join(map(self.name, ("env", "proxy", "agent")))
        for part, usual in ((self.name("exploration"), "none"), (self.agent_hparams, "default")):
            name += f"_{part}" if part != usual else ""
        return f"runs/{as_file_name(f'{name}-s{self.seed}')}"


# --- from words ----------------------------------------------------------------------------------


def config(overrides: Sequence[str] = ()) -> LearnConfig:
    """The configuration of a run, from the words after `python -m sejax.run`.

    Args:
      overrides: a list of words, not one text.

    Raises:
      ConfigError: for an unknown group, choice or field, or a value out of range.

    Example:
      >>> config(["env=acrobot", "generations=7"]).generations
      7
    """
    return LearnConfig.of_words(overrides)


def default_agent(env: Tree) -> str:
    """The default agent of a task, by its name and fields."""
    with contextlib.suppress(ConfigError):  # making the task raises it again
        config = configure("env", registry.DEFAULTS["env"] | env)
        return agents.default_for(envs.spec_of(config))
    return registry.DEFAULTS["agent"]["name"]
