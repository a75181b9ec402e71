"""The rewards that RNs have learned for each move on the Cliff Walking map, as a picture of it.

Source: paper, appendix "Qualitative Study of Reward Networks on the Cliff Walking Task" (figure
"Learned Cliff Walking reward for different reward network types"); `docs/reference.md` 7.7.

The paper describes its picture: the additive potential RNs pay little for entering the cliff and
for going up from the edge, and much for going down to it; the additive non-potential ones pay for
the shortest path; the exclusive non-potential ones only help around the start and the goal; the
exclusive potential ones look random.

Differs: moves out of the goal and the cliff, which end an episode and which no agent ever makes,
are left out.
"""

import itertools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from matplotlib.collections import PolyCollection

from experiments.common import figures
from experiments.common import reward_networks as rn
from experiments.common.experiment import Experiment
from experiments.common.reward_networks import RnSettings
from experiments.common.tables import publish
from sejax import ProxySet
from sejax.envs.gridworld import CLIFF_WALKING as MAP
from sejax.options import one_of

CELLS = np.array([list(line) for line in MAP])  # [row, column]
_COLORS = {"G": "#ffffff", "O": "#d9d9d9"}  # of cells without moves: goal and cliff
IGNORED_BELOW = -50.0  # the right column leaves out rewards of at most this
# Corners of the triangle of each action in a cell whose middle is (0, 0), y downwards: the middle
# and two corners of the cell. Actions as in `envs.gridworld`: RIGHT, LEFT, DOWN, UP.
_CORNERS = {
    0: ((0.5, -0.5), (0.5, 0.5)),
    1: ((-0.5, -0.5), (-0.5, 0.5)),
    2: ((-0.5, 0.5), (0.5, 0.5)),
    3: ((-0.5, -0.5), (0.5, -0.5)),
}


@dataclass(frozen=True, kw_only=True)
class RnHeatmap(RnSettings):
    """Settings of this experiment.

    Attributes:
      objective: that RNs are learned by
    """

    name = "rn_heatmap"

    objective: str = rn.objective_setting()

    def __post_init__(self) -> None:
        super().__post_init__()
        one_of(["cliff_walking"])("env", self.env, None)  # the figure is its map


def compute(settings: RnHeatmap) -> pd.DataFrame:
    """Learns what is missing; a row for each RN and move."""
    rn.check_stored(settings, [settings.objective])
    tables = []
    for variant in settings.variants:
        rewards = rewards_of_moves(rn.learn(settings, variant, settings.objective))
        places = zip(("rn", "state", "action"), np.indices(rewards.shape), strict=True)
        table = pd.DataFrame({name: place.ravel() for name, place in places})
        tables.append(table.assign(variant=variant, reward=rewards.ravel()))
    return pd.concat(tables, ignore_index=True)


def rewards_of_moves(rns: ProxySet) -> np.ndarray:
    """What each RN pays for each move, `[rn, state, action]`; nan out of terminal states."""
    env, task = rns.env, rns.task
    grid, key = task.env, jax.random.key(0)  # nothing is random here

    def reward(weights: Any, index: Any, action: Any) -> Any:
        params = env.params(weights, rns.discount)
        _, state = env.reset_env(key, params)
        state = state.replace(world=state.world.replace(index=index), obs=index)
        _, _, reward, _, _ = env.step_env(key, state, action, params)
        terminal = grid.is_terminated(state.world, task.params)
        return jnp.where(terminal, jnp.nan, reward)

    states, actions = jnp.arange(task.num_states), jnp.arange(grid.num_actions)
    for axis in (2, 1, 0):  # over actions, states and RNs
        reward = jax.vmap(reward, tuple(0 if i == axis else None for i in range(3)))
    return np.asarray(jax.jit(reward)(rns.weights, states, actions))


def by_variant(settings: RnHeatmap, rows: pd.DataFrame) -> dict[str, np.ndarray]:
    """The rewards of each variant, `[rn, state, action]`, from the rows."""
    shape = settings.learned, CELLS.size, len(_CORNERS)
    return {
        variant: rows[rows["variant"] == variant]["reward"].to_numpy().reshape(shape)
        for variant in settings.variants
    }


def kinds_of_moves() -> dict[str, np.ndarray]:
    """The moves that the paper speaks of, as masks `[state, action]`."""
    row, column = np.divmod(np.arange(CELLS.size), CELLS.shape[1])
    right, left, down, up = range(4)
    start, goal = (row == 3) & (column == 0), (column == 11) & (row == 2)
    above_cliff = (row == 2) & (column > 0) & (column < 11)

    def moves(states: np.ndarray, action: int) -> np.ndarray:
        return states[:, None] & (np.arange(4) == action)

    return {
        "into the cliff": moves(above_cliff, down) | moves(start, right),
        "from the start up": moves(start, up),
        "right along the cliff": moves((row == 2) & (column < 11), right),
        "left along the cliff": moves((row == 2) & (column > 0), left),
        "down to the cliff's edge": moves(row == 1, down),
        "up from the cliff's edge": moves(row == 2, up),
        "into the goal": moves(goal, down),
    }


def mean_rewards(rewards: np.ndarray, ignore: bool) -> np.ndarray:
    """Mean over RNs, `[state, action]`, in [0, 1] from the lowest to the highest; nan where none.

    Rewards of at most `IGNORED_BELOW` can be ignored.
    """
    kept = np.where(rewards <= IGNORED_BELOW, np.nan, rewards) if ignore else rewards
    count = np.isfinite(kept).sum(axis=0)
    mean = np.where(count > 0, np.nansum(kept, axis=0) / np.maximum(count, 1), np.nan)
    low, high = np.nanmin(mean), np.nanmax(mean)
    return (mean - low) / max(high - low, 1e-9)


def summarise(rewards: dict[str, np.ndarray]) -> pd.DataFrame:
    """Mean and std over RNs of the mean reward of each kind of move."""
    out = []
    for (variant, mine), (kind, mask) in itertools.product(
        rewards.items(), kinds_of_moves().items()
    ):
        of_rns = mine[:, mask].mean(axis=1)
        row = {"variant": variant, "move": kind, "rns": len(mine)}
        out.append(row | {"mean": of_rns.mean(), "std": of_rns.std()})
    return pd.DataFrame(out)


def report(settings: RnHeatmap, rows: pd.DataFrame) -> pd.DataFrame:
    rewards = by_variant(settings, rows)
    draw(settings, rewards)
    summary = summarise(rewards)
    texts = summary.assign(text=[f"{row.mean:.1f} ± {row.std:.1f}" for row in summary.itertuples()])
    table = texts.pivot(index="variant", columns="move", values="text")
    table = table.loc[list(rewards), list(kinds_of_moves())].reset_index()
    note = (
        f"Mean and standard deviation over {settings.learned} RNs of each variant, learned by "
        f"{settings.objective}. The edge is the row above the cliff."
    )
    title = "Rewards that RNs have learned for the moves on Cliff Walking"
    return publish(settings, title, table, summary, note)


def draw(settings: RnHeatmap, rewards: dict[str, np.ndarray]) -> None:
    """Draws a map for each variant, with all rewards and without the lowest."""
    titles = ("all rewards", f"rewards ≤ {IGNORED_BELOW:g} left out")
    size = (11, 0.7 + 2.05 * len(rewards))
    path = settings.folder / "heatmap.png"
    with figures.panels(path, len(rewards), 2, size) as (figure, axes):
        for line, (variant, mine) in zip(axes, rewards.items(), strict=True):
            for axis, title, ignore in zip(line, titles, (False, True), strict=True):
                shown = draw_map(axis, mean_rewards(mine, ignore))
                axis.set_title(f"{rn.label(variant)}: {title}", fontsize=10)
        bar = figure.colorbar(shown, ax=axes, shrink=0.5, pad=0.02)
        bar.set_label("mean reward, from the lowest to the highest")


def draw_map(axis: Any, values: np.ndarray) -> Any:
    """Draws the map with a triangle for each move, coloured by `values [state, action]`."""
    square = np.array([[-0.5, 0.5, 0.5, -0.5], [-0.5, -0.5, 0.5, 0.5]])
    triangles, colors = [], []
    for (row, column), cell in np.ndenumerate(CELLS):
        middle = np.array([column, row])
        for action, corners in _CORNERS.items():
            value = values[row * CELLS.shape[1] + column, action]
            if cell not in "GO" and np.isfinite(value):
                triangles.append([middle, *(middle + corner for corner in corners)])
                colors.append(value)
        if cell in "GO":
            axis.fill(*(middle[:, None] + square), color=_COLORS[cell], lw=0)
        text, size = ("cliff", 6) if cell == "O" else (cell, 10)
        if cell != " ":
            axis.text(*middle, text, ha="center", va="center", fontsize=size, weight="bold")
    how: Any = {"cmap": "RdYlGn", "clim": (0, 1), "edgecolors": "#555555", "lw": 0.25}
    shown = axis.add_collection(PolyCollection(triangles, array=colors, **how))
    axis.set(xlim=(-0.5, 11.5), ylim=(3.5, -0.5), aspect="equal", xticks=[], yticks=[])
    axis.spines[:].set_visible(True)
    return shown


EXPERIMENT = Experiment(settings=RnHeatmap, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
