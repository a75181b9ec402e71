"""Can SEs be learned: the learning curves of many independent NES runs, and the SEs they find.

Source: paper, section "Experiments with Synthetic Environments", paragraph "Feasibility" (figure
"Multiple NES runs"), and appendix "Discussion on the Feasibility of Learning SEs".

Each run is that of `python -m sejax.run` with the same settings and seed. The best SE of each goes
into `ses.safetensors`, which the other experiments read (`ses`, `varied`, `fixed`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from experiments import figures, proxy_runs
from experiments.experiment import Experiment
from experiments.proxy_runs import RunSettings
from experiments.settings import count, setting
from experiments.statistics import bootstrap_interval
from experiments.tables import iqm_columns, iqm_note, iqm_text, publish
from sejax.cli.build import AGENT_HPARAMS
from sejax.options import one_of

NUM_RUNS = {"cartpole": 10}

# A little world and agents that learn enough to be seen moving.
QUICK = [
    "generations=8",
    "es.population_size=12",
    "es.num_incumbent_evals=8",
    "agent.hidden_size=32",
    "agent.batch_size=32",
    "agent.warmup_episodes=1",
    "training.max_steps=1500",
    "proxy.hidden_size=32",
]

# Paper, paragraph "Feasibility": "50 NES iterations are often sufficient to find SEs that teach
# agents to solve a task"; appendix "Discussion on the Feasibility": 40 runs of 200 iterations with
# 16 workers. It gives no share of solved runs.
PAPER_TASKS = ("cartpole", "acrobot")
PAPER = {
    "runs": "40",
    "generations run": "200",
    "population": "16",
    "generations to solve": "often about 50",
}


@dataclass(frozen=True, kw_only=True)
class SeFeasibility(RunSettings):
    name = "se_feasibility"

    runs: int = count(5, "runs", quick=3, about="independent NES runs; cartpole 10")
    agent: str | None = setting(None, about="that the SEs are learned with; the task's choice")
    agent_hparams: str = setting(
        "default",
        one_of(AGENT_HPARAMS),
        about="its hyperparameters; varied: drawn for each training",
    )

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> dict[str, Any]:
        usual = super().defaults(given)
        if not given.get("quick"):
            usual["runs"] = NUM_RUNS.get(given.get("env", usual["env"]), usual["runs"])
        return usual


def compute(settings: SeFeasibility) -> pd.DataFrame:
    """Learns what is missing; a row for each generation of each run."""
    config, folder = learning_config(settings), settings.work_folder / "runs"
    runs = proxy_runs.configs_of_runs(config, settings.runs, folder)
    curves = proxy_runs.learn_all(runs)
    proxy_runs.collect(runs, settings.folder / "ses.safetensors")
    return curves


def learning_config(settings: SeFeasibility) -> Any:
    """The configuration of the NES runs."""
    words = [f"agent_hparams={settings.agent_hparams}"]
    words += [f"agent={settings.agent}"] if settings.agent else []
    return settings.learn_config(words + (QUICK if settings.quick else []))


def summarise(curves: pd.DataFrame, solved_reward: float) -> pd.DataFrame:
    """One row for each run: what it took to solve the task and how far it came."""
    rows = []
    for seed, curve in curves.groupby("seed"):
        to_solve = proxy_runs.generations_to_solve(curve, solved_reward)
        at_solving = curve[curve["generation"] + 1 == to_solve]
        rows.append(
            {
                "seed": seed,
                "generations": len(curve),
                "generations_to_solve": to_solve,
                "env_steps_to_solve": at_solving["env_steps_total"].max(),
                "best_incumbent_mean": curve["incumbent_mean"].max(),
                "last_incumbent_mean": curve["incumbent_mean"].iloc[-1],
                "env_steps": curve["env_steps_total"].iloc[-1],
                "wall_min": curve["wall_s"].iloc[-1] / 60,
            }
        )
    return pd.DataFrame(rows)


def median_and_range(values: Any, limit: int) -> str:
    """`median (lowest to highest)` of counts, where inf is "more than the limit"."""
    values = np.sort(np.asarray(values, float))
    middle = float(np.median(values))

    def text(x: float) -> str:
        return f"{x:g}" if np.isfinite(x) else f"> {limit}"

    if values[0] == values[-1]:
        return text(middle)
    return f"{text(middle)} ({text(values[0])} to {text(values[-1])})"


def median_steps(runs: pd.DataFrame) -> str:
    """Of real steps to solve; a run that did not solve the task took more than all its steps."""
    steps = runs["env_steps_to_solve"].where(np.isfinite(runs["generations_to_solve"]), np.inf)
    middle = float(np.median(steps))
    return f"{middle:,.0f}" if np.isfinite(middle) else f"> {runs['env_steps'].min():,.0f}"


def make_table(config: Any, runs: pd.DataFrame) -> pd.DataFrame:
    """The statistics of all runs, beside what the paper says of its own."""
    solved = runs[np.isfinite(runs["generations_to_solve"])]
    best, last = runs["best_incumbent_mean"], runs["last_incumbent_mean"]
    low, high = bootstrap_interval(last)
    ours = {
        "runs": str(len(runs)),
        "generations run": f"{runs['generations'].max()}",
        "population": str(config.es.population_size),
        "runs solved": f"{len(solved)} of {len(runs)}",
        "generations to solve": median_and_range(runs["generations_to_solve"], config.generations),
        "real steps to solve, median": median_steps(runs),
        "best incumbent mean": f"{best.median():.1f} ({best.min():.1f} to {best.max():.1f})",
        "last incumbent mean": f"{last.mean():.1f} [{low:.1f}, {high:.1f}]",
        "last incumbent mean, IQM": iqm_text("last").format_map(iqm_columns(last, "last")),
        "wall minutes of a run, mean": f"{runs['wall_min'].mean():.1f}",
    }
    paper = PAPER if config.name("env") in PAPER_TASKS else {}
    return pd.DataFrame(
        [
            {"of the NES runs": name, "sejax": value, "paper": paper.get(name, "")}
            for name, value in ours.items()
        ]
    )


def report(settings: SeFeasibility, rows: pd.DataFrame) -> pd.DataFrame:
    config = learning_config(settings)
    solved_reward = config.task().solved_reward
    summary = summarise(rows, solved_reward)
    figures.learning_curves(rows, solved_reward, settings.folder / "learning_curves.png")
    varied = " with varied hyperparameters" if config.agent_hparams == "varied" else ""
    note = (
        f"Preset {config.preset}. An incumbent mean is over "
        f"{config.es.num_incumbent_evals or config.es.population_size} fresh "
        f"agents with {config.training.test_episodes} test episodes each; a run counts as solved "
        f"from the first generation in which it reaches {solved_reward:g}. Median and range over "
        "runs; a run that did not solve the task counts as longer than all. The last incumbent "
        "mean is that over runs, with a bootstrap 95% interval; the best is a maximum of noisy "
        "means and hence too high: se_performance tests the stored SEs with other agents."
        f"{iqm_note(of='runs')}"
    )
    title = f"Learning SEs of {settings.env} for {config.name('agent')} agents{varied}"
    return publish(settings, title, make_table(config, summary), summary, note)


EXPERIMENT = Experiment(settings=SeFeasibility, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
