"""What agents reach that are trained on SEs, and how fast, against training on the real task.

Source: paper, section "Performance of SE-trained Agents" and "Transferability of SEs" (figure with
densities and bars for CartPole), appendix "Evaluation of Performance and Transferability of SEs on
the Acrobot Task"; `docs/reference.md` 7.1.

On each SE of a set `num_agents` agents are trained whose hyperparameters are drawn anew for each,
whatever the SEs were learned with; `varied` and `fixed` are sets from se_feasibility, learned with
`agent_hparams=varied` and without. SEs that did not reach the task's threshold are left out,
as in the authors' code, which stores no others. As many groups of agents are trained on the real
task, or `real_groups`.

The paper's agents were not tuned for few steps on the real task. With `tuned=true` agents that were
are trained there as well, with the fixed settings of `preset=best` (docs/agents.md) and targets
that go on at the time limit: what an SE saves is to be measured against these too.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import sejax
from experiments import figures, se_agents
from experiments.experiment import Experiment
from experiments.se_agents import SeAgents
from experiments.settings import count, setting
from experiments.tables import (
    as_texts,
    brackets,
    in_strata,
    iqm_columns,
    iqm_note,
    iqm_text,
    publish,
    spread,
)
from experiments.worlds import World, return_columns, tuned_agent
from sejax import envs
from sejax.errors import require
from sejax.options import one_of
from sejax.training import SOLVED_BY, TrainingConfig

NUM_BEST = 5
BEST_FOR = "td3_discrete"
ON_REAL = ("real", "tuned")
SHOWN = {
    "real": (figures.REAL, "real"),
    "tuned": (figures.TUNED, "real, tuned agent"),
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
class SePerformance(SeAgents):
    name = "se_performance"

    varied: str | None = setting(None, about="file of SEs learned with drawn hyperparameters")
    fixed: str | None = setting(
        None,
        about="file of SEs learned with one agent's; with quick=true "
        "and no file, the shipped cartpole SE",
    )
    env: str | None = setting(None, about="task, where no file is given; cartpole")
    tuned: bool = setting(
        True, quick=False, about="whether agents that were tuned for it train on the real task too"
    )
    real_groups: int | None = count(
        None,
        "groups",
        about="groups of agents on the real task, which takes longest; as many as SEs",
    )
    real_episodes: int | None = count(
        None,
        "episodes",
        quick=100,
        about="at most, on the real task; 1000 (500 for discrete TD3 in Acrobot)",
    )
    solved_by: str = setting(
        "train",
        one_of(SOLVED_BY),
        about="whose last returns end training on the real task; train, as in the paper's code",
    )


def compute(settings: SePerformance) -> pd.DataFrame:
    """Trains what is missing; a row for each agent."""
    sets = load_sets(settings)
    for name, ses in sets.items():
        print(f"{name}: {ses.size} SEs, {ses.solved().size} of which reached the threshold")
    task = envs.make(task_name(settings, sets))
    tables = []
    for kind in settings.agents:
        worlds = {"real": real_world(settings, task, sets, kind)}
        if settings.tuned:
            worlds["tuned"] = tuned_world(settings, worlds["real"], kind)
        worlds |= {name: se_agents.se_world(settings, ses, kind) for name, ses in sets.items()}
        tables += [
            se_agents.train(settings, world).assign(kind=kind, setting=name)
            for name, world in worlds.items()
        ]
    return pd.concat(tables, ignore_index=True)


def load_sets(settings: SePerformance) -> dict[str, Any]:
    """The sets of SEs that are compared, by how they were learned; those with a file."""
    given = {"varied": settings.varied, "fixed": settings.fixed}
    files = {name: file for name, file in given.items() if file is not None}
    if settings.quick and not files:
        files["fixed"] = settings.env or "cartpole"
    sets = {}
    for name, file in files.items():
        ses = sejax.load_set(file, option=name, kind="se")
        learned_with = "varied" if ses.config["agent_hparams"] == "varied" else "fixed"
        require(
            learned_with == name,
            name,
            f"be SEs learned with {name} hyperparameters",
            "it is what is compared",
            f"{ses.path} with {learned_with} ones",
            f"{learned_with}={ses.path}",
        )
        solved = ses.solved()
        sets[name] = (solved if solved.size else ses).first(settings.num_ses)
    return sets


def task_name(settings: SePerformance, sets: dict[str, Any]) -> str:
    """The one task of all sets."""
    asked = {settings.env} if settings.env else set()
    names = sorted({str(ses.task.name) for ses in sets.values()} | asked)
    require(
        len(names) <= 1,
        "varied, fixed and env",
        "be of one task",
        "agents are tested on it",
        ", ".join(names),
        "files of the same task",
    )
    return names[0] if names else "cartpole"


def real_world(settings: SePerformance, task: Any, sets: dict[str, Any], kind: str) -> World:
    """The real task for a number of groups of agents; training ends by the solved rule."""
    as_ses = max((ses.size for ses in sets.values()), default=settings.num_ses)
    count = settings.real_groups or as_ses
    # docs/reference.md 7.1: discrete TD3 trains 500 episodes on Acrobot, all others 1000.
    usual = 500 if task.name == "acrobot" and kind == "td3_discrete" else 1000
    training = TrainingConfig(
        max_episodes=settings.real_episodes or usual,
        stop_rule="solved",
        time_limit_is_terminal=True,
        max_steps=settings.max_steps,
        solved_by=settings.solved_by,
        test_episodes=settings.test_episodes,
    )
    return World.real(
        task,
        [f"real-{index:02d}" for index in range(count)],
        name=kind,
        agent=se_agents.agent_config(settings, kind),
        training=training,
        hparams="varied",
    )


def tuned_world(settings: SePerformance, real: World, kind: str) -> World:
    """The real task for agents of the settings that were found there, not drawn."""
    return dataclasses.replace(
        real,
        name=f"{kind}-tuned",
        hparams="default",
        agent=se_agents.agent_config(settings, kind)
        if settings.quick
        else tuned_agent(real.task.name, kind),
        training=dataclasses.replace(real.training, time_limit_is_terminal=False),
    )


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
    on_ses = agents[(agents["kind"] == BEST_FOR) & ~agents["setting"].isin(ON_REAL)]
    best = select_best(on_ses) if len(on_ses) else on_ses
    return pd.concat([agents, best.assign(setting="best")], ignore_index=True)


def summarise(agents: pd.DataFrame) -> pd.DataFrame:
    """Means, deviations and intervals for each kind of agent and setting.

    Deviations are over agents; intervals of means come from drawing SEs (groups) again, since
    agents of the same SE have much in common, or agents on the real task, where groups have
    nothing in common; of fewer than five there is none (nan). Those of interquartile means come
    from drawing agents within their SE.
    """
    rows = []
    for (kind, name), mine in agents.groupby(["kind", "setting"], sort=False):
        row = {
            "kind": kind,
            "setting": name,
            "num_ses": mine["group"].nunique(),
            "num_agents": len(mine),
            "num_nonfinite": int(mine["nonfinite"].sum()),
        }
        for column in ("train_steps", "train_episodes", "test_return"):
            of_ses = mine.groupby("group")[column].mean()
            row |= spread(mine[column], mine[column] if name in ON_REAL else of_ses, column)
        row |= iqm_columns(mine["test_return"], "test_return", strata(mine, str(name)))
        rows.append(row)
    return pd.DataFrame(rows)


def strata(agents: pd.DataFrame, name: str) -> pd.Series | None:
    """Labels of the SEs that agents are drawn within; groups on the real task share it."""
    return None if name in ON_REAL else agents["group"]


def make_table(env_name: str, summary: pd.DataFrame) -> pd.DataFrame:
    """The summary as texts, with the paper's numbers."""
    steps = {
        name: summary[summary["setting"] == name].set_index("kind")["train_steps_mean"]
        for name in ON_REAL
    }

    def measured(row: Any, column: str, digits: int) -> str:
        mean, std, low, high = (
            getattr(row, f"{column}_{x}") for x in ("mean", "std", "low", "high")
        )
        return f"{mean:,.{digits}f} ± {std:,.{digits}f}{brackets(low, high, digits)}"

    def fewer(row: Any, than: str) -> str:
        if row.setting in ON_REAL[: ON_REAL.index(than) + 1] or row.kind not in steps[than]:
            return ""
        return f"{1 - row.train_steps_mean / steps[than][row.kind]:.0%}"

    return as_texts(
        summary,
        {
            "agent": "{kind}",
            "trained on": lambda row: SHOWN[row.setting][1],
            "SEs, agents": "{num_ses}, {num_agents}",
            "training steps": lambda row: measured(row, "train_steps", 0),
            "paper's": lambda row: PAPER_STEPS.get((env_name, row.kind), {}).get(row.setting, ""),
            "fewer": lambda row: fewer(row, "real"),
            **({"than tuned": lambda row: fewer(row, "tuned")} if has_tuned(summary) else {}),
            "episodes": lambda row: measured(row, "train_episodes", 1),
            "return": lambda row: measured(row, "test_return", 1),
            "IQM": iqm_text("test_return"),
            "paper's return": lambda row: PAPER_RETURNS.get((env_name, row.kind), {}).get(
                row.setting, ""
            ),
        },
    )


AND_TUNED = ", and against agents there with fixed settings that were tuned for it"


def has_tuned(rows: pd.DataFrame) -> bool:
    return bool((rows["setting"] == "tuned").any())


def report(settings: SePerformance, rows: pd.DataFrame) -> pd.DataFrame:
    task = envs.make(task_name(settings, load_sets(settings)))
    agents = with_best(rows)
    summary = summarise(agents)
    draw(task, agents, settings.folder / "performance.png")
    draw_profiles(task, agents, settings.folder / "profiles.png")
    note = (
        f"Mean ± std over agents with drawn hyperparameters, {len(return_columns(rows))} test "
        "episodes each; in brackets a bootstrap 95% interval, for at least five SEs: it draws SEs, "
        'and agents on the real task. "Fewer" '
        "are training steps saved against the real task, for which a group of agents takes the "
        f"place of an SE{AND_TUNED if has_tuned(summary) else ''}. "
        f"The best SEs of all sets, {NUM_BEST} at most, are chosen by half of "
        "their agents and shown by the other half. SEs are those of a set that reached the "
        "threshold, all where none did. The paper has 40 SEs with 10 agents each; where a field is "
        "empty it gives no number here, but for DDQN in CartPole a mean return on SEs of 190.7, in "
        "another section. "
        f"Agents that met a number that is not finite: {int(rows['nonfinite'].sum())}."
        f"{iqm_note('within each SE')}"
    )
    title = f"Agents trained on SEs and tested on {task.name} (solved at {task.solved_reward:g})"
    return publish(settings, title, make_table(task.name, summary), summary, note)


def draw(task: Any, agents: pd.DataFrame, path: Any) -> None:
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
            top.set(
                title=figures.AGENT_NAMES.get(kind, kind),
                xlabel=f"return of a test episode on {task.name}",
            )
            below = [f"{values.mean():.1f}" for _, values in met]
            for axis, name in zip(lower, ("train_steps", "train_episodes"), strict=True):
                figures.bars(axis, colored(mine, name), below)
                axis.set_xlabel("mean return")
        for axis, label in zip(axes[:, 0], labels, strict=True):
            axis.set_ylabel(label)
        longest = max((mine["setting"].unique() for mine in kinds.values()), key=len)
        handles = [plt.Line2D([], [], color=SHOWN[name][0], lw=3) for name in longest]
        # Side by side the labels are as wide as two columns.
        figure.legend(
            handles,
            [f"train: {SHOWN[name][1]}" for name in longest],
            ncols=len(longest) if len(kinds) > 1 else 1,
            loc="outside upper center",
        )


def draw_profiles(task: Any, agents: pd.DataFrame, path: Any) -> None:
    """Draws performance profiles of the agents' mean test returns, a panel for each kind."""
    kinds = list(agents.groupby("kind", sort=False))
    low, high = agents["test_return"].min(), agents["test_return"].max()
    size = (1.2 + 3.6 * len(kinds), 3.6)
    with figures.panels(path, 1, len(kinds), size, sharey=True) as (figure, axes):
        for axis, (kind, of_kind) in zip(axes[0], kinds, strict=True):
            for name, mine in of_kind.groupby("setting", sort=False):
                color, label = SHOWN[str(name)]
                runs = in_strata(mine["test_return"], strata(mine, str(name)))
                figures.profile(axis, runs, low, high, color, f"train: {label}")
            axis.axvline(task.solved_reward, color=figures.SOLVED, ls="--", lw=1.1)
            axis.set(
                title=figures.AGENT_NAMES.get(str(kind), kind),
                xlabel=f"return of an agent on {task.name}",
            )
        axes[0, 0].set_ylabel("share of agents with more")
        figures.legend_above(figure, max(axes[0], key=lambda axis: len(axis.lines)), 2)


def colored(agents: pd.DataFrame, names: str | list[str]) -> list[tuple[str, np.ndarray]]:
    """Colour and values of these columns for each setting."""
    return [
        (SHOWN[str(setting)][0], mine[names].to_numpy(float).ravel())
        for setting, mine in agents.groupby("setting", sort=False)
    ]


EXPERIMENT = Experiment(settings=SePerformance, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
