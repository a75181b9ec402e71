"""What agents reach that are trained on SEs, and how fast, against training on the real task.

Source: paper, section "Performance of SE-trained Agents" and "Transferability of SEs" (figure with
densities and bars for CartPole), appendix "Evaluation of Performance and Transferability of SEs on
the Acrobot Task"; `docs/reference.md` 7.1.

On each SE of a set `num_agents` agents are trained whose hyperparameters are drawn anew for each,
whatever the SEs were learned with; `varied` and `fixed` are sets from se_feasibility, learned with
`agent_hparams=varied` and without. SEs that did not reach the task's threshold are left out,
as in the authors' code, which stores no others. As many groups of agents are trained on the real
task, or `real_groups`. These agents were not tuned for few steps there: those that were are in
`experiments.break_even`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import sejax
from experiments.common import agents as groups
from experiments.common import figures, tables
from experiments.common.agents import SE_AGENTS, Condition, return_columns
from experiments.common.experiment import Experiment, Settings, setting
from experiments.common.statistics import worst_tenth
from sejax import ProxySet, Task, TrainingConfig, envs
from sejax.ops.scores import reaches
from sejax.options import Count, require, shortened

NUM_BEST = 5
BEST_FOR = "td3_discrete"
SHOWN = {
    "real": (figures.REAL, "real"),
    "varied": (figures.VARIED, "synth., HPs varied"),
    "fixed": (figures.FIXED, "synth., HPs fixed"),
    "best": (figures.BEST, "synth., best SEs"),
}

# Training steps, "mean ± std", in CartPole: docs/reference.md 7.1, the values in the scripts of
# the authors' bar plot; best: the same and paper, section "Transferability of SEs", which also has
# the returns of TD3. Acrobot: paper, the same section.
PAPER_STEPS = {
    ("cartpole", "ddqn"): {
        "real": "16887.7 ± 24925",
        "varied": "6818.6 ± 2339.5",
        "fixed": "6379.5 ± 3163",
    },
    ("cartpole", "dueling_ddqn"): {"real": "12745.3", "varied": "6781.0", "fixed": "6502.5"},
    ("cartpole", "td3_discrete"): {
        "real": "17874.9",
        "varied": "5832.1",
        "fixed": "5371.0",
        "best": "6287.5",
    },
    ("acrobot", "dueling_ddqn"): {"real": "29531", "varied": "18376"},
    ("acrobot", "td3_discrete"): {"real": "80837", "best": "14408"},
}
PAPER_RETURNS = {
    ("cartpole", "td3_discrete"): {"real": "152", "best": "187"},
    ("acrobot", "dueling_ddqn"): {"varied": "-111"},
    ("acrobot", "td3_discrete"): {"best": "-343"},
}


@dataclass(frozen=True, kw_only=True)
class SePerformance(Settings):
    """Settings of this experiment.

    Attributes:
      agents: kinds of agents
      num_agents: for each SE
      num_ses: SEs of a set at most
      test_episodes: of each agent
      max_steps: of training; as the SEs' configuration says
      varied: file of SEs learned with drawn hyperparameters
      fixed: file of SEs learned with one agent's
      real_groups: Groups of agents on the real task, which is slow; as many as SEs.
      real_episodes: On the real task; 1000 (discrete TD3 in Acrobot 500).
    """

    name = "se_performance"

    agents: tuple[str, ...] = setting(SE_AGENTS, SE_AGENTS)
    num_agents: Count = setting(10, quick=4)
    num_ses: Count = setting(40, quick=3)
    test_episodes: Count = setting(10)
    max_steps: Count | None = setting(None, quick=4000)
    varied: str | None = setting(None)
    fixed: str | None = setting(None, quick="cartpole")
    real_groups: Count | None = setting(None)
    real_episodes: Count | None = setting(None, quick=100)


def compute(settings: SePerformance) -> pd.DataFrame:
    """Trains what is missing; a row for each agent."""
    sets = load_sets(settings)
    for name, ses in sets.items():
        print(f"{name}: {len(ses)} SEs, {len(solved_ones(ses))} of which reached the threshold")
    task = envs.make(task_name(sets))
    parts = []
    for kind in settings.agents:
        conditions = {"real": on_real(settings, task, sets, kind)}
        conditions |= {name: on_ses(settings, ses, kind) for name, ses in sets.items()}
        for name, condition in conditions.items():
            rows = groups.train_groups(condition, settings, settings.num_agents)
            parts.append(rows.assign(kind=kind, setting=name))
    return pd.concat(parts, ignore_index=True)


def solved_ones(ses: ProxySet) -> Any:
    """The SEs whose score, a mean return, reached the task's threshold."""
    return ses[reaches(ses.scores, ses.task.solved_reward)]


def load_sets(settings: SePerformance) -> dict[str, Any]:
    """The sets of SEs that are compared, by how they were learned; those with a file."""
    files = {name: x for name, x in settings.values("varied", "fixed").items() if x is not None}
    sets = {}
    for name, file in files.items():
        ses = sejax.load_set(file, option=name, kind="se")
        learned_with = "varied" if ses.config["agent_hparams"] == "varied" else "fixed"
        got = f"{shortened(ses.path)} with {learned_with} ones"
        must = f"must be SEs learned with {name} hyperparameters; got {got}"
        fix = f"Set {learned_with}={shortened(ses.path)}."
        require(learned_with == name, name, must, fix=fix)
        solved = solved_ones(ses)
        sets[name] = (solved if len(solved) else ses)[: settings.num_ses]
    return sets


def task_name(sets: dict[str, Any]) -> str:
    """The one task of all sets; without one CartPole."""
    names = sorted({str(ses.task.name) for ses in sets.values()})
    must = "must be SEs of the same task as varied"
    require(len(names) <= 1, "fixed", must, got=", ".join(names), use="FILE")
    return names[0] if names else "cartpole"


def on_ses(settings: SePerformance, ses: ProxySet, kind: str) -> Condition:
    """The SEs of a set; agents train as long as those that the SEs were learned with."""
    agent = groups.paper_agent(kind)
    training = groups.training_as_learned(ses, agent, settings.test_episodes, settings.max_steps)
    # The weights' hash is in the name, so that sets can share a folder.
    names = [f"se-{seed:02d}-{ses[i].fingerprint}" for i, seed in enumerate(ses.seeds)]
    return Condition.of_set(ses, names, name=kind, agent=agent, training=training, hparams="varied")


def on_real(settings: SePerformance, task: Task, sets: dict[str, Any], kind: str) -> Condition:
    """The real task for a number of groups of agents; training ends by the solved rule."""
    as_ses = max((len(ses) for ses in sets.values()), default=settings.num_ses)
    # docs/reference.md 7.1: discrete TD3 trains 500 episodes on Acrobot, all others 1000.
    most = 500 if task.name == "acrobot" and kind == "td3_discrete" else 1000
    training = TrainingConfig(
        max_episodes=settings.real_episodes or most,
        stop_rule="solved",
        time_limit_is_terminal=True,
        max_steps=settings.max_steps,
        solved_by="train",  # as in the paper's code
        test_episodes=settings.test_episodes,
    )
    names = [f"real-{index:02d}" for index in range(settings.real_groups or as_ses)]
    agent = groups.paper_agent(kind)
    return Condition.real(task, names, name=kind, agent=agent, training=training, hparams="varied")


def select_best(agents: pd.DataFrame, count: int = NUM_BEST) -> pd.DataFrame:
    """Agents of the best SEs, of one kind, that had no part in selecting them.

    SEs are ranked by the mean return of their agents of even number; the others are returned. On
    the same agents the best SEs would look better than they are. One SE at least is left out.

    Source: paper, section "Transferability of SEs", the five models for TD3.
    """
    judges = agents[agents["agent"] % 2 == 0]
    ranked = judges.groupby("group")["test_return"].mean().sort_values(ascending=False)
    chosen = ranked.index[: min(count, len(ranked) - 1)]
    return agents[agents["group"].isin(chosen) & (agents["agent"] % 2 == 1)]


def with_best(agents: pd.DataFrame) -> pd.DataFrame:
    """Adds the best SEs of all sets for discrete TD3 as a setting, where there are several SEs."""
    on_ses = agents[(agents["kind"] == BEST_FOR) & (agents["setting"] != "real")]
    best = select_best(on_ses) if len(on_ses) else on_ses
    return pd.concat([agents, best.assign(setting="best")], ignore_index=True)


def summarise(agents: pd.DataFrame, solved_reward: float) -> pd.DataFrame:
    """Means, deviations and intervals for each kind of agent and setting.

    Deviations are over agents; intervals of means are of the means of SEs (groups), since agents of
    the same SE have much in common, or of agents on the real task, where groups have nothing in
    common; of fewer than five there is none (nan).
    """

    def statistics(mine: pd.DataFrame) -> dict[str, float]:
        is_real = mine["setting"].iloc[0] == "real"
        ses = None if is_real else mine["group"]
        row = {"num_ses": mine["group"].nunique(), "num_agents": len(mine)}
        row |= {"num_nonfinite": int(mine["nonfinite"].sum())}
        for column in ("train_steps", "train_episodes", "test_return"):
            row |= tables.mean_columns(mine[column], column, ses)
        returns = mine["test_return"]
        row |= {"solved": reaches(returns, solved_reward).mean()}
        return row | {"test_return_worst_tenth": worst_tenth(returns)}

    return tables.summary_by(agents, ["kind", "setting"], statistics)


def make_table(env_name: str, summary: pd.DataFrame, most: int) -> pd.DataFrame:
    """The summary as texts, with the paper's numbers; agents on the task have `most` episodes."""
    steps = summary[summary["setting"] == "real"].set_index("kind")["train_steps_mean"]

    def fewer(row: Any) -> str:
        if row.setting == "real" or row.kind not in steps:
            return ""
        return f"{1 - row.train_steps_mean / steps[row.kind]:.0%}"

    def paper(numbers: Mapping[Any, Mapping[str, str]]) -> Callable[[Any], str]:
        return lambda row: numbers.get((env_name, row.kind), {}).get(row.setting, "")

    columns: dict[str, Any] = {
        "agent": "{kind}",
        "trained on": lambda row: SHOWN[row.setting][1],
        "SEs, agents": "{num_ses}, {num_agents}",
        "interval over": lambda row: tables.drawn_text(
            *((row.num_agents, "agents") if row.setting == "real" else (row.num_ses, "SEs"))
        ),
        f"training steps, restricted to {most:,} episodes": tables.mean_text(
            "train_steps", 0, std=True
        ),
        "paper's": paper(PAPER_STEPS),
        "fewer": fewer,
        "episodes": tables.mean_text("train_episodes", 1, std=True),
        "return": tables.mean_text("test_return", 1, std=True),
        "worst tenth": "{test_return_worst_tenth:.1f}",
        "solved": "{solved:.0%}",
        "paper's return": paper(PAPER_RETURNS),
    }
    return tables.as_texts(summary, columns)


def report(settings: SePerformance, rows: pd.DataFrame) -> pd.DataFrame:
    task = envs.make(task_name(load_sets(settings)))
    agents = with_best(rows)
    summary = summarise(agents, task.solved_reward)
    draw(task, agents, settings.folder / "performance.png")
    note = (
        f"Mean ± std over agents with random hyperparameters, {len(return_columns(rows))} test "
        f"episodes each. {tables.interval_note('what its column names')} "
        '"Fewer" are training steps saved against the real task. '
        f"The best SEs of all sets, {NUM_BEST} at most, are chosen by half of their agents and "
        "shown by the other half. The paper has 40 SEs with 10 agents each. Agents that met a "
        f"number that is not finite: {int(rows['nonfinite'].sum())}.{tables.WORST_NOTE}"
    )
    title = f"Agents trained on SEs and tested on {task.name} (solved at {task.solved_reward:g})"
    table = make_table(task.name, summary, settings.real_episodes or 1000)
    return tables.publish(settings, title, table, summary, note)


def draw(task: Task, agents: pd.DataFrame, path: Path) -> None:
    """Draws densities of the test returns above and bars of steps and episodes below.

    Source: paper, figures "Densities based on each 4000 cumulative test rewards".
    """
    kinds = {str(kind): mine for kind, mine in agents.groupby("kind", sort=False)}
    returns = return_columns(agents)
    low = agents[returns].min(axis=None)
    high = max(low + 1, agents[returns].max(axis=None))
    labels = ("density (log scale)", "training steps", "training episodes")
    size = (1.2 + 3.6 * len(kinds), 8)
    with figures.panels(path, 3, len(kinds), size, height_ratios=(1.5, 1, 1)) as (figure, axes):
        for (kind, mine), (top, *lower) in zip(kinds.items(), axes.T, strict=True):
            met = colored(mine, returns)
            figures.densities(top, met, low, high)
            title, label = figures.agent_name(kind), "return of a test episode on"
            top.set(title=title, xlabel=f"{label} {task.name}")
            below = [f"{values.mean():.1f}" for _, values in met]
            for axis, name in zip(lower, ("train_steps", "train_episodes"), strict=True):
                figures.bars(axis, colored(mine, name), below)
                axis.set_xlabel("mean return")
        for axis, label in zip(axes[:, 0], labels, strict=True):
            axis.set_ylabel(label)
        longest = max((mine["setting"].unique() for mine in kinds.values()), key=len)
        handles = [plt.Line2D([], [], color=SHOWN[name][0], lw=3) for name in longest]
        texts = [f"train: {SHOWN[name][1]}" for name in longest]
        columns = len(longest) if len(kinds) > 1 else 1  # labels are as wide as two panels
        figure.legend(handles, texts, ncols=columns, loc="outside upper center")


def colored(agents: pd.DataFrame, names: str | list[str]) -> list[tuple[str, np.ndarray]]:
    """Colour and values of these columns for each setting."""
    return [
        (SHOWN[str(setting)][0], mine[names].to_numpy(float).ravel())
        for setting, mine in agents.groupby("setting", sort=False)
    ]


EXPERIMENT = Experiment(settings=SePerformance, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
