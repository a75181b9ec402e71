"""A command's configuration: from the overrides that a user types to typed, validated dataclasses.

An override is `group=choice`, `group.field=value` or `field=value`. `sejax.runs.compose` merges
them with a preset into nested plain values; `sejax.options.registry` makes dataclasses of those,
each value read by its field's type; the dataclasses check themselves.
"""

import dataclasses
from collections.abc import Mapping, Sequence
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
    as_text,
    between,
    counts,
    one_of,
    option,
    registry,
    require,
    seed,
    shortened,
)
from sejax.options.plain import flatten, from_plain, to_plain
from sejax.runs.compose import DEFAULTS, compose, key_of, mixture_of, named, read
from sejax.training import TrainingConfig, require_reachable

AGENT_HPARAMS = ("default", "varied")
EVALUATION_HPARAMS = (*AGENT_HPARAMS, "as_learned")
TRAINING_FROM = ("proxy", "config")
TRAINING = TrainingConfig()  # on proxies
REAL_TRAINING = TrainingConfig(stop_rule="solved", max_steps=None, max_episodes=1000)
JOINT = "+"  # between the agents of a mixture, in names
Schema = TypeVar("Schema", bound="CommandConfig")


# --- the agents of a run -------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class MixtureMember(Options):
    """One of the agents of a configuration.

    Attributes:
      key: its name in tables and metrics.
      field: its name in overrides and messages.
      agent: its configuration.
      weight: its share of a generation's candidates; with 0 it only judges incumbents.
    """

    group: ClassVar[str] = "agent"

    key: str
    field: str
    agent: AgentConfig
    weight: float = option(1.0, between(0, 1e6, "it is a share of the candidates"))


@dataclass(frozen=True, kw_only=True)
class AgentsConfig(MixtureConfig):
    """A mixture of agents, sorted by their keys."""

    members: tuple[MixtureMember, ...]


_SHARED = tuple(field.name for field in dataclasses.fields(MixtureConfig))


def _agents_from_plain(values: object) -> AgentsConfig | None:
    """The mixture that plain values describe: `_SHARED` fields, and each agent's under its key."""
    if values is None:
        return None
    by_key = {str(k): x for k, x in values.items()} if isinstance(values, Mapping) else {}
    shared = {name: by_key.pop(name) for name in _SHARED if name in by_key}
    require(
        by_key,
        "agents",
        f"must be a list of agents; got {shortened(values)}. Set agents=[ddqn,ppo].",
    )
    members = tuple(_member(key, by_key[key]) for key in sorted(by_key))
    shared = to_plain(from_plain(MixtureConfig, shared, "agents"))
    return AgentsConfig(members=members, **shared)


def _member(key: str, values: object) -> MixtureMember:
    field = f"agents.{key}"
    require(
        key == key_of(key),
        field,
        f"must be a word, as columns are named by it; got {shortened(key)}. Set agents=[ddqn,ppo].",
    )
    with named(field):
        fields = dict(values) if isinstance(values, Mapping) else {}
        member = {"key": key, "field": field, "weight": fields.pop("weight", 1.0)}
        agent = registry.configure("agent", fields)
        return from_plain(MixtureMember, member | {"agent": agent}, "agent")


def members_of(config: "CommandConfig") -> tuple[MixtureMember, ...]:
    """The agents of a command's configuration: several, or the one."""
    if config.agents is not None:
        return config.agents.members
    key = registry.name_of("agent", config.agent)
    return (MixtureMember(key=key, field="agent", agent=config.agent),)


# --- configurations ------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class CommandConfig(Options):
    """What runs and evaluations share.

    Attributes:
      groups: the groups of plugins whose choices are fields.
      learns: whether proxies are learned: presets have settings, a mixture's agents have shares.
    """

    groups: ClassVar[tuple[str, ...]] = ()
    learns: ClassVar[bool] = False

    agent: Any = option(None, help="trains on the proxies; null with `agents`")
    agents: AgentsConfig | None = option(
        None, help="several agents in place of one: agents=[ddqn,ppo]"
    )
    exploration: ExplorationConfig = option(help="intrinsic reward of the agents")
    training: TrainingConfig = option(TRAINING, help="on proxies")
    seed: int = option(0, seed())
    num_parallel: int | None = option(
        None,
        counts("something must compute"),
        help=(
            "Agents that train side by side on one device; null: what suits the agent and the "
            "device."
        ),
    )
    devices: int | None = option(None, counts("something must compute"), help="null: all")

    @staticmethod
    def spec_for(given: Mapping[str, Any]) -> TaskSpec:
        """The task of overrides, whose default agent is taken."""
        fields = {name[4:]: value for name, value in given.items() if name.startswith("env.")}
        name = given.get("env", DEFAULTS["env"])
        return envs.spec_of(registry.configure("env", {**fields, "name": name}))


@dataclass(frozen=True, kw_only=True)
class LearnConfig(CommandConfig):
    """A whole bilevel optimisation: what `sejax.run` and `sejax.make_learner` take.

    Raises:
      ConfigError: for parts that cannot work together.
    """

    groups: ClassVar[tuple[str, ...]] = tuple(DEFAULTS)
    learns: ClassVar[bool] = True
    # Fields that the default run directory is named by.
    in_run_dir: ClassVar[tuple[str, ...]] = (
        *("env", "proxy", "agent", "agents", "exploration", "agent_hparams", "seed"),
    )

    preset: str = option("best", help="settings that were measured (best) or published (paper)")
    env: Any = option(help="the real task")
    proxy: Any = option(
        help="what is learned: a synthetic environment (se) or a reward network (rn)"
    )
    es: Any = option(help="the evolution strategy of the outer loop")
    objective: Any = option(help="what the outer loop maximises")
    tracker: Any = option(help="follows the run beside its files")
    machines: Any = option(help="where agents train")
    agent_hparams: str = option(
        "default",
        one_of(AGENT_HPARAMS),
        help=(
            "default: the agent's; varied: learning rate, batch and network drawn anew for each "
            "training."
        ),
    )
    generations: int = option(
        100,
        counts("there is nothing to do otherwise", most=1_000_000),
        help="n_o: steps of the outer loop.",
    )
    num_seeds: int = option(
        1, counts("it counts runs"), help="Independent runs, with seeds seed, seed + 1, ..."
    )
    stop_when_solved: bool = option(
        False, help="End a run at its first incumbent mean that reaches the solved threshold."
    )
    checkpoint_every: int = option(
        1, counts("it counts generations"), help="generations between checkpoints"
    )
    run_dir: str | None = option(
        None, help="null: runs/<env>-<proxy>-<agent>[_<exploration>][_varied]-s<seed>"
    )

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
        for member in members_of(self):
            with named(member.field):
                agents.require_fit(member.agent, self.exploration, spec, task_name)
                if self.proxy.reaches_step_limit:
                    limits = max_steps, spec.max_steps
                    require_learning("training", self.training, member.agent, *limits)

    def name(self, group: str) -> str:
        """The name by which a group's choice was made; several agents are `ddqn+ppo`."""
        if group == "agent":
            return JOINT.join(member.key for member in members_of(self))
        return registry.name_of(group, getattr(self, group))

    @property
    def scored_agents(self) -> tuple[str, ...]:
        """The agents that have scores of their own."""
        return tuple(member.key for member in members_of(self))

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
        varied, each = self.agent_hparams == "varied", members_of(self)
        made = tuple(agents.make_agent(x.agent, task, self.exploration, varied) for x in each)
        if self.agents is None:
            return made[0]
        names, weights = tuple(x.key for x in each), tuple(x.weight for x in each)
        shared = self.agents or MixtureConfig()
        return Mixture(agents=made, names=names, weights=weights, config=shared)

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
    """What `sejax.evaluate` takes."""

    groups: ClassVar[tuple[str, ...]] = ("agent", "exploration")

    proxy: str = option(
        help="a run directory, a safetensors file, a shipped name (cartpole), or real"
    )
    env: str | None = option(None, help="the task, where proxy=real or the proxy's is your own")
    proxy_kind: str | None = option(
        None, help="my_module:MyProxy, where the proxy is of a kind of your own"
    )
    agent_hparams: str = option(
        "default",
        one_of(EVALUATION_HPARAMS),
        help=(
            "as_learned: agents and exploration that the proxy was learned with, where no agent "
            "is named; default: the agent's; varied: drawn around them for each agent."
        ),
    )
    training_from: str = option(
        "proxy",
        one_of(TRAINING_FROM),
        help=(
            "How long agents train on the proxy. proxy: on an SE as it was learned with, on a "
            "reward network as on the real task (as_learned: with the time limit as in its run); "
            "config: as `training` says."
        ),
    )
    num_agents: int = option(10, counts("there is nothing to average otherwise"))
    baseline: bool = option(True, help="as many agents trained on the real task, beside them")
    out_dir: str | None = option(
        None, help="null: beside the proxy (runs/evaluate-<name> without a folder)"
    )
    real_training: TrainingConfig = option(
        REAL_TRAINING,
        help="On the real task, and how all agents are tested unless training_from=config.",
    )

    @staticmethod
    def spec_for(given: Mapping[str, Any]) -> TaskSpec:
        """The task of a stored proxy, or of overrides; nothing that a file names is imported."""
        from sejax.proxies import header  # which reads files, and hubs

        source = str(given.get("proxy", ""))
        if source in ("", "real"):
            return CommandConfig.spec_for(given)
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


def learn_config(values: Mapping[str, Any]) -> LearnConfig:
    """The configuration of a run from plain values, as `config.yaml` and proxy files hold them.

    Raises:
      ConfigError: for an unknown, missing or bad field, or parts that cannot work together.
    """
    # A stored proxy does not say who followed its run, or where it was computed.
    unsaid = {"tracker": {"name": "none"}, "machines": {"name": "local"}}
    return _from_plain(LearnConfig, unsaid | dict(values))


def plain(config: CommandConfig) -> dict[str, Any]:
    """A command's configuration as plain values; inverse of `learn_config`."""
    values = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    for group in config.groups:
        if values[group] is not None:
            values[group] = registry.describe(group, values[group])
    if config.agents is not None:
        values["agents"] = {name: getattr(config.agents, name) for name in _SHARED} | {
            each.key: {"name": "", "weight": each.weight} | registry.describe("agent", each.agent)
            for each in config.agents.members
        }
    return to_plain(values)  # type: ignore[no-any-return]


def completed(stored: Mapping[str, Any], config: LearnConfig) -> dict[str, Any]:
    """A stored run's values with the defaults of fields that an older version did not write.

    New fields have a default that changes no number. Of `module:attribute` only what `config` has
    is imported.
    """
    own = map(as_text, flatten(plain(config)).values())
    try:
        with registry.only_typed(own):
            return plain(learn_config(stored))
    except ConfigError:
        return dict(stored)


def _from_plain(schema: type[Schema], values: Mapping[str, Any]) -> Schema:
    typed = dict(values)
    typed["agents"] = mixture = _agents_from_plain(values.get("agents"))
    agent = values.get("agent")
    require(
        mixture is None or agent is None,
        "agent",
        f"must be left out with agents; got {shortened(agent)}. Set agents=[...] alone.",
    )
    for group in schema.groups:
        if group == "agent" and mixture is not None:
            continue
        is_chosen = typed.get(group) is not None
        require(is_chosen, group, f"must be chosen; got none. Set {group}=NAME.")
        typed[group] = registry.configure(group, typed[group])
    return from_plain(schema, typed, "")


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
        return learn_config(compose(LearnConfig, overrides).values)


def evaluate_config(overrides: Sequence[str] = ()) -> EvaluateConfig:
    """As `config`, for the overrides after `python -m sejax.evaluate`."""
    _require_overrides(overrides)
    with registry.only_typed(overrides):
        composed = compose(EvaluateConfig, with_learned(overrides))
        require(
            "proxy" in composed.values,
            "proxy",
            "must be given; got none. Set proxy=RUN_DIR, proxy=FILE, proxy=cartpole (shipped), or "
            "proxy=real env=cartpole.",
        )
        return _from_plain(EvaluateConfig, composed.values)


def with_learned(overrides: Sequence[str]) -> list[str]:
    """Overrides that say which agents a stored proxy was learned with, then those of an evaluation.

    Where these name no agent, they are all of the proxy's, with their exploration. An agent that
    they name has the hyperparameters that the proxy was learned with, if it was with such a one.

    Raises:
      ConfigError: with `agent_hparams=as_learned`, for agents beside it, or a file that does not
        tell its agents.
    """
    from sejax.proxies import header  # which reads files, and hubs

    given = read(overrides)
    source, hparams = str(given.get("proxy", "real")), given.get("agent_hparams")
    if source == "real" or hparams not in (None, "as_learned"):
        return [*overrides]
    groups = ("agents", *EvaluateConfig.groups)
    own = {name: x for name, x in given.items() if name.partition(".")[0] in groups}
    require(
        not own or hparams is None,
        next(iter(own), "").partition(".")[0],
        "must be left out with agent_hparams=as_learned; got "
        f"{shortened(', '.join(f'{k}={x}' for k, x in own.items()))}. Set agent_hparams=default.",
    )
    try:
        path = header.find(source, "proxy")
        stored = header.read_config(path, "proxy")
        learned = {
            key: registry.describe("agent", header.configured("agent", values, path.name))
            for key, values in header.agents_of(stored).items()
        }
        explored = header.configured(
            "exploration", stored.get("exploration", {"name": "none"}), path.name
        )
    except ConfigError:  # of the proxy, which is said when it is loaded
        if hparams == "as_learned":
            raise
        return [*overrides]
    if own:
        by_name = {values["name"]: values for values in learned.values()}
        named = {f"agents.{key}": name for key, name in mixture_of(given).items()}
        if not named:
            default = agents.default_for(EvaluateConfig.spec_for(given))
            named = {"agent": given.get("agent", default)}
        fields = flatten({field: by_name.get(name, {}) for field, name in named.items()})
        fields.pop("agent.name", None)
    else:
        parts = {"exploration": registry.describe("exploration", explored)}
        parts |= {"agent": next(iter(learned.values()))} if len(learned) == 1 else {}
        fields = {group: values.pop("name") for group, values in parts.items()}
        fields |= flatten(parts) | {"agent_hparams": "as_learned"}
        if len(learned) > 1:
            fields |= {"agents": list(learned)} | flatten({"agents": learned})
    words = [f"{name}={as_text(x)}" for name, x in fields.items() if name not in given]
    return [*words, *overrides]


def _require_overrides(overrides: object) -> None:
    require(
        isinstance(overrides, list | tuple) and all(isinstance(x, str) for x in overrides),
        "overrides",
        f"must be a list of text; got {shortened(repr(overrides))}. Set "
        'overrides=["env=cartpole"].',
    )
