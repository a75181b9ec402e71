"""A command's configuration: from the overrides that a user types to typed, validated dataclasses.

An override is `group=choice`, `group.field=value` or `field=value`. They become a configuration in
four steps, the same for every command:

1. `read` splits them into names and texts, and puts the values of a preset file beneath them.
2. The choice of every group is found: the given one, else what the task and the proxy suggest.
3. `compose` merges the settings of the preset for these choices with the overrides, nested values
   that are still plain.
4. `sejax.options.registry` makes dataclasses of them, each value read by its field's type; the
   dataclasses check themselves.

Presets are files `presets/<env>-<proxy>.yaml` with a section for each preset: values, `with_agent`,
`with_es` and `with_objective` for those that only hold with one of these, and `like` for a section
that it builds on. `general-<proxy>.yaml` serves tasks without a file of their own, and sections
that say `like: general`.
"""

import contextlib
import dataclasses
import functools
import hashlib
import itertools
import re
import textwrap
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import yaml

from sejax import agents, envs
from sejax.agents.mixture import Mixture, MixtureConfig
from sejax.ops.files import as_file_name
from sejax.options import (
    ConfigError,
    Options,
    as_text,
    counts,
    help_texts,
    is_number,
    listed,
    one_of,
    option,
    registry,
    require,
    seed,
    shortened,
    told,
    unknown_name,
)
from sejax.options.registry import (
    RENAMED,
    flatten,
    parsed,
    split,
    to_plain,
    unknown_field,
    unquoted,
)
from sejax.training import TrainingConfig, require_reachable

AGENT_HPARAMS = ("default", "varied")
EVALUATION_HPARAMS = (*AGENT_HPARAMS, "as_learned")
TRAINING_FROM = ("proxy", "config")
# Choices where neither an override nor the task or the proxy makes one.
DEFAULTS = {
    "env": "cartpole",
    "proxy": "se",
    "agent": "ddqn",
    "exploration": "none",
    "es": "nes",
    "objective": "max_reward",
    "tracker": "none",
    "machines": "local",
}
TRAINING = TrainingConfig()  # on proxies
REAL_TRAINING = TrainingConfig(stop_rule="solved")
JOINT = "+"  # between the agents of a mixture, in names
PRESETS = Path(__file__).parent / "presets"
GENERAL = "general"  # the presets of tasks without a file of their own
ENDING = ".yaml"  # of a preset file
NAME = re.compile(r"[A-Za-z_][\w.-]*")  # of a field
_KEY = re.compile(r"\w[\w-]*")


# --- the agents of a run -------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class AgentFamily:
    """One of the agents of a configuration.

    Attributes:
      key: its name in tables and metrics.
      field: its name in overrides and messages.
      agent: its configuration.
      weight: its share of a generation's candidates; with 0 it only judges incumbents.
    """

    key: str
    field: str
    agent: Any
    weight: float = 1.0


@dataclass(frozen=True, kw_only=True)
class AgentsConfig(MixtureConfig):
    """A mixture of agents, sorted by their keys."""

    families: tuple[AgentFamily, ...]


_SHARED = tuple(field.name for field in dataclasses.fields(MixtureConfig))


def _agents_from_plain(values: Any) -> AgentsConfig | None:
    """The mixture that plain values describe: `_SHARED` fields, and each agent's under its key."""
    if values is None:
        return None
    one = "agents=[ddqn,ppo]"
    require(
        isinstance(values, Mapping),
        "agents",
        f"must be a list, because it is a mixture; got {shortened(values)}. Set {one}.",
    )
    shared = {name: value for name, value in values.items() if name in _SHARED}
    keys = sorted(values.keys() - set(_SHARED))
    require(
        keys,
        "agents",
        f"must hold an agent, because proxies are judged by agents; got none. Set {one}.",
    )
    return AgentsConfig(
        families=tuple(_family(key, values[key]) for key in keys),
        **to_plain(registry.from_plain(MixtureConfig, shared, "agents")),
    )


def _family(key: str, values: Any) -> AgentFamily:
    field = f"agents.{key}"
    is_word = _KEY.fullmatch(key)
    require(
        is_word,
        field,
        f"must be a word, because columns are named by it; got {shortened(key)}. Set "
        "agents=[ddqn,ppo].",
    )
    with named(field):
        is_agent = isinstance(values, Mapping)
        require(
            is_agent,
            "agent",
            f"must have fields, because it is an agent; got {shortened(values)}. Set agent=ddqn.",
        )
        fields = dict(values)
        weight = fields.pop("weight", 1.0)
        weight = parsed(weight) if isinstance(weight, str) else weight
        require(
            is_number(weight) and 0 <= weight <= 1e6,
            "agent.weight",
            "must lie in [0, 1e6], because it is a share of the candidates; got "
            f"{shortened(weight)}. Set agent.weight=1.",
        )
        agent = registry.configure("agent", fields)
    return AgentFamily(key=key, field=field, agent=agent, weight=float(weight))


def families_of(config: "LearnConfig | EvaluateConfig") -> tuple[AgentFamily, ...]:
    """The agents of a command's configuration: several, or the one."""
    if config.agents is not None:
        return config.agents.families
    key = registry.name_of("agent", config.agent)
    return (AgentFamily(key=key, field="agent", agent=config.agent),)


@contextlib.contextmanager
def named(field: str) -> Iterator[None]:
    """Errors about `agent` in here name a mixture's field, such as `agents.ddqn`."""
    try:
        yield
    except ConfigError as error:
        if field == "agent":
            raise
        text = re.sub(r"\bagent(?=\.\w| must )", field, str(error))
        at_fault = re.sub(r"^agent\b", field, error.field)
        raise ConfigError(re.sub(r"\bagent=", "agents=", text), at_fault) from error


def key_of(name: str) -> str:
    """The key of an agent in a mixture; `my_module_MyAgent` of `my_module:MyAgent`."""
    return re.sub(r"[^\w-]+", "_", name)


# --- configurations ------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class LearnConfig(Options):
    """A whole bilevel optimisation: what `sejax.run` and `sejax.make_learner` take.

    Raises:
      ConfigError: for parts that cannot work together.
    """

    groups: ClassVar[tuple[str, ...]] = tuple(DEFAULTS)
    # Fields that the default run directory is named by.
    in_run_dir: ClassVar[tuple[str, ...]] = (
        *("env", "proxy", "agent", "agents", "exploration", "agent_hparams", "seed"),
    )

    preset: str = "best"  # settings that were measured (best) or published (paper)
    env: Any  # the real task
    proxy: Any  # what is learned: a synthetic environment (se) or a reward network (rn)
    agent: Any = None  # trains on the proxies; null with `agents`
    agents: AgentsConfig | None = None  # several agents that take turns: agents=[ddqn,ppo]
    exploration: Any  # intrinsic reward of the agents
    es: Any  # the evolution strategy of the outer loop
    objective: Any  # what the outer loop maximises
    tracker: Any  # follows the run beside its files
    machines: Any  # where agents train
    training: TrainingConfig = TRAINING
    # default: the agent's; varied: learning rate, batch and network drawn anew for each training.
    agent_hparams: str = option("default", one_of(AGENT_HPARAMS))
    # n_o: steps of the outer loop.
    generations: int = option(50, counts("there is nothing to do otherwise", most=1_000_000))
    seed: int = option(0, seed())
    # Independent runs, with seeds seed, seed + 1, ...
    num_seeds: int = option(1, counts("it counts runs"))
    # End a run at its first incumbent mean that reaches the solved threshold.
    stop_when_solved: bool = False
    # Agents that train side by side on one device; null: what suits the agent and the device.
    num_parallel: int | None = option(None, counts("something must compute"))
    devices: int | None = option(None, counts("something must compute"))  # null: all
    checkpoint_every: int = option(1, counts("it counts generations"))  # generations
    run_dir: str | None = None  # null: runs/<env>-<proxy>-<agent>[_<exploration>][_varied]-s<seed>

    def __post_init__(self) -> None:
        super().__post_init__()
        seed()("seed + num_seeds - 1", self.seed + self.num_seeds - 1, 0)
        registry.require_package("tracker", self.tracker, "the run is told to it")
        registry.require_package("machines", self.machines, "trainings are sent there")
        elsewhere = getattr(self.machines, "is_elsewhere", False)
        require(
            not elsewhere or self.devices is None,
            "devices",
            "must be left out with trainings on other machines, because each worker has one; got "
            f"{shortened(self.devices)}. Set machines.workers=N in its place, or machines=local.",
        )
        require_real_returns("training", self.training)
        returns = getattr(self.objective, "scores_are_returns", None)
        require(
            not self.stop_when_solved or returns is not False,
            "stop_when_solved",
            "must be false with this objective, because its scores are not returns, so that none "
            f"says solved; got true with objective={self.name('objective')}. Set "
            "stop_when_solved=false.",
        )
        spec, task_name = envs.spec_of(self.env), self.name("env")
        self.proxy.require_task(spec, task_name)
        train = not all(x.agent.is_solved_for for x in families_of(self))
        if train and not self.proxy.has_real_dynamics:
            require_reachable("training", self.training, self.proxy.max_steps(spec.max_steps))
        for family in families_of(self):
            with named(family.field):
                agents.require_fit(family.agent, self.exploration, spec, task_name)
                if self.proxy.reaches_step_limit:
                    require_learning(
                        "training",
                        self.training,
                        family.agent,
                        self.proxy.max_steps(spec.max_steps),
                        spec.max_steps,
                    )

    def name(self, group: str) -> str:
        """The name by which a group's choice was made; several agents are `ddqn+ppo`."""
        if group == "agent":
            return JOINT.join(family.key for family in families_of(self))
        return registry.name_of(group, getattr(self, group))

    def plain(self) -> dict[str, Any]:
        """Nested plain values, as in `config.yaml`; what `sejax.save` keeps with a proxy."""
        return plain(self)

    def task(self) -> envs.Task:
        """The real task; it is built once."""
        return envs.make_from(self.env)

    def parts(self) -> dict[str, Any]:
        """The objects that it describes, as `sejax.make_learner` takes them."""
        task = self.task()
        return {
            "task": task,
            "agent": self._learners(task),
            "proxy": registry.make("proxy", self.proxy, task),
            "es": self.es,
            "objective": registry.make("objective", self.objective, task),
            "training": self.training,
            "stop_when_solved": self.stop_when_solved,
            "devices": self.devices,
            "num_parallel": self.num_parallel,
        }

    def _learners(self, task: envs.Task) -> Any:
        """The agent, or the mixture of agents, that trains on the proxies."""
        varied, each = self.agent_hparams == "varied", families_of(self)
        made = tuple(agents.make_agent(x.agent, task, self.exploration, varied) for x in each)
        if self.agents is None:
            return made[0]
        return Mixture(
            agents=made,
            names=tuple(x.key for x in each),
            weights=tuple(x.weight for x in each),
            config=self.agents,
        )

    @property
    def resolved_run_dir(self) -> Path:
        """The run directory: by default named by `in_run_dir`."""
        explored = self.name("exploration")
        explored = "" if explored == "none" else f"_{explored}"
        varied = "_varied" if self.agent_hparams == "varied" else ""
        agent = f"{self.name('agent')}{explored}{varied}"
        name = f"{self.name('env')}-{self.name('proxy')}-{agent}-s{self.seed}"
        return Path(self.run_dir or Path("runs", as_file_name(name)))


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig(Options):
    """What `sejax.evaluate` takes."""

    groups: ClassVar[tuple[str, ...]] = ("agent", "exploration")

    proxy: str  # a run directory, a safetensors file, a shipped name (cartpole), or real
    env: str | None = None  # the task, where proxy=real or the proxy's is your own
    proxy_kind: str | None = None  # my_module:MyProxy, where the proxy is of a kind of your own
    agent: Any = None  # null with `agents`
    agents: AgentsConfig | None = None  # several agents in one table: agents=[ddqn,ppo]
    exploration: Any  # intrinsic reward of the agents
    # default: the agent's; varied: drawn around them for each agent; as_learned: agent and
    # exploration that the proxy was learned with.
    agent_hparams: str = option("default", one_of(EVALUATION_HPARAMS))
    # How long agents train on the proxy. proxy: on an SE as it was learned with, on a reward
    # network as on the real task (as_learned: with the time limit as in its run); config: as
    # `training` says.
    training_from: str = option("proxy", one_of(TRAINING_FROM))
    num_agents: int = option(10, counts("there is nothing to average otherwise"))
    baseline: bool = True  # as many agents trained on the real task, beside them
    seed: int = option(0, seed())
    # Agents that train side by side on one device; null: what suits the agent and the device.
    num_parallel: int | None = option(None, counts("something must compute"))
    devices: int | None = option(None, counts("something must compute"))  # null: all
    out_dir: str | None = None  # null: beside the proxy (runs/evaluate-<name> without a folder)
    training: TrainingConfig = TRAINING  # on the proxy, with training_from=config
    # On the real task, and how all agents are tested unless training_from=config.
    real_training: TrainingConfig = REAL_TRAINING

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, idle, usual in (
            ("agent_hparams", "as_learned", "default"),
            ("training_from", "config", "proxy"),
        ):
            require(
                self.proxy != "real" or getattr(self, name) != idle,
                name,
                f"must be {usual} with proxy=real, because there is no proxy; got "
                f"{shortened(idle)}. Set {name}={usual}.",
            )
        if self.agent_hparams == "as_learned":
            self._require_no_agent()
        instead = "" if self.proxy == "real" else "training_from=config, or "
        require(
            self.training_from == "config" or self.training == TRAINING,
            "training",
            "must be left as it is, because agents train on an SE as it was learned with, and "
            "else as real_training says; got "
            f"{shortened(_changes(to_plain(self.training), to_plain(TRAINING)))}. Set "
            f"{instead}real_training.*.",
        )

    def _require_no_agent(self) -> None:
        """Refuses an agent beside that of the proxy."""
        several = None if self.agents is None else JOINT.join(x.key for x in families_of(self))
        chosen = {"agents": several}
        for group in self.groups if several is None else ():
            described = registry.describe(group, getattr(self, group))
            is_usual = described["name"] in (*agents.DEFAULTS, "none")
            usual = registry.defaults(group, described["name"]) if is_usual else {}
            chosen[group] = _changes(described, usual)
        for group, changed in chosen.items():
            require(
                not changed,
                group,
                "must be left out with agent_hparams=as_learned, because the proxy says which it "
                f"was learned with; got {shortened(changed)}. Set agent_hparams=default.",
            )


def learn_config(values: Mapping[str, Any]) -> LearnConfig:
    """The configuration of a run from plain values, as `config.yaml` and proxy files hold them.

    Raises:
      ConfigError: for an unknown, missing or bad field, or parts that cannot work together.
    """
    # A stored proxy does not say who followed its run, or where it was computed.
    unsaid = {"tracker": {"name": "none"}, "machines": {"name": "local"}}
    return _from_plain(LearnConfig, unsaid | dict(values))


def plain(config: LearnConfig | EvaluateConfig) -> dict[str, Any]:
    """A command's configuration as plain values; inverse of `learn_config`."""
    values = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    for group in config.groups:
        if values[group] is not None:
            values[group] = registry.describe(group, values[group])
    if config.agents is not None:
        shared = {name: getattr(config.agents, name) for name in _SHARED}
        values["agents"] = shared | {
            each.key: {"name": "", "weight": each.weight} | registry.describe("agent", each.agent)
            for each in config.agents.families
        }
    return registry.plain(values)  # type: ignore[no-any-return]


def completed(stored: Mapping[str, Any], config: LearnConfig) -> dict[str, Any]:
    """A stored run's values with the fields that an older version did not write; plain values.

    New fields have a default that changes no number. Those of a choice are taken from the choice of
    the same name in `config`: what only `stored` names is neither imported nor made.
    """
    values = {"agent": None, "agents": None} | dict(stored)
    known = {
        group: registry.defaults(group, config.name(group))
        for group in config.groups
        if getattr(config, group) is not None
    }
    known["training"] = to_plain(TRAINING)
    if config.agents is not None:
        known["agents"] = to_plain(MixtureConfig()) | {
            each.key: {"weight": 1.0}
            | registry.defaults("agent", registry.name_of("agent", each.agent))
            for each in config.agents.families
        }
    return values | {
        name: _filled(values[name], fields) for name, fields in known.items() if name in values
    }


def _filled(there: Any, known: Mapping[str, Any]) -> Any:
    """A group's fields with those that are missing, if it is of the same name."""
    if not isinstance(there, Mapping) or there.get("name") != known.get("name"):
        return there
    nested = {
        name: _filled(value, known[name])
        for name, value in there.items()
        if isinstance(known.get(name), Mapping)
    }
    return {name: x for name, x in known.items() if x != "???"} | dict(there) | nested


def _from_plain(schema: Any, values: Mapping[str, Any]) -> Any:
    typed = dict(values)
    typed["agents"] = _agents_from_plain(values.get("agents"))
    one_agent = values.get("agent")
    require(
        typed["agents"] is None or one_agent is None,
        "agent",
        "must be left out with agents, because all of them are named there; got "
        f"{shortened(one_agent)}. Set agents=[...] alone.",
    )
    for group in schema.groups:
        if group != "agent" or typed["agents"] is None:
            is_chosen = typed.get(group) is not None
            require(
                is_chosen,
                group,
                f"must be chosen, because it is needed; got none. Set {group}=NAME.",
            )
            typed[group] = registry.configure(group, typed[group])
    return registry.from_plain(schema, typed, "")


def require_real_returns(name: str, training: TrainingConfig) -> None:
    """Checks that the rule by which agents stop on a proxy does not read the proxy's returns.

    Raises:
      ConfigError: if it does.
    """
    require(
        training.stop_rule != "solved" or training.solved_by == "test",
        f"{name}.solved_by",
        "must be test with stop_rule=solved, because returns on a proxy say nothing about the "
        f"real task's threshold; got {shortened(training.solved_by)}. Set {name}.solved_by=test.",
    )


def require_learning(
    name: str, training: TrainingConfig, agent: Any, max_episode_steps: int, task_max_steps: int
) -> None:
    """Checks that a step budget lets an agent learn in a world whose episodes last to their limit.

    One-step SEs are such, and most with soft ends, which may never end an episode.

    Raises:
      ConfigError: if it does not.
    """
    before = agent.steps_before_learning(max_episode_steps, task_max_steps)
    require(
        training.max_steps is None or training.max_steps > before,
        f"{name}.max_steps",
        f"must exceed {before}, because {registry.name_of('agent', agent)} learns nothing before; "
        f"got {shortened(training.max_steps)}. Set {name}.max_steps={4 * before}.",
    )


def _changes(given: Mapping[str, Any], usual: Mapping[str, Any]) -> str:
    return ", ".join(f"{k}={v}" for k, v in given.items() if v != usual.get(k))


# --- overrides -----------------------------------------------------------------------------------


def config(overrides: Sequence[str] = ()) -> LearnConfig:
    """Composes and validates a configuration from command-line overrides.

    Args:
      overrides: as typed after `python -m sejax.run`.

    Raises:
      ConfigError: for an unknown group, choice or field, or a value out of range.

    Example:
      >>> config(["env=acrobot", "generations=7"]).generations
      7
    """
    _require_overrides(overrides)
    with registry.only_typed(overrides):
        return learn_config(compose(LearnConfig, overrides))


def evaluate_config(overrides: Sequence[str] = ()) -> EvaluateConfig:
    """As `config`, for the overrides after `python -m sejax.evaluate`."""
    _require_overrides(overrides)
    with registry.only_typed(overrides):
        values = compose(EvaluateConfig, overrides)
        require(
            "proxy" in values,
            "proxy",
            "must be given, because agents are trained on it; got none. Set proxy=RUN_DIR, "
            "proxy=FILE, proxy=cartpole (a shipped one) or proxy=real env=cartpole.",
        )
        made: EvaluateConfig = _from_plain(EvaluateConfig, values)
    return made


def _require_overrides(overrides: Any) -> None:
    is_list = isinstance(overrides, list | tuple) and all(isinstance(x, str) for x in overrides)
    fix = 'overrides=["env=cartpole"]'
    require(
        is_list,
        "overrides",
        f"must be a list of text, because each sets a field; got {shortened(repr(overrides))}. Set "
        f"{fix}.",
    )


def expand(overrides: Sequence[str]) -> list[list[str]]:
    """The overrides of each run of a sweep: commas outside of brackets separate values.

    Example:
      >>> expand(["env=acrobot", "seed=0,1"])
      [['env=acrobot', 'seed=0'], ['env=acrobot', 'seed=1']]
    """
    values = []
    for override in overrides:
        name, equals, text = override.partition("=")
        values.append([f"{name}{equals}{value}" for value in split(text)])
    return [list(each) for each in itertools.product(*values)]


def name_in_sweep(overrides: Sequence[str], of_run: Sequence[str], known: Collection[str]) -> str:
    """What tells a run of a sweep from the others, for the name of its folder.

    Args:
      overrides: of the sweep.
      of_run: those of one run, as from `expand`.
      known: fields that the folder's name has already.

    Example:
      >>> sweep = ["seed=0,1", "es.noise_std=0.1,0.2"]
      >>> name_in_sweep(sweep, ["seed=1", "es.noise_std=0.2"], ["seed"])
      'es.noise_std_0.2'
    """
    swept = [one for one, each in zip(of_run, overrides, strict=True) if one != each]
    name = as_file_name(",".join(x for x in swept if x.partition("=")[0] not in known))
    return name if len(name) <= 120 else hashlib.sha256(name.encode()).hexdigest()[:16]


def file_text(overrides: Iterable[str]) -> str:
    """The preset file that holds overrides.

    Example:
      >>> print(file_text(["env=acrobot", "es.noise_std=0.1"]), end="")
      env: acrobot
      es.noise_std: 0.1
    """
    pairs = (override.partition("=") for override in overrides)
    return str(yaml.safe_dump({name: parsed(text) for name, _, text in pairs}, sort_keys=False))


def read(overrides: Sequence[str]) -> dict[str, Any]:
    """Names and values of overrides, over those of the file that `preset=FILE.yaml` names.

    Raises:
      ConfigError: for what is no override, or several values, and for a file that cannot be read.
    """
    given: dict[str, Any] = {}
    for override in overrides:
        name, equals, text = override.partition("=")
        require(
            equals and NAME.fullmatch(name),
            "an override",
            f"must read FIELD=VALUE, because nothing else is read; got {shortened(override)}. Set "
            f"env={shortened(override)} or proxy={shortened(override)}, if that is meant.",
        )
        values = split(text)
        require(
            len(values) == 1,
            name,
            "must be one value here, because a comma outside of brackets and quotes separates the "
            f"runs of a sweep; got {shortened(text)}. Set {name}={values[0]}.",
        )
        given[name] = unquoted(text)
    if str(given.get("preset", "")).endswith(ENDING):
        given = _of_file(Path(given.pop("preset"))) | given
    return given


def _of_file(path: Path) -> dict[str, Any]:
    """The values of a preset file, by their full names; `preset: paper` in it is its base."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(
            f"preset must be one of {', '.join(preset_names())}, or a YAML file; got "
            f"{shortened(path)} ({told(error)}). Set preset=best.",
            "preset",
        ) from error
    require(
        content and isinstance(content, dict),
        "preset",
        f"must be a file that maps fields to values, because they are set; got {shortened(path)} "
        f"with {shortened(content)}. Set preset=best, or write `es.noise_std: 0.1` there.",
    )
    values = flatten(content)
    base = str(values.get("preset", ""))
    is_name = not base.endswith(ENDING)
    require(
        is_name,
        "preset",
        f"must name no file in a file, because files do not nest; got {shortened(base)}. Set "
        "preset: best.",
    )
    return values


def compose(schema: Any, overrides: Sequence[str]) -> dict[str, Any]:
    """Nested plain values of a command's fields: a preset's, and over them those of overrides.

    Args:
      schema: `LearnConfig` or `EvaluateConfig`.
      overrides: as typed after the command.

    Raises:
      ConfigError: for an override that cannot be.
    """
    given = read(overrides)
    mixture = _agents_of(given)
    chosen = _choices(schema, given, mixture)
    _require_fields(given, schema, chosen, mixture)
    values: dict[str, Any] = {
        field.name: to_plain(field.default)
        for field in dataclasses.fields(schema)
        if isinstance(field.default, TrainingConfig)
    }
    if schema is LearnConfig:
        values = _merged(values, _preset_values(given.get("preset", "best"), chosen, mixture))
    for name, value in given.items():
        if name not in schema.groups and name != "agents":
            values = _merged(values, _nested(name, value))
    for group, name in chosen.items():
        values[group] = {"name": name} | values.get(group, {})
    for key, name in mixture.items():
        values = _merged({"agents": {key: {"name": name}}}, values)
    return values


def _nested(name: str, value: Any) -> dict[str, Any]:
    for part in reversed(name.split(".")):
        value = {part: value}
    return value  # type: ignore[no-any-return]


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Nested values with changes over them."""
    merged = dict(base)
    for key, value in changes.items():
        nested = isinstance(value, Mapping) and isinstance(base.get(key), Mapping)
        merged[key] = _merged(base[key], value) if nested else value
    return merged


# --- choices -------------------------------------------------------------------------------------


def _agents_of(given: Mapping[str, Any]) -> dict[str, str]:
    """The names of a mixture's agents by their keys; empty without `agents=[...]`."""
    text = given.get("agents", "null")
    if text in (None, "null"):
        return {}
    names = parsed(text) if isinstance(text, str) else text
    names = names if isinstance(names, list) else [names]
    require(
        names,
        "agents",
        "must hold an agent, because agents train on it; got none. Set agents=[ddqn,ppo].",
    )
    for name in names:
        if not isinstance(name, str):
            raise unknown_name("agents", name, registry.names("agent"))
    mixture = {key_of(name): name for name in names}
    once = ",".join(mixture.values())
    is_once = len(mixture) == len(names)
    require(
        is_once,
        "agents",
        f"must name each agent once, because each has a key; got {shortened(text)}. Set "
        f"agents=[{once}].",
    )
    extra = next((name for name in given if re.fullmatch(r"agent(\..*)?", name)), "")
    fix = f"agents.{key_of(names[0])}{extra.removeprefix('agent')}={given.get(extra)}"
    fix = fix if "." in extra else f"agents=[{once},{given.get(extra)}]"
    must = f"be left out with agents=[{once}]"
    require(
        not extra,
        extra,
        f"must {must}, because each agent is named there; got {shortened(given.get(extra))}. Set "
        f"{fix}.",
    )
    return mixture


def _choices(schema: Any, given: Mapping[str, Any], mixture: Mapping[str, str]) -> dict[str, str]:
    """The choice of every group; without the agent where there is a mixture."""
    chosen = {group: given.get(group, DEFAULTS[group]) for group in schema.groups}
    for group, choice in chosen.items():
        names = parsed(choice) if isinstance(choice, str) else choice
        is_list = isinstance(names, list) or str(choice).startswith("[")
        first = names[0] if isinstance(names, list) and names else DEFAULTS[group]
        fix = f"agents={as_text(names)}" if group == "agent" else f"{group}={as_text(first)}"
        require(
            not is_list,
            group,
            f"must be one choice, because there is one; got {shortened(choice)}. Set {fix}.",
        )
        registry.find(group, choice)
    for name in mixture.values():
        with named("agents"):
            registry.find("agent", name)
    if mixture:
        del chosen["agent"]
    elif "agent" not in given and schema is LearnConfig:
        fields = {name.partition(".")[2]: x for name, x in given.items() if name[:4] == "env."}
        task = registry.configure("env", {**fields, "name": chosen["env"]})
        chosen["agent"] = agents.default_for(envs.spec_of(task))
    elif "agent" not in given:
        chosen["agent"] = _agent_on(str(given.get("proxy", "")), given.get("env"))
    if schema is LearnConfig and "objective" not in given:
        chosen["objective"] = registry.find("proxy", chosen["proxy"]).default_objective
    return chosen


def _agent_on(source: str, env: str | None) -> str:
    """The agent that suits a stored proxy's task; nothing that a file names is imported."""
    from sejax.proxies import header  # which reads files, and hubs

    try:
        if source not in ("", "real"):
            spec = header.read(source, "proxy").header.spec
            return agents.default_for(spec)
        task = {"name": env} if env is not None else {}
        return agents.default_for(envs.spec_of(registry.configure("env", task)))
    except ConfigError:
        return DEFAULTS["agent"]  # what is wrong is said when the proxy is loaded


def fields_of(schema: Any, chosen: Mapping[str, str], mixture: Mapping[str, str]) -> dict[str, str]:
    """Full names and help texts of the fields that these choices have."""
    texts = help_texts(schema)
    found: dict[str, str] = {}
    for field in dataclasses.fields(schema):
        if field.name in schema.groups:
            if field.name in chosen:
                found |= _fields(registry.find(field.name, chosen[field.name]), field.name)
        elif field.name == "agents":
            found |= _fields(MixtureConfig, "agents") if mixture and schema is LearnConfig else {}
            for key, name in mixture.items():
                weight = {f"agents.{key}.weight": "share of the candidates that train it"}
                found |= weight if schema is LearnConfig else {}
                found |= _fields(registry.find("agent", name), f"agents.{key}")
        elif isinstance(field.default, TrainingConfig):
            found |= _fields(TrainingConfig, field.name)
        else:
            found[field.name] = texts.get(field.name, "")
    return found


def help_text(schema: Any, overrides: Sequence[str]) -> str:
    """What `--help` lists: the choices of each group, and the fields that these overrides compose.

    Args:
      schema: `LearnConfig` or `EvaluateConfig`.
      overrides: as typed after the command.

    Raises:
      ConfigError: for overrides that cannot be composed.
    """
    given = read(overrides)
    mixture = _agents_of(given)
    chosen = _choices(schema, given, mixture)
    values = flatten(compose(schema, overrides))
    lines = ["Choices (group=choice):"]
    for group in schema.groups:
        known = [*registry.names(group), *(f"{x}ID" for x in registry.GROUPS[group].families)]
        lines += _wrapped(f"  {group}: {', '.join([*known, 'module:attribute'])}")
    if schema is LearnConfig:
        lines += _wrapped(f"  preset: {', '.join([*preset_names(), f'FILE{ENDING}'])}")
    lines += ["", "Fields of these choices (field=value), with their values:"]
    defaults = _defaults_of(schema, chosen, mixture)
    for name, text in fields_of(schema, chosen, mixture).items():
        value = as_text(values.get(name, defaults.get(name)))
        lines += _wrapped(f"  {name}={value}" + (f"  # {text}" if text else ""))
    return "\n".join(lines)


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, 98, subsequent_indent="      ", break_long_words=False)


def _defaults_of(
    schema: Any, chosen: Mapping[str, str], mixture: Mapping[str, str]
) -> dict[str, Any]:
    """Defaults of the fields of these choices, by their full names."""
    found: dict[str, Any] = {
        field.name: field.default
        for field in dataclasses.fields(schema)
        if field.default is not dataclasses.MISSING
    }
    for group, name in chosen.items():
        found |= flatten({group: registry.defaults(group, name)})
    found |= flatten({"agents": to_plain(MixtureConfig())}) if mixture else {}
    for key, name in mixture.items():
        found |= flatten({"agents": {key: {"weight": 1.0} | registry.defaults("agent", name)}})
    return found


def _fields(cls: Any, group: str) -> dict[str, str]:
    texts = help_texts(cls)
    names = [field.name for field in dataclasses.fields(cls) if field.init and field.name != "name"]
    return {f"{group}.{name}": texts.get(name, "") for name in names}


def _require_fields(
    given: Mapping[str, Any], schema: Any, chosen: Mapping[str, str], mixture: Mapping[str, str]
) -> None:
    """Checks that overrides name fields of these choices.

    Raises:
      ConfigError: for the first that does not, with what may be meant.
    """
    known = fields_of(schema, chosen, mixture)
    for name, value in given.items():
        is_choice = name in (*schema.groups, "agents")
        if is_choice or any(name == field or name.startswith(f"{field}.") for field in known):
            continue
        group, _, last = name.rpartition(".")
        today = f"{group}.{RENAMED.get(last, '')}".lstrip(".")
        is_old, fix = today in known, f"{today}={value}"
        require(
            not is_old,
            name,
            f"must be called {today}, because it has a new name; got {shortened(value)}. Set "
            f"{fix}.",
        )
        is_name = last == "name" and group in schema.groups
        fix = f"{group}={value}"
        require(
            not is_name,
            name,
            f"must be left out, because a choice is more than a name; got {shortened(value)}. Set "
            f"{fix}.",
        )
        is_agents = name.startswith("agents.") and not mixture
        fix = "agents=[ddqn,ppo]"
        require(
            not is_agents,
            name,
            f"must come with agents, because it is one agent's; got {shortened(value)}. Set {fix}.",
        )
        others = [x for x in registry.GROUPS.get(group, _NO_GROUP).built_in if _has(group, x, last)]
        choice, fix = chosen.get(group), f"{group}={others[0]}" if others else ""
        why = f"{group}={choice} has no such field"
        require(
            not others,
            name,
            f"must be left out with {group}={choice}, because {why}; got {shortened(value)}. Set "
            f"{fix}.",
        )
        raise unknown_field(name, list(known))


_NO_GROUP = registry.Group("", "", (), {})


def _has(group: str, choice: str, field: str) -> bool:
    return field in {x.name for x in dataclasses.fields(registry.find(group, choice))}


# --- presets -------------------------------------------------------------------------------------


def preset_names() -> list[str]:
    """All presets that some file has."""
    return sorted({name for stem in _stems() for name in _sections(stem)})


def is_tuned(env: str, proxy: str) -> bool:
    """Whether a task has a preset file of its own for a proxy."""
    return f"{env}-{proxy}" in _stems()


def tuned(proxy: str, preset: str = "best") -> list[str]:
    """Tasks that have settings of their own for a proxy."""
    stems = [stem for stem in _stems() if stem.endswith(f"-{proxy}") and preset in _sections(stem)]
    return [stem.removesuffix(f"-{proxy}") for stem in stems if not stem.startswith(GENERAL)]


def preset_sections(env: str, proxy: str) -> dict[str, Any]:
    """The presets of a task and proxy, by their names."""
    if not is_tuned(env, proxy):
        env = GENERAL
    return _sections(f"{env}-{proxy}") if is_tuned(env, proxy) else {"best": {}}


def _preset_values(
    preset: Any, chosen: Mapping[str, str], mixture: Mapping[str, str]
) -> dict[str, Any]:
    """The settings of a preset for these choices."""
    if preset not in preset_names():
        raise unknown_name("preset", preset, preset_names())
    env, proxy = chosen["env"], chosen["proxy"]
    sections = preset_sections(env, proxy)
    require(
        preset in sections,
        "preset",
        f"must be one that env={shortened(env)} has with proxy={shortened(proxy)} "
        f"({listed(list(sections))}), because it holds a task's own numbers, as for "
        f"{listed(tuned(proxy, preset))}; got {shortened(preset)}. Set preset=best.",
    )
    section = sections[preset]
    values: dict[str, Any] = {k: v for k, v in section.items() if not k.startswith("with_")}
    for group in ("agent", "es", "objective"):
        values = _merged(values, section.get(f"with_{group}", {}).get(chosen.get(group), {}))
    with_agent = section.get("with_agent", {})
    each = {key: with_agent.get(name, {}).get("agent", {}) for key, name in mixture.items()}
    return {"preset": preset} | values | ({"agents": each} if each else {})


@functools.cache
def _stems() -> Collection[str]:
    return tuple(sorted(file.stem for file in PRESETS.glob(f"*{ENDING}")))


@functools.cache
def _sections(stem: str) -> dict[str, Any]:
    """A file's sections, each with what it builds on merged in."""
    merged: dict[str, Any] = {}
    for name, section in yaml.safe_load((PRESETS / f"{stem}{ENDING}").read_text()).items():
        section = dict(section)
        like = section.pop("like", None)  # stands before it in the file
        general = f"{GENERAL}-{stem.rpartition('-')[2]}"
        base = _sections(general)[name] if like == GENERAL else merged[like] if like else {}
        merged[name] = _merged(base, section)
    return merged
