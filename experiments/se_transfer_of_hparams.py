"""Is a proxy good for tuning: do the hyperparameters that are best on it suit the real task?

Configurations are drawn from the ranges of `agent_hparams=varied`. Agents with each of them, of
several seeds, train on the SE and on the real task, there for as many steps as on the SE (`same`)
and until the stop rule of the paper (`long`), and all are tested on the real task. What is asked is
how the mean returns of the configurations agree in rank, and what somebody loses who tunes on the
SE and then trains on the real task.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
import pandas as pd
from scipy.stats import rankdata

import sejax
from experiments.common import agents, figures
from experiments.common.agents import Condition, Group, Measure
from experiments.common.experiment import Experiment, Settings, count, setting
from experiments.common.statistics import NUM_RESAMPLES, bca_interval
from experiments.common.tables import as_texts, publish, with_interval
from sejax import ProxySet, Task
from sejax.options import each_of, require
from sejax.training import TrainingConfig

BUDGETS = {"same": "as many steps", "long": "until the stop rule"}
QUICK_AGENT = {"hidden_size": 8, "batch_size": 16, "num_layers": 1, "warmup_episodes": 1}


@dataclass(frozen=True, kw_only=True)
class SeTransferOfHparams(Settings):
    name = "se_transfer_of_hparams"

    env: str = setting("cartpole")  # task: cartpole, acrobot, ...
    ses: str | None = setting(
        None
    )  # SE, or a set of which the best is taken; the task's shipped one
    agent: str = setting("ddqn")  # that is tuned, with draws around the preset's settings
    preset: str = setting("best")  # of the agent
    run: tuple[str, ...] = setting(())  # overrides of the agent, as run.agent.discount=0.9
    num_configs: int = count(64, quick=16)  # that are drawn
    num_agents: int = count(4, least=2)  # seeds of each; half of them are judges
    test_episodes: int = count(10)  # of each agent
    # On the real task: same, long.
    budgets: tuple[str, ...] = setting(tuple(BUDGETS), each_of(BUDGETS), quick=("same",))
    max_steps: int | None = count(None, quick=1000)  # of an agent on the SE; as it was learned
    real_episodes: int = count(1000)  # of budget long, at most
    real_steps: int | None = count(100_000)  # of budget long, at most


@dataclass(frozen=True, kw_only=True)
class Parts:
    """What is trained where."""

    ses: ProxySet  # `ProxySet` of one
    agent: Any  # configuration
    trainings: dict[str, TrainingConfig]  # by world: se, and the budgets on the real task


def parts_of(settings: SeTransferOfHparams) -> Parts:
    """Reads the SE and configures agents and trainings."""
    ses = sejax.load_set(settings.ses or settings.env, option="ses", kind="se").ranked(1)
    there = ses.task.name
    require(
        there == settings.env,
        "ses",
        f"must be of {settings.env}; got one of {there}. Set env={there}.",
    )
    words = [f"env={settings.env}", f"preset={settings.preset}", f"agent={settings.agent}"]
    if settings.quick:
        words += [f"agent.{name}={value}" for name, value in QUICK_AGENT.items()]
    config = sejax.config([*words, *settings.run])
    learned = agents.training_as_learned(ses, config.agent, settings.test_episodes)
    on_se = dataclasses.replace(
        learned,
        max_steps=settings.max_steps or learned.max_steps,
        max_episodes=max(learned.max_episodes, settings.max_steps or 0),
    )
    require(
        on_se.max_steps is not None,
        "max_steps",
        "must be given with an SE whose agents a rule stopped; got null. Set max_steps=5000.",
    )
    real = TrainingConfig(
        stop_rule="never",
        max_steps=on_se.max_steps,
        max_episodes=100_000,
        test_episodes=settings.test_episodes,
    )
    long = dataclasses.replace(
        real,
        stop_rule="solved",
        solved_by="train",
        max_episodes=settings.real_episodes,
        max_steps=settings.real_steps,
    )
    budgets = {name: {"same": real, "long": long}[name] for name in settings.budgets}
    return Parts(ses=ses, agent=config.agent, trainings={"se": on_se} | budgets)


def compute(settings: SeTransferOfHparams) -> pd.DataFrame:
    """Trains what is missing; a row for each agent, with what its configuration has drawn."""
    parts = parts_of(settings)
    ses, task = parts.ses, parts.ses.task
    key, at_once = jax.random.key(settings.seed), agents.groups_at_once(settings.devices)
    keys = [jax.random.key_data(jax.random.fold_in(key, i)) for i in range(settings.num_configs)]
    places = {
        "se": (ses.env, ses[0].params, ses[0].fingerprint, {"proxy": ses.config["proxy"]}),
        "real": (task.env, task.params, "", {}),
    }
    tables = []
    for name, training in parts.trainings.items():
        env, params, weights, plain = places["se" if name == "se" else "real"]
        groups = [
            Group(f"{i:02d}", (params, np.asarray(key)), weights) for i, key in enumerate(keys)
        ]
        condition = Condition(
            name=name,
            env=env,
            task=task,
            groups=tuple(groups),
            agent=parts.agent,
            training=training,
            hparams="varied",
            settings=plain,
        )
        rows = agents.train_groups(condition, settings, settings.num_agents, SHARED_DRAWS, at_once)
        tables.append(rows.assign(world=name))
    return pd.concat(tables, ignore_index=True).rename(columns={"group": "config"})


def make_shared_draws(
    agent: Any, env: Any, task: Task, training: TrainingConfig
) -> Callable[..., Any]:
    """Builds `run(key, (env_params, config_key), active) -> (Outcome, drawn values)`.

    Hyperparameters are drawn from `config_key`, raw key data, and everything else from `key`: the
    agents of a configuration share them. An agent draws both from one key otherwise.
    """

    def make_run(agent: Any) -> Callable[..., Any]:
        def run(_: Any, key: Any, env_params: Any, active: Any, hparams: Any) -> Any:
            fixed = dataclasses.replace(agent, hparams=hparams)
            return sejax.make_evaluator(fixed, env, task, training)(key, env_params, active)

        return run

    train = agent.fresh(make_run)

    def run(key: Any, place: Any, active: Any) -> Any:
        env_params, key_data = place
        config_key = jax.random.wrap_key_data(key_data)
        return train(config_key, key, env_params, active), agent.drawn_values(config_key)

    return run


SHARED_DRAWS = Measure(
    make_run=make_shared_draws,
    to_table=lambda results, _: agents.outcome_rows(*results),
    log=lambda rows: f"mean return {rows['test_return'].mean():.1f}",
    is_timed=True,
)


def returns_by_half(rows: pd.DataFrame, world: str) -> np.ndarray:
    """Mean return of each configuration in a world, `[2, config]`.

    On the real task of the agents of even and of odd number: the best of noisy means looks better
    than it is, so that one half judges what the other has chosen. On the SE of all, twice.
    """
    mine = rows[rows["world"] == world].sort_values("config")
    halves = [mine, mine] if world == "se" else [mine[mine["agent"] % 2 == i] for i in (0, 1)]
    return np.stack([half.groupby("config")["test_return"].mean() for half in halves])


def quality(chooser: np.ndarray, target: np.ndarray) -> dict[str, float]:
    """How good one set of returns is for choosing a configuration for the real task.

    Args:
      chooser: `[2, config]`, by which one is chosen twice; of equally good ones any, so that
        the mean over them is what a choice is worth.
      target: `[2, config]`, independent halves of the returns there; each judges the choice that
        the other half of the target's, or of the chooser's, has made.

    Returns:
      `rho`, Spearman's correlation of the two, or of the halves for a target that chooses itself;
      the judged return of the choice, `chosen`; what that loses to the target's own, `regret`; and
      what a random choice loses, `regret_random`.
    """
    is_own = chooser is target
    pair = target if is_own else (chooser.mean(axis=0), target.mean(axis=0))
    judges = target[::-1]

    def judged(by: np.ndarray) -> float:
        return float(np.mean([judges[i, by[i] == by[i].max()].mean() for i in (0, 1)]))

    best = judged(target)
    return {
        "rho": rank_correlation(*pair),
        "chosen": judged(chooser),
        "regret": best - judged(chooser),
        "regret_random": best - target.mean(),
    }


def rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Spearman's rho of `[n]` and `[n]`, with mean ranks for ties; nan where all are equal."""
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return np.nan
    return float(np.corrcoef(rankdata(a), rankdata(b))[0, 1])


def with_intervals(
    chooser: np.ndarray, target: np.ndarray, num_resamples: int = NUM_RESAMPLES
) -> dict[str, float]:
    """`quality` with the ends of BCa 95% intervals over configurations, `..._low` and `..._high`.

    Of fewer than five configurations there is no interval (nan).
    """

    def of(places: np.ndarray) -> dict[str, float]:
        own = target[:, places]
        return quality(own if chooser is target else chooser[:, places], own)

    each = np.arange(target.shape[1])
    draws = np.random.default_rng(0).integers(0, each.size, (num_resamples, each.size))
    drawn = pd.DataFrame([of(places) for places in draws])
    left_out = pd.DataFrame([of(np.delete(each, i)) for i in each])
    found = quality(chooser, target)
    ends = {name: bca_interval(x, drawn[name], left_out[name]) for name, x in found.items()}
    lows = {f"{name}_low": low for name, (low, _) in ends.items()}
    return found | lows | {f"{name}_high": high for name, (_, high) in ends.items()}


def summarise(rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each budget on the real task (`target`) and each way to choose for it."""
    costs = rows.groupby("world", sort=False).agg({"train_steps": "sum", "cpu_s": "sum"})
    returns = {world: returns_by_half(rows, world) for world in costs.index}
    summary = []
    for target in (world for world in costs.index if world != "se"):
        for chooser in costs.index:
            cost = costs.loc[chooser] / (1 if chooser == "se" else 2)  # half of the agents choose
            found = with_intervals(returns[chooser], returns[target])
            summary.append({"target": target, "chosen_by": chooser, **found, **cost})
    return pd.DataFrame(summary)


def make_table(summary: pd.DataFrame) -> pd.DataFrame:
    """The summary as texts."""
    names = {"se": "the SE"} | {name: f"the real task, {text}" for name, text in BUDGETS.items()}
    return as_texts(
        summary,
        {
            "trained on the real task": lambda row: BUDGETS[row.target],
            "tuned on": lambda row: names[row.chosen_by],
            "Spearman's rho": with_interval("rho", "rho", 2),
            "return of the choice": with_interval("chosen", "chosen", 1),
            "regret": with_interval("regret", "regret", 1),
            "regret of a random one": with_interval("regret_random", "regret_random", 1),
            "steps": "{train_steps:,.0f}",
            "CPU s": "{cpu_s:,.1f}",
        },
    )


def report(settings: SeTransferOfHparams, rows: pd.DataFrame) -> pd.DataFrame:
    task = sejax.load_set(settings.ses or settings.env, option="ses", kind="se").task
    summary = summarise(rows)
    draw(task, rows, settings.folder / "hparams.png")
    note = (
        f"{rows['config'].nunique()} drawn configurations of {settings.agent}, each trained "
        f"with {settings.num_agents} seeds on the SE and on the real task. There one half of the "
        "seeds judges what the other has chosen; regret is the judged return of the real task's "
        "choice less that of this one. Rho is that of all seeds, or of the two halves where the "
        "real task chooses for itself. Intervals: BCa bootstrap 95%, over configurations. Steps "
        "and CPU seconds (without compilation): of the agents that choose, half of the real ones."
    )
    title = f"Tuning {settings.agent} on an SE of {task.name} (solved at {task.solved_reward:g})"
    return publish(settings, title, make_table(summary), summary, note)


def draw(task: Task, rows: pd.DataFrame, path: Any) -> None:
    """Draws the configurations' mean returns on the real task against those on the SE."""
    means = rows.groupby(["world", "config"])["test_return"].mean().unstack("world")
    targets = [name for name in BUDGETS if name in means]
    with figures.panels(path, 1, len(targets), (0.6 + 3.6 * len(targets), 3.8)) as (_, axes):
        for axis, target in zip(axes[0], targets, strict=True):
            axis.plot(means["se"], means[target], "o", ms=5, color=figures.REAL, alpha=0.6)
            choices = {
                "best on the SE": (means["se"], figures.VARIED),
                "best on the real task": (means[target], figures.BEST),
            }
            for label, (chosen_by, color) in choices.items():
                choice = means.loc[chosen_by.idxmax()]
                ring: Any = {"ms": 10, "mfc": "none", "mew": 1.8, "color": color, "label": label}
                axis.plot(choice["se"], choice[target], "o", **ring)
            figures.threshold(axis, task.solved_reward)
            label = f"the same, on the real task\n{BUDGETS[target]}"
            axis.set(xlabel="mean return, trained on the SE", ylabel=label)
        axes[0, 0].legend(fontsize=8, loc="best")


EXPERIMENT = Experiment(settings=SeTransferOfHparams, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
