"""How long `python -m sejax.run` takes to find a proxy that solves the task, over many seeds.

Each seed is a run of the command itself, one after another on all cores, in a directory of its
own under `--runs`: an interrupted benchmark goes on where it stopped. A run counts as solved at the
first generation whose incumbent mean (fresh agents, none of which trained before) reaches the
task's threshold, and goes on to the end, to show whether the incumbent stays solved.

Reported for each setting: in how many seeds it solved, and the generations, wall-clock minutes
(start, compilation and all files included), CPU minutes and real environment steps to that point;
then the share of later generations in which the incumbent was still solved.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import common
import numpy as np
import pandas as pd

from sejax import envs

SETTINGS = {
    "best": ["preset=best"],
    "paper": ["preset=paper"],
    "paper_performance": ["preset=paper_performance", "stop_when_solved=false"],
}
QUICK = ["es.population_size=4", "training.max_steps=200", "training.max_episodes=20"]


def main() -> None:
    args = common.parse_args(__doc__, add_options)
    settings = [setting.partition(":") for setting in args.settings]
    if args.quick:
        settings, args.runs = [("best", ":", "2x2")], args.runs / "quick"
    tables, rows = {}, []
    for name, _, size in settings:
        num_seeds, generations = (int(x) for x in size.split("x"))
        extra = QUICK if args.quick else []
        runs = [run_seed(args, name, args.seed + i, generations, extra) for i in range(num_seeds)]
        tables[name] = runs
        rows.append(summarise(name, runs, envs.make(args.env).solved_reward))
    columns = list(rows[0])
    common.print_table(f"{args.env}: time to a solved proxy", columns,
                       [[str(row[c]) for c in columns] for row in rows])  # fmt: skip
    if args.figure:
        draw(tables, envs.make(args.env).solved_reward, args.figure)
    if args.markdown:
        args.markdown.write_text(to_markdown(columns, rows))
    common.finish("time_to_solve", args, {"env": args.env, "settings": rows})


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--env", default="cartpole")
    parser.add_argument("--settings", nargs="+", default=["best:10x30"],
                        metavar="PRESET:SEEDSxGENERATIONS")  # fmt: skip
    parser.add_argument("--runs", type=Path, default=Path("runs/time_to_solve"))
    parser.add_argument("--figure", type=Path, help="draw the curves of all seeds there")
    parser.add_argument("--markdown", type=Path, help="write the table there")


def run_seed(
    args: argparse.Namespace, setting: str, seed: int, generations: int, extra: list[str]
) -> dict[str, Any]:
    """Runs or resumes one seed and reads its files."""
    path = args.runs / f"{args.env}-{setting}-s{seed}"
    command = [sys.executable, "-m", "sejax.run", f"env={args.env}", *SETTINGS[setting],
               f"seed={seed}", f"run_dir={path}", f"generations={generations}", *extra]  # fmt: skip
    metrics = path / "metrics.csv"
    if not metrics.exists() or len(pd.read_csv(metrics)) < generations:
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    summary = json.loads((path / "run.json").read_text())
    return {"metrics": pd.read_csv(metrics), **summary}


def summarise(name: str, runs: list[dict[str, Any]], solved_reward: float) -> dict[str, Any]:
    """One row of the table; medians and ranges over the seeds that solved the task."""
    reached = []
    for run in runs:
        metrics = run["metrics"]
        solved = np.flatnonzero(metrics["incumbent_mean"] >= solved_reward)
        if len(solved):
            first = metrics.iloc[solved[0]]
            cpu_per_wall = run["cpu_s_of_last_session"] / metrics["wall_s"].iloc[-1]
            reached.append(
                {
                    "generations": solved[0] + 1,
                    "wall minutes": first["wall_s"] / 60,
                    "CPU minutes": first["wall_s"] / 60 * cpu_per_wall,
                    "real steps": first["env_steps_total"],
                    "solved afterwards": (
                        metrics["incumbent_mean"].iloc[solved[0] :] >= solved_reward
                    ).mean(),
                }
            )
    last = pd.concat([run["metrics"].tail(5) for run in runs])["incumbent_mean"]
    row = {
        "preset": name,
        "generations run": len(runs[0]["metrics"]),
        "solved": f"{len(reached)} of {len(runs)}",
        "best incumbent": f"{np.mean([r['metrics']['best_so_far'].iloc[-1] for r in runs]):.1f}",
        "last five incumbents": f"{last.mean():.1f}",
    }
    table = pd.DataFrame(reached)
    for column, form in (("generations", ",.0f"), ("wall minutes", ".1f"), ("CPU minutes", ".1f"),
                         ("real steps", ",.0f"), ("solved afterwards", ".0%")):  # fmt: skip
        row[column] = _spread(table[column], form) if reached else "-"
    return row


def _spread(values: pd.Series, form: str) -> str:
    return f"{values.median():{form}} ({values.min():{form}} to {values.max():{form}})"


def to_markdown(columns: list[str], rows: list[dict[str, Any]]) -> str:
    lines = [columns, ["---"] * len(columns), *[[str(row[c]) for c in columns] for row in rows]]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def draw(tables: dict[str, list[dict[str, Any]]], solved_reward: float, path: Path) -> None:
    """A panel for each setting: each seed's incumbent mean, and their mean."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    with plt.rc_context({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False}):
        figure, axes = plt.subplots(
            1, len(tables), figsize=(1 + 3.6 * len(tables), 3.4), sharey=True,
            layout="constrained", squeeze=False,
        )  # fmt: skip
        for axis, (name, runs) in zip(axes[0], tables.items(), strict=True):
            curves = pd.concat([run["metrics"]["incumbent_mean"] for run in runs], axis=1)
            axis.plot(curves.to_numpy(), color="#1f5fa8", lw=0.8, alpha=0.6)
            axis.plot(curves.mean(axis=1), color="black", lw=2.2)
            axis.axhline(solved_reward, color="#3c8d40", ls="--", lw=1.2)
            axis.set_title(f"preset={name}, {len(runs)} seeds", fontsize=10)
            axis.set_xlabel("NES generation")
        axes[0][0].set_ylabel("incumbent: mean return\non the real task")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150)


if __name__ == "__main__":
    main()
