"""Agents whose learning rate, batch size, hidden size and depth are drawn anew for each training.

All of them are one program. Learning rate and batch size are traced numbers; a hidden size is that
of a network in which the other units are switched off (`networks.narrow`), in the smallest of a few
networks that has room; for each of these, and for each depth, there is a branch. A branch is a real
one where agents train one after another (`lanes=1`); in lanes all of them would run.

Source: paper, table "Agent hyperparameter ranges" and appendix "Varied Agent Hyperparameters";
`reference_details.md` 4.9.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from sejax.agents.agent import Agent
from sejax.agents.configs import AgentConfig, ExplorationConfig, QLearningConfig
from sejax.agents.registry import make_agent
from sejax.envs import Task

# Networks of a depth: evenly spaced sizes, since what room to spare costs matters for large ones.
# With one hidden layer the cost grows with the size, with more of them with its square.
_NUM_SIZES, _NUM_SIZES_DEEP = 6, 12
_MULTIPLE = 8  # vector width of a CPU


class Range(NamedTuple):
    """Bounds of a hyperparameter, both included."""

    low: float
    high: float
    log: bool
    integer: bool


@dataclass(frozen=True, kw_only=True)
class VariedAgents:
    """Agents of different sizes, and the drawing of one of them.

    Attributes:
      agents: one for each branch.
      draw: `key -> values`, a drawn hyperparameter for each name in `ranges`.
      branch: `values -> []` int32, the agent that has room for them.
      hparams: `values -> hparams` of that agent.
      ranges: by the names of the configuration's fields.
    """

    agents: tuple[Agent, ...]
    draw: Callable[[Array], dict[str, Array]]
    branch: Callable[[dict[str, Array]], Array]
    hparams: Callable[[dict[str, Array]], Any]
    ranges: dict[str, Range]

    def over_draws(self, make_branch: Callable[[Agent], Callable[..., Any]]) -> Callable[..., Any]:
        """Builds `run(key, *args)` for an agent whose hyperparameters are drawn first, from `key`.

        Args:
          make_branch: builds `branch(key, *args, hparams)` for an agent.
        """
        branches = [make_branch(agent) for agent in self.agents]

        def run(key: Array, *args: Any) -> Any:
            values = self.draw(drawing_key(key))
            hparams = self.hparams(values)
            return jax.lax.switch(self.branch(values), branches, key, *args, hparams)

        return run


def drawing_key(key: Array) -> Array:
    """The part of a training's key that its hyperparameters are drawn from."""
    return jax.random.fold_in(key, 0x48_50)  # training and test keys are splits of the key


def ranges_of(config: AgentConfig) -> dict[str, Range]:
    """The paper's ranges around an agent's configuration.

    A third to three times the learning rate, batch size and hidden size, log-uniformly, and one
    layer less to one more; for tabular agents learning rate and discount in [0.1, 1].
    """
    if isinstance(config, QLearningConfig):
        return {name: Range(0.1, 1.0, False, False) for name in ("learning_rate", "discount")}
    values: dict[str, Any] = vars(config)
    ranges = {"learning_rate": Range(values["learning_rate"] / 3, 3 * values["learning_rate"],
                                     True, False)}  # fmt: skip
    for name in ("batch_size", "hidden_size"):
        if name in values:
            ranges[name] = Range(max(1, values[name] // 3), 3 * values[name], True, True)
    num_layers = values["num_layers"]
    ranges["num_layers"] = Range(max(1, num_layers - 1), num_layers + 1, False, True)
    return ranges


def draw_value(key: Array, bounds: Range) -> Array:
    """One value, `[]` float32; integers are uniform over themselves, or log-uniform and rounded."""
    low, high = (bounds.low - 0.5, bounds.high + 0.5) if bounds.integer else bounds[:2]
    if bounds.log:
        value = jnp.exp(jax.random.uniform(key, minval=math.log(low), maxval=math.log(high)))
    else:
        value = jax.random.uniform(key, minval=low, maxval=high)
    if bounds.integer:
        value = jnp.round(value)
    return jnp.clip(value, bounds.low, bounds.high)


def hidden_sizes(bounds: Range, num_layers: int) -> tuple[int, ...]:
    """Sizes of networks, growing, the last of which has room for all in the range."""
    parts = _NUM_SIZES if num_layers == 1 else _NUM_SIZES_DEEP
    step = -(-math.ceil(bounds.high) // (parts * _MULTIPLE)) * _MULTIPLE
    smallest = math.ceil(bounds.low / step) * step
    return tuple(range(smallest, math.ceil(bounds.high) + step, step))


@functools.cache
def make_varied_agents(
    config: AgentConfig, task: Task, exploration: ExplorationConfig
) -> VariedAgents:
    """Builds the agents for all sizes in the ranges around a configuration."""
    ranges = ranges_of(config)
    shapes: list[tuple[int, int]] = []  # (depth, room for hidden units) of each branch, ascending
    branches = [make_agent(config, task, exploration)]
    if "hidden_size" in ranges:
        low, high = int(ranges["num_layers"].low), int(ranges["num_layers"].high)
        shapes = [(depth, size) for depth in range(low, high + 1)
                  for size in hidden_sizes(ranges["hidden_size"], depth)]  # fmt: skip
        changes: dict[str, Any] = {}
        if "batch_size" in ranges:
            changes["batch_size"] = int(ranges["batch_size"].high)
        branches = [
            make_agent(_replace(config, num_layers=depth, hidden_size=size, **changes), task,
                       exploration)
            for depth, size in shapes
        ]  # fmt: skip

    def draw(key: Array) -> dict[str, Array]:
        keys = jax.random.split(key, len(ranges))
        return {
            name: draw_value(k, bounds)
            for k, (name, bounds) in zip(keys, ranges.items(), strict=True)
        }

    def branch(values: dict[str, Array]) -> Array:
        if not shapes:
            return jnp.int32(0)
        depths, rooms = jnp.array(shapes).T
        too_small = (depths < values["num_layers"]) | (
            (depths == values["num_layers"]) & (rooms < values["hidden_size"])
        )
        return jnp.sum(too_small).astype(jnp.int32)

    def hparams(values: dict[str, Array]) -> Any:
        traced = {name: x for name, x in values.items() if name != "num_layers"}
        return with_hparams(branches[0].hparams, traced)

    return VariedAgents(
        agents=tuple(branches), draw=draw, branch=branch, hparams=hparams, ranges=ranges
    )


def _replace(config: Any, **changes: Any) -> Any:
    return dataclasses.replace(config, **changes)


def with_hparams(hparams: Any, values: dict[str, Array]) -> Any:
    """Traced hyperparameters with these values; those of a wrapped agent are its field `agent`."""
    if "agent" in hparams._fields:
        return hparams._replace(agent=with_hparams(hparams.agent, values))
    return hparams._replace(**values)
