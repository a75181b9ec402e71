"""Is a proxy good for tuning: SEs that are learned to rank configurations of agents.

Configurations of one kind of agent are drawn in wide ranges and trained on the real task, once.
SEs are learned so that what these configurations reach on them ranks them alike
(`objective=ranking`); a tuner is a few of those SEs, whose ranks are averaged. Other
configurations, of this kind and of others, which took no part in learning, stopping or choosing,
are then ranked by each tuner, and beside it by short trainings on the real task, by regressors on
as many measured configurations, and by chance.
"""

import dataclasses
from collections.abc import Callable, Collection
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import rankdata, spearmanr

import sejax
from experiments.common import figures, runs, tables
from experiments.common.agents import CONTINUOUS, DISCRETE, kinds_of_students
from experiments.common.experiment import Experiment, Settings, count, setting
from experiments.common.shards import stack, unstack
from experiments.common.statistics import NUM_RESAMPLES, bca_interval, mean_interval
from sejax import envs, landscape, landscapes
from sejax.cli import session
from sejax.ops import gaussian_process
from sejax.options import each_of
from sejax.proxies.tuners import TRANSFER

QUICK = (
    *("es.population_size=4", "proxy.hidden_size=8", "training.max_steps=200"),
    *("training.max_episodes=200", "objective.num_tests=4"),
)
LEARN, REGRESSED, HELD = 0, 1000, 2000  # seeds of the draws of configurations
USES = {LEARN: "learn", REGRESSED: "regressed", HELD: "held"}
TOP = 5  # configurations that are chosen where several are
TASK_WORDS = "the real task, {steps:,} steps, seeds: {seeds}"
# Landscapes of regressors: the tuners' own, and one in the ranges that are ranked.
REGRESSED_FROM = {"learn": " on the tuners' landscape", "regressed": " on ranked ranges"}


@dataclass(frozen=True, kw_only=True)
class SeTuners(Settings):
    name = "se_tuners"

    env: str = setting("cartpole")  # task
    agent: str | None = setting(None)  # that SEs are learned with; the task's first
    # Kinds of agents whose configurations are ranked; all that fit the task.
    ranked: tuple[str, ...] = setting((), each_of(tuple(dict.fromkeys(DISCRETE + CONTINUOUS))))
    run: tuple[str, ...] = setting(())  # overrides of the NES runs
    learn_configs: int = count(256, quick=8)  # to learn from
    # Ranges of theirs in place of those of space=wide, so that SEs see rates that are too high.
    learn_ranges: tuple[str, ...] = setting(("agent.learning_rate=tag(log, interval(0.0001, 1))",))
    num_configs: int = count(64, quick=8)  # of each kind, to rank
    num_seeds: int = count(8, least=2, quick=2)  # real trainings of each
    steps: int = count(10_000, quick=300)  # of a real training
    num_tuners: int = count(5, quick=2)  # of as many SEs each
    members: int = count(3, quick=2)  # SEs of a tuner
    generations: int | None = count(None, quick=2)  # of the NES runs
    tuning_seeds: int = count(4, quick=2)  # trainings of a configuration on each SE
    transfer: int = count(TRANSFER)  # times as long trainings of other kinds, and as few of them
    short_seeds: int = count(4, quick=2)  # of short real trainings
    # Steps of short real trainings.
    short_steps: tuple[int, ...] = setting((500, 1500, 2000), quick=(100,))

    @property
    def learner(self) -> str:
        """The kind of agent that SEs are learned with."""
        return self.agent or kinds_of_students(envs.make(self.env))[0]

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of agents that are ranked, the learning one first."""
        kinds = self.ranked or kinds_of_students(envs.make(self.env))
        return tuple(dict.fromkeys((self.learner, *kinds)))


# --- computing -----------------------------------------------------------------------------------


def measured(settings: SeTuners, kind: str, seed: int, steps: int, first_seed: int) -> pd.DataFrame:
    """A landscape of one kind, a row for each training; see `python -m sejax.landscape`."""
    path = settings.work_folder / f"{kind}-{seed}-{steps}.csv"
    seeds = settings.num_seeds if steps == settings.steps else settings.short_seeds
    ranges = settings.learn_ranges if seed == LEARN else ()
    words = {
        "env": settings.env,
        "agent": kind,
        "configs": settings.learn_configs if seed != HELD else settings.num_configs,
        "seeds": seeds,
        "first_seed": first_seed,
        "steps": steps,
        "seed": settings.seed + seed,
        "file": path,
        "devices": settings.devices or "null",
    }
    landscape.main([*(f"{name}={value}" for name, value in words.items()), *ranges])
    rows = landscapes.read_table(path, "work")[1].drop(columns="agent")
    return rows.assign(kind=kind, use=USES[seed], steps=steps)


def compute(settings: SeTuners) -> pd.DataFrame:
    """Measures, learns and ranks what is missing."""
    real = [measured(settings, settings.learner, LEARN, settings.steps, 0)]
    if settings.learn_ranges:  # regressors know best what lies in the ranges that are ranked
        real.append(measured(settings, settings.learner, REGRESSED, settings.steps, 0))
    for kind in settings.kinds:
        real.append(measured(settings, kind, HELD, settings.steps, 0))
        for steps in settings.short_steps:  # of other agents than those that judge
            real.append(measured(settings, kind, HELD, steps, 100))
    config = learn_config(settings)
    number = settings.num_tuners * settings.members
    configs = runs.configs_of(config, number, settings.work_folder / "runs")
    chunks = session.make_chunks(configs[0])
    curves = runs.learn(configs, chunks=chunks)
    evaluations = chunks.learner.strategy.num_evaluations
    curves["train_steps_sum"] = curves["train_steps_mean"] * evaluations
    path = settings.folder / "tuners.safetensors"
    runs.collect(configs, path)
    tuners = sejax.load_set(path)
    reached = [reached_by(settings, kind, tuners, "reached") for kind in settings.kinds]
    found = {"real": pd.concat(real), "curves": curves, "reached": pd.concat(reached)}
    if settings.env in {x.name for x in sejax.pretrained()}:  # a proxy that was not made for it
        se = sejax.load_set(settings.env)
        shipped = [reached_by(settings, kind, se, "shipped") for kind in settings.kinds]
        found["shipped"] = pd.concat(shipped)
    return stack(found)


def learn_config(settings: SeTuners) -> Any:
    """The configuration of the NES runs."""
    path = settings.work_folder / f"{settings.learner}-{LEARN}-{settings.steps}.csv"
    words = [
        *(f"env={settings.env}", "preset=ranking", f"agent={settings.learner}"),
        f"objective.landscape={path}",
        *(QUICK if settings.quick else ()),
        *([] if settings.generations is None else [f"generations={settings.generations}"]),
    ]
    steps = next((x.partition("=")[2] for x in words if x.startswith("training.max_steps=")), None)
    if steps is not None:
        agent = agent_config(settings, settings.learner, int(steps))
        counted = ("exploration_steps", "temperature_steps")
        words += [f"agent.{x}={getattr(agent, x)}" for x in counted if hasattr(agent, x)]
    config = sejax.config([*words, *settings.run])
    return dataclasses.replace(config, devices=settings.devices, seed=settings.seed)


def agent_config(settings: SeTuners, kind: str, max_steps: int) -> Any:
    """An agent with room for all configurations, as it trains on an SE."""
    from sejax.ranking import scaled

    words = [f"env={settings.env}", "preset=ranking", "objective=max_reward", f"agent={kind}"]
    config = sejax.config(words)
    agent, factor = config.agent, max_steps / (config.training.max_steps or max_steps)
    plain = {field.name: getattr(agent, field.name) for field in dataclasses.fields(agent)}
    changed = {name: scaled(type(agent), name, x, factor) for name, x in plain.items()}
    return dataclasses.replace(agent, **changed)


def reached_by(settings: SeTuners, kind: str, ses: sejax.ProxySet, name: str) -> pd.DataFrame:
    """What the held-out configurations of one kind reach on each SE, a row each.

    They train as on the tuners, and on a shipped SE as it was learned.
    """
    from sejax import ranking

    path = settings.work_folder / f"{kind}-{HELD}-{settings.steps}.csv"
    found = landscapes.read(path, "work")[kind]
    own = training = sejax.training_of(ses)
    if name == "reached":
        training = ranking.training_on(ses, kind, settings.transfer)
    assert own.max_steps is not None and training.max_steps is not None
    agent = agent_config(settings, kind, training.max_steps)
    num_seeds = max(1, settings.tuning_seeds * own.max_steps // training.max_steps)

    def rows() -> pd.DataFrame:
        reached = ranking.reached_on(
            ses,
            agent,
            found.values,
            steps=settings.steps,
            training=training,
            num_seeds=num_seeds,
            seed=settings.seed,
            devices=settings.devices,
        )
        se, config = np.indices(reached.greedy.shape[:2]).reshape(2, -1)
        means = {x: getattr(reached, x).mean(axis=-1).ravel() for x in ("greedy", "training")}
        steps = reached.train_steps.sum(axis=-1).ravel()
        return pd.DataFrame({"se": se, "config": config, **means, "train_steps": steps})

    made_with = {
        "weights": [ses[i].fingerprint for i in range(len(ses))],
        "seeds": num_seeds,
        "train_steps": training.max_steps,
        "configs": settings.num_configs,
        "steps": settings.steps,
    }
    return settings.shards.compute(f"{name}-{kind}", made_with, rows).assign(kind=kind)


# --- ranking -------------------------------------------------------------------------------------


def returns_of(real: pd.DataFrame, use: str, kind: str, steps: int) -> pd.DataFrame:
    """Returns on the real task, a row for each configuration and a column for each seed."""
    mine = real[(real["use"] == use) & (real["kind"] == kind) & (real["steps"] == steps)]
    lowest = mine["return"].min()
    return mine.pivot(index="config", columns="seed", values="return").fillna(lowest)


def features_of(
    real: pd.DataFrame, use: str, kind: str, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """What configurations set, for regression and held out of one kind, `[config, option]` each.

    Of options that both have, as ranks within all of them, so that all scales are uniform.
    """
    is_full = real["steps"] == steps
    learn = real[is_full & (real["use"] == use)]
    held = real[is_full & (real["use"] == "held") & (real["kind"] == kind)]
    mine = pd.concat([learn, held])
    names = [x for x in mine if x.startswith(landscapes.PREFIX) and mine[x].notna().all()]
    each = mine.groupby(["use", "config"], sort=False)[names].first()
    ranks = each.rank(pct=True)
    return ranks.loc[use].to_numpy(), ranks.loc["held"].to_numpy()


def regressed(
    kind: str, features: np.ndarray, returns: np.ndarray, asked: np.ndarray
) -> np.ndarray:
    """What a regressor expects of configurations, `[config]`: `forest` or `gaussian_process`."""
    if kind == "gaussian_process":
        return gaussian_process.predict(features, returns, asked)
    from sklearn.ensemble import RandomForestRegressor

    model = RandomForestRegressor(min_samples_leaf=2, random_state=0)
    expected: np.ndarray = model.fit(features, returns).predict(asked)
    return expected


def quality(chooser: np.ndarray, target: np.ndarray) -> dict[str, float]:
    """How good an order of configurations is for the real task.

    Args:
      chooser: `[config]`, more is better.
      target: returns on the real task, `[config]`.

    Returns:
      `rho`, Spearman's correlation; `regret`, the highest return less that of the first;
      `regret_top`, the same of the mean of the first `TOP`. Of equally good ones the mean counts.
    """
    order = pd.Series(target).groupby(-rankdata(chooser, method="min")).transform("mean")
    # Equal ones stand together: each is worth their mean.
    sorted_worth = order.to_numpy()[np.argsort(-chooser, kind="stable")]
    first = sorted_worth[0]
    return {
        "rho": float(rank_correlations(chooser[None], target[None])[0]),
        "regret": float(target.max() - first),
        "regret_top": float(target.max() - sorted_worth[:TOP].mean()),
    }


def rank_correlations(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Spearman's correlation of each row, `[row]`; 0 where one is constant."""
    return correlations(rankdata(x, axis=1), rankdata(y, axis=1))


def correlations(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Pearson's correlation of each row, `[row]`; 0 where one is constant."""
    x, y = (each - each.mean(axis=1, keepdims=True) for each in (x, y))
    norm = np.sqrt((x**2).sum(axis=1) * (y**2).sum(axis=1))
    return np.divide((x * y).sum(axis=1), norm, out=np.zeros(len(x)), where=norm > 0)


def over_configs(
    statistic: Callable[[np.ndarray], np.ndarray], number: int
) -> tuple[float, float, float]:
    """A statistic of all configurations, with its BCa interval over them.

    Args:
      statistic: of configurations by their numbers, `[draw, config]` -> `[draw]`.
      number: of configurations.
    """
    each = np.arange(number)
    draws = np.random.default_rng(0).integers(0, number, (NUM_RESAMPLES, number))
    others = np.array([np.delete(each, i) for i in each])
    estimate = float(statistic(each[None])[0])
    drawn, left_out = (pd.Series(statistic(x)) for x in (draws, others))
    return estimate, *bca_interval(estimate, drawn, left_out)


def choices(short: pd.DataFrame, number: int) -> list[np.ndarray]:
    """Mean returns of all choices of so many seeds, `[config]` each."""
    each = combinations(range(short.shape[1]), number)
    return [short.iloc[:, list(seeds)].mean(axis=1).to_numpy() for seeds in each]


def mean_rho(choosers: list[np.ndarray], target: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """Mean rho of choosers, for configurations that were drawn, `[draw, config]` -> `[draw]`."""
    judged = rankdata(target[drawn], axis=1)
    rhos = [correlations(rankdata(x[drawn], axis=1), judged) for x in choosers]
    mean: np.ndarray = np.mean(rhos, axis=0)
    return mean


def with_interval(choosers: list[np.ndarray], target: np.ndarray) -> dict[str, float]:
    """The mean of `quality` over choosers, with a BCa interval of rho over configurations."""
    _, low, high = over_configs(lambda drawn: mean_rho(choosers, target, drawn), target.size)
    mean = pd.DataFrame([quality(chooser, target) for chooser in choosers]).mean()
    return {**mean, "rho_low": low, "rho_high": high}


def ahead(
    choosers: list[np.ndarray], others: list[np.ndarray], target: np.ndarray
) -> dict[str, float]:
    """By how much the mean rho of choosers is above that of others, in pairs of configurations."""

    def difference(drawn: np.ndarray) -> np.ndarray:
        return mean_rho(choosers, target, drawn) - mean_rho(others, target, drawn)

    rho, low, high = over_configs(difference, target.size)
    return {"rho": rho, "rho_low": low, "rho_high": high}


def over_tuners(choosers: list[np.ndarray], target: np.ndarray) -> dict[str, float]:
    """The mean of `quality` over tuners, with Student's interval of rho over them."""
    each = pd.DataFrame([quality(x, target) for x in choosers])
    low, high = mean_interval(each["rho"])
    worst = float(each["rho"].min())
    return {**each.mean(), "rho_low": low, "rho_high": high, "rho_worst": worst}


def halved(returns: dict[int, np.ndarray], judges: np.ndarray) -> dict[str, float]:
    """A choice by successive halving on the real task, the mean over what each judge would choose.

    All configurations train for the fewest steps, a third of them for the next number, and so on;
    the best of the last ones is chosen after the judges' steps.

    Args:
      returns: by the steps of a short training, `[config, seed]`, ascending.
      judges: returns after full trainings, `[config, seed]`; a seed chooses, the others judge.

    Returns:
      `regret` and `regret_top` of the choice, as of `quality`; `trained_...`, the share of the
      configurations that trained for so many steps.

    Source: Li et al., "Hyperband" (2017); its bracket that halves most, with eta = 3.
    """
    number, regrets = len(judges), []
    best = judges.mean(axis=1).max()
    trained = {}
    for seed in range(judges.shape[1]):
        alive = np.arange(number)
        for steps, short in returns.items():
            trained[steps] = len(alive) / number
            order = np.argsort(-short[alive, seed % short.shape[1]], kind="stable")
            alive = alive[order[: max(1, len(alive) // 3)]]
        chosen = alive[np.argmax(judges[alive, seed])]
        regrets.append(best - np.delete(judges[chosen], seed).mean())
    shares = {f"trained_{steps}": share for steps, share in trained.items()}
    mean = float(np.mean(regrets))
    return {"regret": mean, "regret_top": mean, **shares, "trained_last": len(alive) / number}


def equal_steps(tested: Collection[int], steps: float) -> int:
    """Of the steps of tests on the task the most that are not above others, else the fewest.

    An agent may end an SE's last episode a step late, which is no difference.
    """
    return max((x for x in tested if x <= 1.01 * steps), default=min(tested))


def mean_ranks(reached: pd.DataFrame, ses: list[int]) -> np.ndarray:
    """Mean over some SEs of the ranks of greedy returns, `[config]`."""
    mine = reached[reached["se"].isin(ses)]
    ranks = mine.groupby("se")["greedy"].rank()
    means: np.ndarray = ranks.groupby(mine["config"]).mean().to_numpy()
    return means


def summarise(settings: SeTuners, rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each kind of agent and each way to order its configurations."""
    real, reached = unstack(rows, "real"), unstack(rows, "reached")
    curves = unstack(rows, "curves")
    members, number = settings.members, settings.num_tuners
    learning_cpu_s = curves["cpu_s"].sum() / (number * members)
    once = real[real["steps"] == settings.steps].groupby("use")["real_steps"].sum()
    landscape_cost = {"once_steps": once["learn"]}
    # CPU seconds of a training step on an SE, with its share of the tests.
    step_cpu_s = curves["cpu_s"].sum() / curves["train_steps_sum"].sum()
    found = []

    def add(kind: str, how: str, values: dict[str, float], **costs: float) -> None:
        found.append({"kind": kind, "ranked_by": how, **values, **costs})

    for kind in settings.kinds:
        judges = returns_of(real, "held", kind, settings.steps)
        target = judges.mean(axis=1).to_numpy()
        mine = reached[reached["kind"] == kind]
        each = mine["train_steps"].sum() / mine[["se", "config"]].drop_duplicates().shape[0]
        groups = np.arange(number * members).reshape(number, members).tolist()
        singles = [mean_ranks(mine, [se]) for se in range(number * members)]
        tuners = [mean_ranks(mine, ses) for ses in groups]
        add(kind, "one SE", over_tuners(singles, target), steps=each, cpu_s=each * step_cpu_s,
            **landscape_cost, learning_cpu_s=learning_cpu_s)  # fmt: skip
        add(kind, f"a tuner of {members} SEs", over_tuners(tuners, target), steps=members * each,
            cpu_s=members * each * step_cpu_s,
            **landscape_cost, learning_cpu_s=members * learning_cpu_s)  # fmt: skip
        held = real[(real["kind"] == kind) & (real["use"] == "held")]
        cpu_of = held.groupby("steps")["cpu_s"].mean()
        if "shipped" in set(rows["table"]):
            shipped = unstack(rows, "shipped").query("kind == @kind")
            taken = shipped["train_steps"].mean()
            add(kind, "the shipped SE", with_interval([mean_ranks(shipped, [0])], target),
                steps=taken, cpu_s=taken * step_cpu_s)  # fmt: skip
        tested: dict[tuple[int, int], list[np.ndarray]] = {}  # on the task, by steps and seeds
        for steps in settings.short_steps:
            short = returns_of(real, "held", kind, steps)
            for num in range(1, short.shape[1] + 1):
                tested[steps, num] = choices(short, num)
                how = TASK_WORDS.format(steps=steps, seeds=num)
                add(kind, how, with_interval(tested[steps, num], target), real_steps=steps * num,
                    cpu_s=cpu_of[steps] * num)  # fmt: skip
        equal = equal_steps({steps * num for steps, num in tested}, members * each)
        for (steps, num), choosers in tested.items():
            if steps * num == equal:
                how = f"a tuner of {members} SEs, less {TASK_WORDS.format(steps=steps, seeds=num)}"
                add(kind, how, ahead(tuners, choosers, target))
        for use, where in REGRESSED_FROM.items():
            if use not in once:
                continue
            asked = features_of(real, use, kind, settings.steps)
            known = returns_of(real, use, settings.learner, settings.steps)
            costs = {"once_steps": once[use]}
            both_costs = {"once_steps": once[list({"learn", use})].sum()}
            for name in ("forest", "gaussian_process"):
                expected = regressed(name, asked[0], known.mean(axis=1).to_numpy(), asked[1])
                how = name.replace("_", " ") + where
                add(kind, how, with_interval([expected], target), **costs)
                less = f"a tuner of {members} SEs, less the {how}"
                add(kind, less, ahead(tuners, [expected], target))
                both = [rankdata(x) + rankdata(expected) for x in tuners]
                add(kind, f"{how}, and a tuner, mean rank", over_tuners(both, target),
                    **both_costs, learning_cpu_s=members * learning_cpu_s)  # fmt: skip
        rungs = sorted(settings.short_steps)[:2]
        short_returns = {x: returns_of(real, "held", kind, x).to_numpy() for x in rungs}
        found_by = halved(short_returns, judges.to_numpy())
        shares = {x: found_by.pop(f"trained_{x}") for x in rungs}
        shares[settings.steps] = found_by.pop("trained_last")
        add(kind, "successive halving", {"rho": np.nan, **found_by},
            real_steps=sum(x * share for x, share in shares.items()),
            cpu_s=sum(cpu_of[x] * share for x, share in shares.items()))  # fmt: skip
        halves = [judges.iloc[:, i::2].mean(axis=1).to_numpy() for i in (0, 1)]
        add(kind, "half of the judging agents", with_interval(halves[:1], halves[1]),
            real_steps=settings.steps * (judges.shape[1] // 2))  # fmt: skip
        add(kind, "chance", {"rho": 0.0, "regret": float(target.max() - target.mean()),
            "regret_top": float(target.max() - target.mean())})  # fmt: skip
    return pd.DataFrame(found)


# --- the report ----------------------------------------------------------------------------------


def report(settings: SeTuners, rows: pd.DataFrame) -> pd.DataFrame:
    summary = summarise(settings, rows)
    draw(settings, rows, settings.folder / "ranks.png")
    columns: dict[str, Any] = {
        "agent": lambda row: figures.AGENT_NAMES[row.kind],
        "ranked by": "{ranked_by}",
        "rho": lambda row: f"{_number(row.rho, 2)}{tables.brackets(row.rho_low, row.rho_high, 2)}",
        "worst tuner": lambda row: _number(row.rho_worst, 2),
        "regret": lambda row: _number(row.regret, 1),
        f"regret, {TOP} best": lambda row: _number(row.regret_top, 1),
        "SE steps a configuration": lambda row: _number(row.steps),
        "real steps a configuration": lambda row: _number(row.real_steps),
        "CPU s a configuration": lambda row: _number(row.cpu_s, 3),
        "real steps once": lambda row: _number(row.once_steps),
        "CPU s of learning": lambda row: _number(row.learning_cpu_s),
    }
    regressors = others = ""
    if settings.learn_ranges:
        regressors = (
            ", of the configurations that SEs are learned from, or of as many others in the "
            "ranges of those that are ranked"
        )
    if settings.transfer > 1:
        fewer = max(1, settings.tuning_seeds // settings.transfer)
        others = f", of other kinds {fewer} after {settings.transfer} times as many steps"
    note = (
        f"{settings.num_configs} configurations of each kind that took no part in learning, each "
        f"judged by the mean return of {settings.num_seeds} agents after {settings.steps:,} real "
        f"steps. SEs are learned from {settings.learn_configs} others of "
        f"{figures.AGENT_NAMES[settings.learner]}, a quarter of which judges incumbents. On an SE "
        f"{settings.tuning_seeds} agents of a configuration train and are tested on it"
        f"{others}. Rho: "
        "Spearman's correlation with the judging returns; in brackets 95%, of tuners Student's "
        "over these, else BCa over configurations; less: the mean rho of tuners less another, BCa "
        "over configurations. Of several seeds on the task: the mean over all choices of so many "
        f"of {settings.short_seeds}. Regret: the highest judging return less that of "
        f"the first, or of the first {TOP} on average. Regressors see the options that an agent "
        f"shares with {figures.AGENT_NAMES[settings.learner]}{regressors}. "
        "Successive halving chooses one by "
        f"{' and '.join(f'{x:,}' for x in sorted(settings.short_steps)[:2])} steps and full "
        "trainings, of a third of the configurations each. Real steps once: of the configurations "
        "that are learned from, tests included."
    )
    task = envs.make(settings.env)
    title = f"Configurations of agents ranked on SEs of {task.name}"
    return tables.publish(settings, title, tables.as_texts(summary, columns), summary, note)


def _number(value: float, digits: int = 0) -> str:
    return f"{value:,.{digits}f}" if np.isfinite(value) else ""


def draw(settings: SeTuners, rows: pd.DataFrame, path: Path) -> None:
    """Draws the real return of each configuration against its rank by the first tuner."""
    real, reached = unstack(rows, "real"), unstack(rows, "reached")
    kinds = settings.kinds
    with figures.panels(path, 1, len(kinds), (0.6 + 2.6 * len(kinds), 3.0), sharey=True) as (
        _,
        axes,
    ):
        for axis, kind in zip(axes[0], kinds, strict=True):
            target = returns_of(real, "held", kind, settings.steps).mean(axis=1)
            chooser = mean_ranks(reached[reached["kind"] == kind], list(range(settings.members)))
            ranks = rankdata(chooser)
            rho = spearmanr(chooser, target).statistic
            axis.plot(ranks, target, "o", ms=4, color=figures.REAL, alpha=0.7)
            axis.set_title(f"{figures.AGENT_NAMES[kind]}, rho {rho:.2f}", fontsize=9)
            axis.set_xlabel("rank by a tuner")
        axes[0, 0].set_ylabel("return on the real task")


EXPERIMENT = Experiment(settings=SeTuners, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
