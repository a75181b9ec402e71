"""A command's configuration: from the words that a user types to typed, validated dataclasses.

A word is `group=choice`, `group.field=value` or `field=value`. `sejax.runs.compose` lays the words
on a preset, which gives nested plain values. `sejax.options.registry` makes dataclasses of these
values, and reads each value by its field's type. The dataclasses check themselves.
"""

import dataclasses
import importlib.util
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import Field

from sejax import agents, envs
from sejax.agents.base import AgentConfig, ExplorationConfig
from sejax.agents.mixture import Mixture, MixtureConfig
from sejax.envs.spec import TaskSpec
from sejax.ops.files import as_file_name
from sejax.options import (
    ConfigError,
    Count,
    Options,
    WholeNumber,
    errors_of,
    field_lines,
    option,
    registry,
    require,
    shortened,
)
from sejax.options.plain import fields_of, flatten, from_plain, merge, to_plain, unknown_field
from sejax.proxies import ProxyConfig, header
from sejax.runs import compose
from sejax.training import TrainingConfig, require_reachable

TRAINING = TrainingConfig()  # for proxies
REAL_TRAINING = TrainingConfig(stop_rule="solved", max_steps=None, max_episodes=1000)
# Fields that the default run directory is named by.
IN_RUN_DIR = ("env", "proxy", "agent", "agents", "exploration", "agent_hparams", "seed")
FIX = "Set agents=[ddqn,ppo]."
Schema = TypeVar("Schema", bound="CommandConfig")


# --- configurations ------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Share(Options):
    """An agent's part in a mixture: `agents.KEY.weight`.

    Attributes:
      weight: share of the candidates that train it; with 0 it only judges the search mean
    """

    group: ClassVar[str] = "share"

    weight: Annotated[float, Field(ge=0, le=1e6)] = 1.0


@dataclass(frozen=True, kw_only=True)
class CommandConfig(Options):
    """What runs and evaluations share.

    Attributes:
      groups: the groups of plugins whose choices are fields of the command.
      learns: whether the command learns proxies: then presets apply, and several agents have
        shares.
      agents: configurations by key, in the keys' order; see `sejax.runs.compose.agents_of`.
      exploration: intrinsic reward of the agents
      training: training on proxies
      num_parallel: Agents that train side by side on one device; null: what suits the agent and
        the device.
      devices: null: all
    """

    groups: ClassVar[tuple[str, ...]] = ()
    learns: ClassVar[bool] = False

    agents: dict[str, AgentConfig]
    exploration: ExplorationConfig
    training: TrainingConfig = TRAINING
    seed: WholeNumber = 0
    num_parallel: Count | None = None
    devices: Count | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for group in ("tracker", "machines"):
            plugin: Any = getattr(self, group, None)
            package = getattr(plugin, "package", None)
            if package is not None and importlib.util.find_spec(package) is None:
                name = registry.name_of(group, plugin)
                must = f"{group} must be installed; got {name} without the package"
                fix = f"Install it with pip install 'sejax[{name}]'"
                raise ConfigError(f"{must} {package}. {fix}.", group)

    @property
    def agent(self) -> Any:
        """The configuration of the only agent."""
        (agent,) = self.agents.values()
        return agent

    def plain(self) -> dict[str, Any]:
        """Nested plain values, as in `config.yaml`; `sejax.save` keeps them with a proxy."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        for group in self.groups:
            values[group] = registry.describe(group, values[group])
        of_agents = {key: registry.describe("agent", x) for key, x in self.agents.items()}
        mixture, weights = values.pop("mixture", None), values.pop("weights", ())
        if len(of_agents) > 1 and mixture is not None:
            for agent, weight in zip(of_agents.values(), weights, strict=True):
                agent["weight"] = weight
            of_agents |= to_plain(mixture)
        return to_plain(values | {"agents": of_agents})  # type: ignore[no-any-return]

    def require_learning(
        self, key: str, group: str, training: TrainingConfig, proxy: ProxyConfig, spec: TaskSpec
    ) -> None:
        """Checks that an agent learns something on a proxy.

        Episodes of one-step SEs, and of most SEs with soft ends, last to their limit. On such a
        proxy a step budget must be long enough for the agent to learn. The stop rule must not read
        the proxy's returns.

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
        field = f"{group}.solved_by"
        message = f"must be test, as returns on a proxy say nothing; got {got}. Set {field}=test."
        require(training.stop_rule != "solved" or got == "test", field, message)
        before = self.agents[key].steps_before_learning(longest, spec.max_steps)
        steps = training.max_steps
        must = f"must exceed {before}, before which {shortened(key)} learns nothing; got {steps}."
        is_enough = not proxy.reaches_step_limit or steps is None or steps > before
        field = f"{group}.max_steps"
        require(is_enough, field, f"{must} Set {field}={4 * before}.")


@dataclass(frozen=True, kw_only=True)
class LearnConfig(CommandConfig):
    """A whole bilevel optimisation, as `sejax.run` and `sejax.make_learner` take it.

    Attributes:
      weights: the agents' weights; equal if left out
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

    groups: ClassVar[tuple[str, ...]] = tuple(compose.DEFAULTS)
    learns: ClassVar[bool] = True

    weights: tuple[float, ...] = ()
    mixture: MixtureConfig = MixtureConfig()
    preset: str = "best"
    env: Any
    proxy: Any
    es: Any
    objective: Any
    tracker: Any
    machines: Any
    agent_hparams: Literal["default", "varied"] = "default"
    generations: Count = 100
    num_seeds: Count = 1
    stop_when_solved: bool = False
    checkpoint_every: Count = 1
    run_dir: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        is_here = self.devices is None or not getattr(self.machines, "is_elsewhere", False)
        message = f"must be left out with machines; got {self.devices}. Set machines.workers=N."
        require(is_here, "devices", message)
        if self.stop_when_solved and not getattr(self.objective, "scores_are_returns", True):
            must = f"must be false with objective={self.name('objective')}, whose scores are no"
            message = f"stop_when_solved {must} returns. Set stop_when_solved=false."
            raise ConfigError(message, "stop_when_solved")
        spec, task_name = envs.spec_of(self.env), registry.name_of("env", self.env)
        self.proxy.require_task(spec, task_name)
        for key, agent in self.agents.items():
            field = compose.field_of(key, self.agents)
            agents.require_fit(agent, self.exploration, spec, task_name, field)
            self.require_learning(key, "training", self.training, self.proxy, spec)

    def name(self, group: str) -> str:
        """The name of a group's choice; several agents are `ddqn+ppo`."""
        if group == "agent":
            return "+".join(self.agents)
        return registry.name_of(group, getattr(self, group))

    def task(self) -> envs.Task:
        """The real task; it is built once."""
        return envs.make_from(self.env)

    def parts(self) -> dict[str, Any]:
        """The objects that the configuration describes: the arguments of `sejax.make_learner`."""
        task, explored = self.task(), (self.exploration, self.agent_hparams == "varied")
        learners = tuple(agents.make_agent(x, task, *explored) for x in self.agents.values())
        names, weights = tuple(self.agents), self.weights
        mixture = Mixture(agents=learners, names=names, weights=weights, config=self.mixture)
        return {
            "task": task,
            "agent": mixture if len(learners) > 1 else learners[0],
            "proxy": registry.make("proxy", self.proxy, task),
            "es": self.es,
            "objective": registry.make("objective", self.objective, task),
            "training": self.training,
            "stop_when_solved": self.stop_when_solved,
            "devices": self.devices,
            "num_parallel": self.num_parallel,
        }

    @property
    def resolved_run_dir(self) -> Path:
        """The run directory; by default it is named by `IN_RUN_DIR`."""
        name = "-".join(map(self.name, ("env", "proxy", "agent")))
        explored, varied = self.name("exploration"), self.agent_hparams
        name += f"_{explored}" if explored != "none" else ""
        name += f"_{varied}" if varied != "default" else ""
        return Path(self.run_dir or Path("runs", as_file_name(f"{name}-s{self.seed}")))


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig(CommandConfig):
    """What `sejax.evaluate` takes.

    Attributes:
      proxy: a run directory, a safetensors file, a shipped name (cartpole), or real
      env: the task, if proxy=real or if the proxy's task is your own
      proxy_kind: my_module:MyProxy, if the proxy's class is your own
      agent_hparams: as_learned: agents and exploration that the proxy was learned with, if no
        agent is named; default: the agent's; varied: drawn around the default for each agent.
      training_from: How long agents train on the proxy. proxy: on an SE as in the run that learned
        it, on a reward network as on the real task; config: as `training` says.
      baseline: whether as many agents train on the real task, for comparison
      out_dir: null: beside the proxy (runs/evaluate-<name> if the proxy has no folder)
      real_training: Training on the real task. Its test_episodes hold on the proxy too, unless
        training_from=config. Agents as_learned keep the time_limit_is_terminal of the run.
    """

    groups: ClassVar[tuple[str, ...]] = ("exploration",)

    proxy: str
    env: str | None = option(None, names_code=True)
    proxy_kind: str | None = option(None, names_code=True)
    agent_hparams: Literal["default", "varied", "as_learned"] = "default"
    training_from: Literal["proxy", "config"] = "proxy"
    num_agents: Count = 10
    baseline: bool = True
    out_dir: str | None = None
    real_training: TrainingConfig = REAL_TRAINING

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, idle in (("agent_hparams", "as_learned"), ("training_from", "config")):
            is_idle = self.proxy == "real" and getattr(self, name) == idle
            require(not is_idle, name, f"must be left out with proxy=real; got {idle}.")
        default, training = to_plain(TRAINING), to_plain(self.training).items()
        changed = shortened(", ".join(f"{k}={x}" for k, x in training if x != default[k]))
        fix = "" if self.proxy == "real" else "training_from=config, or "
        message = f"must be left out, as it is idle here; got {changed}. Set {fix}real_training.*."
        require(self.training_from == "config" or not changed, "training", message)


# --- plain values ---------------------------------------------------------------------------------


def learn_config(values: Mapping[str, Any], imports: Collection[str] | None = ()) -> LearnConfig:
    """The configuration of a run from plain values, as `config.yaml` and proxy files hold them.

    Args:
      values: nested plain values. One agent may stand as `agent`.
      imports: each `module:attribute` that may be imported; None: any.

    Raises:
      ConfigError: for an unknown, missing or bad field, or parts that cannot work together.
    """
    # A proxy's file names neither the tracker of its run nor the machines.
    unsaid = {"tracker": {"name": "none"}, "machines": {"name": "local"}}
    return _from_plain(LearnConfig, merge(unsaid, header.OLD_DEFAULTS, values), imports)


def completed(stored: Mapping[str, Any], config: LearnConfig) -> dict[str, Any]:
    """A stored run's values with the defaults of fields that an older version did not write.

    The defaults of new fields change no number. A `module:attribute` is imported only if `config`
    has it too.
    """
    try:
        return learn_config(stored, {*map(str, flatten(config.plain()).values())}).plain()
    except ConfigError:
        return dict(stored)


def _from_plain(
    schema: type[Schema], values: Mapping[str, Any], imports: Collection[str] | None
) -> Schema:
    """A command's configuration from nested plain values; see `learn_config`."""
    parts, fields = dict(values), fields_of(schema)
    by_key, only = parts.pop("agents", None) or {}, parts.pop("agent", None)
    if only is not None:  # the form of an older file
        by_key = {compose.key_of(str(dict(only).get("name"))): only, **by_key}
    is_map = isinstance(by_key, Mapping) and all(key == compose.key_of(str(key)) for key in by_key)
    message = f"must be agents by keys that are words; got {shortened(by_key)}. {FIX}"
    require(is_map and by_key, "agents", message)
    keys = sorted(k for k, x in by_key.items() if isinstance(x, Mapping) or not schema.learns)
    parts["agents"], weights = {}, []
    for key in keys:
        field = compose.field_of(shortened(key, 40), keys)
        agent = dict(by_key[key]) if isinstance(by_key[key], Mapping) else {}
        share = {k: agent.pop(k) for k in fields_of(Share) if schema.learns and k in agent}
        weights.append(from_plain(Share, share, field).weight)
        with errors_of("agent", field):
            parts["agents"][key] = registry.configure("agent", agent, imports)
    if schema.learns:
        shared = {name: x for name, x in by_key.items() if name not in keys}
        mixture = from_plain(MixtureConfig, shared, "agents")
        is_idle = mixture == MixtureConfig() and {*weights} == {1.0}
        field = f"agents.{next(iter(shared), 'KEY.weight')}"
        require(len(weights) > 1 or is_idle, field, f"must come with several agents. {FIX}")
        parts |= {"weights": weights, "mixture": mixture}
    for group in schema.groups:
        parts[group] = registry.configure(group, parts.get(group, {}), imports)
    config = from_plain(schema, {k: x for k, x in parts.items() if k in fields}, "", imports)
    for name in [name for name in parts if name not in fields]:
        raise unknown_field(str(name), words_of(config))
    return config


# --- words ---------------------------------------------------------------------------------------


def config(overrides: Sequence[str] = ()) -> LearnConfig:
    """Composes and validates a configuration from the words of the command line.

    Args:
      overrides: as typed after `python -m sejax.run`.

    Raises:
      ConfigError: for an unknown group, choice or field, or a value out of range.

    Example:
      >>> config(["env=acrobot", "generations=7"]).generations
      7
    """
    return _composed(LearnConfig, overrides)[0]


def evaluate_config(overrides: Sequence[str] = (), schema: Any = EvaluateConfig) -> Any:
    """As `config`, for `python -m sejax.evaluate`, or for the command whose class is `schema`."""
    return _composed(schema, overrides)[0]


def _composed(schema: type[Schema], overrides: Sequence[str]) -> tuple[Schema, compose.Layers]:
    """The configuration that a command's words make, and its layers."""
    values, imports = compose.read(overrides), compose.typed(overrides)
    stored = {} if schema.learns else _learned(values)
    layers = compose.compose(values, schema.groups, schema.learns, stored, imports)
    return _from_plain(schema, merge(*layers.values()), imports), layers


def help_text(schema: type[CommandConfig], overrides: Sequence[str]) -> str:
    """The text of `--help` for a command and these words.

    It lists the choices of each group, then the fields of the words' choices. If a value is not the
    default, the layer that sets it stands beside it.
    """
    words = overrides if schema.learns else ["proxy=RUN_DIR", *overrides]
    config, layers = _composed(schema, words)
    lines = ["Choices (group=choice):"]
    for group in ("agent", *schema.groups):
        prefixes = ["gymnax/ID"] if group == "env" else []
        known = ", ".join([*registry.names(group), *prefixes, "module:attribute"])
        lines += [textwrap.fill(f"  {group}: {known}", 98, subsequent_indent=" " * 6)]
    lines += ["  agents: [agent,agent,...]"]
    if isinstance(config, LearnConfig):
        presets = compose.sections_of(config.name("env"), config.name("proxy"))
        lines += [f"  preset: {', '.join([*presets, 'FILE.yaml'])}"]
    lines += ["", "Fields of these choices (field=value), with their values:"]
    classes: list[tuple[str, type]] = [("", schema), ("agents", MixtureConfig)]
    classes += [(name, type(x)) for name, x in vars(config).items()]
    for key, agent in config.agents.items():
        classes += [(compose.field_of(key, config.agents), cls) for cls in (Share, type(agent))]
    sources = dict[str, str]()
    for layer, values in layers.items():
        source = "" if layer == "default" else f" ({layer})"
        sources |= dict.fromkeys(_as_words(values, config.agents), source)
    values = _as_words(config.plain(), config.agents)
    fields = {name: x for name, x in values.items() if not name.endswith(".name")}
    return "\n".join([*lines, field_lines(fields, classes, sources)])


def _as_words(values: Mapping[str, Any], agents: Collection[str]) -> dict[str, Any]:
    """Plain values by the names of words; the fields of an only agent are `agent.FIELD`."""
    by_key = values.get("agents", {})
    rest = {name: x for name, x in values.items() if name != "agents"}
    of_agents = {"agents": by_key} if len(agents) > 1 else {"agent": by_key.get(*agents, {})}
    return flatten(rest | of_agents)


def words_of(config: CommandConfig) -> dict[str, Any]:
    """The value of each field by its name in words; the value of a choice is the plugin's name."""
    values = _as_words(config.plain(), config.agents)
    return values | {k.removesuffix(".name"): x for k, x in values.items() if k.endswith(".name")}


def _learned(values: Mapping[str, Any]) -> dict[str, Any]:
    """What the agents of an evaluation take from the run that learned the proxy.

    If no word names an agent, all of the proxy's agents train, with their exploration and with the
    run's `time_limit_is_terminal`. If a word names an agent that the proxy was learned with, the
    agent has the proxy's hyperparameters. If the file has no agents, the task's default one trains.

    Raises:
      ConfigError: with `agent_hparams=as_learned`, if words set agents or exploration, or if the
        file does not tell its agents.
    """
    message = "must be given. Set proxy=RUN_DIR, FILE, cartpole (shipped), or real env=cartpole."
    require("proxy" in values, "proxy", message)
    source, hparams = str(values["proxy"]), values.get("agent_hparams")
    groups = "agent", "agents", "exploration"
    words = {name: x for name, x in values.items() if name.partition(".")[0] in groups}
    if source == "real":
        return {}
    field, got = next(iter(words), "").partition(".")[0], shortened(", ".join(words))
    message = f"must be left out with agent_hparams=as_learned; got {got}. Set it to default."
    require(not words or hparams != "as_learned", field, message)
    stored, learned = None, dict[str, Any]()
    try:
        stored = header.read(source, "proxy").header
        explored = stored.config.get("exploration", {"name": "none"})
        header.configured("exploration", explored, source)
        agents_there = header.agents_of(stored.config)
        for agent in agents_there.values():
            header.configured("agent", agent, source)
        learned = {compose.key_of(key): agent for key, agent in agents_there.items()}
    except ConfigError:  # loading the proxy raises it later
        if hparams == "as_learned":
            raise
    if stored is None:
        return {}
    if learned and not words and hparams in (None, "as_learned"):
        said = flatten(merge(header.OLD_DEFAULTS, stored.config))
        limit = {"time_limit_is_terminal": said.get("training.time_limit_is_terminal")}
        choices = {"agents": learned, "exploration": explored, "real_training": limit}
        return choices | {"agent_hparams": "as_learned"}
    default = agents.default_for(stored.spec)
    by_name = {x["name"]: x for x in learned.values()} if hparams is None else {}
    names = compose.agents_of(values) or {default: default}
    return {"agents": {key: by_name.get(name, {"name": name}) for key, name in names.items()}}
