"""Everything that can be configured, validated before jax is imported or anything compiled.

The dataclasses here and the YAML files in `conf/` have the same field names. `config` composes
them as the commands do: `sejax.config(["env=acrobot", "generations=50"])`.
"""

from collections.abc import Sequence
from dataclasses import MISSING, dataclass, field, fields, make_dataclass
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sejax import envs
from sejax.agents.configs import (
    ACTIVATIONS,
    AGENT_CONFIGS,
    EXPLORATION_CONFIGS,
    AgentConfig,
    DDQNConfig,
    ExplorationConfig,
    PPOConfig,
)
from sejax.errors import ConfigError, nearest, require, unknown_name
from sejax.validation import at_least, default, fraction, one_of, positive

CONF_DIR = Path(__file__).parent / "conf" / "run"
DONE_MODES = ("soft", "threshold")
RN_VARIANTS = (
    "additive_potential", "exclusive_potential", "additive_non_potential",
    "exclusive_non_potential", "additive_weighted_info", "exclusive_weighted_info",
)  # fmt: skip
STOP_RULES = ("plateau", "solved", "never")
SOLVED_BY = ("test", "train")
SCORE_TRANSFORMS = (
    "linear", "rank", "nes", "nes_unnormalized",
    "single_best", "single_better", "all_better_1", "all_better_2",
)  # fmt: skip
UPDATE_RULES = ("authors", "paper")
AGGREGATES = ("mean", "min")
AGENT_HPARAMS = ("default", "varied")
EVALUATION_HPARAMS = (*AGENT_HPARAMS, "nes")
TRAINING_FROM = ("proxy", "config")
OBJECTIVES = ("max_reward", "reward_threshold", "auc", "auc_sum")

# Name of the `es` choice -> evosax's class. Listed here because importing evosax takes seconds;
# a test holds the list against evosax's own registry. Left out are RandomSearch and the two SV
# algorithms, which have no single mean that could be the incumbent.
EVOSAX_ALGORITHMS = {
    "ars": "ARS",
    "asebo": "ASEBO",
    "cma_anchored_les": "CMAAnchoredLES",
    "cma_es": "CMA_ES",
    "cr_fm_nes": "CR_FM_NES",
    "des": "DES",
    "esmc": "ESMC",
    "evotf_es": "EvoTF_ES",
    "gradientless_descent": "GradientlessDescent",
    "guided_es": "GuidedES",
    "hill_climbing": "HillClimbing",
    "iamalgam_full": "iAMaLGaM_Full",
    "iamalgam_univariate": "iAMaLGaM_Univariate",
    "les": "LES",
    "lm_ma_es": "LM_MA_ES",
    "ma_es": "MA_ES",
    "noise_reuse_es": "NoiseReuseES",
    "open_es": "Open_ES",
    "persistent_es": "PersistentES",
    "pgpe": "PGPE",
    "rm_es": "Rm_ES",
    "sep_cma_es": "Sep_CMA_ES",
    "simple_es": "SimpleES",
    "simulated_annealing": "SimulatedAnnealing",
    "snes": "SNES",
    "xnes": "xNES",
}


@dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """Which real task; its limits are the paper's and live in `sejax.envs`."""

    name: str = "cartpole"
    backend: str | None = None  # physics of a brax task
    goal_reward: float | None = None  # of the move into the goal, in Cliff Walking; null: 0

    def __post_init__(self) -> None:
        one_of("env.name", self.name, envs.names())
        envs.check_choices(self.name, self.backend, self.goal_reward)

    def make(self) -> envs.Task:
        """The task; it is built once."""
        return envs.make(self.name, self.backend, self.goal_reward)


@dataclass(frozen=True, kw_only=True)
class ProxyConfig:
    """What all proxies share: the shape of their networks."""

    name: str
    hidden_size: int = 128
    num_layers: int = 1
    activation: str = "leaky_relu"

    def __post_init__(self) -> None:
        one_of("proxy.name", self.name, tuple(PROXY_CONFIGS))
        at_least(1, "proxy.hidden_size", self.hidden_size, "a layer needs a unit", 128)
        at_least(1, "proxy.num_layers", self.num_layers, "there is a hidden layer", 1)
        one_of("proxy.activation", self.activation, ACTIVATIONS)


@dataclass(frozen=True, kw_only=True)
class SyntheticConfig(ProxyConfig):
    """The SE's three networks, and how their done output is used."""

    name: str = "se"
    done: str = "soft"  # soft: bootstrap with 1 - d (authors); threshold: with 1 - [d > 0.5].

    def __post_init__(self) -> None:
        super().__post_init__()
        one_of("proxy.done", self.done, DONE_MODES)


@dataclass(frozen=True, kw_only=True)
class RewardConfig(ProxyConfig):
    """The RN's network, and how its output makes a reward."""

    name: str = "rn"
    activation: str = "prelu"
    variant: str = "additive_potential"
    augmented: bool = False  # the network sees the task's observation vector v as well
    zero_at_terminal: bool = False  # Phi is 0 where episodes end for the agent; see RewardEnv

    def __post_init__(self) -> None:
        super().__post_init__()
        one_of("proxy.variant", self.variant, RN_VARIANTS)
        for name in ("augmented", "zero_at_terminal"):
            require(not (self.weighs_info and getattr(self, name)), f"proxy.{name}",
                    "be false with weighted info", f"{self.variant} has no network",
                    "true", f"proxy.{name}=false")  # fmt: skip

    @property
    def weighs_info(self) -> bool:
        return self.variant.endswith("weighted_info")

    @property
    def is_additive(self) -> bool:
        return self.variant.startswith("additive")

    @property
    def is_potential_based(self) -> bool:
        return self.variant in ("additive_potential", "exclusive_potential")


PROXY_CONFIGS: dict[str, type[ProxyConfig]] = {"se": SyntheticConfig, "rn": RewardConfig}


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """How long an agent trains, and how it is tested."""

    max_episodes: int = 1000  # n_e
    min_steps: int = 0  # the stop rule waits for so many training steps.
    max_steps: int | None = None  # training ends after so many steps, whatever the rule says.
    stop_rule: str = "plateau"  # plateau (SEs), solved (real tasks), never
    window: int = 10  # d: episodes in each of the two means that the plateau rule compares.
    plateau_tolerance: float = 0.01  # C_diff: relative change between them that counts as flat.
    solved_by: str = "test"  # whose last d returns must reach the solved reward: test or train.
    test_episodes: int = 10  # n_te: episodes on the real task after training.
    time_limit_is_terminal: bool = True  # a real episode cut by the limit does not bootstrap.

    def __post_init__(self) -> None:
        for name in ("max_episodes", "window", "test_episodes"):
            at_least(1, f"training.{name}", getattr(self, name), "it counts episodes",
                      default(TrainingConfig, name))  # fmt: skip
        at_least(0, "training.min_steps", self.min_steps, "it counts steps", 0)
        if self.max_steps is not None:
            at_least(1, "training.max_steps", self.max_steps, "an agent must train", "null")
        at_least(0, "training.plateau_tolerance", self.plateau_tolerance,
                  "it bounds a relative change", 0.01)  # fmt: skip
        one_of("training.stop_rule", self.stop_rule, STOP_RULES)
        one_of("training.solved_by", self.solved_by, SOLVED_BY)


@dataclass(frozen=True, kw_only=True)
class NESConfig:
    """The paper's NES (Algorithm 1 and appendix "NES Score Transformation")."""

    name: str = "nes"
    population_size: int = 16  # n_p: members in a generation.
    num_incumbent_evals: int | None = None  # agents on the incumbent; null: one for each member
    noise_std: float = 0.05  # sigma: std of the weight perturbation.
    noise_std_decay: float = 1.0  # factor on sigma after each generation
    step_size: float = 1.0  # alpha
    step_size_decay: float = 1.0  # factor on alpha after each generation
    mirrored: bool = True  # each member tries +eps and -eps and keeps the better sign.
    score_transform: str = "all_better_2"
    update_rule: str = "authors"  # authors: psi += alpha sum F eps; paper: divided by n_p sigma.
    weight_decay: float = 0.0  # psi shrinks by this fraction before each update.
    num_evals: int = 1  # agents trained on each perturbed proxy
    eval_aggregate: str = "mean"  # what their scores make: mean or min
    common_random_numbers: bool = False  # the same inner seeds for all members of a generation

    def __post_init__(self) -> None:
        at_least(2, "es.population_size", self.population_size,
                  "scores are compared within a generation", 16)  # fmt: skip
        if self.num_incumbent_evals is not None:
            at_least(1, "es.num_incumbent_evals", self.num_incumbent_evals,
                      "the incumbent's score selects the proxy", "null")  # fmt: skip
        positive("es.noise_std", self.noise_std, "members must differ", 0.05)
        positive("es.step_size", self.step_size, "the proxy would not move", 1)
        for name in ("noise_std_decay", "step_size_decay"):
            value = getattr(self, name)
            require(0 < value <= 1, f"es.{name}", "lie in (0, 1]", "it shrinks each generation",
                    value, f"es.{name}=1")  # fmt: skip
        fraction("es.weight_decay", self.weight_decay, 0)
        at_least(1, "es.num_evals", self.num_evals, "a member needs a score", 1)
        one_of("es.score_transform", self.score_transform, SCORE_TRANSFORMS)
        one_of("es.update_rule", self.update_rule, UPDATE_RULES)
        one_of("es.eval_aggregate", self.eval_aggregate, AGGREGATES)


@dataclass(frozen=True, kw_only=True)
class EvosaxConfig:
    """One of evosax's distribution-based algorithms in NES's place."""

    name: str = "open_es"
    population_size: int = 32  # candidates in a generation
    num_incumbent_evals: int = 16  # agents trained on the distribution's mean
    noise_std: float = 0.05  # initial std of the search distribution
    noise_std_decay: float = 1.0  # factor for each generation, where the algorithm takes a schedule
    step_size: float = 0.05  # learning rate of Adam on the mean, where the algorithm takes one
    num_evals: int = 1
    eval_aggregate: str = "mean"
    common_random_numbers: bool = False

    def __post_init__(self) -> None:
        at_least(2, "es.population_size", self.population_size,
                  "scores are compared within a generation", 32)  # fmt: skip
        require(self.population_size % 2 == 0, "es.population_size", "be even",
                "evosax's algorithms pair opposite perturbations", self.population_size,
                f"es.population_size={self.population_size + 1}")  # fmt: skip
        at_least(1, "es.num_incumbent_evals", self.num_incumbent_evals,
                  "the incumbent's score selects the proxy", 16)  # fmt: skip
        positive("es.noise_std", self.noise_std, "candidates must differ", 0.05)
        positive("es.step_size", self.step_size, "the mean would not move", 0.05)
        require(0 < self.noise_std_decay <= 1, "es.noise_std_decay", "lie in (0, 1]",
                "it shrinks", self.noise_std_decay, "es.noise_std_decay=1")  # fmt: skip
        at_least(1, "es.num_evals", self.num_evals, "a candidate needs a score", 1)
        one_of("es.eval_aggregate", self.eval_aggregate, AGGREGATES)
        one_of("es.name", self.name, tuple(EVOSAX_ALGORITHMS))


@dataclass(frozen=True, kw_only=True)
class ObjectiveConfig:
    """What a training and its test on the real task are worth."""

    name: str = "max_reward"
    unsolved_weight: float = 100.0  # w_sol in the reward threshold objective

    def __post_init__(self) -> None:
        one_of("objective.name", self.name, OBJECTIVES)
        at_least(0, "objective.unsolved_weight", self.unsolved_weight,
                  "a shortfall must not be rewarded", 100)  # fmt: skip

    @property
    def needs_curve(self) -> bool:
        """Whether it looks at the tests between training episodes, however many there are."""
        return self.name.startswith("auc")


@dataclass(frozen=True, kw_only=True)
class LearnConfig:
    """A whole bilevel optimisation: what `sejax.run` and `sejax.make_learner` take."""

    preset: str = "best"
    env: EnvConfig = field(default_factory=EnvConfig)
    proxy: ProxyConfig = field(default_factory=SyntheticConfig)
    agent: AgentConfig = field(default_factory=DDQNConfig)
    exploration: ExplorationConfig = field(default_factory=ExplorationConfig)
    es: Any = field(default_factory=NESConfig)
    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    agent_hparams: str = "default"  # default: the agent's; varied: drawn anew for each training
    generations: int = 50  # n_o
    seed: int = 0
    num_seeds: int = 1  # independent runs in one program, with seeds seed, seed + 1, ...
    stop_when_solved: bool = False  # a run ends at its first incumbent mean above the threshold.
    lanes: int | None = None  # agents in lockstep on one device; null: what suits agent and device
    devices: int | None = None  # devices to spread the population over; null: all
    checkpoint_every: int = 1  # generations
    run_dir: str | None = None  # null: runs/<env>-<proxy>-<agent>-s<seed>

    def __post_init__(self) -> None:
        require_fit(self.agent, self.exploration, self.env.name)
        self._require_info()
        require_real_returns("training", self.training)
        self._require_tests_for_auc()
        if getattr(self.proxy, "done", None) == "soft":
            require_learning("training", self.training, self.agent, self.env.name)
        require(not self.stop_when_solved or self.objective.name == "max_reward",
                "stop_when_solved", "be false with this objective", "its scores are not returns, "
                "so that none says solved", f"true with objective={self.objective.name}",
                "stop_when_solved=false")  # fmt: skip
        one_of("agent_hparams", self.agent_hparams, AGENT_HPARAMS)
        at_least(1, "generations", self.generations, "there is nothing to do otherwise", 50)
        require_seed("seed", self.seed)
        at_least(1, "num_seeds", self.num_seeds, "it counts runs", 1)
        at_least(1, "checkpoint_every", self.checkpoint_every, "it counts generations", 1)
        for name in ("lanes", "devices"):
            if getattr(self, name) is not None:
                at_least(1, name, getattr(self, name), "something must compute", "null")

    def _require_info(self) -> None:
        proxy = self.proxy
        if isinstance(proxy, RewardConfig) and not envs.kind(self.env.name).has_info:
            because = f"a step of {self.env.name} tells nothing beyond its observation"
            require(not proxy.weighs_info, "proxy.variant", "be one with a potential", because,
                    proxy.variant, "proxy.variant=additive_potential")  # fmt: skip
            require(not proxy.augmented, "proxy.augmented", "be false", because, "true",
                    "proxy.augmented=false")  # fmt: skip

    def _require_tests_for_auc(self) -> None:
        rule = self.training.stop_rule
        require(not self.objective.needs_curve or rule == "solved", "objective",
                "be reward_threshold or max_reward where agents are not tested after each episode",
                "the area is that under the curve of those tests",
                f"{self.objective.name} with stop_rule {rule}",
                "training.stop_rule=solved")  # fmt: skip

    @property
    def resolved_run_dir(self) -> Path:
        explored = "" if self.exploration.name == "none" else f"_{self.exploration.name}"
        varied = "_varied" if self.agent_hparams == "varied" else ""
        agent = f"{self.agent.name}{explored}{varied}"
        return Path(self.run_dir or f"runs/{self.env.name}-{self.proxy.name}-{agent}-s{self.seed}")


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """What `sejax.evaluate` takes."""

    proxy: str = "???"  # OmegaConf's word for a value that must be given
    env: str | None = None
    agent: AgentConfig = field(default_factory=DDQNConfig)
    exploration: ExplorationConfig = field(default_factory=ExplorationConfig)
    agent_hparams: str = "default"
    training_from: str = "proxy"  # how long agents train: as the proxy was learned, or `training`
    training: TrainingConfig = field(default_factory=TrainingConfig)
    real_training: TrainingConfig = field(default_factory=TrainingConfig)
    num_agents: int = 10
    baseline: bool = True
    seed: int = 0
    lanes: int | None = None
    devices: int | None = None
    out_dir: str | None = None

    def __post_init__(self) -> None:
        at_least(1, "num_agents", self.num_agents, "there is nothing to average otherwise", 10)
        one_of("agent_hparams", self.agent_hparams, EVALUATION_HPARAMS)
        one_of("training_from", self.training_from, TRAINING_FROM)
        require_seed("seed", self.seed)
        self._require_use()
        for name in ("lanes", "devices"):
            if getattr(self, name) is not None:
                at_least(1, name, getattr(self, name), "something must compute", "null")

    def _require_use(self) -> None:
        """Refuses settings that would have no effect."""
        for name, idle in (("agent_hparams", "nes"), ("training_from", "config")):
            usual_value = default(EvaluateConfig, name)
            require(self.proxy != "real" or getattr(self, name) != idle, name,
                    f"be {usual_value} with proxy=real", "there is no proxy", idle,
                    f"{name}={usual_value}")  # fmt: skip
        if self.agent_hparams == "nes":
            for group, usual in (("agent", DDQNConfig()), ("exploration", ExplorationConfig())):
                given = getattr(self, group)
                require(given == usual, group, "be left out with agent_hparams=nes",
                        "the proxy says which it was learned with", _differences(given, usual),
                        "agent_hparams=default")  # fmt: skip
        usual_training = TrainingConfig()
        instead = "" if self.proxy == "real" else "training_from=config, or "
        require(self.training_from == "config" or self.training == usual_training, "training",
                "be left as it is", "agents train on an SE as it was learned with, and else as "
                "real_training says", _differences(self.training, usual_training),
                f"{instead}real_training.*")  # fmt: skip


def require_seed(name: str, seed: int) -> None:
    """Checks that a seed is one that `jax.random.key` takes as it is.

    Raises:
      ConfigError: if it is not.
    """
    require(0 <= seed < 2**31, name, "lie in [0, 2**31)", "it is a 32-bit number", seed,
            f"{name}=0")  # fmt: skip


def require_real_returns(name: str, training: TrainingConfig) -> None:
    """Checks that the rule by which agents stop on a proxy does not read the proxy's returns.

    Raises:
      ConfigError: if it does.
    """
    require(training.stop_rule != "solved" or training.solved_by == "test",
            f"{name}.solved_by", "be test with stop_rule=solved", "returns on a proxy say "
            "nothing about the real task's threshold", training.solved_by,
            f"{name}.solved_by=test")  # fmt: skip


def require_learning(
    name: str, training: TrainingConfig, agent: AgentConfig, env_name: str
) -> None:
    """Checks that a step budget lets an agent learn on an SE with soft ends.

    Most such SEs never end an episode, so that initial episodes take all steps that they may.

    Raises:
      ConfigError: if it does not.
    """
    before = agent.steps_before_learning(envs.kind(env_name).max_steps)
    waits = "update_episodes" if isinstance(agent, PPOConfig) else "init_episodes"
    require(training.max_steps is None or training.max_steps > before, f"{name}.max_steps",
            f"exceed {before}", f"{agent.name} learns nothing before with "
            f"agent.{waits}={getattr(agent, waits, None)}", training.max_steps,
            f"{name}.max_steps={4 * before}, or agent.{waits} lower")  # fmt: skip


def _differences(given: Any, usual: Any) -> str:
    """Fields of a group that are not as usual, for messages."""
    if type(given) is not type(usual):
        return str(given.name)
    return ", ".join(f"{name}={value}" for name, value in vars(given).items()
                     if value != getattr(usual, name))  # fmt: skip


def register_evosax_choices() -> None:
    """Makes `es=<name>` known to Hydra for each of evosax's algorithms."""
    for name in EVOSAX_ALGORITHMS:
        ConfigStore.instance().store(
            group="es", name=name, node=vars(EvosaxConfig(name=name)).copy()
        )


def config(overrides: Sequence[str] = ()) -> LearnConfig:
    """Composes and validates a configuration from command-line overrides.

    Args:
      overrides: Hydra overrides as typed after `python -m sejax.run`.

    Raises:
      ConfigError: for an unknown group, choice or field, or a value out of range.

    Example:
      >>> config(["env=acrobot", "generations=7"]).generations
      7
    """
    register_evosax_choices()
    try:
        with initialize_config_dir(str(CONF_DIR), version_base="1.3"):
            return from_hydra(compose("run", overrides=list(overrides)))
    except HydraException as error:
        raise translate_hydra_error(error) from error


def from_hydra(cfg: DictConfig) -> LearnConfig:
    """The typed and validated configuration of a composed Hydra one."""
    one_of("proxy.name", cfg.proxy.name, tuple(PROXY_CONFIGS))
    groups = {
        "env": EnvConfig,
        "proxy": PROXY_CONFIGS[cfg.proxy.name],
        **_agent_groups(cfg),
        "es": NESConfig if cfg.es.name == "nes" else EvosaxConfig,
        "objective": ObjectiveConfig,
        "training": TrainingConfig,
    }
    return _build(LearnConfig, groups, cfg)


def evaluate_from_hydra(cfg: DictConfig) -> EvaluateConfig:
    """As `from_hydra`, for `sejax.evaluate`.

    Raises:
      ConfigError: if no proxy is named, or a value is out of range.
    """
    if OmegaConf.is_missing(cfg, "proxy"):
        raise ConfigError(
            "proxy must be given, because agents are trained on it; got none. Set proxy=RUN_DIR, "
            "proxy=FILE, proxy=cartpole (a shipped one) or proxy=real env=cartpole."
        )
    groups = {**_agent_groups(cfg), "training": TrainingConfig, "real_training": TrainingConfig}
    return _build(EvaluateConfig, groups, cfg)


def _agent_groups(cfg: DictConfig) -> dict[str, type]:
    """The classes of the chosen agent and exploration; files of older versions lack the latter."""
    one_of("agent.name", cfg.agent.name, tuple(AGENT_CONFIGS))
    groups: dict[str, type] = {"agent": AGENT_CONFIGS[cfg.agent.name]}
    if "exploration" in cfg:
        one_of("exploration.name", cfg.exploration.name, tuple(EXPLORATION_CONFIGS))
        groups["exploration"] = EXPLORATION_CONFIGS[cfg.exploration.name]
    return groups


def require_fit(agent: AgentConfig, exploration: ExplorationConfig, env_name: str) -> None:
    """Checks that an agent can act in a task, and that it can be made to explore so.

    Raises:
      ConfigError: if it cannot.
    """
    kind = envs.kind(env_name)
    fitting = [name for name, schema in AGENT_CONFIGS.items()
               if schema.states == kind.states and kind.actions in schema.actions]  # fmt: skip
    require(agent.name in fitting, "agent", f"be one of {', '.join(fitting)} in {env_name}",
            f"its states are {kind.states} and its actions {kind.actions}", agent.name,
            f"agent={fitting[0]}")  # fmt: skip
    require(agent.name in exploration.agents, "exploration", f"suit {agent.name}",
            f"{exploration.name} is made for {', '.join(exploration.agents)}", exploration.name,
            "exploration=none")  # fmt: skip


def _build(schema: type, groups: dict[str, type], cfg: DictConfig) -> Any:
    """An instance of `schema` from a composed configuration; types are OmegaConf's to check."""
    plain = make_dataclass(
        "Plain", [(f.name, f.type, field(default=f.default)) for f in _plain_fields(schema)]
    )
    try:
        typed = {name: _typed(group, cfg, name) for name, group in groups.items()}
        given = {f.name: cfg[f.name] for f in fields(plain) if f.name in cfg}
        values: Any = OmegaConf.to_container(OmegaConf.merge(OmegaConf.structured(plain), given))
    except OmegaConfBaseException as error:
        where = f" in {error.full_key}" if getattr(error, "full_key", None) else ""
        raise ConfigError(f"{str(error.msg or error).splitlines()[0]}{where}.") from error
    return schema(**typed, **values)


def _plain_fields(schema: Any) -> list[Any]:
    """Fields that are values rather than groups."""
    return [f for f in fields(schema) if f.default_factory is MISSING]


def to_dict(cfg: LearnConfig) -> dict[str, Any]:
    """The configuration as nested plain values, as `config.yaml` and file metadata hold it."""
    return {
        f.name: (vars(value).copy() if hasattr(value, "__dataclass_fields__") else value)
        for f in fields(cfg)
        for value in [getattr(cfg, f.name)]
    }


def from_dict(values: dict[str, Any]) -> LearnConfig:
    """Inverse of `to_dict`."""
    return from_hydra(OmegaConf.create(values))


def _typed(schema: type, cfg: DictConfig, group: str) -> Any:
    target = OmegaConf.create({group: OmegaConf.structured(schema)})
    OmegaConf.set_readonly(target[group], False)  # a frozen dataclass comes read-only
    values: Any = OmegaConf.to_container(OmegaConf.merge(target, {group: cfg[group]}))
    return schema(**values[group])


def translate_hydra_error(error: Exception) -> ConfigError:
    """One clear sentence for what Hydra refused; unknown choices get the nearest known ones."""
    text = str(error)
    missing = _between(text, "Could not find '", "'")
    if missing and "Available options" in text:
        group, _, got = missing.rpartition("/")
        listed = text.split("Available options in")[1].split("Config search path")[0]
        known = [line.strip() for line in listed.splitlines()[1:]]
        return unknown_name(group, got, [name for name in known if name])
    if missing and missing.startswith("tuned/"):
        preset, _, pair = missing.removeprefix("tuned/").partition("/")
        env, _, proxy = pair.rpartition("-")
        if preset == "best":
            files = (CONF_DIR / "tuned" / "best").glob(f"*-{proxy}.yaml")
            known = sorted(path.stem.removesuffix(f"-{proxy}") for path in files)
            return ConfigError(
                f"env must be one of {', '.join(known)} with proxy={proxy}, because there are "
                f"settings for these; got {env}. Set env={known[0]}."
            )
        return ConfigError(
            f"preset must be one that the paper or a measurement defines for the task, because it "
            f"holds that task's numbers; got preset={preset} for {pair}. Set preset=best."
        )
    key = _between(text, "Could not override '", "'")
    if key:
        group = key.rpartition(".")[0]
        siblings = [name for name in _known_fields() if name.rpartition(".")[0] == group]
        if key in siblings:
            return ConfigError(
                f"override must name a field of the chosen {group}, because nothing else is read; "
                f"got {key}, which another choice of {group} has. See --cfg job for its fields."
            )
        in_groups = [name for name in _known_fields() if name.rpartition(".")[2] == key]
        ranked = in_groups or nearest(key, siblings or _known_fields())
        return ConfigError(
            f"override must name a field of the configuration, because nothing else is read; got "
            f"{key}. Did you mean {ranked[0]}? Fields there: {', '.join(ranked)}."
        )
    return ConfigError(text.splitlines()[0])


def _known_fields() -> list[str]:
    groups = (("env", EnvConfig), *(("proxy", c) for c in PROXY_CONFIGS.values()),
              *(("agent", c) for c in AGENT_CONFIGS.values()),
              *(("exploration", c) for c in EXPLORATION_CONFIGS.values()), ("es", NESConfig),
              ("es", EvosaxConfig), ("objective", ObjectiveConfig), ("training", TrainingConfig),
              ("real_training", TrainingConfig))  # fmt: skip
    names = [f.name for f in (*_plain_fields(LearnConfig), *_plain_fields(EvaluateConfig))]
    schema: Any
    for group, schema in groups:
        names += [f"{group}.{f.name}" for f in fields(schema)]
    return list(dict.fromkeys(names))


def _between(text: str, start: str, end: str) -> str:
    _, found, rest = text.partition(start)
    return rest.partition(end)[0] if found else ""


__all__ = ["ConfigError", "LearnConfig", "config"]
