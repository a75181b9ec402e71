"""NES runs that learn proxies, one after the other, and what their generations cost.

Each run is that of `python -m sejax.run` with the same configuration and seed, in a run directory
of its own: one that was stopped goes on, and a finished one is kept.
"""

import contextlib
import dataclasses
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import jax
import numpy as np
import pandas as pd

import sejax
from experiments.common.agents import HPARAMS, Condition, groups_at_once, train_groups
from experiments.common.experiment import Settings, count, setting
from experiments.common.statistics import worst_tenth
from experiments.common.tables import mean_columns, summary_by
from sejax import ProxySet
from sejax.cli import config as configuration
from sejax.cli import run_directory, session
from sejax.cli.compose import key_of
from sejax.cli.config import JOINT
from sejax.cli.progress import Tally
from sejax.ops.files import write_text
from sejax.options import ConfigError, each_of, positive, registry, require

UNLIMITED = 100_000  # generations of a run that its budget ends


@dataclass(frozen=True, kw_only=True)
class RunSettings(Settings):
    """Settings about the NES runs; `num_runs` has the default of a field `runs` by task."""

    num_runs: ClassVar[Mapping[str, int]] = {}

    env: str = setting("cartpole")  # task: cartpole, acrobot, ...
    generations: int | None = count(None)  # outer iterations; the preset's
    preset: str = setting("best")  # of the NES runs: best, paper, for SEs paper_performance
    run: tuple[str, ...] = setting(())  # overrides of the NES runs, or as below

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> dict[str, Any]:
        default = super().defaults(given)
        task = given.get("env", default["env"])
        if not given.get("quick") and task in cls.num_runs:
            default["runs"] = cls.num_runs[task]
        return default

    def learn_config(self, overrides: Iterable[str]) -> Any:
        """The configuration of the NES runs with these overrides; those of `run` win."""
        words = [f"env={self.env}", f"preset={self.preset}", *overrides]
        if self.generations is not None:
            words.append(f"generations={self.generations}")
        config = sejax.config([*words, *self.run])
        return dataclasses.replace(config, devices=self.devices, seed=self.seed)


def configs_of(config: Any, num_runs: int, folder: Path) -> list[Any]:
    """Configurations of runs with the seeds from `config.seed` on, in folders of their own."""
    return [
        dataclasses.replace(config, seed=seed, num_seeds=1, run_dir=str(folder / f"seed{seed}"))
        for seed in range(config.seed, config.seed + num_runs)
    ]


def learn(
    configs: list[Any],
    budget_s: float | None = None,
    option: str = "work",
    chunks: session.Chunks | None = None,
) -> pd.DataFrame:
    """Learns the proxies of several runs that differ in the seed, or what is left of them.

    Args:
      configs: of the runs; see `configs_of`.
      budget_s: CPU seconds after which a run begins no further generation.
      option: the setting that names the folder, for messages.
      chunks: the compiled generations of these runs, if they were made before.

    Returns:
      The generations of all runs: the columns of `metrics.csv`, and their CPU seconds `cpu_s`.

    Raises:
      ConfigError: if a folder holds a run of other settings or of more generations, or is in use.
    """
    chunks = chunks or session.make_chunks(configs[0])
    curves = []
    with Tally(len(configs), "NES runs") as tally:
        for config in configs:
            with run_directory.open_for(config, f"Set {option}=DIR.") as directory:
                curve = _learn_one(config, directory, chunks, budget_s)
            _require_no_more(config, curve)
            print(f"{config.run_dir}: {_log(curve, chunks.learner.solved_score)}", flush=True)
            curves.append(curve)
            tally.add()
    return pd.concat(curves, ignore_index=True)


def _learn_one(
    config: Any, directory: Any, chunks: session.Chunks, budget_s: float | None
) -> pd.DataFrame:
    path = directory.path / "cpu_s.txt"
    limit = np.inf if budget_s is None else budget_s
    if read_costs(path, directory.finished_generations).sum() < limit:
        with contextlib.suppress(BudgetSpent):
            session.run(config, directory, TimedChunks(chunks, path, limit))
    curve = pd.DataFrame(directory.rows).apply(pd.to_numeric)  # those of the verified checkpoint
    return curve.assign(cpu_s=pd.Series(read_costs(path, len(curve))))


def _require_no_more(config: Any, curve: pd.DataFrame) -> None:
    there = int(curve["generation"].max()) + 1 if len(curve) else 0
    require(
        there <= config.generations,
        "generations",
        f"must be at least {there}, as the run in {config.run_dir} has so many; got "
        f"{config.generations}. Set generations={there}, or another folder.",
    )


def _log(curve: pd.DataFrame, solved_score: float | None) -> str:
    best = f"best {curve['best_so_far'].max():.1f}"
    if solved_score is None:
        return best
    solved = generations_to_solve(curve, solved_score)
    first = f"{solved:.0f}" if np.isfinite(solved) else "none"
    return f"{best}, first passage of the threshold in generation {first} of {len(curve)}"


def collect(configs: list[Any], path: Path, before: Any = None) -> None:
    """Writes the best proxy of each run into one file, after those of the set `before`."""
    sets = [*([before] if before else []), *(sejax.load_set(Path(x.run_dir)) for x in configs)]
    proxies = [proxy for each in sets for proxy in each]
    sejax.save_set(
        path,
        sets[0].env,
        [proxy.params.weights for proxy in proxies],
        [proxy.record for proxy in proxies],
        before.config if before else configuration.plain(configs[0]),
        sets[0].discount,
    )


def generations_to_solve(curve: pd.DataFrame, solved_reward: float) -> float:
    """Generations of a run until the first whose incumbent mean is high enough; inf if none is."""
    solved = curve["generation"][curve["incumbent_mean"] >= solved_reward]
    return float(solved.iloc[0]) + 1 if len(solved) else np.inf


# --- what generations cost -----------------------------------------------------------------------


class BudgetSpent(Exception):
    """A run has spent its budget. All of its generations are on the disk."""


class TimedChunks(session.Chunks):
    """Compiled generations that write down their CPU seconds and stop at a budget.

    CPU seconds are those of this process on all of its threads, while it computes a generation:
    compilation, files and figures are left out. Costs are written before the generation itself is;
    after a kill there may be one too many, which the run writes again as it goes on.
    """

    def __init__(self, chunks: session.Chunks, path: Path, budget_s: float):
        super().__init__(chunks.learner)
        self._compiled = chunks._compiled  # shared by all runs
        self._path, self._budget_s = path, budget_s

    def advance(self, state: Any, length: int) -> tuple[Any, Any]:
        """Runs `length` generations.

        Raises:
          BudgetSpent: if the generations so far have used it up.
        """
        before = read_costs(self._path, int(state.generation))
        if before.sum() >= self._budget_s:
            raise BudgetSpent
        started = time.process_time()
        result = jax.block_until_ready(super().advance(state, length))
        each = (time.process_time() - started) / length
        costs = np.concatenate([before, np.full(length, each)])
        write_text(self._path, "".join(f"{cost:.3f}\n" for cost in costs))
        return result


def read_costs(path: Path, generations: int) -> np.ndarray:
    """CPU seconds of the first generations, `[generation]`; of fewer, if no more are known.

    Raises:
      ConfigError: if the file is damaged.
    """
    try:
        return np.array(path.read_text().split()[:generations], float)
    except FileNotFoundError:
        return np.array([])
    except ValueError as error:
        raise ConfigError(
            f"work must hold whole files; {path} is damaged. Set work=DIR.", "work"
        ) from error


def within(curve: pd.DataFrame, budget_s: float | None) -> pd.DataFrame:
    """The generations of one run that began before the budget was spent."""
    if budget_s is None:
        return curve
    return curve[curve["cpu_s"].cumsum() - curve["cpu_s"] < budget_s]


# --- SEs learned and tested with agent mixtures, which are written as `ddqn+ppo` -----------------

# A small proxy and agents that learn enough to be seen moving.
QUICK = (
    "es.population_size=12",
    "es.num_incumbent_evals=6",
    "training.max_steps=1000",
    "proxy.hidden_size=32",
)
QUICK_AGENT = {"hidden_size": 32, "batch_size": 32, "num_layers": 1, "warmup_episodes": 1}


@dataclass(frozen=True, kw_only=True)
class MixtureRuns(RunSettings):
    """Settings about SEs that are learned with some kinds of agents and tested with others."""

    runs: int = count(5, quick=2)  # NES runs of each, of the same seeds everywhere
    tested: tuple[str, ...] = setting(())  # kinds of agents that SEs are tested with
    # Their hyperparameters; varied: drawn for each.
    tested_hparams: tuple[str, ...] = setting(HPARAMS, each_of(HPARAMS), quick=("default",))
    num_agents: int = count(10, quick=4)  # of each kind on each SE
    test_episodes: int = count(10)  # of each agent
    # CPU seconds of a run, without compilation.
    cpu_budget_s: float | None = setting(None, positive("it is time"))

    def config_with(self, kinds: Sequence[str], others: Iterable[str], words: Any = ()) -> Any:
        """The configuration of NES runs with these kinds of agents.

        Args:
          kinds: of the agents.
          others: further ones; overrides in `run` about these are left out.
          words: overrides beside those of `run`, which win.
        """
        foreign = tuple(f"agents.{key_of(name)}." for name in others if name not in kinds)
        run = tuple(word for word in self.run if not word.startswith(foreign))
        chosen = [f"agents=[{','.join(kinds)}]", *words]
        if self.cpu_budget_s is not None and self.generations is None:
            chosen.append(f"generations={UNLIMITED}")
        if self.quick:
            chosen += QUICK
            for name in kinds:
                known = registry.defaults("agent", name)
                small = {field: x for field, x in QUICK_AGENT.items() if field in known}
                chosen += [f"agents.{key_of(name)}.{field}={x}" for field, x in small.items()]
        return dataclasses.replace(self, run=run).learn_config(chosen)

    def learn(self, name: str, config: Any) -> tuple[pd.DataFrame, Any]:
        """Learns the SEs of some runs: their generations, and the set of the best ones."""
        configs = configs_of(config, self.runs, self.work_folder / "runs" / name)
        path = self.folder / f"{name}.safetensors"
        curves = learn(configs, self.cpu_budget_s)
        collect(configs, path)
        return curves, sejax.load_set(path)

    def evaluate(self, name: str, ses: ProxySet, config: Any) -> pd.DataFrame:
        """Agents of one kind on each SE of a set, a row each.

        Args:
          name: of the set, in the names of files.
          ses: the set.
          config: `config_with` the kind; agents train as long as it says.

        Returns:
          Rows with the columns `kind`, `hparams`, and `seed` of the SE.
        """
        (member,) = config.agents.members
        training = dataclasses.replace(config.training, test_episodes=self.test_episodes)
        seeds = {
            f"{name}-{seed:02d}-{ses[i].fingerprint}": seed for i, seed in enumerate(ses.seeds)
        }
        at_once, tables = groups_at_once(self.devices), []
        for hparams in self.tested_hparams:
            condition = Condition.of_set(
                ses,
                seeds,
                name=f"{member.key}-{hparams}",
                agent=member.agent,
                training=training,
                hparams=hparams,
            )
            rows = train_groups(condition, self, self.num_agents, at_once=at_once)
            own = rows["group"].map(seeds)
            tables.append(rows.assign(kind=member.key, hparams=hparams, seed=own))
        return pd.concat(tables, ignore_index=True)


def summarise_tests(agents: pd.DataFrame, by: list[str], solved_reward: float) -> pd.DataFrame:
    """Statistics of the returns (`test_return_...`) for each value of the columns `by`.

    The mean's interval is over SEs, of which there must be five, and agents where there is one SE.
    """

    def statistics(mine: pd.DataFrame) -> dict[str, float]:
        returns, num_ses = mine["test_return"], mine["seed"].nunique()
        return (
            {"num_ses": num_ses, "num_agents": len(mine)}
            | mean_columns(returns, "test_return", mine["seed"] if num_ses > 1 else None)
            | {"test_return_worst_tenth": worst_tenth(returns)}
            | {"solved": (returns >= solved_reward).mean()}
        )

    return summary_by(agents, by, statistics)


def kinds_in(mixture: str) -> list[str]:
    """The kinds of agents in a mixture."""
    return mixture.split(JOINT)
