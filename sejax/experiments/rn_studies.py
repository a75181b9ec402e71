"""What the paper studies about reward networks, task by task, and the sets of RNs it needs.

RNs are learned once and shared by all experiments: those of a task, variant and objective are one
file, `<rns>/<env>/<objective>/<variant>.safetensors`, and the curves of their NES runs lie beside
it. Runs that were interrupted go on, and where more RNs are asked for than a file holds only the
further ones are learned.

Differs: on HalfCheetah the unseen agent, PPO, has the ICM and the number of episodes of TD3; the
authors' scripts have others for it (`reference_details.md` 4.8 and 7.3).
"""

import argparse
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sejax.agents.configs import (
    AgentConfig,
    CountBasedConfig,
    DDQNConfig,
    DuelingDDQNConfig,
    ExplorationConfig,
    ICMConfig,
    PPOConfig,
    QLearningConfig,
    SARSAConfig,
    TD3Config,
)
from sejax.configs import OBJECTIVES, EnvConfig
from sejax.errors import ConfigError
from sejax.experiments import common, proxy_runs
from sejax.validation import each_of, one_of

# Paper, table "Overview of Reward Network variants".
VARIANTS = (
    "additive_potential", "exclusive_potential", "additive_non_potential",
    "exclusive_non_potential",
)  # fmt: skip
AUGMENTED = "+augm"  # of a variant's name: the network sees the task's observation vector as well
WEIGHTED_INFO = ("additive_weighted_info", "exclusive_weighted_info")
# With --quick; a task's own come on top.
QUICK: dict[str, Any] = {
    "learned": 2, "generations": 4, "rns": 2, "num_agents": 4, "max_steps": 1500,
    "set": ["es.population_size=8"],
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Study:
    """What the paper trains on the RNs of a task.

    Attributes:
      agent: of the rows with default and varied hyperparameters.
      transfer_agent: of the row with an unseen agent.
      bonuses: exploration bonuses that are compared on the real task.
      variants: of the RNs.
      max_episodes: that the paper trains.
      max_steps: training steps that its figure shows.
      learned: RNs of each variant that are learned.
      runs_at_once: of them in one program; a run is saved after each generation of all.
      rns: number of them, the best ones, that agents are trained on.
      num_agents: on each of these.
      quick: options with --quick, where trainings of this task, or the compilation of HalfCheetah's
        physics, would take too long otherwise.
    """

    agent: AgentConfig
    transfer_agent: AgentConfig
    bonuses: dict[str, ExplorationConfig]
    variants: tuple[str, ...] = VARIANTS
    max_episodes: int
    max_steps: int
    learned: int = 10
    runs_at_once: int = 1
    rns: int = 10
    num_agents: int = 10
    quick: dict[str, Any] = field(default_factory=dict)


# Paper, appendix "Reward Network Hyperparameters": the tables of default hyperparameters.
_CARTPOLE: dict[str, Any] = {
    "init_episodes": 1, "batch_size": 32, "learning_rate": 2.5e-4, "target_update_rate": 0.01,
    "epsilon_min": 0.1, "hidden_size": 64, "num_layers": 1, "buffer_size": 1_000_000,
}  # fmt: skip
STUDIES = {
    "cliff_walking": Study(
        # SARSA explores less than the paper's table says, as in the authors' scripts: with an
        # epsilon of 0.1 and a learning rate of 1 it does not learn the task.
        agent=QLearningConfig(), transfer_agent=SARSAConfig(epsilon_init=0.01, epsilon_min=0.01),
        bonuses={"count_based": CountBasedConfig()},
        max_episodes=500, max_steps=5000, learned=50, runs_at_once=50,
    ),
    "cartpole": Study(
        agent=DDQNConfig(**_CARTPOLE), transfer_agent=DuelingDDQNConfig(**_CARTPOLE),
        bonuses={"icm": ICMConfig()},
        max_episodes=1000, max_steps=50_000,
        quick={"variants": ["additive_potential"], "rows": ["default", "transfer"],
               "generations": 2},
    ),
    "mountain_car_continuous": Study(
        agent=TD3Config(init_episodes=50, action_repeat=2),
        transfer_agent=PPOConfig(action_repeat=5),
        bonuses={"icm": ICMConfig(forward_weight=0.1, reward_scale=0.01, learning_rate=5e-4)},
        max_episodes=3000, max_steps=250_000,
        quick={"variants": ["additive_potential"], "rows": ["default"], "generations": 2,
               "set": ["es.population_size=4", "es.num_incumbent_evals=4",
                       "training.max_episodes=4", "agent.init_episodes=1"]},
    ),
    "halfcheetah": Study(
        agent=TD3Config(),
        transfer_agent=PPOConfig(
            hidden_size=128, activation="tanh", learning_rate=1e-5, update_episodes=1, epochs=10,
            entropy_weight=0.001, init_action_std=0.1,
        ),
        bonuses={"icm": ICMConfig(forward_weight=0.001, reward_scale=0.1, learning_rate=1e-5)},
        variants=(*VARIANTS, *(v + AUGMENTED for v in VARIANTS), *WEIGHTED_INFO),
        max_episodes=1000, max_steps=500_000, learned=5, rns=5, num_agents=5,
        quick={"variants": ["additive_potential"], "rows": ["default"], "generations": 1,
               "learned": 1, "num_agents": 2, "bonuses": ["none"],
               "set": ["es.population_size=2", "es.num_incumbent_evals=2",
                       "training.max_episodes=2", "agent.init_episodes=1"]},
    ),
}  # fmt: skip
LABELS = {
    "real": "real reward",
    "icm": "real reward + ICM",
    "count_based": "real reward + count-based",
    "additive_potential": r"$r + \gamma\Phi(s') - \Phi(s)$",
    "exclusive_potential": r"$\gamma\Phi(s') - \Phi(s)$",
    "additive_non_potential": r"$r + \Phi(s')$",
    "exclusive_non_potential": r"$\Phi(s')$",
    "additive_weighted_info": r"$r + w^\top i'$",
    "exclusive_weighted_info": r"$w^\top i'$",
}


def label(name: str) -> str:
    """Name of a world in pictures: the reward that agents get there."""
    plain = LABELS[name.removesuffix(AUGMENTED)]
    return (
        plain.replace("(s')", "(s', v')").replace("(s)", "(s, v)") if AUGMENTED in name else plain
    )


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options about the task and the RNs that are learned."""
    parser.add_argument("--env", default="cliff_walking", help=f"task: {', '.join(STUDIES)}")
    parser.add_argument("--variants", nargs="+", metavar="VARIANT",
                        help=f"{', '.join(VARIANTS)}, these with {AUGMENTED}, "
                             f"{', '.join(WEIGHTED_INFO)}; all of the paper's")  # fmt: skip
    parser.add_argument("--learned", type=int, help="RNs to learn of each variant; 50 on "
                        "cliff_walking, 5 on halfcheetah, else 10")  # fmt: skip
    parser.add_argument("--generations", type=int, help="outer iterations; the preset's")
    parser.add_argument("--preset", default="best", help="of the NES runs: best, paper")
    parser.add_argument("--set", nargs="+", metavar="KEY=VALUE",
                        help="overrides of the NES runs, as in sejax.run")  # fmt: skip
    parser.add_argument("--rns-dir", type=Path,
                        help="where RNs are kept; results/reward_networks")  # fmt: skip


def add_objective(parser: argparse.ArgumentParser) -> None:
    """The option of experiments that use the RNs of one objective."""
    parser.add_argument("--objective", default="reward_threshold", help=", ".join(OBJECTIVES))


def fill_in(args: argparse.Namespace) -> None:
    """Sets the options that were not given, and checks those of this module.

    Raises:
      ConfigError: for an unknown name or a number out of range.
    """
    one_of("--env", args.env, STUDIES)
    study = STUDIES[args.env]
    for name, value in default_options(args).items():
        if getattr(args, name, value) is None:
            setattr(args, name, value)
    each_of("--variants", args.variants, study.variants)
    one_of("--objective", getattr(args, "objective", OBJECTIVES[0]), OBJECTIVES)
    common.require_counts(args, "learned", "generations")


def default_options(args: argparse.Namespace) -> dict[str, Any]:
    """Options of this module and of those that use it, where they are not given."""
    study = STUDIES[args.env]
    defaults = {"variants": list(study.variants), "set": [], "learned": study.learned,
                "rns": study.rns, "num_agents": study.num_agents,
                "max_steps": study.max_steps}  # fmt: skip
    return defaults | (QUICK | study.quick if args.quick else {})


def learn(args: argparse.Namespace, variant: str, objective: str) -> Any:
    """The RNs of a variant, learned by an objective, in the order of their seeds.

    Args:
      args: with the options of `add_options`, filled in.
      variant: one of the study's.
      objective: one of `configs.OBJECTIVES`.

    Returns:
      A `ProxySet` of `args.learned` RNs.

    Raises:
      ConfigError: for settings that cannot work, or a folder with RNs of other settings.
    """
    from sejax.proxies.sets import load_set

    there = stored(args, variant, objective)
    known = there.size if there else 0
    if known < args.learned:
        config = learning_config(args, variant, objective)
        config = dataclasses.replace(config, seed=args.seed + known)
        path = set_file(args, variant, objective)
        at_once = STUDIES[args.env].runs_at_once
        configs = proxy_runs.configs_of_runs(
            config, args.learned - known, path.parent / "runs" / variant, at_once
        )
        print(f"{variant}: learns {args.learned - known} RNs, {config.generations} generations "
              "each; may be stopped and started again", flush=True)  # fmt: skip
        curves = common.Pieces(path.parent / "curves", "--rns-dir")
        proxy_runs.learn_all(configs, curves, f"{variant}-")
        proxy_runs.collect(configs, path, there)
        there = load_set(path, "--rns-dir", "rn")
    return there.first(args.learned)


def rns_dir(args: argparse.Namespace) -> Path:
    """Where all RNs are kept."""
    default = args.out / "rns" if args.quick else Path("results/reward_networks")
    return args.rns_dir or default


def set_file(args: argparse.Namespace, variant: str, objective: str) -> Path:
    """Where the RNs of a variant and objective are kept."""
    return rns_dir(args) / args.env / objective / f"{variant}.safetensors"


def stored(args: argparse.Namespace, variant: str, objective: str) -> Any:
    """The RNs that are there already, a `ProxySet`; None if they are to be learned.

    Raises:
      ConfigError: if they were learned with other settings. Fewer generations are no such settings:
        their runs go on.
    """
    from sejax.proxies.sets import load_set

    path = set_file(args, variant, objective)
    if not path.exists():
        return None
    there = load_set(path, "--rns-dir", "rn")
    made_with, asked = map(
        proxy_runs.piece_settings, (there.config, learning_config(args, variant, objective))
    )
    differing = [name for name in sorted({*made_with, *asked})
                 if name != "num_seeds" and made_with.get(name) != asked.get(name)]  # fmt: skip
    if differing == ["generations"] and made_with["generations"] < asked["generations"]:
        return None
    if differing:
        raise ConfigError(
            f"--rns-dir must be a new folder or hold RNs of the same settings, because they are "
            f"learned once for all experiments; got {path} with another {', '.join(differing)}. "
            f"Set --rns-dir=DIR, or the options that they were learned with."
        )
    return there


def check_stored(args: argparse.Namespace, objectives: Sequence[str]) -> None:
    """Checks all RNs that are there before any are learned, which may take days.

    Raises:
      ConfigError: if some were learned with other settings.
    """
    for objective in objectives:
        for variant in args.variants:
            stored(args, variant, objective)


def learning_config(args: argparse.Namespace, variant: str, objective: str) -> Any:
    """Settings of the NES runs for a variant and objective.

    Raises:
      ConfigError: for settings that cannot work.
    """
    import sejax

    plain = variant.removesuffix(AUGMENTED)
    overrides = [f"env={args.env}", "proxy=rn", f"preset={args.preset}", f"proxy.variant={plain}",
                 f"proxy.augmented={str(plain != variant).lower()}",
                 f"objective={objective}"]  # fmt: skip
    if args.generations is not None:
        overrides.append(f"generations={args.generations}")
    config = sejax.config([*overrides, *args.set])
    return dataclasses.replace(config, devices=args.devices, seed=args.seed)


def env_config(args: argparse.Namespace) -> EnvConfig:
    """Which real task it is, with the physics and rewards that the RNs are learned with."""
    return learning_config(args, args.variants[0], OBJECTIVES[0]).env
