"""How fast agents learn with learned rewards: test returns against training steps for each RN.

Source: paper, section "Experiments with Reward Networks" (figure with the average cumulative test
rewards, and the rows for default hyperparameters, varied ones and unseen agents), appendix
"HalfCheetah RNs Plots"; `reference_details.md` 7.3.

The RNs of each variant are learned first (`--learned`), and are kept for all experiments. On each
of the best `--rns` of them `--num-agents` agents are trained in each row, and as many on the real
task alone and with an exploration bonus. Episodes of training and of greedy testing on the real
task alternate, and nothing stops an agent early.

Differs: agents stop after the steps that the paper's figure shows, or its number of episodes.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import pandas as pd

from sejax.experiments import common, return_curves, rn_curves, rn_studies

NAME = "rn_performance"


def main() -> None:
    """Runs the experiment as the command line says."""
    common.run_command(NAME, __doc__, add_options, run)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this experiment."""
    rn_curves.add_options(parser)
    rn_studies.add_objective(parser)


def run(args: argparse.Namespace) -> pd.DataFrame:
    """Computes what is missing, writes everything and returns the table.

    Raises:
      ConfigError: for settings that cannot work, or an output folder of other settings.
    """
    rn_curves.fill_in(args)
    rn_studies.check_stored(args, [args.objective])
    pieces = common.Pieces(args.out / "pieces")
    tables = [
        rn_curves.train_all(args, row, world, pieces) for world in worlds(args) for row in args.rows
    ]
    return report(args, rn_curves.by_row(args, pd.concat(tables)))


def worlds(args: argparse.Namespace) -> Iterator[rn_curves.World]:
    """All worlds that agents are trained in; RNs are learned when they are needed."""
    yield from rn_curves.real_worlds(args)
    for variant in args.variants:
        rns = rn_studies.learn(args, variant, args.objective).ranked(args.rns)
        yield rn_curves.rn_world(variant, rns)


def report(args: argparse.Namespace, curves: pd.DataFrame) -> pd.DataFrame:
    """Writes the CSV, the picture and the table, prints the table and returns it."""
    from sejax.experiments import figures
    from sejax.files import write_text

    task = rn_studies.env_config(args).make()
    summary = rn_curves.summarise(curves, task.solved_reward, args.max_steps)
    table = rn_curves.make_table(summary)
    write_text(args.out / "summary.csv", summary.to_csv(index=False))
    draw(curves, args, task.solved_reward, args.out / "performance.png")
    title = f"Agents trained with reward networks and tested on {args.env}"
    episodes = rn_studies.STUDIES[args.env].max_episodes
    with_bonus = f" (with a bonus: {args.bonus_groups})" if args.bonus_groups else ""
    note = (
        f"The best {args.rns} of {args.learned} RNs of each variant, learned by {args.objective}, "
        f"with {args.num_agents} agents each, and as many groups on the real task{with_bonus}; up "
        f"to {args.max_steps:,} training steps or {episodes:,} episodes, one greedy test episode "
        f"after each. Steps to solve: until the mean of {return_curves.WINDOW} tests in a row "
        f"reaches {task.solved_reward:g}; an agent that never does counts {args.max_steps:,}. In "
        "brackets bootstrap 95% intervals, for at least five RNs: they draw RNs, and agents on the "
        "real task. The paper shows curves and gives no numbers: on each of these tasks some "
        "variant learns faster than all agents without an RN, the additive ones most reliably."
    )
    command = figures.command(NAME, args, "env", "variants", "bonuses", "bonus_groups", "rows",
                              "objective", "learned", "rns", "generations", "num_agents",
                              "max_steps", "preset", "set", "rns_dir")  # fmt: skip
    common.write_markdown(args.out / "table.md", title, command, table, note)
    figures.print_table(title, table)
    rns_dir = rn_studies.rns_dir(args)
    print(f"{args.out}: summary.csv, performance.png and table.md; the RNs are in {rns_dir}.")
    return table


def draw(curves: pd.DataFrame, args: argparse.Namespace, solved_reward: float, path: Path) -> None:
    """Draws a panel for each row of agents."""
    import matplotlib.pyplot as plt

    from sejax.experiments import figures

    with plt.rc_context(figures.STYLE):
        figure, axes = plt.subplots(
            1, len(args.rows), figsize=(0.6 + 4 * len(args.rows), 3.9), sharey=True,
            squeeze=False, layout="constrained",
        )  # fmt: skip
        for axis, row in zip(axes[0], args.rows, strict=True):
            rn_curves.panel(axis, curves[curves["row"] == row], args, solved_reward)
            axis.set_title(rn_curves.panel_title(args, row), fontsize=10)
            axis.set_xlabel("training steps")
        axes[0, 0].set_ylabel(f"test return on {args.env}")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, ncols=min(len(labels), 4), loc="outside upper center",
                      fontsize=9)  # fmt: skip
        figures.write(figure, path)


if __name__ == "__main__":
    main()
