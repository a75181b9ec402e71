"""What agents reach that are trained on SEs, and how fast, against training on the real task.

Source: paper, section "Performance of SE-trained Agents" and "Transferability of SEs" (figure with
densities and bars for CartPole), appendix "Evaluation of Performance and Transferability of SEs on
the Acrobot Task"; `reference_details.md` 7.1.

On each SE of a set `--num-agents` agents are trained whose hyperparameters are drawn anew for each,
whatever the SEs were learned with; `--varied` and `--fixed` are sets from se_feasibility, learned
with `--agent-hparams varied` and without. SEs that did not reach the task's threshold are left out,
as in the authors' code, which stores no others. As many groups of agents are trained on the real
task.
"""

import argparse
import dataclasses
import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from sejax.configs import TrainingConfig
from sejax.errors import require, unknown_name
from sejax.experiments import common

NAME = "se_performance"
AGENTS = ("ddqn", "dueling_ddqn", "td3_discrete")
NUM_SES = 40
NUM_BEST = 5
BEST_FOR = "td3_discrete"
GROUPS_AT_ONCE = 5  # groups of agents in one program, but for one CPU device
LABELS = {"real": "real", "varied": "synth., HPs varied", "fixed": "synth., HPs fixed",
          "best": "synth., best SEs"}  # fmt: skip

# Hidden sizes up to 6: one network has room for all of them, and little is compiled.
QUICK_AGENT: dict[str, Any] = {
    "hidden_size": 2,
    "batch_size": 16,
    "num_layers": 1,
    "init_episodes": 1,
}
QUICK = {"num_agents": 4, "num_ses": 3, "real_episodes": 100, "max_steps": 4000}

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


@dataclass(frozen=True, kw_only=True)
class World:
    """What agents are trained in: the SEs of a set, or the real task a number of times.

    Attributes:
      env: gymnax environment; `params` are what its SEs differ in.
      task: the real task that agents are tested on.
      params: `EnvParams`, one for each group of agents.
      names: of the groups, in the files' names.
      training: how long an agent of a configuration trains.
      settings: what else the agents' results depend on; plain values.
    """

    env: Any
    task: Any
    params: tuple[Any, ...]
    names: tuple[str, ...]
    training: Callable[[Any], TrainingConfig]
    settings: dict[str, Any]


def main() -> None:
    """Runs the experiment as the command line says."""
    common.run_command(NAME, __doc__, add_options, run)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this experiment."""
    parser.add_argument("--varied", metavar="FILE", help="SEs learned with drawn hyperparameters")
    parser.add_argument("--fixed", metavar="FILE", help="SEs learned with one agent's; with "
                        "--quick and no file, the shipped cartpole SE")  # fmt: skip
    parser.add_argument("--env", help="task, where no file is given; cartpole")
    parser.add_argument("--solved-by", choices=("train", "test"), default="train", help="whose "
                        "last returns end training on the real task; train, as in the paper's "
                        "code")  # fmt: skip
    parser.add_argument("--real-episodes", type=int, help="at most, on the real task; 1000 (500 "
                        "for discrete TD3 in Acrobot)")  # fmt: skip
    add_agent_options(parser)


def add_agent_options(parser: argparse.ArgumentParser) -> None:
    """Options on the agents, which se_models shares."""
    parser.add_argument("--agents", nargs="+", default=list(AGENTS), metavar="AGENT",
                        help=", ".join(AGENTS))  # fmt: skip
    parser.add_argument("--num-agents", type=int, help="agents for each SE; 10, quick 4")
    parser.add_argument("--num-ses", type=int, help="SEs of a set at most; 40, quick 3")
    parser.add_argument("--test-episodes", type=int, default=10, help="of each agent; 10")
    parser.add_argument("--max-steps", type=int, help="training steps at most; no other limit "
                        "than that of the SEs' own configuration")  # fmt: skip


def fill_in(args: argparse.Namespace) -> None:
    """Sets the options whose default depends on `--quick`, and checks the numbers.

    Raises:
      ConfigError: for an unknown agent or a number out of range.
    """
    defaults: dict[str, Any] = {"num_agents": 10, "num_ses": NUM_SES}
    for name, value in (QUICK if args.quick else defaults).items():
        if getattr(args, name, 0) is None:
            setattr(args, name, value)
    check_agents(args)
    common.require_counts(args, "num_agents", "num_ses", "test_episodes", "max_steps",
                          "real_episodes")  # fmt: skip


def check_agents(args: argparse.Namespace) -> None:
    """Checks `--agents`, which the experiments with SEs share.

    Raises:
      ConfigError: for an agent that is not one of `AGENTS`.
    """
    for kind in args.agents:
        if kind not in AGENTS:
            raise unknown_name("--agents", kind, AGENTS)


def run(args: argparse.Namespace) -> pd.DataFrame:
    """Trains what is missing, writes everything and returns the table.

    Raises:
      ConfigError: for files or settings that cannot work.
    """
    fill_in(args)
    worlds = make_worlds(args)
    task = worlds["real"].task
    pieces = common.Pieces(args.out / "pieces")
    agents = pd.concat(
        [train_all(args, kind, world, pieces).assign(setting=name)
         for kind in args.agents for name, world in worlds.items()],
        ignore_index=True,
    )  # fmt: skip
    return report(args, task, agents)


def make_worlds(args: argparse.Namespace) -> dict[str, World]:
    """The settings that are compared, `real` first; those without a file are left out.

    Raises:
      ConfigError: if the SEs are of different tasks.
    """
    from sejax import envs
    from sejax.experiments.proxy_sets import load_set

    files = {"varied": args.varied, "fixed": args.fixed}
    if args.quick and not any(files.values()):
        files["fixed"] = args.env or "cartpole"
    sets = {name: load_set(file, f"--{name}") for name, file in files.items() if file}
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
    count = max((ses.size for ses in sets.values()), default=args.num_ses)
    task = envs.make(names[0] if names else "cartpole")
    return {"real": real_world(args, task, count)} | {
        name: se_world(args, ses) for name, ses in sets.items()
    }


def real_world(args: argparse.Namespace, task: Any, count: int) -> World:
    """The real task as often as there are SEs; training ends by the solved rule."""

    def training(agent: Any) -> TrainingConfig:
        # reference_details.md 7.1: discrete TD3 trains 500 episodes on Acrobot, all others 1000.
        short = task.name == "acrobot" and agent.name == "td3_discrete"
        return TrainingConfig(
            max_episodes=args.real_episodes or (500 if short else 1000),
            max_steps=args.max_steps,
            stop_rule="solved",
            solved_by=args.solved_by,
            test_episodes=args.test_episodes,
            time_limit_is_terminal=True,
        )

    names = tuple(f"real-{index:02d}" for index in range(count))
    return World(env=task.env, task=task, params=(task.params,) * count, names=names,
                 training=training, settings={"world": task.name})  # fmt: skip


def se_world(args: argparse.Namespace, ses: Any) -> World:
    """The SEs of a set; agents train as long as those that the SEs were learned with."""
    from sejax.evaluation import training_as_learned

    def training(agent: Any) -> TrainingConfig:
        learned = training_as_learned(ses, agent)
        limits = [x for x in (learned.max_steps, args.max_steps) if x is not None]
        return dataclasses.replace(learned, max_steps=min(limits, default=None),
                                   test_episodes=args.test_episodes)  # fmt: skip

    # The name has the weights' hash, so that sets can share a folder: se_models then finds these.
    names = tuple(f"se-{seed:02d}-{ses.fingerprint(i)}" for i, seed in enumerate(ses.seeds))
    proxy = {f"proxy.{name}": value for name, value in vars(ses.config.proxy).items()}
    params = tuple(ses.one(i) for i in range(ses.size))
    return World(env=ses.env, task=ses.task, params=params, names=names, training=training,
                 settings={"world": f"SE of {ses.task.name}", **proxy})  # fmt: skip


def train_all(
    args: argparse.Namespace, kind: str, world: World, pieces: common.Pieces
) -> pd.DataFrame:
    """Agents of one kind in a world, a row each; every group is a piece."""
    from sejax.agents.configs import AGENT_CONFIGS

    config = AGENT_CONFIGS[kind](**(QUICK_AGENT if args.quick else {}))
    training = world.training(config)
    settings = {
        **world.settings,
        **{f"agent.{name}": value for name, value in vars(config).items()},
        **{f"training.{name}": value for name, value in vars(training).items()},
        "num_agents": args.num_agents,
        "seed": args.seed,
    }
    tables = []
    at_once = groups_at_once(args.devices)
    for first in range(0, len(world.names), at_once):
        indices = {f"{kind}-{name}": index for index, name in enumerate(world.names)
                   if first <= index < first + at_once}  # fmt: skip

        def compute(missing: list[str], indices: dict[str, int] = indices) -> list[pd.DataFrame]:
            chosen = [indices[piece] for piece in missing]
            return train_groups(args, config, world, training, chosen)

        named = {piece: settings | {"group": world.names[i]} for piece, i in indices.items()}
        computed = pieces.compute_all(named, compute)
        for index, table in zip(indices.values(), computed, strict=True):
            name = world.names[index]
            print(f"{kind} {name}: mean return {table['test_return'].mean():.1f} after "
                  f"{table['train_steps'].mean():,.0f} steps", flush=True)  # fmt: skip
            tables.append(table.assign(kind=kind, group=name))
    return pd.concat(tables, ignore_index=True)


def groups_at_once(devices: int | None) -> int:
    """Groups in one program: some agents train a hundred times as long as others.

    Several groups keep all devices, or an accelerator's lanes, busy; with one CPU device, a group
    is saved as soon as it is done.
    """
    import jax

    alone = (devices or jax.device_count()) == 1 and jax.default_backend() == "cpu"
    return 1 if alone else GROUPS_AT_ONCE


def train_groups(
    args: argparse.Namespace,
    config: Any,
    world: World,
    training: TrainingConfig,
    indices: list[int],
) -> list[pd.DataFrame]:
    """Trains and tests the agents of some SEs, or groups on the real task; a row for each agent.

    There are always as many as `groups_at_once`, so that the program is compiled once. Agents of
    the same numbers draw the same hyperparameters in every setting, so that settings are compared
    on equal draws.
    """
    import jax

    program = make_program(config, world.env, world.task, training, args.devices)
    num_agents = args.num_agents
    padded = [*indices, *[indices[-1]] * (groups_at_once(args.devices) - len(indices))]
    groups = np.repeat(padded, num_agents)
    numbers = np.tile(np.arange(num_agents), len(padded))
    key = jax.random.key(args.seed)
    keys = jax.vmap(lambda g, n: jax.random.fold_in(jax.random.fold_in(key, g), n))(groups, numbers)
    params = jax.tree.map(
        lambda *each: np.repeat(np.stack(each), num_agents, axis=0),
        *[world.params[index] for index in padded],
    )
    active = np.arange(len(groups)) < len(indices) * num_agents
    outcome, drawn = jax.device_get(program(keys, params, active))
    tables = []
    for place in range(len(indices)):
        mine = slice(place * num_agents, (place + 1) * num_agents)
        table = to_table(jax.tree.map(lambda x, mine=mine: x[mine], outcome))
        tables.append(table.assign(**{name: x[mine].astype(float) for name, x in drawn.items()}))
    return tables


def to_table(outcome: Any) -> pd.DataFrame:
    """The outcomes of some agents, a row each, with a column for each test episode's return."""
    returns = outcome.test_returns.astype(float)
    columns = {
        "agent": range(len(returns)),
        "test_return": returns.mean(axis=1),
        "nonfinite": outcome.nonfinite,
        "train_episodes": outcome.train_episodes.astype(float),
        "train_steps": outcome.train_steps.astype(float),
    }
    return pd.DataFrame(columns | {f"return_{i}": x for i, x in enumerate(returns.T)})


@functools.cache
def make_program(
    config: Any, env: Any, task: Any, training: TrainingConfig, devices: int | None
) -> Callable[..., Any]:
    """Builds `program(keys, env_params, active) -> (Outcome, hparams)`, compiled once for all SEs.

    All leaves are `[agent, ...]`. Nothing is computed for an agent that is not active.
    """
    import jax

    from sejax.agents.configs import ExplorationConfig
    from sejax.agents.hparams import drawing_key, make_varied_agents
    from sejax.evaluation import make_varied_evaluator
    from sejax.parallel import spread_over_devices

    varied = make_varied_agents(config, task, ExplorationConfig())
    evaluate = make_varied_evaluator(varied, env, task, training)

    def train_one(key: Any, env_params: Any, active: Any) -> Any:
        return evaluate(key, env_params, active), varied.draw(drawing_key(key))

    spread = spread_over_devices(train_one, devices, cpu_lanes=varied.agents[0].cpu_lanes)
    return jax.jit(spread)


def return_columns(agents: pd.DataFrame) -> list[str]:
    """Names of the columns that hold the return of one test episode."""
    return [name for name in agents if name.startswith("return_")]


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
    """Adds the best SEs for discrete TD3 as a setting of its own, where there are several SEs."""
    for setting in ("varied", "fixed"):
        mine = agents[(agents["kind"] == BEST_FOR) & (agents["setting"] == setting)]
        best = select_best(mine) if len(mine) else mine
        if len(best):
            return pd.concat([agents, best.assign(setting="best")], ignore_index=True)
    return agents


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
        f"of an SE. The best SEs, {NUM_BEST} at most, are chosen by half of their agents and shown "
        "by the other half. SEs are those of a set that reached the threshold, all where none did. "
        "The paper has 40 SEs with 10 agents each; where a field is empty it gives no number. "
        f"Agents that met a number that is not finite: {int(agents['nonfinite'].sum())}."
    )
    command = figures.command(NAME, args, "varied", "fixed", "env", "agents", "num_agents",
                              "num_ses", "test_episodes", "solved_by", "real_episodes",
                              "max_steps")  # fmt: skip
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
    figures.performance(columns, return_columns(agents), task.name, path)


if __name__ == "__main__":
    main()
