"""What an SE shows its agents: histograms of next states and rewards, beside the real task's.

Source: paper, section "Analyzing SE Behavior" (figure "Histograms of next state s' and reward r")
and appendix "Qualitative Study of Synthetic Environments for the CartPole and Acrobot Tasks";
`reference_details.md` 7.2.

Agents with default hyperparameters are trained on one SE and tested on the real task. Shown are

- `train`: the SE's transitions in training itself, in the initial episodes and with exploration;
  of each agent the last `--max-rows` ones,
- `test`: the real transitions of its greedy test episodes,
- `response`: what the SE's networks say in one step from the states and actions of `test`.

If `response` is closer to `train` than to `test`, it is the SE that shifts the distributions and
not what the agents do in it.
"""

import argparse
import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sejax.experiments import common
from sejax.experiments.se_agents import AGENTS, check_agents

NAME = "se_histograms"
QUICK_AGENT = {"hidden_size": 16, "num_layers": 1, "batch_size": 16, "init_episodes": 1}
SOURCES = ("train", "test", "response")
LABELS = {"train": "SE, in training", "test": "real task, in tests",
          "response": "SE, from the tests' states and actions"}  # fmt: skip

DIMENSIONS = {
    "cartpole": ("cart position (m)", "cart velocity (m/s)", "pole angle (rad)",
                 "pole angular velocity (rad/s)"),
    "acrobot": ("cos of angle 1", "sin of angle 1", "cos of angle 2", "sin of angle 2",
                "angular velocity 1 (rad/s)", "angular velocity 2 (rad/s)"),
}  # fmt: skip

# Paper, the same appendix: mean test returns of the agents shown; section "Analyzing SE Behavior":
# 199.3 for CartPole and DDQN.
PAPER_RETURNS = {
    ("cartpole", "ddqn"): "199.3",
    ("cartpole", "dueling_ddqn"): "193.75",
    ("cartpole", "td3_discrete"): "197.26",
    ("acrobot", "ddqn"): "-91.62",
    ("acrobot", "dueling_ddqn"): "-88.56",
    ("acrobot", "td3_discrete"): "-93.17",
}


def main() -> None:
    """Runs the experiment as the command line says."""
    common.run_command(NAME, __doc__, add_options, run)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this experiment."""
    parser.add_argument("--proxy", default="cartpole", help="SE: a run directory, a file or a "
                        "shipped name; cartpole")  # fmt: skip
    parser.add_argument("--agents", nargs="+", default=list(AGENTS), metavar="AGENT",
                        help=f"a row each; {', '.join(AGENTS)}")  # fmt: skip
    parser.add_argument("--num-agents", type=int, help="of each kind; 10, quick 3")
    parser.add_argument("--test-episodes", type=int, default=10, help="of each agent; 10")
    parser.add_argument("--max-rows", type=int, default=10_000, help="training transitions of an "
                        "agent that are kept, the last ones; 10000")  # fmt: skip


def fill_in(args: argparse.Namespace) -> None:
    """Sets the options that were not given.

    Raises:
      ConfigError: for an unknown agent or a number out of range.
    """
    if args.num_agents is None:
        args.num_agents = 3 if args.quick else 10
    check_agents(args)
    common.require_counts(args, "num_agents", "test_episodes", "max_rows")


def run(args: argparse.Namespace) -> pd.DataFrame:
    """Trains what is missing, writes everything and returns the table.

    Raises:
      ConfigError: for a proxy or settings that cannot work.
    """
    fill_in(args)
    from sejax.agents.configs import AGENT_CONFIGS
    from sejax.configs import require_fit
    from sejax.proxies.sets import load_set

    ses = load_set(args.proxy, "--proxy", "se").first(1)
    pieces = common.Pieces(args.out / "pieces")
    tables = []
    for kind in args.agents:
        changes: dict[str, Any] = QUICK_AGENT if args.quick else {}
        agent = AGENT_CONFIGS[kind](**changes)
        require_fit(agent, ses.config.exploration, ses.task.name)
        training = training_of(args, ses, agent)
        settings = {"proxy": ses.fingerprint(0), "num_agents": args.num_agents,
                    "max_rows": args.max_rows, "agent": vars(agent), "training": vars(training),
                    "seed": args.seed}  # fmt: skip
        rows = pieces.compute(kind, settings, functools.partial(record, args, ses, agent, training))
        print(f"{kind}: mean return {test_returns(rows).mean():.1f}, {len(rows):,} transitions",
              flush=True)  # fmt: skip
        tables.append(rows.assign(kind=kind))
    return report(args, ses.task, pd.concat(tables, ignore_index=True))


def training_of(args: argparse.Namespace, ses: Any, agent: Any) -> Any:
    """How long an agent trains: as those that the SE was learned with."""
    from sejax.evaluation import training_as_learned

    training = dataclasses.replace(
        training_as_learned(ses, agent), test_episodes=args.test_episodes
    )
    if args.quick:
        training = dataclasses.replace(training, max_steps=min(training.max_steps or 2000, 2000))
    return training


class Steps(NamedTuple):
    """Transitions of one agent, leaves `[rows, ...]`; only those with `valid` were made."""

    obs: Any
    action: Any
    next_obs: Any
    reward: Any
    terminated: Any
    valid: Any


def record(args: argparse.Namespace, ses: Any, config: Any, training: Any) -> pd.DataFrame:
    """Trains and tests the agents of one kind; a row for each transition shown."""
    import jax

    from sejax.parallel import spread_over_devices

    agent, one = make_recorder(ses, config, training, args.max_rows)
    keys = jax.random.split(jax.random.key(args.seed), args.num_agents)
    params = ses.one(0)
    spread = spread_over_devices(lambda key: one(key, params), args.devices,
                                 cpu_lanes=agent.cpu_lanes)  # fmt: skip
    recorded = jax.device_get(jax.jit(spread)(keys))
    tables = [
        rows_of(source, index, steps)
        for index in range(args.num_agents)
        for source, steps in jax.tree.map(lambda x, i=index: x[i], recorded).items()
    ]
    return pd.concat(tables, ignore_index=True)


def rows_of(source: str, agent: int, recorded: dict[str, np.ndarray]) -> pd.DataFrame:
    """The valid ones of an agent's transitions as a table.

    Args:
      source: one of `SOURCES`.
      agent: its number.
      recorded: `next_obs [rows, obs_dim]`, and `reward`, `episode` and `valid`, `[rows]`.
    """
    valid = recorded["valid"]
    columns = {"source": source, "agent": agent, "episode": recorded["episode"][valid],
               "reward": recorded["reward"][valid].astype(float)}  # fmt: skip
    states = recorded["next_obs"][valid].astype(float)
    return pd.DataFrame(columns | {f"state_{i}": states[:, i] for i in range(states.shape[1])})


def make_recorder(
    ses: Any, config: Any, training: Any, max_rows: int
) -> tuple[Any, Callable[..., Any]]:
    """The agent, and `one(key, env_params)` that trains, tests and records one of it."""
    import jax
    import jax.numpy as jnp

    from sejax.agents.registry import make_agent
    from sejax.evaluation import make_tested_trainer

    agent = make_agent(config, ses.task, ses.config.exploration)
    capacity = min(max_rows, training.max_steps or max_rows)
    recording = recording_agent(agent, capacity, ses.task.obs_dim)
    train = make_tested_trainer(recording, ses.env, ses.task, training)
    test = make_test_recorder(agent, ses.task, training.test_episodes)

    def one(key: Any, env_params: Any) -> dict[str, dict[str, Any]]:
        key_train, key_test = jax.random.split(key)
        trained = train(key_train, env_params, recording.hparams).agent_state
        steps = test(key_test, trained.agent)
        predict = jax.vmap(lambda s, a: ses.env.predict(env_params.weights, s, a)[:2])
        next_obs, reward = predict(steps.obs, steps.action)
        episode = jnp.arange(steps.reward.shape[0]) // ses.task.max_steps
        met = trained.rows
        return {
            "train": {"next_obs": met[:, 2:], "reward": met[:, 1], "episode": jnp.int32(met[:, 0]),
                      "valid": jnp.arange(capacity) < trained.num_rows},
            "test": {"next_obs": steps.next_obs, "reward": steps.reward, "episode": episode,
                     "valid": steps.valid},
            "response": {"next_obs": next_obs, "reward": reward, "episode": episode,
                         "valid": steps.valid},
        }  # fmt: skip

    return agent, one


def recording_agent(agent: Any, capacity: int, obs_dim: int) -> Any:
    """An agent that keeps the last transitions of its training in its state.

    It trains as the given one does, on the same random numbers: only that its learning phases begin
    with the first episode, and that in those before `agent.learns_from` it only takes notes.

    Args:
      agent: whose training is recorded.
      capacity: transitions to keep.
      obs_dim: length of an observation.

    Returns:
      An `Agent` whose state has the fields `agent`; `rows [capacity, 2 + obs_dim]` of episode,
      reward and next state, in no order; `num_rows`, so many have been met; and `episode`.
    """
    import jax
    import jax.numpy as jnp
    from flax import struct

    @struct.dataclass
    class State:
        agent: Any
        rows: Any
        num_rows: Any
        episode: Any

    def init(key: Any, hparams: Any) -> State:
        return State(agent=agent.init(key, hparams), rows=jnp.zeros((capacity, 2 + obs_dim)),
                     num_rows=jnp.int32(0), episode=jnp.int32(0))  # fmt: skip

    def begin_episode(state: State, episode: Any) -> State:
        return state.replace(agent=agent.begin_episode(state.agent, episode), episode=episode)

    def memory(example: Any, max_steps: int) -> Any:
        inner = agent.memory(example, max_steps)

        def batch(key: Any, arrays: Any, num_steps: Any, transition: Any, size: Any = None) -> Any:
            return inner.batch(key, arrays, num_steps, transition, size), transition

        return inner._replace(batch=batch)

    def update(key: Any, state: State, batch_and_transition: Any) -> State:
        batch, step = batch_and_transition
        learned = jax.lax.cond(
            state.episode >= agent.learns_from,
            lambda inner: agent.update(key, inner, batch),
            lambda inner: inner,
            state.agent,
        )
        row = jnp.concatenate([jnp.stack([jnp.float32(state.episode), step.reward]), step.next_obs])
        return state.replace(agent=learned, rows=state.rows.at[state.num_rows % capacity].set(row),
                             num_rows=state.num_rows + 1)  # fmt: skip

    return dataclasses.replace(
        agent,
        init=init,
        begin_episode=begin_episode,
        act=lambda key, state, obs, explore: agent.act(key, state.agent, obs, explore),
        memory=memory,
        update=update,
        learns_from=0,
        batch_size=lambda state: agent.batch_size(state.agent),
    )


def make_test_recorder(agent: Any, task: Any, num_episodes: int) -> Callable[..., Steps]:
    """Builds `test(key, agent_state) -> Steps` of greedy episodes on the real task.

    The leaves are `[num_episodes * max_steps, ...]`, episode by episode; `action` is what the world
    was given. The episodes are those of `make_tester` with the same key, for an agent that does not
    repeat its actions.
    """
    import jax
    import jax.numpy as jnp

    env, params = task.env, task.params

    def episode(key: Any, agent_state: Any) -> Steps:
        key_reset, key_steps = jax.random.split(key)

        def step(carry: Any, index: Any) -> Any:
            obs, env_state, active = carry
            key_act, key_env = jax.random.split(jax.random.fold_in(key_steps, index))
            action = agent.env_action(agent.act(key_act, agent_state, obs, explore=False))
            next_obs, env_state, reward, terminated, _ = env.step_env(
                key_env, env_state, action, params
            )
            steps = Steps(obs, action, next_obs, jnp.float32(reward), terminated, active)
            ended = terminated | env.is_truncated(env_state, params)
            return (next_obs, env_state, active & ~ended), steps

        start = (*env.reset_env(key_reset, params), jnp.bool_(True))
        return jax.lax.scan(step, start, jnp.arange(task.max_steps))[1]

    def test(key: Any, agent_state: Any) -> Steps:
        keys = jax.random.split(key, num_episodes)
        steps = jax.vmap(episode, in_axes=(0, None))(keys, agent_state)
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), steps)

    return test


def test_returns(rows: pd.DataFrame) -> pd.Series:
    """Return of each agent's test episodes, by agent and episode."""
    tests = rows[rows["source"] == "test"]
    return tests.groupby(["agent", "episode"])["reward"].sum()


def columns_of(rows: pd.DataFrame) -> list[str]:
    """The columns that are shown: those of the next state, then the reward."""
    return [*[name for name in rows if name.startswith("state_")], "reward"]


def distance(a: Any, b: Any) -> float:
    r"""Wasserstein distance of two samples in one dimension, in their unit.

    .. math:: \int |F_a(x) - F_b(x)| dx

    Args:
      a: `[n]`.
      b: `[m]`.
    """
    a, b = np.sort(np.asarray(a, float)), np.sort(np.asarray(b, float))
    grid = np.sort(np.concatenate([a, b]))
    below_a = np.searchsorted(a, grid[:-1], side="right") / a.size
    below_b = np.searchsorted(b, grid[:-1], side="right") / b.size
    return float(np.sum(np.abs(below_a - below_b) * np.diff(grid)))


def summarise(rows: pd.DataFrame) -> pd.DataFrame:
    """Widths and distances of the distributions, a row for each kind of agent and dimension."""
    out = []
    for kind, mine in rows.groupby("kind", sort=False):
        for column in columns_of(rows):
            samples = {name: mine[mine["source"] == name][column] for name in SOURCES}
            out.append({
                "kind": kind,
                "dimension": column,
                **{f"std_{name}": x.std(ddof=0) for name, x in samples.items()},
                "response_to_train": distance(samples["response"], samples["train"]),
                "response_to_test": distance(samples["response"], samples["test"]),
                "train_to_test": distance(samples["train"], samples["test"]),
            })  # fmt: skip
    return pd.DataFrame(out)


def make_table(task: Any, rows: pd.DataFrame, summary: pd.DataFrame) -> pd.DataFrame:
    """The summary as texts; the return stands in each kind's first row."""
    names = [*DIMENSIONS.get(task.name, ()), "reward"]
    out = []
    for kind, mine in summary.groupby("kind", sort=False):
        returns = test_returns(rows[rows["kind"] == kind])
        for i, (_, row) in enumerate(mine.iterrows()):
            last = row["dimension"] == "reward"
            label = names[-1] if last else names[i] if len(names) > 1 else f"state {i}"
            closer = row["response_to_train"] < row["response_to_test"]
            out.append({
                "agent": kind if i == 0 else "",
                "return": f"{returns.mean():.2f} ± {returns.std():.2f}" if i == 0 else "",
                "paper's": PAPER_RETURNS.get((task.name, str(kind)), "") if i == 0 else "",
                "next": label,
                **{f"std, {name}": f"{row[f'std_{name}']:.3g}" for name in SOURCES},
                "response to train": f"{row['response_to_train']:.3g}",
                "response to test": f"{row['response_to_test']:.3g}",
                "response is closer to": "train" if closer else "test",
            })  # fmt: skip
    return pd.DataFrame(out)


def report(args: argparse.Namespace, task: Any, rows: pd.DataFrame) -> pd.DataFrame:
    """Writes the CSV, the picture and the table, prints the table and returns it."""
    from sejax.experiments import figures
    from sejax.files import write_text

    summary = summarise(rows)
    table = make_table(task, rows, summary)
    write_text(args.out / "summary.csv", summary.to_csv(index=False))
    draw(task, rows, args.out / "histograms.png")
    title = f"Transitions of agents trained on an SE of {task.name}"
    closer = int((summary["response_to_train"] < summary["response_to_test"]).sum())
    note = (
        f"{args.num_agents} agents a row with {args.test_episodes} test episodes each; the return "
        "is mean ± std over test episodes. Train: the SE's transitions met in training; test: the "
        "real task's in greedy tests; response: the SE's from the states and actions of those "
        "tests. Distances are Wasserstein's, in the unit of the dimension. The response is closer "
        f"to training than to the tests in {closer} of {len(summary)} distributions (paper: it "
        "aligns better with training, so that the SE makes the shift and not its agents)."
    )
    command = figures.command(NAME, args, "proxy", "agents", "num_agents", "test_episodes",
                              "max_rows")  # fmt: skip
    common.write_markdown(args.out / "table.md", title, command, table, note)
    figures.print_table(title, table)
    print(f"{args.out}: histograms.png, summary.csv and table.md; every transition is in "
          f"{args.out / 'pieces'}.")  # fmt: skip
    return table


def bin_edges(samples: dict[str, np.ndarray], num_bins: int = 80) -> np.ndarray:
    """Bins `[num_bins + 1]` over what is common to look at: a thousandth at each end is left out.

    Of each sample, not of all: a narrow one would else be lost in one bin of a wide one.
    """
    quantiles = [np.quantile(x, (0.001, 0.999)) for x in samples.values() if x.size]
    low, high = min(q[0] for q in quantiles), max(q[1] for q in quantiles)
    room = 0.03 * (high - low) or 0.5
    return np.linspace(low - room, high + room, num_bins + 1)


def draw(task: Any, rows: pd.DataFrame, path: Path) -> None:
    """Draws a row for each kind of agent and a column for each state dimension and the reward.

    Source: paper, figure "Histograms of next state s' and reward r".
    """
    import matplotlib.pyplot as plt

    from sejax.experiments import figures

    kinds, columns = list(rows["kind"].unique()), columns_of(rows)
    colors = {"train": figures.REAL, "test": figures.VARIED, "response": figures.FIXED}
    names = [*DIMENSIONS.get(task.name, [f"state {i}" for i in range(len(columns) - 1)]), "reward"]
    with plt.rc_context(figures.STYLE):
        figure, axes = plt.subplots(
            len(kinds), len(columns), figsize=(2.5 * len(columns), 0.8 + 2.2 * len(kinds)),
            squeeze=False, sharey="row", layout="constrained",
        )  # fmt: skip
        for line, kind in zip(axes, kinds, strict=True):
            for axis, column, name in zip(line, columns, names, strict=True):
                mine = rows[rows["kind"] == kind]
                _panel(axis, {s: mine[mine["source"] == s][column].to_numpy() for s in SOURCES},
                       colors)  # fmt: skip
                axis.set_xlabel(f"next {name}" if name != "reward" else name, fontsize=9)
            line[0].set_ylabel(f"{figures.AGENT_NAMES.get(kind, kind)}\ntransitions")
        handles = [plt.Rectangle((0, 0), 1, 1, color=colors[s], alpha=0.6) for s in SOURCES]
        figure.legend(handles, list(LABELS.values()), ncols=3, loc="outside upper center")
        figures.write(figure, path)


def _panel(axis: Any, samples: dict[str, np.ndarray], colors: dict[str, str]) -> None:
    edges = bin_edges(samples)
    for source, values in samples.items():
        options: dict[str, Any] = {"bins": edges, "color": colors[source]}
        axis.hist(values, histtype="stepfilled", alpha=0.3, **options)
        axis.hist(values, histtype="step", lw=1.1, **options)
    axis.set_yscale("log")
    axis.set_xlim(edges[0], edges[-1])


if __name__ == "__main__":
    main()
