"""How well each single SE of a set trains agents: violins of the test returns, the best SE first.

Source: paper, appendix "Evaluation of Individual SE Models" for CartPole and for Acrobot: 40 SEs,
1000 agents with drawn hyperparameters on each, 10 test episodes.

Agents are trained as in se_performance; with its `--out` folder, those that it trained on the same
SEs are used again.
"""

import argparse
from typing import Any

import numpy as np
import pandas as pd

from sejax.errors import ConfigError
from sejax.experiments import common, se_agents

NAME = "se_models"


def main() -> None:
    """Runs the experiment as the command line says."""
    common.run_command(NAME, __doc__, add_options, run)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this experiment."""
    parser.add_argument("--ses", metavar="FILE", help="SEs, from se_feasibility; with --quick, "
                        "the shipped cartpole SE")  # fmt: skip
    se_agents.add_options(parser)


def run(args: argparse.Namespace) -> pd.DataFrame:
    """Trains what is missing, writes everything and returns the table.

    Raises:
      ConfigError: for a file or settings that cannot work.
    """
    from sejax.proxies.sets import load_set

    se_agents.fill_in(args)
    source = args.ses or ("cartpole" if args.quick else None)
    if source is None:
        raise ConfigError("--ses must be given, because agents are trained on its SEs; got none. "
                          "Set --ses=results/se_feasibility/ses.safetensors.")  # fmt: skip
    ses = load_set(source, "--ses", "se").first(args.num_ses)
    world = se_agents.se_world(args, ses)
    pieces = common.Pieces(args.out / "pieces")
    agents = pd.concat([se_agents.train_all(args, kind, world, pieces) for kind in args.agents])
    agents["se"] = agents["group"].map({name: i for i, name in enumerate(world.names)})
    return report(args, ses, agents)


def summarise(agents: pd.DataFrame, solved_reward: float) -> pd.DataFrame:
    """One row for each kind of agent and SE, the best SE of each kind first.

    Args:
      agents: with columns `kind`, `se`, `test_return` and `train_steps`.
      solved_reward: an agent counts as solving the task from this mean test return on.
    """
    grouped = agents.groupby(["kind", "se"], sort=False)
    summary = grouped["test_return"].agg(
        return_mean="mean",
        return_std=lambda x: x.std(ddof=0),
        solved=lambda x: (x >= solved_reward).mean(),
    )
    summary["train_steps"] = grouped["train_steps"].mean()
    kinds = list(dict.fromkeys(agents["kind"]))
    rank = summary.reset_index().assign(order=lambda t: t["kind"].map(kinds.index))
    rank = rank.sort_values(["order", "return_mean"], ascending=[True, False], kind="stable")
    return rank.drop(columns="order").reset_index(drop=True)


def rank_correlations(summary: pd.DataFrame) -> pd.DataFrame:
    """Spearman's correlation of the SEs' mean returns between each two kinds of agents.

    It says whether an SE that suits one kind of agent suits another; nan where all SEs are equal.
    """
    means = summary.pivot(index="se", columns="kind", values="return_mean")
    return means[list(dict.fromkeys(summary["kind"]))].rank().corr()


def report(args: argparse.Namespace, ses: Any, agents: pd.DataFrame) -> pd.DataFrame:
    """Writes the CSV, the picture and the table, prints the table and returns it."""
    from sejax.experiments import figures
    from sejax.files import write_text

    task, scores, seeds = ses.task, ses.scores, ses.seeds
    summary = summarise(agents, task.solved_reward)
    table = pd.DataFrame([
        {
            "agent": row.kind,
            "SE": row.se,
            "run's seed": seeds[row.se],
            "score when learned": f"{scores[row.se]:.1f}",
            "return": f"{row.return_mean:.1f} ± {row.return_std:.1f}",
            "agents that solve the task": f"{row.solved:.0%}",
            "training steps": f"{row.train_steps:,.0f}",
        }
        for row in summary.itertuples()
    ])  # fmt: skip
    write_text(args.out / "models_agents.csv", agents.to_csv(index=False))
    write_text(args.out / "models_summary.csv", summary.to_csv(index=False))
    kinds = {kind: agents[agents["kind"] == kind] for kind in args.agents}
    figures.violins(kinds, se_agents.return_columns(agents), task.name, task.solved_reward,
                    args.out / "models.png")  # fmt: skip
    title = f"Single SEs of {task.name} (solved at {task.solved_reward:g})"
    note = (
        f"Return: mean ± std over {args.num_agents} agents with drawn hyperparameters and "
        f"{args.test_episodes} test episodes each. The paper has 1000 agents on each of 40 SEs "
        f"and shows violins only, no numbers.{correlations_text(summary)}"
    )
    command = figures.command(NAME, args, "ses", "agents", "num_agents", "num_ses",
                              "test_episodes", "max_steps")  # fmt: skip
    common.write_markdown(args.out / "models_table.md", title, command, table, note)
    figures.print_table(title, table)
    print(f"{args.out}: models_agents.csv (every test return), models_summary.csv, models.png and "
          f"models_table.md.{correlations_text(summary)}")  # fmt: skip
    return table


def correlations_text(summary: pd.DataFrame) -> str:
    """A sentence on the rank correlations; nothing for fewer than three SEs or two kinds."""
    if summary["se"].nunique() < 3:
        return ""
    matrix = rank_correlations(summary)
    kinds = list(matrix)
    texts = [f"{a} and {b} {matrix.loc[a, b]:.2f}" for i, a in enumerate(kinds)
             for b in kinds[i + 1 :] if np.isfinite(matrix.loc[a, b])]  # fmt: skip
    return f" Rank correlation of the SEs' mean returns: {', '.join(texts)}." if texts else ""


if __name__ == "__main__":
    main()
