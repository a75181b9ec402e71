"""What agents reach that are trained on SEs, and how fast, against training on the real task.

Source: paper, section "Performance of SE-trained Agents" and "Transferability of SEs" (figure with
densities and bars for CartPole), appendix "Evaluation of Performance and Transferability of SEs on
the Acrobot Task"; `reference_details.md` 7.1.

On each SE of a set `--num-agents` agents are trained whose hyperparameters are drawn anew for each,
whatever the SEs were learned with; `--varied` and `--fixed` are sets from se_feasibility, learned
with `--agent-hparams varied` and without. SEs that did not reach the task's threshold are left out,
as in the authors' code, which stores no others. As many groups of agents are trained on the real
task, or `--real-groups`.
"""

import argparse
from collections.abc import Iterable
from typing import Any

import pandas as pd

from sejax.errors import require
from sejax.experiments import common, se_agents

NAME = "se_performance"
NUM_BEST = 5
BEST_FOR = "td3_discrete"
LABELS = {"real": "real", "varied": "synth., HPs varied", "fixed": "synth., HPs fixed",
          "best": "synth., best SEs"}  # fmt: skip

# Training steps, "mean ± std", in CartPole: reference_details.md 7.1, the values in the scripts of
# the authors' bar plot; best: the same and paper, section "Transferability of SEs", which also has
# the returns of TD3. Acrobot: paper, the same section.
PAPER_STEPS = {
    ("cartpole", "ddqn", "real"): "16887.7 ± 24925",
    ("cartpole", "ddqn", "varied"): "6818.6 ± 2339.5",
    ("cartpole", "ddqn", "fixed"): "6379.5 ± 3163",
    ("cartpole", "dueling_ddqn", "real"): "12745.3",
    ("cartpole", "dueling_ddqn", "varied"): "6781.0",
    ("cartpole", "dueling_ddqn", "fixed"): "6502.5",
    ("cartpole", "td3_discrete", "real"): "17874.9",
    ("cartpole", "td3_discrete", "varied"): "5832.1",
    ("cartpole", "td3_discrete", "fixed"): "5371.0",
    ("cartpole", "td3_discrete", "best"): "6287.5",
    ("acrobot", "dueling_ddqn", "real"): "29531",
    ("acrobot", "dueling_ddqn", "varied"): "18376",
    ("acrobot", "td3_discrete", "real"): "80837",
    ("acrobot", "td3_discrete", "best"): "14408",
}
PAPER_RETURNS = {
    ("cartpole", "td3_discrete", "real"): "152",
    ("cartpole", "td3_discrete", "best"): "187",
    ("acrobot", "dueling_ddqn", "varied"): "-111",
    ("acrobot", "td3_discrete", "best"): "-343",
}


def main() -> None:
    """Runs the experiment as the command line says."""
    common.run_command(NAME, __doc__, add_options, run)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this experiment."""
    parser.add_argument("--varied", metavar="FILE", help="SEs learned with drawn hyperparameters")
    parser.add_argument("--fixed", metavar="FILE", help="SEs learned with one agent's; with "
                        "--quick and no file, the shipped cartpole SE")  # fmt: skip
    parser.add_argument("--env", help="task, where no file is given; cartpole")
    parser.add_argument("--real-groups", type=int, help="groups of agents on the real task, which "
                        "takes longest; as many as SEs")  # fmt: skip
    parser.add_argument("--solved-by", choices=("train", "test"), default="train", help="whose "
                        "last returns end training on the real task; train, as in the paper's "
                        "code")  # fmt: skip
    parser.add_argument("--real-episodes", type=int, help="at most, on the real task; 1000 (500 "
                        "for discrete TD3 in Acrobot)")  # fmt: skip
    se_agents.add_options(parser)


def run(args: argparse.Namespace) -> pd.DataFrame:
    """Trains what is missing, writes everything and returns the table.

    Raises:
      ConfigError: for files or settings that cannot work.
    """
    se_agents.fill_in(args)
    worlds = make_worlds(args)
    task = worlds["real"].task
    pieces = common.Pieces(args.out / "pieces")
    agents = pd.concat(
        [se_agents.train_all(args, kind, world, pieces).assign(setting=name)
         for kind in args.agents for name, world in worlds.items()],
        ignore_index=True,
    )  # fmt: skip
    return report(args, task, agents)


def make_worlds(args: argparse.Namespace) -> dict[str, se_agents.World]:
    """The settings that are compared, `real` first; those without a file are left out.

    Raises:
      ConfigError: if the SEs are of different tasks.
    """
    from sejax import envs
    from sejax.proxies.sets import load_set

    files = {"varied": args.varied, "fixed": args.fixed}
    if args.quick and not any(files.values()):
        files["fixed"] = args.env or "cartpole"
    sets = {name: load_set(file, f"--{name}", "se") for name, file in files.items() if file}
    for name, ses in sets.items():
        solved = ses.solved()
        sets[name] = (solved if solved.size else ses).first(args.num_ses)
        print(f"{name}: {solved.size} of {ses.size} SEs reached the threshold"
              f"{'' if solved.size else ', all are used'}", flush=True)  # fmt: skip
    for name, ses in sets.items():
        learned_with = "varied" if ses.config.agent_hparams == "varied" else "fixed"
        require(learned_with == name, f"--{name}", f"be SEs learned with {name} hyperparameters",
                "it is what is compared", f"{ses.path} with {learned_with} ones",
                f"--{learned_with}={ses.path}")  # fmt: skip
    names = sorted({ses.task.name for ses in sets.values()} | ({args.env} if args.env else set()))
    require(len(names) <= 1, "--varied, --fixed and --env", "be of one task",
            "agents are tested on it", ", ".join(names), "files of the same task")  # fmt: skip
    as_ses = max((ses.size for ses in sets.values()), default=args.num_ses)
    count = args.real_groups or as_ses
    task = envs.make(names[0] if names else "cartpole")
    return {"real": se_agents.real_world(args, task, count)} | {
        name: se_agents.se_world(args, ses) for name, ses in sets.items()
    }


def select_best(agents: pd.DataFrame, count: int = NUM_BEST) -> pd.DataFrame:
    """Agents of the best SEs that had no part in selecting them.

    SEs are ranked by the mean return of their agents of even number; the others are returned. On
    the same agents the best SEs would look better than they are.

    Args:
      agents: of one kind in one setting.
      count: of SEs; all but one if there are not more.

    Source: paper, section "Transferability of SEs", the five models for TD3.
    """
    judges = agents[agents["agent"] % 2 == 0]
    ranked = judges.groupby("group")["test_return"].mean().sort_values(ascending=False)
    chosen = ranked.index[: min(count, len(ranked) - 1)]
    return agents[agents["group"].isin(chosen) & (agents["agent"] % 2 == 1)]


def with_best(agents: pd.DataFrame) -> pd.DataFrame:
    """Adds the best SEs of all sets for discrete TD3 as a setting, where there are several SEs."""
    on_ses = agents[(agents["kind"] == BEST_FOR) & (agents["setting"] != "real")]
    best = select_best(on_ses) if len(on_ses) else on_ses
    return pd.concat([agents, best.assign(setting="best")], ignore_index=True)


def summarise(agents: pd.DataFrame) -> pd.DataFrame:
    """Means, deviations and intervals for each kind of agent and setting.

    Deviations are over agents; intervals come from drawing SEs (groups) again, since agents of the
    same SE have much in common.
    """
    rows = []
    for (kind, setting), mine in agents.groupby(["kind", "setting"], sort=False):
        row = {"kind": kind, "setting": setting, "num_ses": mine["group"].nunique(),
               "num_agents": len(mine), "num_nonfinite": int(mine["nonfinite"].sum())}  # fmt: skip
        for column in ("train_steps", "train_episodes", "test_return"):
            means = mine.groupby("group")[column].mean()
            low, high = common.bootstrap_interval(means)
            mean, std = mine[column].mean(), mine[column].std(ddof=0)
            row |= {f"{column}_mean": mean, f"{column}_std": std, f"{column}_low": low,
                    f"{column}_high": high}  # fmt: skip
        rows.append(row)
    return pd.DataFrame(rows)


def make_table(env_name: str, summary: pd.DataFrame) -> pd.DataFrame:
    """The summary as texts, with the paper's numbers."""
    real_steps = summary[summary["setting"] == "real"].set_index("kind")["train_steps_mean"]

    def measured(row: Any, column: str, digits: int) -> str:
        mean, std, low, high = (
            getattr(row, f"{column}_{x}") for x in ("mean", "std", "low", "high")
        )
        interval = f" [{low:,.{digits}f}, {high:,.{digits}f}]" if row.num_ses > 1 else ""
        return f"{mean:,.{digits}f} ± {std:,.{digits}f}{interval}"

    def fewer(row: Any) -> str:
        if row.setting == "real" or row.kind not in real_steps:
            return ""
        return f"{1 - row.train_steps_mean / real_steps[row.kind]:.0%}"

    return pd.DataFrame([
        {
            "agent": row.kind,
            "trained on": LABELS[row.setting],
            "SEs, agents": f"{row.num_ses}, {row.num_agents}",
            "training steps": measured(row, "train_steps", 0),
            "paper's": PAPER_STEPS.get((env_name, row.kind, row.setting), ""),
            "fewer": fewer(row),
            "episodes": measured(row, "train_episodes", 1),
            "return": measured(row, "test_return", 1),
            "paper's return": PAPER_RETURNS.get((env_name, row.kind, row.setting), ""),
        }
        for row in summary.itertuples()
    ])  # fmt: skip


def report(args: argparse.Namespace, task: Any, agents: pd.DataFrame) -> pd.DataFrame:
    """Writes the CSV, the picture and the table, prints the table and returns it."""
    from sejax.experiments import figures
    from sejax.files import write_text

    all_agents = with_best(agents)
    summary = summarise(all_agents)
    table = make_table(task.name, summary)
    write_text(args.out / "agents.csv", agents.to_csv(index=False))
    write_text(args.out / "summary.csv", summary.to_csv(index=False))
    draw(task, all_agents, args.agents, args.out / "performance.png")
    title = f"Agents trained on SEs and tested on {task.name} (solved at {task.solved_reward:g})"
    note = (
        f"Mean ± std over agents with drawn hyperparameters, {args.test_episodes} test episodes "
        'each; in brackets a bootstrap 95% interval that draws SEs, not agents. "Fewer" are '
        "training steps saved against the real task, for which a group of agents takes the place "
        f"of an SE. The best SEs of all sets, {NUM_BEST} at most, are chosen by half of their "
        "agents and shown by the other half. SEs are those of a set that reached the threshold, "
        "all where none did. The paper has 40 SEs with 10 agents each; where a field is empty it "
        "gives no number here, but for DDQN in CartPole a mean return on SEs of 190.7, in another "
        "section. "
        f"Agents that met a number that is not finite: {int(agents['nonfinite'].sum())}."
    )
    command = figures.command(NAME, args, "varied", "fixed", "env", "agents", "num_agents",
                              "num_ses", "real_groups", "test_episodes", "solved_by",
                              "real_episodes", "max_steps")  # fmt: skip
    common.write_markdown(args.out / "table.md", title, command, table, note)
    figures.print_table(title, table)
    print(f"{args.out}: agents.csv (every test return), summary.csv, performance.png and table.md.")
    return table


def draw(task: Any, agents: pd.DataFrame, kinds: Iterable[str], path: Any) -> None:
    """Draws densities of the test returns above and bars of steps and episodes below.

    Source: paper, figures "Densities based on each 4000 cumulative test rewards".
    """
    from sejax.experiments import figures

    colors = {"real": figures.REAL, "varied": figures.VARIED, "fixed": figures.FIXED,
              "best": figures.BEST}  # fmt: skip
    columns = {
        kind: {
            LABELS[setting]: (colors[setting], mine)
            for setting, mine in agents[agents["kind"] == kind].groupby("setting", sort=False)
        }
        for kind in kinds
    }
    figures.performance(columns, se_agents.return_columns(agents), task.name, path)


if __name__ == "__main__":
    main()
