"""What the paper studies about reward networks, task by task, and the agents that train on them.

RNs are learned once and shared by all experiments: those of a task, variant and objective are one
file, `<rns_dir>/<env>/<objective>/<variant>.safetensors`, and the curves of their NES runs lie
beside it. Runs that were interrupted go on, and where more RNs are asked for than a file holds only
the further ones are learned.

The agents of a row of the paper's figure are trained under several conditions: on the real task, on
the real task with an exploration bonus, and on each of several RNs. Stored rows call the condition
`world`.

Differs: on HalfCheetah the unseen agent, PPO, has the ICM and the number of episodes of TD3; the
authors' scripts have others for it (`docs/reference.md` 4.8 and 7.3). TD3 is the quick one of
`preset=best` (docs/agents.md): the paper's takes 250 CPU seconds for each of some hundred trainings
on MountainCarContinuous, and five times that on HalfCheetah.
"""

import dataclasses
import functools
import itertools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import sejax
from experiments.common import agents, curves, figures, runs
from experiments.common.agents import Condition
from experiments.common.experiment import count, each_of, setting, work_beside
from experiments.common.runs import RunSettings
from experiments.common.shards import read_rows, write_rows
from experiments.common.tables import (
    as_texts,
    iqm_columns,
    iqm_note,
    iqm_text,
    mean_columns,
    mean_text,
)
from sejax import ICMConfig, errors, registry, serialize
from sejax.cli import build, run_directory
from sejax.errors import ConfigError, require
from sejax.options import one_of
from sejax.training import TrainingConfig

# Paper, table "Overview of Reward Network variants".
VARIANTS = (
    "additive_potential",
    "exclusive_potential",
    "additive_non_potential",
    "exclusive_non_potential",
)
AUGMENTED = "+augm"  # of a variant's name: the network sees the task's observation vector as well
WEIGHTED_INFO = ("additive_weighted_info", "exclusive_weighted_info")
ROWS = {  # agents that are trained: the rows of the paper's figure, and one of ours
    "default": "default hyperparameters",
    "varied": "varied hyperparameters",
    "transfer": "unseen agent",
    "tuned": "tuned for few steps",
}
PAPER_ROWS = ("default", "varied", "transfer")
WITHOUT_RN = ("real", "count_based", "icm")  # conditions whose groups have nothing in common
GRID_POINTS = 200
OBJECTIVES = tuple(registry.GROUPS["objective"].built_in)
# With quick=true; a task's own come on top.
QUICK: dict[str, Any] = {
    "learned": 2,
    "generations": 4,
    "rns": 2,
    "num_agents": 4,
    "max_steps": 1500,
    "run": ("es.population_size=8",),
}


@dataclass(frozen=True, kw_only=True)
class Study:
    """What the paper trains on the RNs of a task."""

    agent: Any  # of the rows with default and varied hyperparameters; None: that of `preset=best`
    transfer_agent: Any  # of the row with an unseen agent
    # Makes the one that was tuned on the real task for few steps, if it is another one.
    tuned_agent: Callable[[], Any] | None = None
    rows: tuple[str, ...] = PAPER_ROWS  # of the figure
    bonuses: dict[str, Any]  # exploration bonuses that are compared on the real task
    variants: tuple[str, ...] = VARIANTS
    max_episodes: int  # that the paper trains
    max_steps: int  # training steps that its figure shows
    learned: int = 10  # RNs of each variant
    rns: int = 10  # the best ones of them, that agents are trained on
    num_agents: int = 10  # on each of these
    # Where trainings of the task, or compiling its physics, would take too long with quick=true.
    when_quick: dict[str, Any] = field(default_factory=dict)


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
}
_FEW: dict[str, Any] = {"variants": ("additive_potential",), "rows": ("default",)}  # when quick
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
        transfer_agent=sejax.DuelingDDQNConfig(**_CARTPOLE),
        tuned_agent=functools.partial(agents.tuned_agent, "cartpole", "ddqn"),
        rows=(*PAPER_ROWS, "tuned"),
        bonuses={"icm": ICMConfig()},
        max_episodes=1000,
        max_steps=50_000,
        when_quick=_FEW | {"rows": ("default", "transfer"), "generations": 2},
    ),
    "mountain_car_continuous": Study(
        agent=None,
        transfer_agent=sejax.PPOConfig.paper(action_repeat=5),
        # docs/agents.md, "PPO in few steps"
        tuned_agent=functools.partial(
            sejax.PPOConfig.paper,
            action_repeat=5,
            rollout_steps=256,
            learning_rate=0.0015,
            init_action_std=1.0,
        ),
        rows=(*PAPER_ROWS, "tuned"),
        bonuses={"icm": ICMConfig(forward_weight=0.1, reward_scale=0.01, learning_rate=5e-4)},
        max_episodes=3000,
        max_steps=250_000,
        when_quick=_FEW
        | {
            "generations": 2,
            "run": (
                "es.population_size=4",
                "es.num_incumbent_evals=4",
                "training.max_episodes=4",
                "agent.warmup_episodes=1",
            ),
        },
    ),
    "halfcheetah": Study(
        agent=None,
        transfer_agent=sejax.PPOConfig.paper(
            hidden_size=128,
            activation="tanh",
            learning_rate=1e-5,
            update_episodes=1,
            epochs=10,
            entropy_weight=0.001,
            init_action_std=0.1,
        ),
        bonuses={"icm": ICMConfig(forward_weight=0.001, reward_scale=0.1, learning_rate=1e-5)},
        variants=(*VARIANTS, *(v + AUGMENTED for v in VARIANTS), *WEIGHTED_INFO),
        max_episodes=1000,
        max_steps=500_000,
        learned=5,
        rns=5,
        num_agents=5,
        when_quick=_FEW
        | {
            "generations": 1,
            "learned": 1,
            "num_agents": 2,
            "bonuses": (),
            "run": (
                "es.population_size=2",
                "es.num_incumbent_evals=2",
                "training.max_episodes=2",
                "agent.warmup_episodes=1",
            ),
        },
    ),
}
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
    """Settings about the task and the RNs that are learned; defaults are those of the study."""

    env: str = setting("cliff_walking", one_of(STUDIES), about=f"task: {', '.join(STUDIES)}")
    variants: tuple[str, ...] = setting(
        VARIANTS, about=f"of the RNs: those, with {AUGMENTED}, {', '.join(WEIGHTED_INFO)}"
    )
    learned: int = count(10, "RNs", about="RNs to learn of each variant")
    rns_dir: str | None = setting(
        None, about="where RNs are kept; results/reward_networks, quick rns/ in `out`"
    )

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> dict[str, Any]:
        default = super().defaults(given)
        env = given.get("env", default["env"])
        errors.one_of("env", env, STUDIES)
        study = STUDIES[env]
        values = vars(study) | {"bonuses": tuple(study.bonuses)}
        values |= QUICK | study.when_quick if given.get("quick") else {}
        return default | {name: values[name] for name in default.keys() & values.keys()}

    def __post_init__(self) -> None:
        super().__post_init__()
        errors.each_of("variants", self.variants, self.study.variants)

    @property
    def study(self) -> Study:
        return STUDIES[self.env]

    @property
    def task(self) -> Any:
        """The real task, with the physics and rewards that RNs are learned with."""
        return learning_config(self, self.variants[0], OBJECTIVES[0]).task()

    @property
    def learning_agent(self) -> Any:
        """The agent that RNs are learned with."""
        return learning_config(self, self.variants[0], OBJECTIVES[0]).agent

    @property
    def rns_folder(self) -> Path:
        """Where all RNs are kept."""
        if self.rns_dir is not None:
            return Path(self.rns_dir)
        return self.folder / "rns" if self.quick else Path("results/reward_networks")


def objective_setting() -> Any:
    """The setting of experiments that use the RNs of one objective."""
    return setting(
        "reward_threshold",
        one_of(OBJECTIVES),
        about=f"that RNs are learned by: {', '.join(OBJECTIVES)}",
    )


def learn(settings: RnSettings, variant: str, objective: str) -> Any:
    """The RNs of a variant, learned by an objective: a `ProxySet` in the order of their seeds."""
    there = stored(settings, variant, objective)
    known = there.size if there else 0
    if known < settings.learned:
        config = learning_config(settings, variant, objective)
        config = dataclasses.replace(config, seed=settings.seed + known)
        path, missing = file_of(settings, variant, objective), settings.learned - known
        folder = work_beside(settings.rns_folder, "runs")
        folder /= path.relative_to(settings.rns_folder).with_suffix("")
        configs = runs.configs_of(config, missing, folder)
        print(f"{variant}: learns {missing} RNs, {config.generations} generations each", flush=True)
        curve = runs.learn(configs, option="rns_dir")
        if there:
            before = read_rows(curves_file(path))  # with those beyond, if stopped right here
            curve = pd.concat([before[before["seed"] < config.seed], curve], ignore_index=True)
        write_rows(curves_file(path), curve)
        runs.collect(configs, path, there)
        there = sejax.load_set(path, option="rns_dir", kind="rn")
    return there.first(settings.learned)


def file_of(settings: RnSettings, variant: str, objective: str) -> Path:
    """Where the RNs of a variant and objective are kept."""
    return settings.rns_folder / settings.env / objective / f"{variant}.safetensors"


def curves_file(path: Path) -> Path:
    """Where the curves of the NES runs of a set are kept."""
    return path.with_suffix(".csv.xz")


def stored(settings: RnSettings, variant: str, objective: str) -> Any:
    """The RNs that are there already, a `ProxySet`; None if they are to be learned.

    Raises:
      ConfigError: if they were learned with other settings. Fewer generations are no such settings:
        their runs go on.
    """
    path = file_of(settings, variant, objective)
    if not path.exists():
        return None
    there = sejax.load_set(path, option="rns_dir", kind="rn")
    made_with = _what_counts(build.learn_config(there.config))
    asked = _what_counts(learning_config(settings, variant, objective))
    names = sorted(made_with.keys() | asked.keys())
    differing = [name for name in names if made_with.get(name) != asked.get(name)]
    if differing == ["generations"] and made_with["generations"] < asked["generations"]:
        return None
    if differing:
        raise ConfigError(
            f"rns_dir must be a new folder or hold RNs of the same settings, because they are "
            f"learned once for all experiments; got {path} with another {', '.join(differing)}. "
            f"Set rns_dir=DIR, or the settings that they were learned with."
        )
    return there


def _what_counts(config: Any) -> dict[str, Any]:
    """The fields that a run's numbers depend on."""
    free = run_directory.FREE_FIELDS - {"generations"} | {"num_parallel", "num_seeds"}
    flat = serialize.flatten(build.to_plain(config))
    return {name: value for name, value in flat.items() if name.partition(".")[0] not in free}


def check_stored(settings: RnSettings, objectives: Sequence[str]) -> None:
    """Checks all RNs that are there (see `stored`) before any are learned, which may take days."""
    for objective, variant in itertools.product(objectives, settings.variants):
        stored(settings, variant, objective)


@functools.cache
def learning_config(settings: RnSettings, variant: str, objective: str) -> Any:
    """The configuration of the NES runs for a variant and objective.

    The scale of a network's output is the preset's for the preset's own variant, and 1 for others.
    """
    plain = variant.removesuffix(AUGMENTED)
    preset = settings.learn_config(["proxy=rn"]).proxy
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


# --- agents that train with RNs ------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class CurveSettings(RnSettings):
    """Settings about the agents."""

    rows: tuple[str, ...] = setting(
        PAPER_ROWS,
        each_of(ROWS),
        about="agents to train: default (the paper's hyperparameters; on continuous tasks those of "
        "the quick agent that RNs are learned with), varied (drawn for each agent), transfer (one "
        "that the RNs never saw), tuned (on the real task for few steps: DDQN on cartpole, PPO on "
        "mountain_car_continuous)",
    )
    bonuses: tuple[str, ...] = setting(
        (),
        about="exploration bonuses on the real task to compare with: count_based on cliff_walking, "
        "elsewhere icm; or none",
    )
    rns: int = count(10, "RNs", about="RNs of each variant that agents are trained on, the best")
    bonus_groups: int = count(10, "groups", about="groups of agents with a bonus; as many as RNs")
    num_agents: int = count(10, "agents", about="on each RN, in each row")
    max_steps: int = count(5000, "steps", about="training steps; as the paper's figure")

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> dict[str, Any]:
        default = super().defaults(given)
        default["rns"] = min(default["rns"], given.get("learned", default["learned"]))
        return default | {"bonus_groups": given.get("rns", default["rns"])}

    def __post_init__(self) -> None:
        super().__post_init__()
        errors.each_of("rows", self.rows, self.study.rows)
        errors.each_of("bonuses", self.bonuses, (*self.study.bonuses, "none"))
        most, fix = f"be at most {self.learned}", f"learned={self.rns}"
        require(self.rns <= self.learned, "rns", most, "so many are learned", self.rns, fix)

    def agent(self, row: str) -> Any:
        """The agent that is trained in a row."""
        if row == "transfer":
            return self.study.transfer_agent
        if row == "tuned" and self.study.tuned_agent:
            return self.study.tuned_agent()
        return self.study.agent or self.learning_agent

    def training(self, row: str) -> TrainingConfig:
        """Episodes of training and of tests alternate until a limit.

        At the task's time limit tuned agents bootstrap, as they were tuned; the paper's do not.
        """
        return TrainingConfig(
            max_episodes=self.study.max_episodes,
            max_steps=self.max_steps,
            stop_rule="never",
            tests_between=1,
            time_limit_is_terminal=row != "tuned",
        )


def real_curves(settings: CurveSettings) -> Iterator[pd.DataFrame]:
    """Curves of all agents on the real task, without and with the bonuses that are compared."""
    make = functools.partial(Condition.real, settings.task)
    yield from curves_in(settings, "real", settings.rns, make)
    for name, bonus in settings.study.bonuses.items():
        if name in settings.bonuses:
            yield from curves_in(settings, name, settings.bonus_groups, make, exploration=bonus)


def rn_curves(settings: CurveSettings, variant: str, rns: Any, prefix: str = "") -> Any:
    """Curves of all agents on the RNs of a set, of which each group of agents has one."""
    make = functools.partial(Condition.of_set, rns)
    return curves_in(settings, variant, rns.size, make, prefix)


def curves_in(
    settings: CurveSettings, name: str, groups: int, make: Any, prefix: str = "", **more: Any
) -> Iterator[pd.DataFrame]:
    """Those of each row, with the columns `group`, `row` and `world`.

    `make(group names, ...)` makes a condition; the prefix tells apart conditions of one name.
    """
    for row in settings.rows:
        condition = make(
            [f"{i:02d}" for i in range(groups)],
            name=f"{prefix}{row}-{name}",
            agent=settings.agent(row),
            training=settings.training(row),
            hparams="varied" if row == "varied" else "default",
            **more,
        )
        rows = agents.train_groups(condition, settings, settings.num_agents, curves.CURVES)
        group = rows["group"].astype(int)
        number = rows["agent"] + group * settings.num_agents
        yield rows.assign(agent=number, group=group, row=row, world=name)


def by_row(settings: CurveSettings, rows: pd.DataFrame) -> pd.DataFrame:
    """The curves, those of the figure's first row of agents first, else in the order they have."""
    return pd.concat([rows[rows["row"] == row] for row in settings.rows], ignore_index=True)


def require_rows(settings: CurveSettings, rows: pd.DataFrame) -> None:
    """Checks that stored rows have as many groups and agents as a table's text will say.

    Raises:
      ConfigError: if they do not, as where other settings made them.
    """

    def same(name: str, there: Any, asked: Any) -> None:
        reason, fix = f"{settings.rows_file} has these", f"{name}={there}, or from_rows=false"
        require(there == asked, name, f"be {there}", reason, asked, fix)

    there = rows["row"].unique()
    same("rows", *(f"[{','.join(sorted(names))}]" for names in (there, settings.rows)))
    for (_, world), mine in rows.groupby(["row", "world"], sort=False):
        groups = mine["group"].nunique()
        same("num_agents", mine["agent"].nunique() // groups, settings.num_agents)
        name = "bonus_groups" if world in settings.study.bonuses else "rns"
        same(name, groups, settings.values(name)[name])


def summarise(rows: pd.DataFrame, solved_reward: float, max_steps: int) -> pd.DataFrame:
    """One row for each row of the figure and condition.

    An agent that did not solve the task counts `max_steps`. Intervals come from drawing RNs again,
    since agents of one RN have much in common, and agents where there are no RNs; of fewer than
    five there is none (nan).
    """
    out = []
    grid = step_grid(max_steps)
    counted: dict[Any, Any] = {}  # steps and group of each agent, by row and condition
    for (row, world), mine in rows.groupby(["row", "world"], sort=False):
        groups = mine.groupby("agent")["group"].first()
        to_solve = curves.all_steps_to_solve(mine, solved_reward)
        steps = to_solve.clip(upper=max_steps)
        held = curves.on_grid(mine, grid, window=1)
        mean_return = pd.Series(np.nanmean(held, axis=1), index=steps.index)
        labels = None if world in WITHOUT_RN else groups
        counted[row, world] = steps, groups
        out.append(
            {"row": row, "world": world, "groups": groups.nunique(), "agents": len(steps)}
            | {"solved": np.isfinite(to_solve).mean()}
            | mean_columns(steps, "steps", _draws(steps, labels))
            | mean_columns(mean_return, "return", _draws(mean_return, labels))
            | iqm_columns(mean_return, "return", labels)
            | {"last_return": curves.last_returns(mine).mean()}
        )
    shares = [
        share_of_bare(*mine, *counted[row, "real"]) if (row, "real") in counted else np.nan
        for (row, _), mine in counted.items()
    ]
    return pd.DataFrame(out).assign(share_of_bare=shares)


def _draws(values: pd.Series, labels: pd.Series | None) -> pd.Series:
    """What an interval draws again: the means of the RNs, or agents where there are none."""
    return values if labels is None else values.groupby(labels).mean()


def share_of_bare(
    steps: pd.Series, groups: pd.Series, bare_steps: pd.Series, bare_groups: pd.Series
) -> float:
    """Mean steps as a share of those of the groups of the same seeds on the real task.

    A bonus has fewer groups, and where hyperparameters are drawn the groups' draws differ.
    """
    return float(steps.mean() / bare_steps[bare_groups.isin(groups.unique())].mean())


def step_grid(max_steps: int) -> np.ndarray:
    """Training steps at which curves are compared, `[GRID_POINTS]`."""
    return np.linspace(max_steps / GRID_POINTS, max_steps, GRID_POINTS)


def make_table(summary: pd.DataFrame) -> pd.DataFrame:
    """The summary as texts."""

    def share(row: Any) -> str:
        return f"{row.share_of_bare:.0%}" if np.isfinite(row.share_of_bare) else ""

    return as_texts(
        summary,
        {
            "agents": lambda row: ROWS[row.row],
            "trained with": "{world}",
            "groups, agents": "{groups}, {agents}",
            "steps to solve": mean_text("steps", 0),
            "of the bare agent's": share,
            "solved": "{solved:.0%}",
            "mean return over training": mean_text("return", 1),
            "IQM": iqm_text("return"),
            "last tests": "{last_return:.1f}",
        },
    )


def common_note(settings: CurveSettings, solved_reward: float) -> str:
    """What a reader must know of every table made of these curves."""
    learned_with = (
        " Default hyperparameters are those of the agent that the RNs were learned with, not the "
        "paper's."
    )
    return (
        f"up to {settings.max_steps:,} training steps or {settings.study.max_episodes:,} episodes, "
        "one greedy test episode after each. Steps to solve: until the mean of "
        f"{curves.WINDOW} tests in a row reaches {solved_reward:g}; an agent that never "
        f"does counts {settings.max_steps:,}. The share of the bare agent's is of as many groups, "
        "of the same seeds. Where episodes end before the steps do, a curve and its mean go on as "
        "the last test. In brackets bootstrap 95% intervals, for at least "
        f"five RNs: they draw RNs, and agents on the real task.{iqm_note('within each RN')}"
        f"{'' if settings.study.agent else learned_with}"
    )


def draw(settings: Any, rows: dict[str, pd.DataFrame], height: float, name: str) -> None:
    """Draws a line of panels for each kind of curves, and in it a panel for each row of agents.

    The curves are named by their label on the left; the height is a panel's, in inches.
    """
    shape = len(rows), len(settings.rows)
    size = 0.8 + 3.8 * shape[1], 0.8 + height * shape[0]
    solved_reward, path = settings.task.solved_reward, settings.folder / name
    with figures.panels(path, *shape, size, sharex=True, sharey=True) as (figure, axes):
        for line, (label, mine) in zip(axes, rows.items(), strict=True):
            for axis, row in zip(line, settings.rows, strict=True):
                panel(axis, mine[mine["row"] == row], settings.max_steps, solved_reward)
            line[0].set_ylabel(label)
        for axis, row in zip(axes[0], settings.rows, strict=True):
            agent = figures.AGENT_NAMES[registry.name_of("agent", settings.agent(row))]
            axis.set_title(f"{agent}, {ROWS[row]}", fontsize=10)
        for axis in axes[-1]:
            axis.set_xlabel("training steps")
        figures.legend_above(figure, axes[0, 0])


def panel(axis: Any, rows: pd.DataFrame, max_steps: int, solved_reward: float) -> None:
    """Draws the mean test return under each condition with its standard error over all agents.

    Source: paper, figure "The average cumulative test rewards of agents when trained on different
    RN variants".
    """
    grid = step_grid(max_steps)
    for world, mine in rows.groupby("world", sort=False):
        name = str(world)
        style = "--" if name in WITHOUT_RN[1:] else ":" if AUGMENTED in name else "-"
        color, _ = SHOWN[name.removesuffix(AUGMENTED)]
        held, line = curves.on_grid(mine, grid, window=1), {"ls": style, "lw": 1.6}
        figures.band(axis, grid, held, standard_errors, color, label=label(name), **line)
    axis.axhline(solved_reward, color="#7a7a7a", ls=":", lw=1)


def standard_errors(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the mean with its standard error, `[points]` each, of `[agent, points]`."""
    mean, error = values.mean(axis=0), values.std(axis=0) / np.sqrt(len(values))
    return mean - error, mean + error
