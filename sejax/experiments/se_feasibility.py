"""Can SEs be learned: the learning curves of many independent NES runs, and the SEs they find.

Source: paper, section "Experiments with Synthetic Environments", paragraph "Feasibility" (figure
"Multiple NES runs"), and appendix "Discussion on the Feasibility of Learning SEs".

Each run is that of `python -m sejax.run` with the same settings and seed. Run by run they are
learned in `<out>/runs/seed<N>`, and the best SE of each goes into `<out>/ses.safetensors`, which
the other experiments read (`--ses`, `--varied`, `--fixed`).
"""

import argparse
import dataclasses
from typing import Any

import numpy as np
import pandas as pd

from sejax.experiments import common, proxy_runs

NAME = "se_feasibility"
NUM_RUNS = {"cartpole": 10, "acrobot": 5}

# A little world and agents that learn enough to be seen moving.
QUICK = ["generations=8", "es.population_size=12", "es.num_incumbent_evals=8",
         "agent.hidden_size=32", "agent.batch_size=32", "agent.init_episodes=1",
         "training.max_steps=1500", "proxy.hidden_size=32"]  # fmt: skip
QUICK_RUNS = 3

# Paper, paragraph "Feasibility": "50 NES iterations are often sufficient to find SEs that teach
# agents to solve a task"; appendix "Discussion on the Feasibility": 40 runs of 200 iterations with
# 16 workers. It gives no share of solved runs.
PAPER = {"runs": "40", "generations run": "200", "population": "16",
         "generations to solve": "often about 50"}  # fmt: skip


def main() -> None:
    """Runs the experiment as the command line says."""
    common.run_command(NAME, __doc__, add_options, run)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this experiment."""
    parser.add_argument("--env", default="cartpole", help="task: cartpole (default), acrobot, ...")
    parser.add_argument("--runs", type=int, help="independent NES runs; 10, acrobot 5, quick 3")
    parser.add_argument("--generations", type=int, help="outer iterations; the preset's")
    parser.add_argument("--agent-hparams", choices=("default", "varied"), default="default")
    parser.add_argument("--agent", default="ddqn", help="that the SEs are learned with; ddqn")
    parser.add_argument("--preset", default="best", help="best, paper, paper_performance")
    parser.add_argument("--set", nargs="+", default=[], metavar="FIELD=VALUE", dest="overrides",
                        help="further overrides, as of sejax.run")  # fmt: skip


def run(args: argparse.Namespace) -> pd.DataFrame:
    """Learns what is missing, writes everything and returns the table.

    Raises:
      ConfigError: for settings that cannot work, or an output folder of other settings.
    """
    import sejax
    from sejax.errors import require

    config = sejax.config(overrides(args))
    count = args.runs
    if count is None:
        count = QUICK_RUNS if args.quick else NUM_RUNS.get(config.env.name, 5)
    require(count >= 1, "--runs", "be at least 1", "it counts runs", count, "--runs=5")
    config = dataclasses.replace(config, devices=args.devices, seed=args.seed)
    configs = proxy_runs.configs_of_runs(config, count, args.out / "runs")
    curves = proxy_runs.learn_all(configs, common.Pieces(args.out / "pieces"))
    proxy_runs.collect(configs, args.out / "ses.safetensors")
    return report(args, config, curves, config.env.make().solved_reward)


def overrides(args: argparse.Namespace) -> list[str]:
    """The options as overrides of `sejax.config`; later ones win."""
    chosen = [f"env={args.env}", f"agent={args.agent}", f"preset={args.preset}",
              f"agent_hparams={args.agent_hparams}"]  # fmt: skip
    chosen += QUICK if args.quick else []
    if args.generations is not None:
        chosen.append(f"generations={args.generations}")
    return chosen + args.overrides


def summarise(curves: pd.DataFrame, solved_reward: float) -> pd.DataFrame:
    """One row for each run: what it took to solve the task and how far it came.

    Args:
      curves: rows of all runs, with the columns of `metrics.csv`.
      solved_reward: the threshold.
    """
    rows = []
    for seed, curve in curves.groupby("seed"):
        to_solve = proxy_runs.generations_to_solve(curve, solved_reward)
        at_solving = curve[curve["generation"] + 1 == to_solve]
        rows.append({
            "seed": seed,
            "generations": len(curve),
            "generations_to_solve": to_solve,
            "env_steps_to_solve": at_solving["env_steps_total"].max(),
            "best_incumbent_mean": curve["incumbent_mean"].max(),
            "last_incumbent_mean": curve["incumbent_mean"].iloc[-1],
            "env_steps": curve["env_steps_total"].iloc[-1],
            "wall_min": curve["wall_s"].iloc[-1] / 60,
        })  # fmt: skip
    return pd.DataFrame(rows)


def median_and_range(values: Any, limit: int) -> str:
    """`median (lowest to highest)` of counts, where inf is "more than the limit"."""
    values = np.sort(np.asarray(values, float))
    middle = common.median(values)

    def text(x: float) -> str:
        return f"{x:g}" if np.isfinite(x) else f"> {limit}"

    if values[0] == values[-1]:
        return text(middle)
    return f"{text(middle)} ({text(values[0])} to {text(values[-1])})"


def make_table(config: Any, runs: pd.DataFrame) -> pd.DataFrame:
    """The statistics of all runs, beside what the paper says of its own."""
    solved = runs[np.isfinite(runs["generations_to_solve"])]
    best, last = runs["best_incumbent_mean"], runs["last_incumbent_mean"]
    low, high = common.bootstrap_interval(last)
    ours = {
        "runs": str(len(runs)),
        "generations run": f"{runs['generations'].max()}",
        "population": str(config.es.population_size),
        "runs solved": f"{len(solved)} of {len(runs)}",
        "generations to solve": median_and_range(runs["generations_to_solve"], config.generations),
        "real steps to solve, median": f"{solved['env_steps_to_solve'].median():,.0f}"
        if len(solved) else "-",
        "best incumbent mean": f"{best.median():.1f} ({best.min():.1f} to {best.max():.1f})",
        "last incumbent mean": f"{last.mean():.1f} [{low:.1f}, {high:.1f}]",
        "wall minutes of a run": f"{runs['wall_min'].mean():.1f}",
    }  # fmt: skip
    return pd.DataFrame([
        {"of the NES runs": name, "sejax": value, "paper": PAPER.get(name, "")}
        for name, value in ours.items()
    ])  # fmt: skip


def report(
    args: argparse.Namespace, config: Any, curves: pd.DataFrame, solved_reward: float
) -> pd.DataFrame:
    """Writes the CSV, the picture and the table, prints the table and returns it."""
    from sejax.experiments import figures
    from sejax.files import write_text

    runs = summarise(curves, solved_reward)
    table = make_table(config, runs)
    write_text(args.out / "learning_curves.csv", curves.to_csv(index=False))
    write_text(args.out / "runs.csv", runs.to_csv(index=False))
    figures.learning_curves(curves, solved_reward, args.out / "learning_curves.png")
    varied = " with varied hyperparameters" if config.agent_hparams == "varied" else ""
    title = f"Learning SEs of {config.env.name} for {config.agent.name} agents{varied}"
    note = (
        f"Preset {config.preset}. An incumbent mean is over {num_incumbent_evals(config)} fresh "
        f"agents with {config.training.test_episodes} test episodes each; a run counts as solved "
        f"from the first generation in which it reaches {solved_reward:g}. Median and range over "
        "runs; a run that did not solve the task counts as longer than all. The last incumbent "
        "mean is that over runs, with a bootstrap 95% interval; the best is a maximum of noisy "
        "means and hence too high: se_performance tests the stored SEs with other agents."
    )
    common.write_markdown(args.out / "table.md", title, common_command(args), table, note)
    figures.print_table(title, table)
    print(f"{args.out}: learning_curves.csv, .png, runs.csv and table.md; the best SE of each run "
          f"is in {args.out / 'ses.safetensors'}.")  # fmt: skip
    return table


def num_incumbent_evals(config: Any) -> int:
    """Agents that an incumbent mean is over; one for each member if not configured."""
    return config.es.num_incumbent_evals or config.es.population_size


def common_command(args: argparse.Namespace) -> str:
    """The command that makes these results again."""
    from sejax.experiments.figures import command

    return command(NAME, args, "env", "agent", "agent_hparams", "preset", "runs", "generations",
                   ("overrides", "set"))  # fmt: skip


if __name__ == "__main__":
    main()
