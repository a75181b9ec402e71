"""What RNs are learned for: the reward threshold, the area under the curve, or the final return.

Source: paper, appendix "Studying the Influence of Different Reward Network Optimization
Objectives"; `reference_details.md` 7.3 and 7.4.

As `rn_performance`, once for each objective. The authors' scripts picked the ten RNs with the
*lowest* scores for two of the three objectives; both choices are shown here, `best` and `worst`, of
half of the RNs at most each.

Differs: the area under the curve is divided by the training steps; the authors' is `auc_sum`, for
which falling off the cliff at once is best.
"""

import argparse
from pathlib import Path

import pandas as pd

from sejax.configs import OBJECTIVES
from sejax.errors import require
from sejax.experiments import common, return_curves, rn_curves, rn_studies
from sejax.validation import each_of

NAME = "rn_objectives"
PICKS = ("best", "worst")
QUICK_LEARNED = 4
OBJECTIVE_NAMES = {
    "reward_threshold": "reward threshold",
    "auc": "area under the curve",
    "max_reward": "final return",
    "auc_sum": "area, not by steps",
}
DEFAULT_OBJECTIVES = ("reward_threshold", "auc", "max_reward")


def main() -> None:
    """Runs the experiment as the command line says."""
    common.run_command(NAME, __doc__, add_options, run)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this experiment."""
    rn_curves.add_options(parser)
    parser.add_argument("--objectives", nargs="+", default=list(DEFAULT_OBJECTIVES),
                        metavar="OBJECTIVE", help=", ".join(OBJECTIVE_NAMES))  # fmt: skip
    parser.add_argument("--picks", nargs="+", default=list(PICKS), metavar="PICK",
                        help="RNs that train agents: best, worst (as the authors' scripts picked "
                             "for two objectives); both")  # fmt: skip


def fill_in(args: argparse.Namespace) -> None:
    """As `rn_curves.fill_in`; unless they are given, as few RNs are picked as leave picks apart.

    Raises:
      ConfigError: for options that cannot work, or if the best would be among the worst.
    """
    picked = args.rns
    if args.quick and args.learned is None:
        args.learned = QUICK_LEARNED
    rn_curves.fill_in(args)
    each_of("--objectives", args.objectives, OBJECTIVES)
    each_of("--picks", args.picks, PICKS)
    if len(args.picks) > 1 and picked is None:
        args.rns = max(1, min(args.rns, args.learned // 2))
    require(len(args.picks) == 1 or 2 * args.rns <= args.learned, "--learned",
            f"be at least {2 * args.rns}", "the best and the worst are picked from them",
            args.learned, f"--learned={2 * args.rns} or --picks best")  # fmt: skip


def run(args: argparse.Namespace) -> pd.DataFrame:
    """Computes what is missing, writes everything and returns the table.

    Raises:
      ConfigError: for settings that cannot work, or an output folder of other settings.
    """
    fill_in(args)
    rn_studies.check_stored(args, args.objectives)
    pieces = common.Pieces(args.out / "pieces")
    without = pd.concat(
        [
            rn_curves.train_all(args, row, world, pieces)
            for row in args.rows
            for world in rn_curves.real_worlds(args)
        ]
    )
    tables = []
    for objective in args.objectives:
        learned = {variant: rn_studies.learn(args, variant, objective) for variant in args.variants}
        for pick in args.picks:
            curves = [without]
            for variant, rns in learned.items():
                world = rn_curves.rn_world(variant, rns.ranked(args.rns, worst=pick == "worst"))
                prefix = f"{objective}-{pick}-"
                curves += [rn_curves.train_all(args, row, world, pieces, prefix)
                           for row in args.rows]  # fmt: skip
            curves_by_row = rn_curves.by_row(args, pd.concat(curves))
            tables.append(curves_by_row.assign(objective=objective, pick=pick))
    return report(args, pd.concat(tables, ignore_index=True))


def report(args: argparse.Namespace, curves: pd.DataFrame) -> pd.DataFrame:
    """Writes the CSV, the pictures and the table, prints the table and returns it."""
    from sejax.experiments import figures
    from sejax.files import write_text

    task = rn_studies.env_config(args).make()
    summaries: list[pd.DataFrame] = []
    tables: list[pd.DataFrame] = []
    for (objective, pick), mine in curves.groupby(["objective", "pick"], sort=False):
        summary = rn_curves.summarise(mine, task.solved_reward, args.max_steps)
        table = rn_curves.make_table(summary)
        with_rn = ~table["trained with"].isin(rn_curves.WITHOUT_RN)
        if not tables:  # the agents without an RN are the same beside each objective
            tables.append(table[~with_rn].assign(objective="", RNs=""))
        chosen = {"objective": OBJECTIVE_NAMES[str(objective)], "RNs": pick}
        tables.append(table[with_rn].assign(**chosen))
        summaries.append(summary.assign(objective=objective, pick=pick))
    table = pd.concat(tables, ignore_index=True)
    table = table[["objective", "RNs", *table.columns.drop(["objective", "RNs"])]]
    write_text(args.out / "summary.csv", pd.concat(summaries).to_csv(index=False))
    for pick in args.picks:
        draw(curves[curves["pick"] == pick], args, task.solved_reward, args.out / f"{pick}.png")
    title = f"Objectives of reward networks on {args.env}"
    episodes = rn_studies.STUDIES[args.env].max_episodes
    note = (
        f"{args.learned} RNs of each variant were learned by each objective. Of these the "
        f"{args.rns} with the highest and with the lowest scores (best, worst) train "
        f"{args.num_agents} agents each, for up to {args.max_steps:,} training steps or "
        f"{episodes:,} episodes. Steps to solve: until the mean of {return_curves.WINDOW} tests in "
        f"a row reaches {task.solved_reward:g}; an agent that never does counts "
        f"{args.max_steps:,}. In brackets bootstrap 95% intervals, for at least five RNs: they "
        "draw RNs, and agents on the real task. The area is by training steps, where the authors' "
        "code has the sum. The paper shows curves and gives no numbers; those for the area and the "
        "final return are, by a slip in the authors' scripts, of the worst ten. It concludes that "
        "the area does about as well as the threshold, and that the final return makes learning "
        "faster on CartPole but not on Cliff Walking."
    )
    command = figures.command(NAME, args, "env", "objectives", "picks", "variants", "bonuses",
                              "bonus_groups", "rows", "learned", "rns", "generations",
                              "num_agents", "max_steps", "preset", "set", "rns_dir")  # fmt: skip
    common.write_markdown(args.out / "table.md", title, command, table, note)
    figures.print_table(title, table)
    pictures = ", ".join(f"{pick}.png" for pick in args.picks)
    rns_dir = rn_studies.rns_dir(args)
    print(f"{args.out}: summary.csv, {pictures} and table.md; the RNs are in {rns_dir}.")
    return table


def draw(curves: pd.DataFrame, args: argparse.Namespace, solved_reward: float, path: Path) -> None:
    """Draws a row of panels for each objective and a column for each row of agents."""
    import matplotlib.pyplot as plt

    from sejax.experiments import figures

    shape = (len(args.objectives), len(args.rows))
    with plt.rc_context(figures.STYLE):
        figure, axes = plt.subplots(
            *shape, figsize=(0.8 + 3.8 * shape[1], 0.8 + 2.7 * shape[0]), sharex=True, sharey=True,
            squeeze=False, layout="constrained",
        )  # fmt: skip
        for line, objective in zip(axes, args.objectives, strict=True):
            mine = curves[curves["objective"] == objective]
            for axis, row in zip(line, args.rows, strict=True):
                rn_curves.panel(axis, mine[mine["row"] == row], args, solved_reward)
            line[0].set_ylabel(f"{OBJECTIVE_NAMES[objective]}\ntest return")
        for axis, row in zip(axes[0], args.rows, strict=True):
            axis.set_title(rn_curves.panel_title(args, row), fontsize=10)
        for axis in axes[-1]:
            axis.set_xlabel("training steps")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, ncols=min(len(labels), 4), loc="outside upper center",
                      fontsize=9)  # fmt: skip
        figures.write(figure, path)


if __name__ == "__main__":
    main()
