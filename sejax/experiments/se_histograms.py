"""What an SE shows its agents: histograms of next states and rewards, beside the real task's.

Source: paper, section "Analyzing SE Behavior" (figure "Histograms of next state s' and reward r")
and appendix "Qualitative Study of Synthetic Environments for the CartPole and Acrobot Tasks";
`reference_details.md` 7.2.

Agents with default hyperparameters are trained on one SE and tested on the real task. Shown are

- `train`: the SE's transitions in training itself, in the initial episodes and with exploration;
  of each agent the last `max_rows` ones,
- `test`: the real transitions of its greedy test episodes,
- `response`: what the SE's networks say in one step from the states and actions of `test`.

If `response` is closer to `train` than to `test`, it is the SE that shifts the distributions and
not what the agents do in it.
"""

import dataclasses
import functools
from collections.abc import Callable
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
from sejax import plugins
from sejax.agents import replay
from sejax.agents.memory import Memory, MemoryMaker
from sejax.experiments import figures, se_agents
from sejax.experiments.experiment import Experiment
from sejax.experiments.se_agents import AGENTS
from sejax.experiments.settings import Settings, each_of, setting
from sejax.experiments.tables import publish
from sejax.experiments.worlds import Group, Measure, World, train_groups, training_as_learned
from sejax.options import counts
from sejax.training import TrainingConfig

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


@dataclass(frozen=True, kw_only=True)
class SeHistograms(Settings):
    """Settings of this experiment."""

    name = "se_histograms"

    proxy: str = setting("cartpole", about="SE: a run directory, a file or a shipped name")
    agents: tuple[str, ...] = setting(AGENTS, each_of(AGENTS), about="kinds of agents, a row each")
    num_agents: int = setting(10, counts("it counts agents"), quick=3, about="of each kind")
    test_episodes: int = setting(10, counts("it counts episodes"), about="of each agent")
    max_rows: int = setting(10_000, counts("it counts transitions"), about="training transitions "
                            "of an agent that are kept, the last ones")  # fmt: skip

    @property
    def rows_file(self) -> Path:
        """Every transition: too many to keep."""
        return self.work_folder / "rows.csv.xz"


def compute(settings: SeHistograms) -> pd.DataFrame:
    """Trains what is missing; a row for each transition.

    Raises:
      ConfigError: for a proxy or settings that cannot work.
    """
    ses = load(settings)
    group = Group("all", ses.one(0), ses.fingerprint(0))
    tables = []
    for kind in settings.agents:
        agent = se_agents.agent_config(settings, kind)
        world = World(
            name=kind, env=ses.env, task=ses.task, groups=(group,), agent=agent,
            training=training_of(settings, ses, agent), is_single=True,
            exploration=plugins.configure("exploration", ses.config["exploration"]),
            settings={"proxy": ses.config["proxy"], "max_rows": settings.max_rows},
        )  # fmt: skip
        measure = transitions(settings.max_rows)
        rows = train_groups(world, settings, settings.num_agents, measure)
        tables.append(rows.assign(kind=kind))
    return pd.concat(tables, ignore_index=True).drop(columns="group")


def load(settings: SeHistograms) -> Any:
    """The SE."""
    return sejax.load_set(settings.proxy, option="proxy", kind="se").first(1)


def training_of(settings: SeHistograms, ses: Any, agent: Any) -> TrainingConfig:
    """How long an agent trains: as those that the SE was learned with."""
    training = training_as_learned(ses, agent)
    if settings.quick:
        most = min(training.max_steps or se_agents.QUICK_STEPS, se_agents.QUICK_STEPS)
        training = dataclasses.replace(training, max_steps=most)
    return dataclasses.replace(training, test_episodes=settings.test_episodes)


# --- what is recorded ----------------------------------------------------------------------------


@functools.cache
def transitions(max_rows: int) -> Measure:
    """What is kept of an agent: the last transitions of its training, and its tests'."""
    return Measure(
        make_run=functools.partial(make_recorded_run, max_rows),
        to_table=lambda recorded, drawn: rows_of(recorded),
        say=lambda rows: f"mean return {test_returns(rows).mean():.1f}, {len(rows):,} transitions",
    )


def make_recorded_run(
    max_rows: int, agent: Any, env: Any, task: Any, training: TrainingConfig
) -> Callable[..., Any]:
    """Builds `run(key, env_params, active)` that trains, tests and records one agent."""
    from sejax.evaluation import make_tested_trainer
    from sejax.rollout import make_recorder

    capacity = min(max_rows, training.max_steps or max_rows)
    train = make_tested_trainer(agent, env, task, training, recorder=last_steps(capacity))
    test = make_recorder(agent, task, training.test_episodes)

    def run(key: Any, env_params: Any, active: Any) -> dict[str, dict[str, Any]]:
        key_train, key_test = jax.random.split(key)
        trained = train(key_train, env_params, agent.hparams, active)
        steps = test(key_test, trained.agent_state)
        predict = jax.vmap(lambda s, a: env.predict(env_params.weights, s, a)[:2])
        next_obs, reward = predict(steps.obs, steps.action)
        tested = {"episode": jnp.arange(steps.reward.shape[0]) // task.max_steps,
                  "valid": steps.valid}  # fmt: skip
        met = trained.recorded.rows
        valid = jnp.arange(capacity) < trained.train_steps
        return {
            "train": {"next_obs": met[:, 2:], "reward": met[:, 1], "episode": jnp.int32(met[:, 0]),
                      "valid": valid},
            "test": {"next_obs": steps.next_obs, "reward": steps.reward} | tested,
            "response": {"next_obs": next_obs, "reward": reward} | tested,
        }  # fmt: skip

    return run


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LastSteps:
    """What a recorder keeps.

    Attributes:
      rows: `[capacity, 2 + obs_dim]` of episode, reward and next state, in no order.
      episode: that goes on, `[]`.
    """

    rows: Any
    episode: Any


def last_steps(capacity: int) -> MemoryMaker:
    """A recorder of the last `capacity` steps of a training."""

    def make(example: Any, max_steps: int) -> Memory:
        def init() -> LastSteps:
            rows = jnp.zeros((capacity, 2 + example.next_obs.shape[0]))
            return LastSteps(rows=rows, episode=jnp.int32(0))

        def store(kept: LastSteps, step: Any, made: Any, ended: Any, active: Any) -> LastSteps:
            first = jnp.stack([jnp.float32(kept.episode), jnp.float32(made.reward)])
            row = jnp.concatenate([first, made.next_obs])
            return LastSteps(rows=replay.write_row(kept.rows, step, row, active),
                             episode=kept.episode + (ended & active))  # fmt: skip

        return Memory(init=init, store=store, batch=lambda *_: None)

    return make


def rows_of(recorded: dict[str, dict[str, np.ndarray]]) -> pd.DataFrame:
    """The valid transitions of all agents as a table.

    Args:
      recorded: by source `next_obs [agent, rows, obs_dim]`, and `reward`, `episode` and `valid`,
        `[agent, rows]`.
    """
    tables = []
    for agent in range(recorded["test"]["valid"].shape[0]):
        for source, every in recorded.items():
            mine = {name: x[agent][every["valid"][agent]] for name, x in every.items()}
            columns = {"source": source, "agent": agent, "episode": mine["episode"],
                       "reward": mine["reward"].astype(float)}  # fmt: skip
            states = mine["next_obs"].astype(float).T
            columns |= {f"state_{i}": x for i, x in enumerate(states)}
            tables.append(pd.DataFrame(columns))
    return pd.concat(tables, ignore_index=True)


# --- what is made of it --------------------------------------------------------------------------


def test_returns(rows: pd.DataFrame) -> pd.Series:
    """Return of each agent's test episodes, by agent and episode."""
    tests = rows[rows["source"] == "test"]
    return tests.groupby(["agent", "episode"])["reward"].sum()


def columns_of(rows: pd.DataFrame) -> list[str]:
    """The columns that are shown: those of the next state, then the reward."""
    return [*[name for name in rows if name.startswith("state_")], "reward"]


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
                "response_to_train": wasserstein_distance(samples["response"], samples["train"]),
                "response_to_test": wasserstein_distance(samples["response"], samples["test"]),
                "train_to_test": wasserstein_distance(samples["train"], samples["test"]),
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


def report(settings: SeHistograms, rows: pd.DataFrame) -> pd.DataFrame:
    """Writes the table and the picture."""
    task = load(settings).task
    summary = summarise(rows)
    draw(task, rows, settings.folder / "histograms.png")
    closer = int((summary["response_to_train"] < summary["response_to_test"]).sum())
    note = (
        f"{rows['agent'].nunique()} agents a row with {settings.test_episodes} test episodes each; "
        "the return is mean ± std over test episodes. Train: the SE's transitions met in training; "
        "test: the real task's in greedy tests; response: the SE's from the states and actions of "
        "those tests. Distances are Wasserstein's, in the unit of the dimension. The response is "
        f"closer to training than to the tests in {closer} of {len(summary)} distributions "
        "(paper: it aligns better with training, so that the SE makes the shift and not its "
        "agents)."
    )
    title = f"Transitions of agents trained on an SE of {task.name}"
    return publish(settings, title, make_table(task, rows, summary), summary, note)


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


EXPERIMENT = Experiment(settings=SeHistograms, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
