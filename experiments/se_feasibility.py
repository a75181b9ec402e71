"""Can SEs be learned: the learning curves of many independent NES runs, and the SEs they find.

Source: paper, section "Experiments with Synthetic Environments", paragraph "Feasibility" (figure
"Multiple NES runs"), and appendix "Discussion on the Feasibility of Learning SEs".

Each run is that of `python -m sejax.run` with the same settings and seed. The best SE of each goes
into `ses.safetensors`, which the other experiments read (`ses`, `varied`, `fixed`).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.ticker import MaxNLocator

from experiments.common import figures, runs, tables
from experiments.common.experiment import Experiment, count, setting
from experiments.common.runs import RunSettings
from experiments.common.statistics import worst_tenth
from sejax.options import one_of, require
from sejax.runs.config import AGENT_HPARAMS

# Paper, paragraph "Feasibility": "50 NES iterations are often sufficient to find SEs that teach
# agents to solve a task"; appendix "Discussion on the Feasibility": 40 runs of 200 iterations with
# 16 workers. It gives no share of solved runs.
PAPER_TASKS = ("cartpole", "acrobot")
PAPER = {
    "runs": "40",
    "generations run": "200",
    "population": "16",
    "generations to the first passage": "often about 50",
}


@dataclass(frozen=True, kw_only=True)
class SeFeasibility(RunSettings):
    name = "se_feasibility"

    generations: int | None = count(None, quick=8, help="outer iterations; the preset's")
    runs: int = count(10, quick=3, help="independent NES runs")
    agent_hparams: str = setting(
        "default", one_of(AGENT_HPARAMS), help="varied: drawn for each agent"
    )


def compute(settings: SeFeasibility) -> pd.DataFrame:
    """Learns what is missing; a row for each generation of each run."""
    config, folder = learning_config(settings), settings.work_folder / "runs"
    configs = runs.configs_of(config, settings.runs, folder)
    curves = runs.learn(configs)
    runs.collect(configs, settings.folder / "ses.safetensors")
    return curves


def learning_config(settings: SeFeasibility) -> Any:
    """The configuration of the NES runs."""
    words = [f"agent_hparams={settings.agent_hparams}"]
    config = settings.learn_config([*words, *(runs.QUICK if settings.quick else ())])
    require(
        config.name("proxy") != "rn",
        "run.proxy",
        "must be an SE; got rn. Set run.proxy=se, or run experiments.rn_performance.",
    )
    return config


def summarise(curves: pd.DataFrame, solved_reward: float) -> pd.DataFrame:
    """One row for each run: what it took to solve the task and how far it came."""

    def statistics(curve: pd.DataFrame) -> dict[str, float]:
        to_solve = runs.generations_to_solve(curve, solved_reward)
        at_solving = curve[curve["generation"] + 1 == to_solve]
        return {
            "generations": len(curve),
            "generations_to_solve": to_solve,
            "env_steps_to_solve": at_solving["env_steps_total"].max(),
            "best_incumbent_mean": curve["incumbent_mean"].max(),
            "last_incumbent_mean": curve["incumbent_mean"].iloc[-1],
            "env_steps": curve["env_steps_total"].iloc[-1],
            "wall_min": curve["wall_s"].iloc[-1] / 60,
        }

    return tables.summary_by(curves, ["seed"], statistics)


def median_and_range(values: Any, limit: int) -> str:
    """`median (lowest to highest)` of counts, where inf is "more than the limit"."""
    values = np.asarray(values, float)

    def text(x: float) -> str:
        return f"{x:g}" if np.isfinite(x) else f"> {limit}"

    middle, low, high = map(text, (np.median(values), values.min(), values.max()))
    return middle if low == high else f"{middle} ({low} to {high})"


def median_steps(summary: pd.DataFrame) -> str:
    """Of real steps to solve; a run that did not solve the task took more than all its steps."""
    is_solved = np.isfinite(summary["generations_to_solve"])
    middle = float(np.median(summary["env_steps_to_solve"].where(is_solved, np.inf)))
    return f"{middle:,.0f}" if np.isfinite(middle) else f"> {summary['env_steps'].min():,.0f}"


def make_table(config: Any, summary: pd.DataFrame) -> pd.DataFrame:
    """The statistics of all runs, beside what the paper says of its own."""
    best, last = summary["best_incumbent_mean"], summary["last_incumbent_mean"]
    to_solve = summary["generations_to_solve"]
    row = pd.Series(tables.mean_columns(last, "last"))
    ours = {
        "runs": str(len(summary)),
        "generations run": f"{summary['generations'].max()}",
        "population": str(config.es.population_size),
        "runs with a first passage": f"{np.isfinite(to_solve).sum()} of {len(summary)}",
        "generations to the first passage": median_and_range(to_solve, config.generations),
        "real steps to the first passage, median": median_steps(summary),
        "best incumbent mean": f"{best.median():.1f} ({best.min():.1f} to {best.max():.1f})",
        "last incumbent mean": tables.mean_text("last", 1)(row),
        "last incumbent mean, worst tenth": f"{worst_tenth(last):.1f}",
        "wall minutes of a run, mean": f"{summary['wall_min'].mean():.1f}",
    }
    paper = PAPER if config.name("env") in PAPER_TASKS else {}
    beside = [paper.get(name, "") for name in ours]
    return pd.DataFrame({"of the NES runs": ours.keys(), "sejax": ours.values(), "paper": beside})


def report(settings: SeFeasibility, rows: pd.DataFrame) -> pd.DataFrame:
    config = learning_config(settings)
    solved_reward = config.task().solved_reward
    summary = summarise(rows, solved_reward)
    draw(rows, solved_reward, settings.folder / "learning_curves.png")
    varied = " with varied hyperparameters" if config.agent_hparams == "varied" else ""
    note = (
        f"Preset {config.preset}. An incumbent mean is over "
        f"{config.es.num_incumbent_evals or config.es.population_size} fresh agents with "
        f"{config.training.test_episodes} test episodes each; the "
        f"first passage is the first that reaches {solved_reward:g}, which does not say that fresh "
        "agents solve the task on that SE. Median and range over runs; one "
        "without a first passage took longer than all. The last incumbent mean: over runs. "
        f"{tables.interval_note('runs')} The best is a maximum of noisy means and hence too high: "
        f"se_performance tests the stored SEs with other agents.{tables.WORST_NOTE}"
    )
    title = f"Learning SEs of {settings.env} for {config.name('agent')} agents{varied}"
    return tables.publish(settings, title, make_table(config, summary), summary, note)


def draw(curves: pd.DataFrame, solved_reward: float, path: Path) -> None:
    """Draws each run's incumbent mean as a thin line, and their mean with one std.

    Source: paper, figure "Multiple NES runs of Alg. 1".
    """
    lines = curves.pivot(index="generation", columns="seed", values="incumbent_mean")
    lines = lines.ffill()  # a run that stopped when it solved the task stays where it was
    iterations = lines.index.to_numpy() + 1
    mean, std = lines.mean(axis=1), lines.std(axis=1, ddof=0)
    with figures.panels(path, 1, 1, (6, 3.6)) as (_, axes):
        axis = axes[0, 0]
        for index, seed in enumerate(lines.columns):
            label = None if index else f"NES run ({lines.shape[1]} in all)"
            axis.plot(iterations, lines[seed], color=figures.REAL, lw=0.7, alpha=0.5, label=label)
        shade: Any = {"color": figures.REAL, "alpha": 0.15, "lw": 0}
        axis.fill_between(
            iterations, mean - std, mean + std, label="mean ± std of the runs", **shade
        )
        axis.plot(iterations, mean, color=figures.REAL, lw=2.4)
        figures.threshold(axis, solved_reward, f"solved ({solved_reward:g})")
        label = "mean return of the incumbent's\nagents on the real task"
        limits = (1, max(iterations[-1], 2))
        axis.set(xlabel="NES outer iteration", xlim=limits, ylabel=label)
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        axis.legend(fontsize=9, loc="best")


EXPERIMENT = Experiment(settings=SeFeasibility, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
