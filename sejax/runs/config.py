"""A command's configuration: from the words that a user types to typed, validated dataclasses.

A word is `group=choice`, `group.field=value` or `field=value`. `sejax.runs.compose` lays them on a
preset, which gives nested plain values; `sejax.options.registry` makes dataclasses of those, each
value read by its field's type; the dataclasses check themselves.
"""

import dataclasses
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from sejax import agents, envs
from sejax.agents.base import Agent, AgentConfig, ExplorationConfig
from sejax.agents.mixture import Mixture, MixtureConfig
from sejax.envs.spec import TaskSpec
from sejax.ops.files import as_file_name
from sejax.options import (
    ConfigError,
    Options,
    counts,
    one_of,
    option,
    registry,
    require,
    seed,
    shortened,
)
from sejax.options.plain import fields_of, flatten, from_plain, to_plain, unknown_field
from sejax.proxies import header
from sejax.runs.compose import (
    DEFAULTS,
    Share,
    agents_of,
    compose,
    errors_of,
    field_of,
    key_of,
    list_fields,
    read,
)
from sejax.training import TrainingConfig, require_reachable

AGENT_HPARAMS = ("default", "varied")
EVALUATION_HPARAMS = (*AGENT_HPARAMS, "as_learned")
TRAINING_FROM = ("proxy", "config")
TRAINING = TrainingConfig()  # on proxies
REAL_TRAINING = TrainingConfig(stop_rule="solved", max_steps=None, max_episodes=1000)
JOINT = "+"  # between several agents, in names
FIX = "Set agents=[ddqn,ppo]."
Schema = TypeVar("Schema", bound="CommandConfig")


# --- configurations ------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class CommandConfig(Options):
    """What runs and evaluations share.

    Attributes:
      groups: the groups of plugins whose choices are fields.
      learns: whether proxies are learned: presets have settings, several agents have shares.
      agents: by their keys, in the order of these; see `sejax.runs.compose.agents_of`.
      exploration: intrinsic reward of the agents
      training: on proxies
      num_parallel: Agents that train side by side on one device; null: what suits the agent and the
        device.
      devices: null: all
    """

    groups: ClassVar[tuple[str, ...]] = ()
    learns: ClassVar[bool] = False

    agents: dict[str, AgentConfig]
    exploration: ExplorationConfig
    training: TrainingConfig = TRAINING
    seed: int = option(0, seed())
    num_parallel: int | None = option(None, counts("something must compute"))
    devices: int | None = option(None, counts("something must compute"))

    @property
    def agent(self) -> Any:
        """The agent's configuration, where it is one alone."""
        (agent,) = self.agents.values()
        return agent

    def field_of(self, key: str) -> str:
        """The name of an agent's fields in words and messages."""
        return field_of(key, self.agents)

    def sections(self) -> Iterator[tuple[str, str, Any]]:
        """Each dataclass that has fields: their prefixes in words and in files, and itself."""
        yield "", "", self
        for key, agent in self.agents.items():
            yield self.field_of(key), f"agents.{key}", agent
        for name, value in vars(self).items():
            if dataclasses.is_dataclass(value) and name != "mixture":
                yield name, name, value

    @staticmethod
    def spec_for(given: Mapping[str, Any], imports: Collection[str] | None = None) -> TaskSpec:
        """The task of words, whose default agent is taken."""
        fields = {name[4:]: value for name, value in given.items() if name.startswith("env.")}
        name = given.get("env", DEFAULTS["env"])
        return envs.spec_of(registry.configure("env", {**fields, "name": name}, imports))


@dataclass(frozen=True, kw_only=True)
class LearnConfig(CommandConfig):
    """A whole bilevel optimisation: what `sejax.run` and `sejax.make_learner` take.

    Attributes:
      weights: of the agents; equal if not given
      preset: settings that were measured (best) or published (paper)
      env: the real task
      proxy: what is learned: a synthetic environment (se) or a reward network (rn)
      es: the evolution strategy of the outer loop
      objective: what the outer loop maximises
      tracker: follows the run beside its files
      machines: where agents train
      agent_hparams: default: the agent's; varied: learning rate, batch and network drawn anew for
        each training.
      generations: n_o: steps of the outer loop.
      num_seeds: Independent runs, with seeds seed, seed + 1, ...
      stop_when_solved: End a run at its first incumbent mean that reaches the solved threshold.
      checkpoint_every: generations between checkpoints
      run_dir: null: runs/<env>-<proxy>-<agent>[_<exploration>][_varied]-s<seed>

    Raises:
      ConfigError: for parts that cannot work together.
    """

    groups: ClassVar[tuple[str, ...]] = tuple(DEFAULTS)
    learns: ClassVar[bool] = True
    # Fields that the default run directory is named by.
    in_run_dir: ClassVar[tuple[str, ...]] = (
        *("env", "proxy", "agent", "agents", "exploration", "agent_hparams", "seed"),
    )

    weights: tuple[float, ...] = option(())
    mixture: MixtureConfig = option(MixtureConfig())
    preset: str = "best"
    env: Any
    proxy: Any
    es: Any
    objective: Any
    tracker: Any
    machines: Any
    agent_hparams: str = option("default", one_of(AGENT_HPARAMS))
    generations: int = option(100, counts("there is nothing to do otherwise", most=1_000_000))
    num_seeds: int = option(1, counts("it counts runs"))
    stop_when_solved: bool = False
    checkpoint_every: int = option(1, counts("it counts generations"))
    run_dir: str | None = None

    def sections(self) -> Iterator[tuple[str, str, Any]]:
        yield from super().sections()
        if len(self.agents) > 1:
            yield "agents", "agents", self.mixture
            for key, weight in zip(self.agents, self.weights, strict=True):
                yield self.field_of(key), f"agents.{key}", Share(weight=weight)

    def __post_init__(self) -> None:
        super().__post_init__()
        seed()("seed + num_seeds - 1", self.seed + self.num_seeds - 1, 0)
        registry.require_package("tracker", self.tracker)
        registry.require_package("machines", self.machines)
        require(
            self.devices is None or not getattr(self.machines, "is_elsewhere", False),
            "devices",
            f"must be left out with trainings on other machines; got {self.devices}. Set "
            "machines.workers=N in its place, or machines=local.",
        )
        require_real_returns("training", self.training)
        require(
            not self.stop_when_solved or getattr(self.objective, "scores_are_returns", True),
            "stop_when_solved",
            "must be false with an objective whose scores are not returns; got true with "
            f"objective={self.name('objective')}. Set stop_when_solved=false.",
        )
        spec, task_name = envs.spec_of(self.env), self.name("env")
        self.proxy.require_task(spec, task_name)
        max_steps = self.proxy.max_steps(spec.max_steps)
        if not self.proxy.has_real_dynamics:
            require_reachable("training", self.training, max_steps)
        for key, agent in self.agents.items():
            with errors_of("agent", self.field_of(key)):
                agents.require_fit(agent, self.exploration, spec, task_name)
                if self.proxy.reaches_step_limit:
                    limits = max_steps, spec.max_steps
                    require_learning("training", self.training, agent, *limits)

    def name(self, group: str) -> str:
        """The name by which a group's choice was made; several agents are `ddqn+ppo`."""
        if group == "agent":
            return JOINT.join(self.agents)
        return registry.name_of(group, getattr(self, group))

    @property
    def scored_agents(self) -> tuple[str, ...]:
        """The agents that have scores of their own."""
        return tuple(self.agents)

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

    def _learners(self, task: envs.Task) -> Agent | Mixture:
        """The agent, or the mixture of agents, that trains on the proxies."""
        is_varied = self.agent_hparams == "varied"
        learners = tuple(
            agents.make_agent(agent, task, self.exploration, is_varied)
            for agent in self.agents.values()
        )
        if len(learners) == 1:
            return learners[0]
        names = tuple(self.agents)
        return Mixture(agents=learners, names=names, weights=self.weights, config=self.mixture)

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
class EvaluateConfig(CommandConfig):
    """What `sejax.evaluate` takes.

    Attributes:
      proxy: a run directory, a safetensors file, a shipped name (cartpole), or real
      env: the task, where proxy=real or the proxy's is your own
      proxy_kind: my_module:MyProxy, where the proxy is of a kind of your own
      agent_hparams: as_learned: agents and exploration that the proxy was learned with, where no
        agent is named; default: the agent's; varied: drawn around them for each agent.
      training_from: How long agents train on the proxy. proxy: on an SE as it was learned with, on
        a reward network as on the real task (as_learned: with the time limit as in its run);
        config: as `training` says.
      baseline: as many agents trained on the real task, beside them
      out_dir: null: beside the proxy (runs/evaluate-<name> without a folder)
      real_training: On the real task, and how all agents are tested unless training_from=config.
    """

    groups: ClassVar[tuple[str, ...]] = ("exploration",)

    proxy: str
    env: str | None = option(None, names_code=True)
    proxy_kind: str | None = option(None, names_code=True)
    agent_hparams: str = option("default", one_of(EVALUATION_HPARAMS))
    training_from: str = option("proxy", one_of(TRAINING_FROM))
    num_agents: int = option(10, counts("there is nothing to average otherwise"))
    baseline: bool = True
    out_dir: str | None = None
    real_training: TrainingConfig = REAL_TRAINING

    @staticmethod
    def spec_for(given: Mapping[str, Any], imports: Collection[str] | None = None) -> TaskSpec:
        """The task of a stored proxy, or of words; nothing that a file names is imported."""
        source = str(given.get("proxy", "real"))
        if source == "real":
            return CommandConfig.spec_for(given, imports)
        return header.read(source, "proxy").header.spec

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, idle, default in (
            ("agent_hparams", "as_learned", "default"),
            ("training_from", "config", "proxy"),
        ):
            require(
                self.proxy != "real" or getattr(self, name) != idle,
                name,
                f"must be {default} with proxy=real; got {idle}. Set {name}={default}.",
            )
        own, default = to_plain(self.training).items(), to_plain(TRAINING)
        changed = ", ".join(f"{k}={v}" for k, v in own if v != default[k])
        instead = "" if self.proxy == "real" else "training_from=config, or "
        require(
            self.training_from == "config" or not changed,
            "training",
            "must be left as it is: agents train on an SE as it was learned with, else as "
            f"real_training says; got {shortened(changed)}. Set {instead}real_training.*.",
        )


def learn_config(values: Mapping[str, Any], imports: Collection[str] | None = ()) -> LearnConfig:
    """The configuration of a run from plain values, as `config.yaml` and proxy files hold them.

    Args:
      values: nested plain values. One agent may stand as `agent`.
      imports: each `module:attribute` that may be imported; None: any.

    Raises:
      ConfigError: for an unknown, missing or bad field, or parts that cannot work together.
    """
    # A stored proxy does not say who followed its run, or where it was computed.
    unsaid = {"tracker": {"name": "none"}, "machines": {"name": "local"}}
    return _from_plain(LearnConfig, unsaid | dict(values), imports)


def plain(config: CommandConfig) -> dict[str, Any]:
    """A command's configuration as plain values; inverse of `learn_config`."""
    values = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    for group in config.groups:
        values[group] = registry.describe(group, values[group])
    of_agents = {key: registry.describe("agent", x) for key, x in config.agents.items()}
    mixture, weights = values.pop("mixture", None), values.pop("weights", ())
    if len(of_agents) > 1 and mixture is not None:
        for one, weight in zip(of_agents.values(), weights, strict=True):
            one["weight"] = weight
        of_agents |= to_plain(mixture)
    return to_plain(values | {"agents": of_agents})  # type: ignore[no-any-return]


def words_of(config: CommandConfig) -> dict[str, Any]:
    """The value of each field, by its name in words; that of a choice is its name."""
    values = plain(config)
    if len(config.agents) == 1:
        values["agent"] = values.pop("agents").popitem()[1]
    values = flatten(values)
    return values | {k.removesuffix(".name"): x for k, x in values.items() if k.endswith(".name")}


def completed(stored: Mapping[str, Any], config: LearnConfig) -> dict[str, Any]:
    """A stored run's values with the defaults of fields that an older version did not write.

    New fields have a default that changes no number. Of `module:attribute` only what `config` has
    is imported.
    """
    try:
        return plain(learn_config(stored, {*map(str, flatten(plain(config)).values())}))
    except ConfigError:
        return dict(stored)


def _from_plain(
    schema: type[Schema], values: Mapping[str, Any], imports: Collection[str] | None
) -> Schema:
    objects = dict(values)
    one, several = objects.pop("agent", None), objects.pop("agents", None) or {}
    if one is not None:  # as an older file has it
        several = {key_of(str(dict(one).get("name"))): one, **several}
    is_map = isinstance(several, Mapping) and bool(several)
    require(is_map, "agents", f"must be agents by their keys; got {shortened(several)}. {FIX}")
    of_mixture = fields_of(MixtureConfig) if schema.learns else ()
    shared = {name: several[name] for name in of_mixture if name in several}
    of_agents = {str(key): x for key, x in several.items() if key not in shared}
    objects["agents"], weights = {}, []
    for key, fields in sorted(of_agents.items()):
        require(key == key_of(key), "agents", f"must be words; got {shortened(key)}. {FIX}")
        where, fields = field_of(key, of_agents), fields if isinstance(fields, Mapping) else {}
        share = {k: x for k, x in fields.items() if k == "weight" and schema.learns}
        weights.append(from_plain(Share, share, where).weight)
        with errors_of("agent", where):
            own = {k: x for k, x in fields.items() if k not in share}
            objects["agents"][key] = registry.configure("agent", own, imports)
    if schema.learns:
        mixture = from_plain(MixtureConfig, shared, "agents")
        objects |= {"weights": weights, "mixture": mixture}
        is_idle = mixture == MixtureConfig() and {*weights} == {1.0}
        field = f"agents.{next(iter(shared), 'KEY.weight')}"
        require(len(weights) > 1 or is_idle, field, f"must come with several agents. {FIX}")
    for group in schema.groups:
        objects[group] = registry.configure(group, objects.get(group, {}), imports)
    fields = fields_of(schema)
    for name in objects.keys() - fields.keys():
        parts = {k: x for k, x in objects.items() if k in fields and k != "agents"}
        parts |= {field_of(key, of_agents): x for key, x in objects["agents"].items()}
        raise unknown_field(str(name), [*fields, *flatten(to_plain(parts))])
    return from_plain(schema, objects, "", imports)


def require_real_returns(name: str, training: TrainingConfig) -> None:
    """Checks that the rule by which agents stop on a proxy does not read the proxy's returns.

    Raises:
      ConfigError: if it does.
    """
    require(
        training.stop_rule != "solved" or training.solved_by == "test",
        f"{name}.solved_by",
        "must be test with stop_rule=solved, as returns on a proxy say nothing of the threshold; "
        f"got {training.solved_by}. Set {name}.solved_by=test.",
    )


def require_learning(
    name: str,
    training: TrainingConfig,
    agent: AgentConfig,
    max_episode_steps: int,
    task_max_steps: int,
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
        f"must exceed {before}, before which {shortened(registry.name_of('agent', agent))} learns "
        f"nothing; got {training.max_steps}. Set {name}.max_steps={4 * before}.",
    )


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
    composed = compose(LearnConfig, overrides)
    return _from_plain(LearnConfig, composed.values, composed.imports)


def evaluate_config(overrides: Sequence[str] = ()) -> EvaluateConfig:
    """As `config`, for the words after `python -m sejax.evaluate`."""
    composed = compose(EvaluateConfig, overrides, _learned(read(overrides)))
    require(
        "proxy" in composed.values,
        "proxy",
        "must be given; got none. Set proxy=RUN_DIR, proxy=FILE, proxy=cartpole (shipped), or "
        "proxy=real env=cartpole.",
    )
    return _from_plain(EvaluateConfig, composed.values, composed.imports)


def help_text(schema: type[CommandConfig], overrides: Sequence[str]) -> str:
    """What `--help` says of a command's fields beside these words."""
    stored = {} if schema.learns else _learned(read(overrides))
    composed = compose(schema, overrides, stored)
    values = {"proxy": "RUN_DIR", **composed.values}  # if an evaluation has none yet
    config = _from_plain(schema, values, composed.imports)
    return list_fields(config, composed.layers)


def _learned(given: Mapping[str, Any]) -> dict[str, Any]:
    """What a proxy was learned with, as far as the agents of an evaluation have it.

    Where its words name no agent, they are all of the proxy's, with their exploration. An agent
    that they name has the hyperparameters that the proxy was learned with, if it was with such a
    one.

    Raises:
      ConfigError: with `agent_hparams=as_learned`, for agents beside it, or a file that does not
        tell its agents.
    """
    source, hparams = str(given.get("proxy", "real")), given.get("agent_hparams")
    if source == "real" or hparams not in (None, "as_learned"):
        return {}
    groups = ("agent", "agents", *EvaluateConfig.groups)
    own = {name: x for name, x in given.items() if name.partition(".")[0] in groups}
    require(
        not own or hparams is None,
        next(iter(own), "").partition(".")[0],
        "must be left out with agent_hparams=as_learned; got "
        f"{shortened(', '.join(f'{k}={x}' for k, x in own.items()))}. Set agent_hparams=default.",
    )
    none = {"name": "none"}
    try:
        path = header.find(source, "proxy")
        stored = header.read_config(path, "proxy")
        learned = {
            key_of(key): registry.describe("agent", header.configured("agent", x, path.name))
            for key, x in header.agents_of(stored).items()
        }
        explored = header.configured("exploration", stored.get("exploration", none), path.name)
    except ConfigError:  # of the proxy, which is said when it is loaded
        if hparams == "as_learned":
            raise
        return {}
    if not own:
        explored = registry.describe("exploration", explored)
        return {"agents": learned, "exploration": explored, "agent_hparams": "as_learned"}
    by_name = {values["name"]: values for values in learned.values()}
    default = agents.default_for(EvaluateConfig.spec_for(given))
    keys = agents_of(given) or {default: default}
    return {"agents": {key: by_name.get(name, {"name": name}) for key, name in keys.items()}}
