"""How long `python -m sejax.run` takes until an incumbent reaches the threshold, over many seeds.

Each seed is a run of the command itself, one after another on all cores, in a directory of its
own under `--runs`: an interrupted benchmark goes on where it stopped. The curves of finished seeds
are kept in `--curves`, and no seed is run again that it has with as many generations. A run's first
passage is the first generation whose incumbent mean reaches the task's threshold, after which fresh
agents can still fall short of it. The run goes on, to show whether the incumbent stays there.

Reported for each setting: in how many seeds there was a first passage, and the generations,
wall-clock minutes (compilation and all files included, Python's start and imports not), CPU minutes
and real environment steps until it, of those seeds; then the share of later generations in which
the incumbent was there.
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
from sejax.ops.files import write_text

SETTINGS = {
    "best": ["preset=best"],
    "paper": ["preset=paper"],
    "paper_performance": ["preset=paper_performance", "stop_when_solved=false"],
    "soft": ["preset=soft"],
    # The soft preset with one thing changed; 128 trainings in a generation as there.
    "threshold": ["preset=soft", "proxy.done=threshold"],
    "unmirrored": ["preset=soft", "es.mirrored=false", "es.population_size=128"],
    "rank": ["preset=soft", "es.score_transform=rank", "es.step_size=0.03"],
    "nes_unnormalized": ["preset=soft", "es.score_transform=nes_unnormalized", "es.step_size=0.06"],
    "snes": ["preset=soft", "es=snes", "es.population_size=128", "es.noise_std=0.06"],
    "open_es": ["preset=soft", "es=open_es", "es.population_size=128", "es.noise_std=0.06"],
    "sep_cma_es": ["preset=soft", "es=sep_cma_es", "es.population_size=128", "es.noise_std=0.06"],
}
COLUMNS = ["preset", "seed", "generation", "incumbent_mean", "env_steps_total", "wall_s", "cpu_s"]
QUICK = ["es.population_size=4", "agent.warmup_episodes=1", "training.max_steps=1000"]


def main() -> None:
    args = common.parse_args(__doc__, add_options)
    settings = [setting.partition(":") for setting in args.settings]
    if args.quick:
        settings, args.runs = [("best", ":", "2x2")], args.runs / "quick"
        args.curves = args.runs / "curves.csv"
    args.curves = args.curves or Path(f"results/time_to_solve/{args.env}.csv")
    tables, rows = {}, []
    for name, _, size in settings:
        num_seeds, generations = (int(x) for x in size.split("x"))
        seeds = range(args.seed, args.seed + num_seeds)
        tables[name] = [curve_of(args, name, seed, generations) for seed in seeds]
        rows.append(summarise(name, tables[name], envs.make(args.env).solved_reward))
    title = f"{args.env}: time until the first incumbent at the threshold"
    common.print_table(title, [*rows[0]], [[*row.values()] for row in rows])
    if args.figure:
        draw(tables, envs.make(args.env).solved_reward, args.figure)
    common.finish("time_to_solve", args, {"env": args.env, "settings": rows})


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--env", default="cartpole")
    parser.add_argument("--settings", nargs="+", default=["best:10x30"],
                        metavar="NAME:SEEDSxGENERATIONS", help=", ".join(SETTINGS))  # fmt: skip
    parser.add_argument("--runs", type=Path, default=Path("runs/time_to_solve"))
    parser.add_argument("--curves", type=Path, metavar="CSV", help="curves of all finished seeds; "
                        "results/time_to_solve/ENV.csv")  # fmt: skip
    parser.add_argument("--figure", type=Path, help="draw the curves of all seeds there")


def curve_of(args: argparse.Namespace, setting: str, seed: int, generations: int) -> pd.DataFrame:
    """One seed's curve, a row for each generation: read if it is there, else run and kept."""
    kept = pd.read_csv(args.curves) if args.curves.exists() else pd.DataFrame(columns=COLUMNS)
    mine = (kept["preset"] == setting) & (kept["seed"] == seed)
    if mine.sum() < generations:
        curve = run_seed(args, setting, seed, generations)
        parts = [part for part in (kept[~mine], curve) if len(part)]
        write_text(args.curves, pd.concat(parts).to_csv(index=False, float_format="%.6g"))
        return curve
    return kept[mine].head(generations)


def run_seed(args: argparse.Namespace, setting: str, seed: int, generations: int) -> pd.DataFrame:
    """Runs or resumes one seed and returns its curve, with the columns of `COLUMNS`."""
    path = args.runs / f"{args.env}-{setting}-s{seed}"
    command = [sys.executable, "-m", "sejax.run", f"env={args.env}", *SETTINGS[setting],
               f"seed={seed}", f"run_dir={path}", f"generations={generations}",
               *(QUICK if args.quick else [])]  # fmt: skip
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    metrics = pd.read_csv(path / "metrics.csv")
    cpu_s = json.loads((path / "run.json").read_text())["cpu_s"]
    # All of a run's generations are alike enough to share out the CPU time by wall-clock.
    cpu_per_wall = cpu_s / metrics["wall_s"].iloc[-1]
    return metrics.assign(preset=setting, cpu_s=metrics["wall_s"] * cpu_per_wall)[COLUMNS]


def summarise(name: str, curves: list[pd.DataFrame], solved_reward: float) -> dict[str, Any]:
    """One row of the table; medians and ranges over the seeds with a first passage."""
    reached = []
    for curve in curves:
        is_there = curve["incumbent_mean"].to_numpy() >= solved_reward
        if is_there.any():
            first = int(np.argmax(is_there))
            row = curve.iloc[first]
            reached.append(
                {
                    "generations": first + 1,
                    "wall minutes": row["wall_s"] / 60,
                    "CPU minutes": row["cpu_s"] / 60,
                    "real steps": row["env_steps_total"],
                    "there afterwards": is_there[first + 1 :].mean()
                    if first + 1 < len(curve)
                    else np.nan,
                }
            )
    last = pd.concat([curve.tail(5) for curve in curves])["incumbent_mean"]
    best = np.mean([curve["incumbent_mean"].max() for curve in curves])
    cpu_s = np.mean([curve["cpu_s"].iloc[-1] / len(curve) for curve in curves])
    row = {
        "preset": name,
        "generations run": len(curves[0]),
        "first passage": f"{len(reached)} of {len(curves)}",
        "best search mean": f"{best:.1f}",
        "last five search means": f"{last.mean():.1f}",
        "CPU seconds of a generation": f"{cpu_s:.0f}",
    }
    table = pd.DataFrame(reached)
    for column, form in (("generations", ",.0f"), ("wall minutes", ".1f"), ("CPU minutes", ".1f"),
                         ("real steps", ",.0f"), ("there afterwards", ".0%")):  # fmt: skip
        row[column] = _spread(table[column], form) if reached else "-"
    return row


def _spread(values: pd.Series, form: str) -> str:
    return f"{values.median():{form}} ({values.min():{form}} to {values.max():{form}})"


def draw(tables: dict[str, list[pd.DataFrame]], solved_reward: float, path: Path) -> None:
    """A panel for each setting: each seed's incumbent mean, and their mean."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    with plt.rc_context({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False}):
        figure, axes = plt.subplots(
            1, len(tables), figsize=(1 + 3.6 * len(tables), 3.4), sharey=True,
            layout="constrained", squeeze=False,
        )  # fmt: skip
        for axis, (name, seeds) in zip(axes[0], tables.items(), strict=True):
            curves = pd.concat([c.set_index("generation")["incumbent_mean"] for c in seeds], axis=1)
            axis.plot(curves.index + 1, curves.to_numpy(), color="#1f5fa8", lw=0.8, alpha=0.6)
            axis.plot(curves.index + 1, curves.mean(axis=1), color="black", lw=2.2)
            axis.axhline(solved_reward, color="#3c8d40", ls="--", lw=1.2)
            axis.set_title(f"preset={name}, {len(seeds)} seeds", fontsize=10)
            axis.set_xlabel("NES generation")
        axes[0][0].set_ylabel("search mean: return\non the real task")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150)


if __name__ == "__main__":
    main()
