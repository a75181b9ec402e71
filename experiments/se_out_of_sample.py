"""Do stored one-step SEs teach agents that had no part in learning or choosing them?

Source of the design: paper, section "Performance of SE-trained Agents", figure "Densities based on
each 4000 cumulative test rewards" (40 SEs, ten agents on each, ten tests of each agent).

All SEs of `se_feasibility` train fresh agents of five kinds, solved or not. Beside them train
agents of the same kinds, with as many steps on a bandit that copies a controller of one line
(`experiments.null_baselines`), and on the real task with as many steps and with more. All have the
settings of `preset=best`, tuned on other seeds (docs/agents.md), or hyperparameters drawn around
them. An SE counts as solved where the mean return of its fresh agents reaches the threshold.
"""

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import pandas as pd

import sejax
from experiments.common import bandits, figures, tables
from experiments.common.agents import (
    DISCRETE,
    HPARAMS,
    Condition,
    Group,
    return_columns,
    train_groups,
    training_as_learned,
    tuned_agent,
)
from experiments.common.bandits import PolicyBandit
from experiments.common.experiment import Experiment, Settings, count, setting
from experiments.common.statistics import worst_tenth
from sejax import ProxySet, Task, TrainingConfig, envs
from sejax.options import each_of, one_of, require, seed

FOLDER = "results/se_feasibility"
FILES = {  # of SEs learned with one agent (fixed) and with drawn hyperparameters (varied)
    "cartpole": {
        "fixed": f"{FOLDER}/cartpole-one-step/ses.safetensors",
        "varied": f"{FOLDER}/cartpole-one-step-varied/ses.safetensors",
    },
    "acrobot": {"fixed": f"{FOLDER}/acrobot-one-step/ses.safetensors"},
}
MORE_STEPS = (5_000, 10_000, 20_000)  # on the real task; "as many" are 2,000
SHOWN = {
    "fixed": (figures.FIXED, "SEs, learned with one agent"),
    "varied": (figures.VARIED, "SEs, learned with drawn agents"),
    "hand": (figures.BEST, "bandit by hand"),
    "real": (figures.REAL, "real task, as many steps"),
    "real_more": (figures.TUNED, "real task, most steps"),
}
WHAT = {"hand": "tables", "real": "agents"}  # what an interval draws, where it is not SEs
TABLES, NUM_STATES, WIDEN = 10, 1024, 1.5  # bandits by hand, as those of null_baselines


@dataclass(frozen=True, kw_only=True)
class SeOutOfSample(Settings):
    name = "se_out_of_sample"

    env: str = setting("cartpole", one_of(tuple(FILES)))  # the task
    # File of SEs learned with one agent; where no file is given, those of se_feasibility.
    fixed: str | None = setting(None)
    varied: str | None = setting(None)  # file of SEs learned with drawn hyperparameters
    agents: tuple[str, ...] = setting(DISCRETE, each_of(DISCRETE), quick=("ddqn", "ppo"))  # kinds
    # Hyperparameters of the agents; varied: drawn for each.
    hparams: tuple[str, ...] = setting(HPARAMS, each_of(HPARAMS), quick=("default",))
    num_ses: int = count(40, quick=5)  # SEs of a set at most
    num_agents: int = count(10, quick=2)  # of each kind on each SE
    real_agents: int = count(100, quick=5)  # of each kind on the real task and on bandits by hand
    more_steps: tuple[int, ...] = setting(MORE_STEPS, quick=(3000,))  # on the real task
    test_episodes: int = count(10)  # of each agent
    # First seed of the agents; those of docs/agents.md, of the NES runs and of the shipped cards
    # are lower.
    seed: int = setting(1000, seed())

    @property
    def task(self) -> Task:
        """The real task."""
        return envs.make(self.env)


def compute(settings: SeOutOfSample) -> pd.DataFrame:
    """Trains what is missing; a row for each agent."""
    sets = load_sets(settings)
    tables = []
    for kind, hparams in itertools.product(settings.agents, settings.hparams):
        for condition, num_agents in conditions(settings, sets, kind, hparams):
            rows = train_groups(condition, settings, num_agents, at_once=len(condition.groups))
            own = {"trained_on": rows["group"].str.partition("-")[0]}
            own |= {"steps": condition.training.max_steps, "kind": kind, "hparams": hparams}
            tables.append(rows.assign(**own))
    return pd.concat(tables, ignore_index=True)


def load_sets(settings: SeOutOfSample) -> dict[str, ProxySet]:
    """All SEs of each set, by what they were learned with."""
    given = {name: file for name, file in settings.values("fixed", "varied").items() if file}
    sets: dict[str, ProxySet] = {}
    for name, file in (given or FILES[settings.env]).items():
        sets[name] = ses = sejax.load_set(file, option=name, kind="se")
        require(
            ses.task.name == settings.env,
            name,
            f"must be SEs of env={settings.env}; got those of {ses.task.name} in {ses.path}. "
            f"Set env={ses.task.name}.",
        )
        first = next(iter(sets.values()))
        require(
            all(ses.config[part] == first.config[part] for part in ("proxy", "training")),
            name,
            f"must be SEs of the same proxy and training as {first.path}, as one program trains "
            f"agents on all; got {ses.path}. Run it with another out.",
        )
    return {name: ses[: settings.num_ses] for name, ses in sets.items()}


def conditions(
    settings: SeOutOfSample, sets: Mapping[str, ProxySet], kind: str, hparams: str
) -> Iterator[tuple[Condition, int]]:
    """What agents of a kind are trained on, and how many in each group.

    The names of the groups begin with what is in the rows' column `trained_on`. Compiling is most
    of the cost of drawn hyperparameters: with them agents train on the real task once.
    """
    task, agent = settings.task, tuned_agent(settings.env, kind)
    first = next(iter(sets.values()))
    training = training_as_learned(first, agent, settings.test_episodes)
    common: dict[str, Any] = {"task": task, "agent": agent, "hparams": hparams}
    ses = tuple(
        Group(f"{name}-{i:02d}-{one[i].fingerprint}", one[i].params, one[i].fingerprint)
        for name, one in sets.items()
        for i in range(len(one))
    )
    proxy = {"proxy": first.config["proxy"]}
    on_ses: dict[str, Any] = {"env": first.env, "groups": ses, "settings": proxy}
    yield (
        Condition(name=f"se-{kind}-{hparams}", training=training, **on_ses, **common),
        settings.num_agents,
    )
    hand = by_hand(settings)
    yield (
        Condition(name=f"hand-{kind}-{hparams}", training=training, **hand, **common),
        settings.real_agents // len(hand["groups"]),
    )
    for steps in (training.max_steps, *(settings.more_steps if hparams == "default" else ())):
        real = TrainingConfig(
            max_steps=steps,
            max_episodes=steps or 0,
            stop_rule="never",
            time_limit_is_terminal=False,
            test_episodes=settings.test_episodes,
        )
        name = f"real-{kind}-{hparams}-{steps}"
        yield (
            Condition.real(names=["real"], name=name, training=real, **common),
            (settings.real_agents),
        )


def by_hand(settings: SeOutOfSample) -> dict[str, Any]:
    """Fields of the condition: bandits that copy a controller of one line, in different states."""
    env, groups = PolicyBandit(settings.task), []
    for own_seed in range(settings.seed, settings.seed + min(TABLES, settings.real_agents)):
        made = bandits.copy_by_hand(settings.task, own_seed, NUM_STATES, WIDEN)
        params = env.params({"states": made.states, "actions": made.actions})
        groups.append(Group(f"hand-{own_seed}", params))
    table = {"num_states": NUM_STATES, "widen": WIDEN}
    return {"env": env, "groups": tuple(groups), "settings": table}


def summarise(rows: pd.DataFrame, solved_reward: float) -> pd.DataFrame:
    """A row for each kind of agent, hyperparameters, and what they were trained on.

    Intervals are of the means of SEs or bandits, as agents of one have much in common, and of
    agents on the real task.
    """

    def statistics(mine: pd.DataFrame) -> dict[str, Any]:
        returns = mine["test_return"]
        is_real = mine["trained_on"].iloc[0] == "real"
        each = returns.groupby(mine["group"]).mean()
        return {
            "num_groups": 0 if is_real else len(each),
            "num_agents": len(mine),
            **tables.mean_columns(returns, "test_return", None if is_real else mine["group"]),
            "worst_tenth": worst_tenth(returns),
            "worst": returns.min(),
            "solved": (returns >= solved_reward).mean(),
            "groups_solved": 0 if is_real else int((each >= solved_reward).sum()),
        }

    return tables.summary_by(rows, ["kind", "hparams", "trained_on", "steps"], statistics)


def make_table(summary: pd.DataFrame) -> pd.DataFrame:
    """The summary as texts."""
    return tables.as_texts(
        summary,
        {
            "agent": lambda row: figures.AGENT_NAMES[row.kind],
            "hyperparameters": "{hparams}",
            "trained on": lambda row: SHOWN[row.trained_on][1].partition(", as many")[0],
            "steps": "{steps:,}",
            "agents": "{num_agents}",
            "return": tables.mean_text("test_return", 1),
            "interval over": lambda row: (
                f"{row.num_groups or row.num_agents} {WHAT.get(row.trained_on, 'SEs')}"
            ),
            "worst tenth": "{worst_tenth:.1f}",
            "agents solved": "{solved:.0%}",
            "SEs or tables solved": lambda row: (
                f"{row.groups_solved} of {row.num_groups}" if row.num_groups else ""
            ),
        },
    )


def report(settings: SeOutOfSample, rows: pd.DataFrame) -> pd.DataFrame:
    solved_reward = settings.task.solved_reward
    summary = summarise(rows, solved_reward)
    draw(settings, rows)
    note = (
        f"Mean return of fresh agents on {settings.env} over {settings.test_episodes} tests each. "
        f"{tables.interval_note('what the next column names')} Worst tenth: the mean of the lowest "
        f"tenth of the agents. An agent solves the task at {solved_reward:g}; an SE or a table is "
        "solved where the mean of its agents is. Agents have the settings of preset=best, tuned "
        "on the real task with other seeds, or drawn around them (varied). All SEs are tested, "
        "solved in learning or not. A bandit by hand is a table of "
        f"{NUM_STATES:,} states and what a controller of one line does in each."
    )
    title = f"Fresh agents on one-step SEs of {settings.env}"
    return tables.publish(settings, title, make_table(summary), summary, note)


def draw(settings: SeOutOfSample, rows: pd.DataFrame) -> None:
    """Draws densities of the test returns, a panel for each kind of agent, a line for each hparams.

    Source: paper, figure "Densities based on each 4000 cumulative test rewards".
    """
    returns = return_columns(rows)
    low, high = rows[returns].min(axis=None), rows[returns].max(axis=None)
    high = max(high, low + 1)
    kinds, hparams = rows["kind"].unique(), rows["hparams"].unique()
    size = (1.2 + 2.8 * len(kinds), 1.2 + 2.6 * len(hparams))
    path = settings.folder / "densities.png"
    with figures.panels(path, len(hparams), len(kinds), size, sharex=True, sharey=True) as (
        figure,
        axes,
    ):
        for line, drawn in zip(axes, hparams, strict=True):
            for axis, kind in zip(line, kinds, strict=True):
                mine = rows[(rows["kind"] == kind) & (rows["hparams"] == drawn)]
                figures.densities(axis, colored(mine, returns), low, high)
                axis.set_title(f"{figures.AGENT_NAMES[kind]}, {drawn}", fontsize=10)
            line[0].set_ylabel("density (log scale)")
        for axis in axes[-1]:
            axis.set_xlabel("return of a test")
        names = [name for name in SHOWN if name in {*rows["trained_on"], "real_more"}]
        handles = [figures.plt.Line2D([], [], color=SHOWN[name][0], lw=3) for name in names]
        labels = [SHOWN[name][1] for name in names]
        columns = min(len(names), max(len(kinds), 2))
        figure.legend(handles, labels, ncols=columns, loc="outside upper center")


def colored(rows: pd.DataFrame, returns: list[str]) -> list[tuple[str, Any]]:
    """Colour and test returns of each thing that agents of one kind were trained on."""
    found = []
    for name, mine in rows.groupby("trained_on", sort=False):
        least, most = mine["steps"].min(), mine["steps"].max()
        named = {str(name): least} | ({"real_more": most} if most > least else {})
        for label, steps in named.items():
            values = mine.loc[mine["steps"] == steps, returns].to_numpy(float).ravel()
            found.append((SHOWN[label][0], values))
    return found


EXPERIMENT = Experiment(settings=SeOutOfSample, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
