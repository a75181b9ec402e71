"""What the paper studies about reward networks, task by task, and the sets of RNs it needs.

RNs are learned once and shared by all experiments: those of a task, variant and objective are one
file, `<rns_dir>/<env>/<objective>/<variant>.safetensors`, and the curves of the NES runs of all
variants lie beside it, `curves.csv.xz`. Runs that were interrupted go on, and where more RNs are
asked for than a file holds only the further ones are learned.

Differs: on HalfCheetah the unseen agent, PPO, has the ICM and the number of episodes of TD3; the
authors' scripts have others for it (`docs/reference.md` 4.8 and 7.3). TD3 is the quick one of
`preset=best` (docs/agents.md): the paper's takes 250 CPU seconds for each of some hundred trainings
on MountainCarContinuous, and five times that on HalfCheetah.
"""

import dataclasses
import functools
import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import filelock
import pandas as pd

import sejax
from experiments.common import agents, figures, runs
from experiments.common.experiment import setting, work_beside
from experiments.common.runs import RunSettings
from experiments.common.shards import read_rows, write_rows
from sejax import ICMConfig, ProxySet, Task
from sejax.agents import AgentConfig, ExplorationConfig
from sejax.options import ConfigError, Count, listed, registry, require_known
from sejax.options.plain import flatten
from sejax.proxies import reward
from sejax.runs.config import LearnConfig

# Paper, table "Overview of Reward Network variants".
VARIANTS = tuple(x for x, shaping in reward.VARIANTS.items() if not shaping.weighs_info)
WEIGHTED_INFO = tuple(x for x, shaping in reward.VARIANTS.items() if shaping.weighs_info)
AUGMENTED = "+augm"  # of a variant's name: the network sees the task's observation vector as well
PAPER_ROWS = ("default", "varied", "transfer")
OBJECTIVES = tuple(registry.BUILT_IN["objective"])


@dataclass(frozen=True, kw_only=True)
class Study:
    """What the paper trains on the RNs of a task."""

    # Of the rows with default and varied hyperparameters; None: that of `preset=best`.
    agent: AgentConfig | None
    transfer_agent: AgentConfig  # of the row with an unseen agent
    tuned_agent: AgentConfig | None = None  # on the real task for few steps, if it is another one
    rows: tuple[str, ...] = PAPER_ROWS  # of the figure
    bonuses: dict[str, ExplorationConfig]  # exploration bonuses that are compared on the real task
    variants: tuple[str, ...] = VARIANTS
    max_episodes: int  # that the paper trains
    max_steps: int  # training steps that its figure shows
    learned: int = 10  # RNs of each variant
    rns: int = 10  # the best ones of them, that agents are trained on
    num_agents: int = 10  # on each of these


def _paper_ppo(env: str) -> sejax.PPOConfig:
    """The paper's PPO for showing transfer of RNs."""
    words = [f"env={env}", "proxy=rn", "agent=ppo", "preset=paper"]
    ppo: sejax.PPOConfig = sejax.config(words).agent
    return ppo


# Paper, appendix "Reward Network Hyperparameters": the tables of default hyperparameters.
_CARTPOLE: dict[str, Any] = {
    "warmup_episodes": 1,
    "batch_size": 32,
    "learning_rate": 2.5e-4,
    "tau": 0.01,
    "epsilon_min": 0.1,
    "hidden_size": 64,
    "num_layers": 1,
    "buffer_size": 1_000_000,
    "exploration_steps": None,
}
STUDIES = {
    "cliff_walking": Study(
        # SARSA explores less than the paper's table says, as in the authors' scripts: with an
        # epsilon of 0.1 and a learning rate of 1 it does not learn the task.
        agent=sejax.QLearningConfig(),
        transfer_agent=sejax.SARSAConfig(epsilon_init=0.01, epsilon_min=0.01),
        bonuses={"count_based": sejax.CountBasedConfig()},
        max_episodes=500,
        max_steps=5000,
        learned=50,
    ),
    "cartpole": Study(
        agent=sejax.DDQNConfig(**_CARTPOLE),
        transfer_agent=sejax.DuelingDDQNConfig(
            **_CARTPOLE, feature_dim=128, stream_hidden_size=128
        ),
        tuned_agent=agents.tuned_agent("cartpole", "ddqn"),
        rows=(*PAPER_ROWS, "tuned"),
        bonuses={"icm": ICMConfig()},
        max_episodes=1000,
        max_steps=50_000,
    ),
    "mountain_car_continuous": Study(
        agent=None,
        transfer_agent=_paper_ppo("mountain_car_continuous"),
        # docs/agents.md, "PPO"
        tuned_agent=dataclasses.replace(
            _paper_ppo("mountain_car_continuous"),
            rollout_steps=256,
            learning_rate=0.0015,
            init_action_std=1.0,
        ),
        rows=(*PAPER_ROWS, "tuned"),
        bonuses={"icm": ICMConfig(forward_weight=0.1, reward_scale=0.01, learning_rate=5e-4)},
        max_episodes=3000,
        max_steps=250_000,
    ),
    "halfcheetah": Study(
        agent=None,
        transfer_agent=_paper_ppo("halfcheetah"),
        bonuses={"icm": ICMConfig(forward_weight=0.001, reward_scale=0.1, learning_rate=1e-5)},
        variants=(*VARIANTS, *(v + AUGMENTED for v in VARIANTS), *WEIGHTED_INFO),
        max_episodes=1000,
        max_steps=500_000,
        learned=5,
        rns=5,
        num_agents=5,
    ),
}
# Columns of the NES runs' curves: scores and costs.
KEPT = ("generation", "seed", "incumbent_mean", "env_steps_total", "wall_s", "cpu_s")
SHOWN = {  # colour of a condition, and the reward that agents get there
    "real": (figures.BEST, "real reward"),
    "icm": ("#7a7a7a", "real reward + ICM"),
    "count_based": ("#7a7a7a", "real reward + count-based"),
    "additive_potential": (figures.REAL, r"$r + \gamma\Phi(s') - \Phi(s)$"),
    "exclusive_potential": ("#56B4E9", r"$\gamma\Phi(s') - \Phi(s)$"),
    "additive_non_potential": (figures.VARIED, r"$r + \Phi(s')$"),
    "exclusive_non_potential": (figures.FIXED, r"$\Phi(s')$"),
    "additive_weighted_info": (figures.SOLVED, r"$r + w^\top i'$"),
    "exclusive_weighted_info": ("#CC79A7", r"$w^\top i'$"),
}


def label(name: str) -> str:
    """Name of a condition in figures: the reward that agents get there."""
    _, text = SHOWN[name.removesuffix(AUGMENTED)]
    return text if AUGMENTED not in name else re.sub(r"\(s('?)\)", r"(s\1, v\1)", text)


@dataclass(frozen=True, kw_only=True)
class RnSettings(RunSettings):
    """Settings about the task and the RNs that are learned; defaults are those of the study.

    Attributes:
      env: Task: cliff_walking, cartpole, mountain_car_continuous, halfcheetah.
      variants: Of the RNs: those, with +augm, additive_weighted_info, exclusive_weighted_info.
      learned: RNs to learn of each variant
      generations: outer iterations; the preset's
      rns_dir: of RNs; results/reward_networks, quick: rns/ in `out`
    """

    quick_run = ("es.population_size=8",)

    env: str = setting("cliff_walking", STUDIES)
    variants: tuple[str, ...] = setting(VARIANTS)
    learned: Count = setting(10, quick=2)
    generations: Count | None = setting(None, quick=4)
    rns_dir: str | None = setting(None)

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> dict[str, Any]:
        usual, default = super().defaults({}), super().defaults(given)
        env = given.get("env", default["env"])
        require_known("env", env, STUDIES)
        study = vars(STUDIES[env]) | {"bonuses": tuple(STUDIES[env].bonuses)}
        same = [name for name in default if name in study and default[name] == usual[name]]
        return default | {name: study[name] for name in same}

    def __post_init__(self) -> None:
        super().__post_init__()
        for variant in self.variants:
            require_known("variants", variant, self.study.variants)

    @property
    def study(self) -> Study:
        return STUDIES[self.env]

    @property
    def task(self) -> Task:
        """The real task, with the physics and rewards that RNs are learned with."""
        return learning_config(self, self.variants[0], OBJECTIVES[0]).task()

    @property
    def learning_agent(self) -> AgentConfig:
        """The agent that RNs are learned with."""
        return learning_config(self, self.variants[0], OBJECTIVES[0]).agent

    @property
    def rns_folder(self) -> Path:
        """Where all RNs are kept."""
        if self.rns_dir is not None:
            return Path(self.rns_dir)
        return self.folder / "rns" if self.quick else Path("results/reward_networks")


def learn(settings: RnSettings, variant: str, objective: str) -> ProxySet:
    """The RNs of a variant, learned by an objective: a `ProxySet` in the order of their seeds."""
    there = stored(settings, variant, objective)
    if there is None or len(there) < settings.learned:
        known = len(there) if there else 0
        config = learning_config(settings, variant, objective)
        config = dataclasses.replace(config, seed=settings.seed + known)
        path, missing = file_of(settings, variant, objective), settings.learned - known
        folder = work_beside(settings.rns_folder, "runs")
        folder /= path.relative_to(settings.rns_folder).with_suffix("")
        configs = runs.configs_of(config, missing, folder)
        print(f"{variant}: learns {missing} RNs, {config.generations} generations each", flush=True)
        curve = runs.learn(configs, option="rns_dir")
        curve = curve[curve.columns.intersection(KEPT)].assign(variant=variant)
        file = path.with_name("curves.csv.xz")  # of all variants
        with filelock.FileLock(folder.parent / "curves.lock"):  # another variant may end too
            if file.exists():
                before = read_rows(file)  # with those beyond, if stopped right here
                first = config.seed if there else 0
                is_anew = (before["variant"] == variant) & (before["seed"] >= first)
                curve = pd.concat([before[~is_anew], curve], ignore_index=True)
            write_rows(file, curve)
        runs.collect(configs, path, there)
        there = sejax.load_set(path, option="rns_dir", kind="rn")
    return there[: settings.learned]


def file_of(settings: RnSettings, variant: str, objective: str) -> Path:
    """Where the RNs of a variant and objective are kept."""
    return settings.rns_folder / settings.env / objective / f"{variant}.safetensors"


def stored(settings: RnSettings, variant: str, objective: str) -> ProxySet | None:
    """The RNs that are there already, a `ProxySet`; None if they are to be learned.

    Raises:
      ConfigError: if they were learned with other settings. Fewer generations are no such settings:
        their runs go on.
    """
    path = file_of(settings, variant, objective)
    if not path.exists():
        return None
    there = sejax.load_set(path, option="rns_dir", kind="rn")
    made_with = _what_counts(LearnConfig.of_stored(there.config))
    asked = _what_counts(learning_config(settings, variant, objective))
    names = made_with.keys() | asked.keys()
    differing = sorted(name for name in names if made_with.get(name) != asked.get(name))
    if differing == ["generations"] and made_with["generations"] < asked["generations"]:
        return None
    if differing:
        got = f"{path} with another {listed(differing)}"
        must = f"must be a new folder or hold RNs of the same settings; got {got}"
        raise ConfigError("rns_dir", must, use="DIR, or these settings")
    return there


def _what_counts(config: LearnConfig) -> dict[str, Any]:
    """The fields that a run's numbers depend on."""
    counted = {"generations", "stop_when_solved"}
    free = {*config.free} - counted | {"num_parallel"}
    flat = flatten(config.plain())
    return {name: value for name, value in flat.items() if name.partition(".")[0] not in free}


def check_stored(settings: RnSettings, objectives: Sequence[str]) -> None:
    """Checks all RNs that are there (see `stored`) before any are learned, which may take days."""
    for objective, variant in itertools.product(objectives, settings.variants):
        stored(settings, variant, objective)


@functools.cache
def learning_config(settings: RnSettings, variant: str, objective: str) -> LearnConfig:
    """The configuration of the NES runs for a variant and objective.

    The scale of a network's output is the preset's for the preset's own variant, and 1 for others.
    """
    plain = variant.removesuffix(AUGMENTED)
    preset: Any = settings.learn_config(["proxy=rn"]).proxy
    scale = preset.output_scale if plain == preset.variant else 1.0
    return settings.learn_config(
        [
            "proxy=rn",
            f"proxy.variant={plain}",
            f"proxy.augmented={plain != variant}",
            f"proxy.output_scale={scale}",
            f"objective={objective}",
        ]
    )
