"""What an SE shows its agents: histograms of next states and rewards, beside the real task's.

Source: paper, section "Analyzing SE Behavior" (figure "Histograms of next state s' and reward r")
and appendix "Qualitative Study of Synthetic Environments for the CartPole and Acrobot Tasks";
`docs/reference.md` 7.2.

Agents with default hyperparameters are trained on one SE and tested on the real task. Shown are

- `train`: the SE's transitions in training itself, in the initial episodes and with exploration;
  of each agent the last `max_rows` ones,
- `test`: the real transitions of its greedy test episodes,
- `response`: what the SE's networks say in one step from the states and actions of `test`.

If `response` is closer to `train` than to `test`, it is the SE that shifts the distributions and
not what the agents do in it.

Of the transitions, which are too many to keep, the rows have how often values were met in narrow
bins, and the returns of the tests.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from scipy.stats import wasserstein_distance

import sejax
from experiments.common import agents as groups
from experiments.common import figures
from experiments.common.agents import SE_AGENTS, SOFT_SE, Condition, Measure
from experiments.common.experiment import Experiment, Settings, setting
from experiments.common.shards import stack, unstack
from experiments.common.tables import as_texts, publish, summary_by
from sejax import ProxySet, Task, TrainingConfig
from sejax.agents.buffers import Buffer, BufferMaker, write_row
from sejax.evaluation import make_recorder, make_tested_trainer
from sejax.options import Count

NUM_BINS, NUM_DRAWN = 2000, 80  # of the rows, and of the figure
SOURCES = {
    "train": (figures.REAL, "SE, in training"),
    "test": (figures.VARIED, "real task, in tests"),
    "response": (figures.FIXED, "SE, from the tests' states and actions"),
}
DIMENSIONS = {
    "cartpole": (
        "cart position (m)",
        "cart velocity (m/s)",
        "pole angle (rad)",
        "pole angular velocity (rad/s)",
    ),
    "acrobot": (
        "cos of angle 1",
        "sin of angle 1",
        "cos of angle 2",
        "sin of angle 2",
        "angular velocity 1 (rad/s)",
        "angular velocity 2 (rad/s)",
    ),
}

# Paper, the same appendix: mean test returns of the agents shown; section "Analyzing SE Behavior":
# 199.3 for CartPole and DDQN.
PAPER_RETURNS = {
    "cartpole": {"ddqn": "199.3", "dueling_ddqn": "193.75", "td3_discrete": "197.26"},
    "acrobot": {"ddqn": "-91.62", "dueling_ddqn": "-88.56", "td3_discrete": "-93.17"},
}


@dataclass(frozen=True, kw_only=True)
class SeHistograms(Settings):
    """Settings of this experiment.

    Attributes:
      proxy: SE: a run directory, a file or a shipped name
      agents: kinds of agents, a row each
      num_agents: of each kind
      test_episodes: of each agent
      max_steps: of training; as the SE's configuration says
      max_rows: transitions of training, the last ones of an agent
    """

    name = "se_histograms"

    proxy: str = setting(SOFT_SE)
    agents: tuple[str, ...] = setting(SE_AGENTS, SE_AGENTS)
    num_agents: Count = setting(10, quick=3)
    test_episodes: Count = setting(10)
    max_steps: Count | None = setting(None, quick=1500)
    max_rows: Count = setting(10_000)


def compute(settings: SeHistograms) -> pd.DataFrame:
    """Trains what is missing; a row for each bin, and one for each test."""
    ses, measure = load(settings), transitions(settings.max_rows)
    limits = settings.test_episodes, settings.max_steps
    tables = []
    for kind in settings.agents:
        agent = groups.agent_config(kind)
        condition = Condition.of_set(
            ses,
            ["all"],
            name=kind,
            agent=agent,
            training=groups.training_as_learned(ses, agent, *limits),
            exploration=ses.learned_with("exploration"),
            settings=settings.values("max_rows"),
            is_single=True,
        )
        rows = groups.train_groups(condition, settings, settings.num_agents, measure)
        tables.append(rows.assign(kind=kind))
    rows = pd.concat(tables, ignore_index=True)
    return stack({"bins": binned(rows), "returns": test_returns(rows)})


def load(settings: SeHistograms) -> ProxySet:
    """The SE."""
    return sejax.load_set(settings.proxy, option="proxy", kind="se")[:1]


@functools.cache
def transitions(max_rows: int) -> Measure:
    """What is kept of an agent: the last transitions of its training, and its tests'."""
    return Measure(
        make_run=functools.partial(make_recorded_run, max_rows),
        to_table=lambda recorded, drawn: rows_of(recorded),
    )


def make_recorded_run(
    max_rows: int, agent: Any, env: Any, task: Task, training: TrainingConfig
) -> Callable[..., Any]:
    """Builds `run(key, env_params, active)` that trains, tests and records one agent."""
    capacity = min(max_rows, training.max_steps or max_rows)
    recording = dataclasses.replace(agent, buffer=with_last_steps(agent.buffer, capacity))
    train = make_tested_trainer(recording, env, task, training, keeps_stored=True)
    test = make_recorder(agent, task, training.test_episodes)

    def run(key: Any, env_params: Any, active: Any) -> dict[str, dict[str, Any]]:
        key_train, key_test = jax.random.split(key)
        trained = train(key_train, env_params, agent.hparams, active)
        steps = test(key_test, trained.agent_state)
        predict = jax.vmap(lambda s, a: env.predict(env_params.weights, s, a)[:2])
        next_obs, reward = predict(steps.obs, steps.action)
        episode = jnp.arange(steps.reward.shape[0]) // task.max_steps
        (_, met), is_made = trained.stored, jnp.arange(capacity) < trained.train_steps
        tested = {"next_obs": steps.next_obs, "reward": steps.reward, "episode": episode}
        return {
            "train": {"next_obs": met[:, :-1], "reward": met[:, -1], "valid": is_made},
            "test": tested | {"valid": steps.valid},
            "response": {"next_obs": next_obs, "reward": reward, "valid": steps.valid},
        }

    return run


def with_last_steps(buffer: BufferMaker, capacity: int) -> BufferMaker:
    """A buffer beside which the last `capacity` steps of a training are kept, in no order.

    Their rows are next state and reward, `[capacity, obs_dim + 1]`.
    """

    def make(example: Any, max_steps: int) -> Buffer:
        inner = buffer(example, max_steps)

        def init() -> Any:
            return inner.init(), jnp.zeros((capacity, example.next_obs.shape[0] + 1))

        def store(arrays: Any, step: Any, made: Any, ended: Any, active: Any) -> Any:
            rows = write_row(arrays[1], step, jnp.append(made.next_obs, made.reward), active)
            return inner.store(arrays[0], step, made, ended, active), rows

        def batch(key: Any, arrays: Any, *others: Any) -> Any:
            return inner.batch(key, arrays[0], *others)

        return dataclasses.replace(inner, init=init, store=store, batch=batch)

    return make


def rows_of(recorded: dict[str, dict[str, np.ndarray]]) -> pd.DataFrame:
    """The valid transitions of all agents as a table.

    Each source has `next_obs [agent, rows, obs_dim]`, and `reward` and `valid`, `[agent, rows]`;
    the tests have the `episode` too.
    """
    tables = []
    for agent in range(recorded["test"]["valid"].shape[0]):
        for source, every in recorded.items():
            is_valid = every["valid"][agent]
            columns = {name: x[agent][is_valid].astype(float) for name, x in every.items()}
            states = {f"state_{i}": x for i, x in enumerate(columns.pop("next_obs").T)}
            tables.append(pd.DataFrame({"source": source, "agent": agent} | columns | states))
    return pd.concat(tables, ignore_index=True)


def binned(rows: pd.DataFrame) -> pd.DataFrame:
    """How often values were met: a row for each kind of agent, dimension and bin, where any was.

    A column for each source has the counts; the bin goes from `low + bin * width` on, a `width`.
    """
    tables = []
    shown = [*[name for name in rows if name.startswith("state_")], "reward"]
    for (kind, mine), column in itertools.product(rows.groupby("kind", sort=False), shown):
        edges = np.histogram_bin_edges(mine[column], NUM_BINS)
        counts = {
            source: np.histogram(mine[mine["source"] == source][column], edges)[0]
            for source in SOURCES
        }
        where = {"kind": kind, "dimension": column, "low": edges[0], "width": edges[1] - edges[0]}
        table = pd.DataFrame({"bin": range(NUM_BINS)} | counts).assign(**where)
        tables.append(table[table[[*SOURCES]].any(axis=1)])
    return pd.concat(tables, ignore_index=True)


def test_returns(rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each test episode of each agent, its rewards summed."""
    tests = rows[rows["source"] == "test"]
    by = [name for name in ("kind", "agent", "episode") if name in rows]
    return tests.groupby(by, sort=False, as_index=False)["reward"].sum()


def names_of(task: Task, rows: pd.DataFrame) -> dict[str, str]:
    """What people call the dimensions."""
    usual = {name: name.replace("_", " ") for name in rows["dimension"].unique()}
    return usual | dict(zip(usual, DIMENSIONS.get(task.name, ()), strict=False))


def summarise(bins: pd.DataFrame) -> pd.DataFrame:
    """Widths and distances of the distributions, a row for each kind of agent and dimension."""

    def statistics(mine: pd.DataFrame) -> dict[str, float]:
        places, width = mine["bin"].astype(int), mine["width"].iloc[0]
        counts = mine[[*SOURCES]].astype(int)
        pairs = (("response", "train"), ("response", "test"), ("train", "test"))
        return {
            f"std_{name}": width * np.cov(places, fweights=x, ddof=0) ** 0.5
            for name, x in counts.items()
        } | {
            f"{a}_to_{b}": width * wasserstein_distance(places, places, counts[a], counts[b])
            for a, b in pairs
        }

    return summary_by(bins, ["kind", "dimension"], statistics)


def make_table(task: Task, summary: pd.DataFrame, returns: pd.DataFrame) -> pd.DataFrame:
    """The summary as texts; the return stands in each kind's first row."""
    names = names_of(task, summary)

    def first(text: Callable[[str], str]) -> Callable[[Any], str]:
        return lambda row: text(row.kind) if row.dimension == next(iter(names)) else ""

    def returned(kind: str) -> str:
        mine = returns[returns["kind"] == kind]["reward"]
        return f"{mine.mean():.2f} ± {mine.std():.2f}"

    return as_texts(
        summary,
        {
            "agent": first(str),
            "return": first(returned),
            "paper's": first(lambda kind: PAPER_RETURNS.get(task.name, {}).get(kind, "")),
            "next": lambda row: names[row.dimension],
            **{f"std, {name}": f"{{std_{name}:.3g}}" for name in SOURCES},
            "response to train": "{response_to_train:.3g}",
            "response to test": "{response_to_test:.3g}",
            "response is closer to": lambda row: (
                "train" if row.response_to_train < row.response_to_test else "test"
            ),
        },
    )


def report(settings: SeHistograms, rows: pd.DataFrame) -> pd.DataFrame:
    task = load(settings).task
    bins, returns = unstack(rows, "bins"), unstack(rows, "returns")
    summary = summarise(bins)
    draw(task, bins, settings.folder / "histograms.png")
    closer = int((summary["response_to_train"] < summary["response_to_test"]).sum())
    note = (
        f"{returns['agent'].nunique()} agents a row; the return is mean ± std over their test "
        "episodes. Distances are Wasserstein's, in the unit of the dimension. The response is "
        f"closer to training than to the tests in {closer} of {len(summary)} distributions (paper: "
        "it aligns better with training, so that the SE makes the shift and not its agents)."
    )
    title = f"Transitions of agents trained on an SE of {task.name}"
    return publish(settings, title, make_table(task, summary, returns), summary, note)


def bin_edges(mine: pd.DataFrame, samples: Mapping[str, np.ndarray]) -> np.ndarray:
    """Wider bins over what is common to look at: a thousandth at each end is left out.

    Of each sample, not of all: a narrow one would else be lost in one bin of a wide one.
    """
    quantiles = [np.quantile(x, (0.001, 0.999)) for x in samples.values() if x.size]
    low, width = mine["low"].iloc[0], mine["width"].iloc[0]
    first = int((min(q[0] for q in quantiles) - low) / width)
    last = int((max(q[1] for q in quantiles) - low) / width) + 1
    step = max(1, (last - first) // NUM_DRAWN)  # bins that one is drawn of
    return low + width * np.arange(first - 2 * step, last + 3 * step, step)


def draw(task: Task, bins: pd.DataFrame, path: Path) -> None:
    """Draws a row for each kind of agent and a column for each state dimension and the reward.

    Source: paper, figure "Histograms of next state s' and reward r".
    """
    kinds, names = list(bins["kind"].unique()), names_of(task, bins)
    size = 2.5 * len(names), 0.8 + 2.2 * len(kinds)
    with figures.panels(path, len(kinds), len(names), size, sharey="row") as (figure, axes):
        for line, kind in zip(axes, kinds, strict=True):
            for axis, (column, name) in zip(line, names.items(), strict=True):
                mine = bins[(bins["kind"] == kind) & (bins["dimension"] == column)]
                values = mine["low"] + (mine["bin"] + 0.5) * mine["width"]  # the middles of bins
                samples = {s: values.repeat(mine[s].astype(int)).to_numpy() for s in SOURCES}
                edges = bin_edges(mine, samples)
                for source, values in samples.items():
                    color, _ = SOURCES[source]
                    axis.hist(values, edges, histtype="stepfilled", alpha=0.3, color=color)
                    axis.hist(values, edges, histtype="step", lw=1.1, color=color, log=True)
                axis.set_xlim(edges[0], edges[-1])
                axis.set_xlabel(f"next {name}" if name != "reward" else name, fontsize=9)
            line[0].set_ylabel(f"{figures.agent_name(kind)}\ntransitions")
        colors, labels = zip(*SOURCES.values(), strict=True)
        handles = [plt.Rectangle((0, 0), 1, 1, color=color, alpha=0.6) for color in colors]
        figure.legend(handles, labels, ncols=3, loc="outside upper center")


EXPERIMENT = Experiment(settings=SeHistograms, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
