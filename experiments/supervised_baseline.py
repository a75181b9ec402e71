"""Do models fitted to real transitions train agents as SEs do: the supervised baseline.

Source: paper, appendix "Supervised Learning and Synthetic Environments", subsection "Comparing
Supervised Learning with Synthetic Environments on CartPole"; `docs/reference.md` 7.5.

1. `models` NES runs, with the settings that the SE was learned with and `population` members.
   All real test episodes of their agents, those of members and of incumbents, are recorded, and
   `max_rows` transitions of each run are drawn from them.
2. A model with the SE's architecture is fitted to each run's transitions: Adam on the mean squared
   error of [s', r]. In the authors' code nobody fitted the network for the end of an episode; it
   kept its random weights. Here it is fitted too (mean squared error, 1 where the episode
   terminated, else 0). The three networks share nothing, so that one fit gives both models:
   `as the authors` has the random weights of that network, `fair` the fitted ones and ends an
   episode, and its return, where they say so.
3. On each model, and on the SE, agents are trained and tested on the real task.

Differs: the paper fits to all transitions of a run and not to a part of them. Its agents stop by
the plateau rule; here they train as long as those that the SE was learned with. That may be too
short for any agent on the real task itself: `max_steps` gives those on the models more time.
"""

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import sejax
from experiments.common import agents as groups
from experiments.common import figures, supervised_models, tables
from experiments.common.agents import HPARAMS, SE_AGENTS, SOFT_SE, Condition, return_columns
from experiments.common.experiment import Experiment
from experiments.common.shards import stack, unstack
from experiments.common.statistics import worst_tenth
from experiments.common.supervised_models import SupervisedBaseline
from sejax import ProxySet, Task
from sejax.options import require, shortened

BEST = 2  # models in the paper's second figure
LABELS = {
    "authors": "model, as the authors",
    "authors_best": f"model, as the authors, best {BEST}",
    "fair": "model, fair",
    "se": "SE",
}
# Paper, the same subsection, "Result": mean test returns of DDQN agents with drawn hyperparameters.
PAPER = {
    ("authors", "ddqn", "varied"): "15.01",
    ("authors_best", "ddqn", "varied"): "17.73",
    ("se", "ddqn", "varied"): "190.7",
}
DRAWN = {"varied": "drawn"}  # what tables and pictures call it


def compute(settings: SupervisedBaseline) -> pd.DataFrame:
    """Computes what is missing: tables of the agents, of the fits and of the transitions."""
    ses = load(settings)
    data = supervised_models.collect_all(settings, ses)
    fits = supervised_models.fit_shard(settings, ses, data)
    parts = []
    for kind, hparams in itertools.product(settings.agents, settings.hparams):
        for name, condition in make_conditions(settings, ses, kind, hparams).items():
            rows = groups.train_groups(condition, settings, settings.num_agents)
            parts.append(rows.assign(world=name, kind=kind, hparams=hparams))
    transitions = supervised_models.summary_of(data)
    return stack({"agents": pd.concat(parts), "fits": fits, "transitions": transitions})


def load(settings: SupervisedBaseline) -> ProxySet:
    """The SE, if agents can be trained on it, and the tests of its NES run recorded."""
    ses = sejax.load_set(settings.proxy, option="proxy", kind="se")[:1]

    agent = ses.config["agent"] or {"name": "several agents"}
    is_discrete = ses.task.num_states is None and ses.task.num_actions is not None
    is_recorded = agent["name"] in SE_AGENTS and agent.get("action_repeat", 1) == 1
    for holds, rule, got in (
        (is_discrete, "with vector states and discrete actions", ses.task.name),
        (ses.env.config.horizon != 1, "whose episodes have several steps", "a bandit"),
        (is_recorded, f"learned with {', '.join(SE_AGENTS)}, no action repeat", agent["name"]),
    ):
        message = f"must be an SE {rule}; got one of {shortened(got)}. Set proxy={SOFT_SE}."
        require(holds, "proxy", message)
    return ses


def make_conditions(settings: Any, ses: ProxySet, kind: str, hparams: str) -> dict[str, Condition]:
    """The models of both variants and the SE, with as many agents on the SE as on all models."""
    sets = {
        name: sejax.load_set(supervised_models.model_file(settings, name), option="out")
        for name in ("authors", "fair")
    }
    agent = groups.agent_config(settings, kind)
    made = {}
    for name, proxies in (sets | {"se": ses}).items():
        training = groups.training_as_learned(proxies, agent, settings.test_episodes)
        own = settings.max_steps if name != "se" else None
        max_steps = own or (groups.QUICK_STEPS if settings.quick else training.max_steps)
        made[name] = Condition.of_set(
            proxies,
            map(str, range(settings.models)),
            name=f"{kind}-{hparams}-{name}",
            agent=agent,
            training=dataclasses.replace(training, max_steps=max_steps),
            hparams=hparams,
        )
    return made


def with_best(agents: pd.DataFrame, quality_of_models: list[float]) -> pd.DataFrame:
    """Adds the models whose transitions come from the best episodes as a world of its own.

    Differs: the paper takes two models most of whose samples come from episodes with a return of
    190 at least; here it is the mean return, which ranks models of any task.
    """
    if len(quality_of_models) <= BEST:
        return agents
    best = np.argsort(quality_of_models)[-BEST:]
    chosen = agents[(agents["world"] == "authors") & agents["group"].isin(best)]
    return pd.concat([agents, chosen.assign(world="authors_best")], ignore_index=True)


def summarise(agents: pd.DataFrame, solved_reward: float) -> pd.DataFrame:
    """Means over test episodes for each kind of agent, hyperparameters and world.

    Intervals come from drawing models again, as agents of one model have much in common. All groups
    of the SE share it: their intervals are those of drawing agents.
    """

    def statistics(mine: pd.DataFrame) -> dict[str, float]:
        returns = mine["test_return"]
        model = None if mine["world"].iloc[0] == "se" else mine["group"]
        return (
            {"num_agents": len(mine)}
            | tables.mean_columns(returns, "return", model)
            | {"return_std": mine[return_columns(mine)].to_numpy().std()}
            | {"return_worst_tenth": worst_tenth(returns)}
            | {"solved": (returns >= solved_reward).mean()}
            | dict(mine[["train_steps", "train_episodes"]].mean())
            | {"num_nonfinite": int(mine["nonfinite"].sum())}
        )

    by, order = ["kind", "hparams", "world"], [*SE_AGENTS, *HPARAMS, *LABELS]
    summary = tables.summary_by(agents, by, statistics)
    return summary.sort_values(by, key=lambda x: x.map(order.index), ignore_index=True)


def make_table(summary: pd.DataFrame) -> pd.DataFrame:
    """The summary as texts, with the paper's numbers."""
    return tables.as_texts(
        summary,
        {
            "agent": "{kind}",
            "hyperparameters": lambda row: DRAWN.get(row.hparams, row.hparams),
            "trained on": lambda row: LABELS[row.world],
            "agents": "{num_agents}",
            "return": tables.mean_text("return", 1, std=True),
            "worst tenth": "{return_worst_tenth:.1f}",
            "paper's": lambda row: PAPER.get((row.world, row.kind, row.hparams), ""),
            "solved": "{solved:.0%}",
            "training steps": "{train_steps:,.0f}",
            "episodes": "{train_episodes:.1f}",
        },
    )


def report(settings: SupervisedBaseline, rows: pd.DataFrame) -> pd.DataFrame:
    task = load(settings).task
    made, fits, data = (unstack(rows, name) for name in ("agents", "fits", "transitions"))
    agents = with_best(made, data["episode_return"].tolist())
    summary = summarise(agents, task.solved_reward)
    draw(task, agents, settings.folder / "supervised_baseline.png")
    last = fits[fits["epoch"] == fits["epoch"].max()].mean()
    note = (
        f"Mean ± std over test episodes. {tables.interval_note('models, for the SE over agents')} "
        f"Solved: agents with a mean return of {task.solved_reward:g} at least. "
        f"{len(data)} models, each fitted for {fits['epoch'].max() + 1:.0f} epochs to "
        f"{data['transitions'].min():,.0f} transitions of one NES run, from episodes with a mean "
        f"return of {data['episode_return'].mean():.1f}; {data['ends'].mean():.2%} end an episode. "
        f"Mean squared error {last['error']:.2g} of [s', r] (paper: 5e-07), "
        f"{last['done_error']:.2g} of the end. The best models are those of the runs with the best "
        f"episodes. Agents that met a number that is not finite: {diverged_text(agents)}."
        f"{tables.WORST_NOTE}"
    )
    title = f"Agents trained on supervised models of {task.name} and on an SE"
    return tables.publish(settings, title, make_table(summary), summary, note)


def diverged_text(agents: pd.DataFrame) -> str:
    """How many agents diverged, world by world; the best models' are among the authors'."""
    own = agents[agents["world"] != "authors_best"]
    counts = own.groupby("world", sort=False)["nonfinite"].sum()
    texts = [
        f"{int(count)} of {(own['world'] == world).sum()} ({LABELS[str(world)]})"
        for world, count in counts.items()
        if count
    ]
    return ", ".join(texts) or "none"


def draw(task: Task, agents: pd.DataFrame, path: Path) -> None:
    """Draws histograms of the test returns, a panel for each agent and choice of hyperparameters.

    Source: paper, figure "Comparing the cumulative test reward densities", top.
    """
    colors = {"authors": figures.SOLVED, "fair": figures.VARIED, "se": figures.REAL}
    returns = agents[return_columns(agents)].to_numpy()
    edges = np.linspace(returns.min(), max(returns.max(), returns.min() + 1), 41)
    panels = list(agents.groupby(["kind", "hparams"], sort=False))
    num_episodes = max((mine["world"] == "se").sum() for _, mine in panels) * returns.shape[1]
    size = (1 + 4 * len(panels), 3.6)
    with figures.panels(path, 1, len(panels), size, sharey=True) as (figure, axes):
        for axis, ((kind, hparams), mine) in zip(axes[0], panels, strict=True):
            for name, color in colors.items():
                met = mine[mine["world"] == name][return_columns(agents)].to_numpy().ravel()
                how = {"bins": edges, "color": color, "weights": np.full(met.size, 1 / met.size)}
                figures.histogram(axis, met, 0.2, 1.4, f"{LABELS[name]} (dashed: mean)", **how)
                axis.axvline(met.mean(), color=color, ls="--", lw=1.2)
            agent = figures.AGENT_NAMES.get(kind, kind)
            axis.set_title(f"{agent}, {DRAWN.get(hparams, hparams)} hyperparameters")
            axis.set_xlabel(f"return of a test episode on {task.name}")
            axis.set_ylim(0.5 / num_episodes, 1.1)
        axes[0, 0].set_ylabel("share of test episodes")
        figures.legend_above(figure, axes[0, 0], 3, fontsize=None)


EXPERIMENT = Experiment(settings=SupervisedBaseline, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
