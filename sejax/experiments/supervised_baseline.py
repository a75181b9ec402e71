"""Do models fitted to real transitions train agents as SEs do: the supervised baseline.

Source: paper, appendix "Supervised Learning and Synthetic Environments", subsection "Comparing
Supervised Learning with Synthetic Environments on CartPole"; `reference_details.md` 7.5.

1. `--models` NES runs, with the settings that the SE was learned with and `--population` members.
   All real test episodes of their agents, those of members and of incumbents, are recorded, and
   `--max-rows` transitions of each run are drawn from them.
2. A model with the SE's architecture is fitted to each run's transitions: Adam on the mean squared
   error of [s', r]. In the authors' code nobody fitted the network for the end of an episode; it
   kept its random weights. Here it is fitted too (mean squared error, 1 where the episode
   terminated, else 0). The three networks share nothing, so that one fit gives both models:
   `as the authors` has the random weights of that network, `fair` the fitted ones and ends an
   episode, and its return, where they say so.
3. On each model, and on the SE, agents are trained and tested on the real task.

Differs: the paper fits to all transitions of a run and not to a part of them. Its agents stop by
the plateau rule; here they train as long as those that the SE was learned with. That may be too
short for any agent on the real task itself: `--max-steps` gives those on the models more time.
"""

import argparse
import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sejax.errors import require
from sejax.experiments import common, supervised_models
from sejax.experiments.se_agents import AGENTS, check_agents, return_columns, to_table

NAME = "supervised_baseline"
HPARAMS = ("varied", "default")
BEST = 2  # models in the paper's second figure
# Of each option: in full, quick.
DEFAULTS = {"models": (5, 2), "generations": (25, 3), "population": (16, 3),
            "max_rows": (100_000, 3000), "epochs": (100, 20), "num_agents": (20, 2)}  # fmt: skip

LABELS = {"authors": "model, as the authors", "authors_best": f"model, as the authors, best {BEST}",
          "fair": "model, fair", "se": "SE"}  # fmt: skip
# Paper, the same subsection, "Result": mean test returns of DDQN agents with drawn hyperparameters.
PAPER = {
    ("authors", "ddqn", "varied"): "15.01",
    ("authors_best", "ddqn", "varied"): "17.73",
    ("se", "ddqn", "varied"): "190.7",
}


def main() -> None:
    """Runs the experiment as the command line says."""
    common.run_command(NAME, __doc__, add_options, run)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this experiment."""
    parser.add_argument("--proxy", default="cartpole", help="SE to compare with; the NES runs "
                        "have its settings; run directory, file or name; cartpole")  # fmt: skip
    parser.add_argument("--models", type=int, help="NES runs, and a model for each; 5, quick 2")
    parser.add_argument("--generations", type=int, help="of an NES run; 25, quick 3")
    parser.add_argument("--population", type=int, help="members of a generation; 16, quick 3")
    parser.add_argument("--max-rows", type=int, help="transitions for a model; 100000, quick 3000")
    parser.add_argument("--epochs", type=int, help="of a fit; 100, quick 20")
    parser.add_argument("--agents", nargs="+", default=["ddqn"], metavar="AGENT",
                        help=f"{', '.join(AGENTS)}; ddqn")  # fmt: skip
    parser.add_argument("--num-agents", type=int, help="for each model; 20, quick 2")
    parser.add_argument("--test-episodes", type=int, default=10, help="of each agent; 10")
    parser.add_argument("--max-steps", type=int, help="training steps of an agent on a model; as "
                        "on the SE")  # fmt: skip


def fill_in(args: argparse.Namespace) -> None:
    """Sets the options that were not given.

    Raises:
      ConfigError: for an unknown agent or a number out of range.
    """
    for name, values in DEFAULTS.items():
        if getattr(args, name) is None:
            setattr(args, name, values[args.quick])
    common.require_counts(args, *DEFAULTS, "test_episodes", "max_steps")
    common.require_counts(args, "population", least=2)
    check_agents(args)


def run(args: argparse.Namespace) -> pd.DataFrame:
    """Computes what is missing, writes everything and returns the table.

    Raises:
      ConfigError: for a proxy or settings that cannot work.
    """
    fill_in(args)
    from sejax.proxies.sets import load_set

    ses = load_set(args.proxy, "--proxy", "se").first(1)
    require(ses.task.num_states is None and ses.task.num_actions is not None, "--proxy",
            "be an SE with vector states and discrete actions", "the agents are made for these",
            f"one of {ses.task.name}", "--proxy=cartpole")  # fmt: skip
    require(ses.config.agent_hparams == "default" and not ses.config.es.common_random_numbers,
            "--proxy", "be an SE learned with fixed hyperparameters and a seed for each agent",
            "the recorded NES runs have these", "one learned otherwise",
            "--proxy=cartpole")  # fmt: skip
    learned_with: Any = ses.config.agent
    require(learned_with.name in AGENTS and getattr(learned_with, "action_repeat", 1) == 1,
            "--proxy", f"be an SE learned with {', '.join(AGENTS)}, without action repeat", "the "
            "recorded NES runs have its agent, and their every step is a row",
            f"one learned with {learned_with.name}", "--proxy=cartpole")  # fmt: skip
    pieces = common.Pieces(args.out / "pieces")
    data = [
        supervised_models.collect_piece(args, ses, index, pieces) for index in range(args.models)
    ]
    fits = supervised_models.fit_piece(args, ses, data, pieces)
    worlds = make_worlds(args, ses)
    tables = [
        train_all(args, world, kind, hparams, pieces).assign(world=name, kind=kind, hparams=hparams)
        for kind in args.agents
        for hparams in HPARAMS
        for name, world in worlds.items()
    ]
    agents = with_best(pd.concat(tables, ignore_index=True), supervised_models.quality(data))
    return report(args, ses.task, data, fits, agents)


@dataclass(frozen=True, kw_only=True)
class World:
    """What agents are trained in.

    Attributes:
      sets: the models, or the SE, as an `ProxySet`.
      groups: groups of agents; the i-th trains on the i-th model, or on the SE.
      is_model: whether these are models.
    """

    sets: Any
    groups: int
    is_model: bool

    def one(self, group: int) -> tuple[Any, str]:
        """`EnvParams` of a group's world, and the fingerprint of its weights."""
        index = group % self.sets.size
        return self.sets.one(index), self.sets.fingerprint(index)


def make_worlds(args: argparse.Namespace, ses: Any) -> dict[str, World]:
    """The models of both variants and the SE, with as many agents on the SE as on all models."""
    from sejax.proxies.sets import load_set

    sets = {
        name: load_set(supervised_models.model_file(args, name), "--out", "se")
        for name in ("authors", "fair")
    }
    return {
        name: World(sets=each, groups=args.models, is_model=each is not ses)
        for name, each in (sets | {"se": ses}).items()
    }


def train_all(
    args: argparse.Namespace, world: World, kind: str, hparams: str, pieces: common.Pieces
) -> pd.DataFrame:
    """Agents of one kind in a world, a row each; every group is a piece."""
    from sejax.agents.configs import AGENT_CONFIGS
    from sejax.evaluation import training_as_learned

    changes: dict[str, Any] = supervised_models.QUICK_AGENT if args.quick else {}
    config = AGENT_CONFIGS[kind](**changes)
    training = training_as_learned(world.sets, config)
    max_steps = supervised_models.QUICK_STEPS if args.quick else training.max_steps
    if args.max_steps and world.is_model:
        max_steps = args.max_steps
    training = dataclasses.replace(training, test_episodes=args.test_episodes, max_steps=max_steps)
    tables = []
    for group in range(world.groups):
        params, fingerprint = world.one(group)
        settings = {"weights": fingerprint, "proxy": vars(world.sets.config.proxy),
                    "agent": vars(config), "training": vars(training), "hparams": hparams,
                    "num_agents": args.num_agents, "group": group, "seed": args.seed}  # fmt: skip
        table = pieces.compute(
            f"{kind}-{hparams}-{world.sets.path.stem}-{group}", settings,
            functools.partial(train_group, args, world, config, training, hparams, params, group),
        )  # fmt: skip
        tables.append(table.assign(group=group))
    agents = pd.concat(tables, ignore_index=True)
    print(f"{kind}, {hparams} hyperparameters, {world.sets.path.stem}: mean return "
          f"{agents['test_return'].mean():.1f}", flush=True)  # fmt: skip
    return agents


def train_group(
    args: argparse.Namespace,
    world: World,
    config: Any,
    training: Any,
    hparams: str,
    params: Any,
    group: int,
) -> pd.DataFrame:
    """Trains and tests a group of agents; a row each. Groups draw the same in every world."""
    import jax

    program = make_program(config, world.sets.env, training, hparams, args.devices)
    key = jax.random.fold_in(jax.random.key(args.seed), group)
    outcome = jax.device_get(program(jax.random.split(key, args.num_agents), params))
    return to_table(outcome)


@functools.cache
def make_program(
    config: Any, env: Any, training: Any, hparams: str, devices: int | None
) -> Callable[..., Any]:
    """Builds `program(keys [agent], env_params) -> Outcome`, leaves `[agent, ...]`."""
    import jax

    from sejax.agents.configs import ExplorationConfig
    from sejax.agents.hparams import make_varied_agents
    from sejax.agents.registry import make_agent
    from sejax.evaluation import evaluator_and_lanes
    from sejax.parallel import spread_over_devices

    make: Any = make_varied_agents if hparams == "varied" else make_agent
    agent = make(config, env.task, ExplorationConfig())
    evaluate, cpu_lanes = evaluator_and_lanes(agent, env, env.task, training)

    def program(keys: Any, params: Any) -> Any:
        return spread_over_devices(lambda key: evaluate(key, params), devices,
                                   cpu_lanes=cpu_lanes)(keys)  # fmt: skip

    return jax.jit(program)


def with_best(agents: pd.DataFrame, quality_of_models: list[float]) -> pd.DataFrame:
    """Adds the models whose transitions come from the best episodes as a world of its own.

    Differs: the paper takes two models most of whose samples come from episodes with a return of
    190 at least; here it is the mean return, which ranks models of any task.
    """
    if len(quality_of_models) <= BEST:
        return agents
    best = np.argsort(quality_of_models)[-BEST:]
    chosen = agents[(agents["world"] == "authors") & agents["group"].isin(best)]
    return pd.concat([agents, chosen.assign(world="authors_best")], ignore_index=True)


def summarise(agents: pd.DataFrame, solved_reward: float) -> pd.DataFrame:
    """Means over test episodes for each kind of agent, hyperparameters and world.

    Intervals come from drawing models again, as agents of one model have much in common. All groups
    of the SE share it: their intervals are those of drawing agents.
    """
    rows = []
    for (kind, hparams, name), mine in agents.groupby(["kind", "hparams", "world"]):
        independent = mine["test_return"]
        if name != "se":
            independent = mine.groupby("group")["test_return"].mean()
        low, high = common.bootstrap_interval(independent)
        rows.append({
            "kind": kind, "hparams": hparams, "world": name, "num_agents": len(mine),
            "return_mean": mine["test_return"].mean(),
            "return_std": mine[return_columns(mine)].to_numpy().std(),
            "return_low": low, "return_high": high,
            "solved": (mine["test_return"] >= solved_reward).mean(),
            "train_steps": mine["train_steps"].mean(),
            "train_episodes": mine["train_episodes"].mean(),
            "num_nonfinite": int(mine["nonfinite"].sum()),
        })  # fmt: skip
    order = [*AGENTS, *HPARAMS, *LABELS]
    return pd.DataFrame(rows).sort_values(
        ["kind", "hparams", "world"], key=lambda names: names.map(order.index), ignore_index=True
    )


def make_table(summary: pd.DataFrame) -> pd.DataFrame:
    """The summary as texts, with the paper's numbers."""
    return pd.DataFrame([
        {
            "agent": row.kind,
            "hyperparameters": {"varied": "drawn"}.get(row.hparams, row.hparams),
            "trained on": LABELS[row.world],
            "agents": row.num_agents,
            "return": f"{row.return_mean:.1f} ± {row.return_std:.1f} "
                      f"[{row.return_low:.1f}, {row.return_high:.1f}]",
            "paper's": PAPER.get((row.world, row.kind, row.hparams), ""),
            "solved": f"{row.solved:.0%}",
            "training steps": f"{row.train_steps:,.0f}",
            "episodes": f"{row.train_episodes:.1f}",
        }
        for row in summary.itertuples()
    ])  # fmt: skip


def report(
    args: argparse.Namespace,
    task: Any,
    data: list[pd.DataFrame],
    fits: pd.DataFrame,
    agents: pd.DataFrame,
) -> pd.DataFrame:
    """Writes the CSV, the picture and the table, prints the table and returns it."""
    from sejax.experiments import figures
    from sejax.files import write_text

    summary = summarise(agents, task.solved_reward)
    table = make_table(summary)
    write_text(args.out / "agents.csv", agents.to_csv(index=False))
    write_text(args.out / "summary.csv", summary.to_csv(index=False))
    write_text(args.out / "fits.csv", fits.to_csv(index=False))
    draw(task, agents, summary, args.out / "supervised_baseline.png")
    last = fits[fits["epoch"] == args.epochs - 1].mean()
    quality = np.mean(supervised_models.quality(data))
    ended = np.mean([rows["terminated"].mean() for rows in data])
    title = f"Agents trained on supervised models of {task.name} and on an SE"
    note = (
        f"Mean ± std over test episodes and a bootstrap 95% interval that draws models, for the SE "
        f"agents; solved: agents with a mean return of {task.solved_reward:g} at least. "
        f"{args.models} models, each fitted for {args.epochs} epochs to "
        f"{min(map(len, data)):,} transitions of one NES run, from episodes with a mean return of "
        f"{quality:.1f}; {ended:.2%} of the transitions end an episode. Mean squared error "
        f"{last['error']:.2g} of [s', r] (paper: 5e-07), {last['done_error']:.2g} "
        "of the end. As the authors: the network for the end keeps its random weights. Fair: it is "
        "fitted too, and used. The best models are those of the runs with the best episodes. "
        f"Agents that met a number that is not finite: {diverged_text(agents)}."
    )
    command = figures.command(NAME, args, "proxy", "models", "generations", "population",
                              "max_rows", "epochs", "agents", "num_agents",
                              "test_episodes", "max_steps")  # fmt: skip
    common.write_markdown(args.out / "table.md", title, command, table, note)
    figures.print_table(title, table)
    print(f"{args.out}: agents.csv (every test return), summary.csv, fits.csv, "
          "supervised_baseline.png and table.md.")  # fmt: skip
    return table


def diverged_text(agents: pd.DataFrame) -> str:
    """How many agents diverged, world by world; the best models' are among the authors'."""
    own = agents[agents["world"] != "authors_best"]
    counts = own.groupby("world", sort=False)["nonfinite"].sum()
    texts = [f"{int(count)} of {(own['world'] == world).sum()} ({LABELS[str(world)]})"
             for world, count in counts.items() if count]  # fmt: skip
    return ", ".join(texts) or "none"


def draw(task: Any, agents: pd.DataFrame, summary: pd.DataFrame, path: Path) -> None:
    """Draws histograms of the test returns, a panel for each agent and choice of hyperparameters.

    Source: paper, figure "Comparing the cumulative test reward densities", top.
    """
    import matplotlib.pyplot as plt

    from sejax.experiments import figures

    colors = {"authors": figures.SOLVED, "fair": figures.VARIED, "se": figures.REAL}
    returns = agents[return_columns(agents)].to_numpy()
    edges = np.linspace(returns.min(), max(returns.max(), returns.min() + 1), 41)
    panels = list(agents.groupby(["kind", "hparams"], sort=False))
    num_episodes = max((mine["world"] == "se").sum() for _, mine in panels) * returns.shape[1]
    with plt.rc_context(figures.STYLE):
        figure, axes = plt.subplots(1, len(panels), figsize=(1 + 4 * len(panels), 3.6),
                                    squeeze=False, sharey=True, layout="constrained")  # fmt: skip
        for axis, ((kind, hparams), mine) in zip(axes[0], panels, strict=True):
            for name, color in colors.items():
                _histogram(axis, mine[mine["world"] == name], edges, color, LABELS[name])
            given = "drawn" if hparams == "varied" else hparams
            axis.set_title(f"{figures.AGENT_NAMES.get(kind, kind)}, {given} hyperparameters")
            axis.set_xlabel(f"return of a test episode on {task.name}")
            axis.set_yscale("log")
            axis.set_ylim(0.5 / num_episodes, 1.1)
        axes[0, 0].set_ylabel("share of test episodes")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, ncols=3, loc="outside upper center")
        figures.write(figure, path)


def _histogram(axis: Any, agents: pd.DataFrame, edges: np.ndarray, color: str, label: str) -> None:
    returns = agents[return_columns(agents)].to_numpy().ravel()
    share = np.full(returns.size, 1 / returns.size)
    options: dict[str, Any] = {"bins": edges, "weights": share, "color": color}
    axis.hist(returns, histtype="stepfilled", alpha=0.2, **options)
    axis.hist(returns, histtype="step", lw=1.4, label=f"{label} (dashed: mean)", **options)
    axis.axvline(returns.mean(), color=color, ls="--", lw=1.2)


if __name__ == "__main__":
    main()
