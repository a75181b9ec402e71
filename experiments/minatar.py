"""How agents with a convolution learn MinAtar, whose observations are small images.

DQN and PPO with `agent.torso=conv` train on gymnax's four games. Nothing is tested on the way: the
curves are the returns of training episodes, those that ended in each part of the steps, so that
DQN's have its exploration in them. Beside them stand the returns that gymnax publishes for PPO.

Source: Young and Tian, "MinAtar" (2019), for the networks; gymnax's README for its returns, and
gymnax-blines for the steps of its PPO, whose network is an MLP on the flat image.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd

import sejax
from experiments.common import figures, tables
from experiments.common.experiment import Experiment, Settings, count, setting
from sejax.options import each_of
from sejax.options.plain import to_plain
from sejax.training import TrainingConfig, make_trainer

GAMES = {"Asterix": 15, "Breakout": 28, "Freeway": 58, "SpaceInvaders": 131}  # gymnax's returns
SHORTEST_EPISODE = 5  # steps, so that there is room for all episodes' returns
NETWORK: dict[str, Any] = dict(torso="conv", num_layers=1, hidden_size=128, activation="relu")
# Chosen by looks at Breakout and SpaceInvaders, seed 0, 300,000 steps of PPO and 150,000 of DQN.
AGENTS = {
    "ppo": sejax.PPOConfig(
        **NETWORK, rollout_steps=1024, num_minibatches=8, epochs=4, learning_rate=5e-4,
        gae_lambda=0.95,
    ),
    "dqn": sejax.DQNConfig(
        **NETWORK, batch_size=32, train_every=4, learning_rate=2.5e-4, loss="huber", tau=0.005,
        exploration_steps=50_000, warmup_episodes=50,
    ),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Minatar(Settings):
    name = "minatar"

    # Of gymnax's games of MinAtar.
    games: tuple[str, ...] = setting(tuple(GAMES), each_of(GAMES), quick=("Breakout",))
    agents: tuple[str, ...] = setting(tuple(AGENTS), each_of(AGENTS))  # kinds of agents
    num_agents: int = count(3, quick=1)  # seeds of each agent on each game
    ppo_steps: int = count(1_000_000, quick=3000)  # of a training of PPO
    dqn_steps: int = count(300_000, quick=3000)  # of DQN
    num_parts: int = count(50, quick=4)  # parts of the steps, a point of the curve each


def compute(settings: Minatar) -> pd.DataFrame:
    """Trains what is missing; a row for each part of each agent's steps."""
    parts = []
    for game in settings.games:
        for agent in settings.agents:
            steps = settings.ppo_steps if agent == "ppo" else settings.dqn_steps
            learn = functools.cache(lambda agent=agent, game=game, n=steps: learner(agent, game, n))
            for seed in range(settings.seed + 1, settings.seed + 1 + settings.num_agents):
                made_with = {"agent": to_plain(AGENTS[agent]), "steps": steps, "seed": seed}
                rows = settings.shards.compute(
                    f"{game}-{agent}-{seed}",
                    made_with | settings.values("num_parts"),
                    functools.partial(curve, learn, seed, steps, settings.num_parts),
                )
                parts.append(rows.assign(game=game, agent=agent, seed=seed))
    return pd.concat(parts, ignore_index=True)


def learner(agent: str, game: str, steps: int) -> Callable[[jax.Array], Any]:
    """Compiles the training of an agent on a game."""
    task = sejax.envs.make(f"gymnax/{game}-MinAtar")
    training = TrainingConfig(
        max_steps=steps,
        max_episodes=steps // SHORTEST_EPISODE,
        stop_rule="never",
        time_limit_is_terminal=False,
    )
    train = make_trainer(sejax.make_agent(AGENTS[agent], task), task.env, training)
    return jax.jit(lambda key: train(key, task.params))


def curve(learn: Any, seed: int, steps: int, num_parts: int) -> pd.DataFrame:
    """Mean return of the training episodes that ended in each part of the steps."""
    trained = learn()(jax.random.key(seed))
    num = int(trained.episodes)
    ends, returns = (np.asarray(x)[:num] for x in (trained.episode_ends, trained.returns))
    part = np.minimum((ends - 1) * num_parts // steps, num_parts - 1)
    rows = pd.DataFrame({"part": part, "return": returns}).groupby("part")["return"]
    found = rows.agg(["mean", "size"]).reindex(range(num_parts)).reset_index()
    return found.assign(steps=(found["part"] + 1) * steps // num_parts)


def summarise(rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each game and agent: the returns in the last tenth of the steps."""

    def statistics(mine: pd.DataFrame) -> dict[str, Any]:
        is_late = mine["steps"] > 0.9 * mine["steps"].max()
        last = mine[is_late].groupby("seed")["mean"].mean()
        row = {"num_agents": len(last), "steps": mine["steps"].max()}
        row |= {"worst": last.min(), "gymnax": GAMES[mine["game"].iloc[0]]}
        return row | tables.mean_columns(last, "last")

    return tables.summary_by(rows, ["game", "agent"], statistics)


COLUMNS: dict[str, Any] = {
    "game": "{game}",
    "agent": lambda row: figures.AGENT_NAMES[row.agent],
    "agents": "{num_agents}",
    "steps": "{steps:,}",
    "return, last tenth of the steps": tables.mean_text("last", 1),
    "worst": "{worst:.1f}",
    "gymnax, PPO of 10 million steps": "{gymnax}",
}


def report(settings: Minatar, rows: pd.DataFrame) -> pd.DataFrame:
    draw(rows, settings.folder / "learning_curves.png")
    summary = summarise(rows)
    note = (
        "Returns of training episodes, with exploration, in the last tenth of the steps, of which "
        "each part weighs alike; mean over agents. gymnax's returns are "
        "those of its README. Pictures: shaded from the worst to the best agent."
    )
    title = "Agents with a convolution on MinAtar"
    return tables.publish(settings, title, tables.as_texts(summary, COLUMNS), summary, note)


def draw(rows: pd.DataFrame, path: Path) -> None:
    """Draws a panel for each game: mean, worst and best of each kind, and gymnax's return."""
    games = list(rows.groupby("game", sort=False))
    with figures.panels(path, 1, len(games), (3.6 * len(games), 3.4)) as (_, axes):
        for axis, (game, mine) in zip(axes[0], games, strict=True):
            for color, (agent, some) in zip(
                (figures.REAL, figures.VARIED), mine.groupby("agent", sort=False), strict=False
            ):
                values = some.pivot(index="seed", columns="steps", values="mean")
                label = figures.AGENT_NAMES[str(agent)]
                grid = values.columns.to_numpy() / 1e6
                figures.band(axis, grid, values.to_numpy(), _ends, color, lw=1.8, label=label)
            figures.threshold(axis, GAMES[str(game)], f"gymnax ({GAMES[str(game)]})")
            axis.set_title(str(game), fontsize=10)
            axis.set_xlabel("million steps")
        axes[0][0].set_ylabel("return of training episodes")
        axes[0][0].legend(fontsize=8, loc="upper left")


def _ends(values: np.ndarray) -> np.ndarray:
    """The worst and the best agent, `[2, points]`, of `[agent, points]`."""
    return np.stack([values.min(axis=0), values.max(axis=0)])


EXPERIMENT = Experiment(settings=Minatar, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
