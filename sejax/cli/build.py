"""A command's configuration: typed, validated, and able to make the objects that it describes."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sejax import agents, envs, registry, serialize
from sejax.agents.mixture import Families
from sejax.cli import families
from sejax.cli.families import AgentsConfig, families_of
from sejax.errors import one_of, require, require_seed, shortened, whole
from sejax.ops.files import as_file_name
from sejax.training import TrainingConfig, require_reachable

AGENT_HPARAMS = ("default", "varied")
EVALUATION_HPARAMS = (*AGENT_HPARAMS, "as_learned")
TRAINING_FROM = ("proxy", "config")
LEARN_GROUPS = ("env", "proxy", "agent", "exploration", "es", "objective", "tracker", "machines")
EVALUATE_GROUPS = ("agent", "exploration")
TRAININGS = ("training", "real_training")

# Fields that the default run directory is named by.
IN_RUN_DIR = ("env", "proxy", "agent", "agents", "exploration", "agent_hparams", "seed")


@dataclass(frozen=True, kw_only=True)
class LearnConfig:
    """A whole bilevel optimisation: what `sejax.run` and `sejax.make_learner` take.

    It has no defaults: those are the command's (`sejax.config()`), so that there is one set.

    Raises:
      ConfigError: for parts that cannot work together.
    """

    preset: str
    env: Any
    proxy: Any
    agent: Any  # None where there are several
    agents: AgentsConfig | None  # None where there is one
    exploration: Any
    es: Any
    objective: Any
    tracker: Any  # who is told of the run beside its files
    machines: Any  # where trainings are computed
    training: TrainingConfig
    agent_hparams: str  # default: the agent's; varied: drawn anew for each training
    generations: int  # n_o
    seed: int
    num_seeds: int  # independent runs in one program, with seeds seed, seed + 1, ...
    stop_when_solved: bool  # a run ends at its first incumbent mean above the threshold
    num_parallel: int | None  # agents in lockstep on one device; null: what suits agent and device
    devices: int | None  # devices to spread the population over; null: all
    checkpoint_every: int  # generations
    run_dir: str | None  # null: runs/<env>-<proxy>-<agent>[_<exploration>][_varied]-s<seed>

    def __post_init__(self) -> None:
        one_of("agent_hparams", self.agent_hparams, AGENT_HPARAMS)
        whole(1, "generations", self.generations, "there is nothing to do otherwise", 50)
        require_seed("seed", self.seed)
        whole(1, "num_seeds", self.num_seeds, "it counts runs", 1)
        require_seed("seed + num_seeds - 1", self.seed + self.num_seeds - 1)
        whole(1, "checkpoint_every", self.checkpoint_every, "it counts generations", 1)
        _require_computing(self)
        registry.require_package("tracker", self.tracker, "the run is told to it")
        registry.require_package("machines", self.machines, "trainings are sent there")
        elsewhere = getattr(self.machines, "is_elsewhere", False)
        require(
            not elsewhere or self.devices is None,
            "devices",
            "be left out with trainings on other machines",
            "each worker has one",
            self.devices,
            "machines.workers=N in its place, or machines=local",
        )
        require_real_returns("training", self.training)
        returns = getattr(self.objective, "scores_are_returns", None)
        require(
            not self.stop_when_solved or returns is not False,
            "stop_when_solved",
            "be false with this objective",
            "its scores are not returns, so that none says solved",
            f"true with objective={self.name('objective')}",
            "stop_when_solved=false",
        )
        facts, task_name = envs.facts_of(self.env), self.name("env")
        self.proxy.require_task(facts, task_name)
        train = not all(x.agent.is_solved_for for x in families_of(self))
        if train and not self.proxy.has_real_dynamics:
            require_reachable("training", self.training, self.proxy.max_steps(facts.max_steps))
        for family in families_of(self):
            with families.named(family.field):
                agents.require_fit(family.agent, self.exploration, facts, task_name)
                if self.proxy.reaches_step_limit:
                    require_learning(
                        "training",
                        self.training,
                        family.agent,
                        self.proxy.max_steps(facts.max_steps),
                        facts.max_steps,
                    )

    def name(self, group: str) -> str:
        """The name by which a group's choice was made; several agents are `ddqn+ppo`."""
        if group == "agent":
            return families.JOINT.join(family.key for family in families_of(self))
        return registry.name_of(group, getattr(self, group))

    def plain(self) -> dict[str, Any]:
        """Nested plain values, as in `config.yaml`; what `sejax.save` keeps with a proxy."""
        return to_plain(self)

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
        """The agent, or the families of agents, that learn on the proxies."""
        varied, each = self.agent_hparams == "varied", families_of(self)
        made = tuple(agents.make_agent(x.agent, task, self.exploration, varied) for x in each)
        if self.agents is None:
            return made[0]
        return Families(
            agents=made,
            names=tuple(x.key for x in each),
            weights=tuple(x.weight for x in each),
            config=self.agents,
        )

    @property
    def resolved_run_dir(self) -> Path:
        """The run directory: by default named by `IN_RUN_DIR`."""
        explored = self.name("exploration")
        explored = "" if explored == "none" else f"_{explored}"
        varied = "_varied" if self.agent_hparams == "varied" else ""
        agent = f"{self.name('agent')}{explored}{varied}"
        name = f"{self.name('env')}-{self.name('proxy')}-{agent}-s{self.seed}"
        return Path(self.run_dir or Path("runs", as_file_name(name)))


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """What `sejax.evaluate` takes. It has no defaults either: see `LearnConfig`."""

    proxy: str
    proxy_kind: str | None  # a kind of proxy of somebody's own, which its file's name never imports
    env: str | None
    agent: Any  # None where there are several
    agents: AgentsConfig | None  # None where there is one
    exploration: Any
    agent_hparams: str
    training_from: str  # how long agents train: as the proxy was learned, or `training`
    training: TrainingConfig
    real_training: TrainingConfig
    num_agents: int
    baseline: bool
    seed: int
    num_parallel: int | None
    devices: int | None
    out_dir: str | None

    def __post_init__(self) -> None:
        whole(1, "num_agents", self.num_agents, "there is nothing to average otherwise", 10)
        one_of("agent_hparams", self.agent_hparams, EVALUATION_HPARAMS)
        one_of("training_from", self.training_from, TRAINING_FROM)
        require_seed("seed", self.seed)
        _require_computing(self)
        for name, idle, usual in (
            ("agent_hparams", "as_learned", "default"),
            ("training_from", "config", "proxy"),
        ):
            require(
                self.proxy != "real" or getattr(self, name) != idle,
                name,
                f"be {usual} with proxy=real",
                "there is no proxy",
                idle,
                f"{name}={usual}",
            )
        self._require_use()

    def _require_use(self) -> None:
        """Refuses settings that would have no effect."""
        if self.agent_hparams == "as_learned":
            require(
                self.agents is None,
                "agents",
                "be left out with agent_hparams=as_learned",
                "the proxy says which it was learned with",
                families.JOINT.join(family.key for family in families_of(self)),
                "agent_hparams=default",
            )
            named = registry.name_of("agent", self.agent)
            for group, usual in (
                ("agent", named if named in agents.DEFAULTS else "ddqn"),
                ("exploration", "none"),
            ):
                changed = _differences(group, getattr(self, group), usual)
                require(
                    not changed,
                    group,
                    "be left out with agent_hparams=as_learned",
                    "the proxy says which it was learned with",
                    changed,
                    "agent_hparams=default",
                )
        instead = "" if self.proxy == "real" else "training_from=config, or "
        changed = _changes(serialize.to_plain(self.training), serialize.to_plain(TrainingConfig()))
        require(
            self.training_from == "config" or not changed,
            "training",
            "be left as it is",
            "agents train on an SE as it was learned with, and else as real_training says",
            changed,
            f"{instead}real_training.*",
        )


def learn_config(values: Mapping[str, Any]) -> LearnConfig:
    """The configuration of a run from plain values, as `config.yaml` and proxy files hold them.

    Raises:
      ConfigError: for an unknown, missing or bad field, or parts that cannot work together.
    """
    # A stored proxy does not say who followed its run, or where it was computed.
    unsaid = {"tracker": {"name": "none"}, "machines": {"name": "local"}}
    return _from_plain(LearnConfig, LEARN_GROUPS, unsaid | dict(values))


def evaluate_config(values: Mapping[str, Any]) -> EvaluateConfig:
    """As `learn_config`, for `sejax.evaluate`."""
    require(
        values.get("proxy") not in (None, "???"),
        "proxy",
        "be given",
        "agents are trained on it",
        "none",
        "proxy=RUN_DIR, proxy=FILE, proxy=cartpole (a shipped one) or proxy=real env=cartpole",
    )
    return _from_plain(EvaluateConfig, EVALUATE_GROUPS, values)


def to_plain(config: LearnConfig | EvaluateConfig) -> dict[str, Any]:
    """Inverse of `learn_config` and `evaluate_config`."""
    groups = LEARN_GROUPS if isinstance(config, LearnConfig) else EVALUATE_GROUPS
    return {
        field.name: families.to_plain(value)
        if field.name == "agents"
        else registry.describe(field.name, value)
        if field.name in groups and value is not None
        else serialize.to_plain(value)
        if field.name in TRAININGS
        else value
        for field in dataclasses.fields(config)
        for value in [getattr(config, field.name)]
    }


def completed(stored: Mapping[str, Any], config: LearnConfig) -> dict[str, Any]:
    """A stored run's values with the fields that a former version did not write; plain values.

    New fields have a default that changes no number. Those of a choice are taken from the choice of
    the same name in `config`: what only `stored` names is neither imported nor made.
    """
    whole = {"agent": None, "agents": None} | dict(stored)
    usual = {
        group: registry.defaults(group, config.name(group))
        for group in LEARN_GROUPS
        if getattr(config, group) is not None
    }
    usual["training"] = serialize.to_plain(TrainingConfig())
    if config.agents is not None:
        usual["agents"] = families.defaults(config.agents)
    return whole | {
        name: _filled(whole[name], fields) for name, fields in usual.items() if name in whole
    }


def _filled(there: Any, usual: Mapping[str, Any]) -> Any:
    """A group's fields with those that are missing, if it is of the same name."""
    if not isinstance(there, Mapping) or there.get("name") != usual.get("name"):
        return there
    nested = {
        name: _filled(value, usual[name])
        for name, value in there.items()
        if isinstance(usual.get(name), Mapping)
    }
    return {name: x for name, x in usual.items() if x != "???"} | dict(there) | nested


def _from_plain(schema: Any, groups: tuple[str, ...], values: Mapping[str, Any]) -> Any:
    typed: dict[str, Any] = dict(values)
    typed["agents"] = families.from_plain(values.get("agents"))
    if typed["agents"] is not None:
        require(
            values.get("agent") is None,
            "agent",
            "be left out with agents",
            "all of them are named there",
            shortened(values.get("agent")),
            "agents=[...] alone",
        )
        typed["agent"], groups = None, tuple(x for x in groups if x != "agent")
    for group in groups:
        require(
            group in values, group, "be chosen", "nothing works without", "none", f"{group}=NAME"
        )
        typed[group] = registry.configure(group, values[group])
    for name in TRAININGS:
        if name in values:
            require(
                isinstance(values[name], Mapping),
                name,
                "have fields",
                "they say how long agents train",
                shortened(values[name]),
                f"{name}.max_episodes=1000",
            )
            typed[name] = serialize.from_plain(TrainingConfig, values[name], name)
    return serialize.from_plain(schema, typed, "")


def require_real_returns(name: str, training: TrainingConfig) -> None:
    """Checks that the rule by which agents stop on a proxy does not read the proxy's returns.

    Raises:
      ConfigError: if it does.
    """
    require(
        training.stop_rule != "solved" or training.solved_by == "test",
        f"{name}.solved_by",
        "be test with stop_rule=solved",
        "returns on a proxy say nothing about the real task's threshold",
        training.solved_by,
        f"{name}.solved_by=test",
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
        f"exceed {before}",
        f"{registry.name_of('agent', agent)} learns nothing before",
        training.max_steps,
        f"{name}.max_steps={4 * before}",
    )


def _require_computing(config: Any) -> None:
    for name in ("num_parallel", "devices"):
        if getattr(config, name) is not None:
            whole(1, name, getattr(config, name), "something must compute", "null")


def _differences(group: str, config: Any, usual: str) -> str:
    """Fields of a group that are not as usual, for messages; its name if that differs."""
    given, expected = registry.describe(group, config), registry.defaults(group, usual)
    return str(given["name"]) if given["name"] != usual else _changes(given, expected)


def _changes(given: dict[str, Any], usual: dict[str, Any]) -> str:
    return ", ".join(f"{k}={v}" for k, v in given.items() if v != usual.get(k))
