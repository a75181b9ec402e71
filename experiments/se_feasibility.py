"""Can SEs be learned: the learning curves of many independent NES runs, and the SEs they find.

Source: paper, section "Experiments with Synthetic Environments", paragraph "Feasibility" (figure
"Multiple NES runs"), and appendix "Discussion on the Feasibility of Learning SEs".

Each run is that of `python -m sejax.run` with the same settings and seed. The best SE of each goes
into `ses.safetensors`, which the other experiments read (`ses`, `varied`, `fixed`).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.ticker import MaxNLocator

from experiments.common import figures, runs, tables
from experiments.common.experiment import Experiment, setting
from experiments.common.runs import RunSettings
from experiments.common.statistics import worst_tenth
from sejax.options import Count, require

# Paper, paragraph "Feasibility": "50 NES iterations are often sufficient to find SEs that teach
# agents to solve a task"; appendix "Discussion on the Feasibility": 40 runs of 200 iterations with
# 16 workers. It gives no share of solved runs.
PAPER_TASKS = ("cartpole", "acrobot")
PAPER = {
    "runs": "40",
    "generations run": "200",
    "population": "16",
    "generations until then": "often about 50",
}


@dataclass(frozen=True, kw_only=True)
class SeFeasibility(RunSettings):
    """Settings of this experiment.

    Attributes:
      generations: outer iterations; the preset's
      runs: independent NES runs
      agent_hparams: varied: drawn for each agent
    """

    name = "se_feasibility"
    quick_run = runs.QUICK

    generations: Count | None = setting(None, quick=8)
    runs: Count = setting(10, quick=3)
    agent_hparams: Literal["default", "varied"] = setting("default")


def compute(settings: SeFeasibility) -> pd.DataFrame:
    """Learns what is missing; a row for each generation of each run."""
    config, folder = learning_config(settings), settings.work_folder / "runs"
    configs = runs.configs_of(config, settings.runs, folder)
    curves = runs.learn(configs)
    runs.collect(configs, settings.folder / "ses.safetensors")
    return curves


def learning_config(settings: SeFeasibility) -> Any:
    """The configuration of the NES runs."""
    config = settings.learn_config([f"agent_hparams={settings.agent_hparams}"])
    use = "se, or run experiments.rn_performance"
    require(config.name("proxy") != "rn", "run.proxy", "must be an SE", got="rn", use=use)
    return config


def median_and_range(values: Any, limit: int) -> str:
    """`median (lowest to highest)` of counts, where inf is "more than the limit"."""
    values = np.median(values), np.min(values), np.max(values)
    middle, low, high = (f"{x:g}" if np.isfinite(x) else f"> {limit}" for x in values)
    return middle if low == high else f"{middle} ({low} to {high})"


def make_table(config: Any, summary: pd.DataFrame) -> pd.DataFrame:
    """The statistics of all runs, beside what the paper says of its own."""
    best, last = summary["best_incumbent_mean"], summary["last_incumbent_mean"]
    to_solve, steps = summary["generations_to_solve"], summary["steps_to_solve"].median()
    more = (
        f"> {summary['steps'].min():,.0f}"  # one that did not solve it took more than all its steps
    )
    row = pd.Series(tables.mean_columns(last, "last"))
    ours = {
        "runs": str(len(summary)),
        "generations run": f"{summary['generations'].max()}",
        "population": str(config.es.population_size),
        "runs that reach the solved score": f"{np.isfinite(to_solve).sum()} of {len(summary)}",
        "generations until then": median_and_range(to_solve, config.generations),
        "real steps until then, median": f"{steps:,.0f}" if np.isfinite(steps) else more,
        "best search mean": f"{best.median():.1f} ({best.min():.1f} to {best.max():.1f})",
        "last search mean": tables.mean_text("last", 1)(row),
        "last search mean, worst tenth": f"{worst_tenth(last):.1f}",
        "wall minutes of a run, mean": f"{summary['wall_min'].mean():.1f}",
    }
    paper = PAPER if config.name("env") in PAPER_TASKS else {}
    beside = [paper.get(name, "") for name in ours]
    return pd.DataFrame({"of the NES runs": ours.keys(), "sejax": ours.values(), "paper": beside})


def report(settings: SeFeasibility, rows: pd.DataFrame) -> pd.DataFrame:
    config = learning_config(settings)
    solved_reward = config.task().solved_reward
    minutes = rows.groupby("seed", sort=False)["wall_s"].last() / 60
    summary = runs.summarise(rows, ["seed"], solved_reward).assign(wall_min=minutes.to_numpy())
    draw(rows, solved_reward, settings.folder / "learning_curves.png")
    varied = " with random hyperparameters" if config.agent_hparams == "varied" else ""
    note = (
        f"Preset {config.preset}. A search mean is over "
        f"{config.es.num_incumbent_evals or config.es.population_size} fresh agents with "
        f"{config.training.test_episodes} test episodes each, the solved score "
        f"{solved_reward:g}. Median and range over runs. {tables.interval_note('runs')} "
        "The best is a maximum of noisy means and hence too high: se_performance tests the stored "
        f"SEs with other agents.{tables.WORST_NOTE}"
    )
    title = f"Learning SEs of {settings.env} for {config.name('agent')} agents{varied}"
    return tables.publish(settings, title, make_table(config, summary), summary, note)


def draw(curves: pd.DataFrame, solved_reward: float, path: Path) -> None:
    """Draws the NES runs.

    Source: paper, figure "Multiple NES runs of Alg. 1".
    """
    with figures.panels(path, 1, 1, (6, 3.6)) as (_, [[axis]]):
        figures.runs(axis, curves, solved_reward)
        axis.set_ylabel("search mean: return of agents\non the real task")
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        axis.legend(fontsize=9, loc="best")


EXPERIMENT = Experiment(settings=SeFeasibility, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
