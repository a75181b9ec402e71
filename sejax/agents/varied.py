"""Agents whose learning rate, batch size, hidden size and depth are drawn anew for each training.

One program holds all of them. Learning rate and batch size are traced numbers. For each depth there
are networks of a few sizes, and each network has a branch. A training takes the smallest network
with room for its hidden size; the other units are switched off (`networks.narrow`). If agents train
one after another (`num_parallel=1`), only one branch runs; under `vmap` all branches would run.

Source: paper, table "Agent hyperparameter ranges" and appendix "Varied Agent Hyperparameters";
`docs/reference.md` 4.9.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import NamedTuple, cast, get_type_hints

import jax
import jax.numpy as jnp
from jaxtyping import Array

from sejax.agents.base import Agent, AgentConfig, Drawn, Varied
from sejax.ops import cpu
from sejax.options import marks, require


class Range(NamedTuple):
    """Bounds of a hyperparameter, both included."""

    low: float
    high: float
    log: bool
    integer: bool


def ranges_of(config: AgentConfig) -> dict[str, Range]:
    """The ranges from which options are drawn, around an agent's configuration.

    An option with `option(..., varied=how)` is drawn:

    - `triple`: a third to three times the value, log-uniformly.
    - `one_more_or_less`: from one less, at least 1, to one more.
    - `tenth_to_one`: in [0.1, 1].

    Raises:
      ConfigError: if no option has `varied` set.

    Source: paper, table "Agent hyperparameter ranges"; tabular agents: `docs/reference.md` 4.9.
    """
    cls = type(config)
    hints = get_type_hints(cls)
    marks_of = {field.name: marks(cls, field.name) for field in dataclasses.fields(config)}
    varied = {name: mark["varied"] for name, mark in marks_of.items() if mark.get("varied")}
    is_whole = bool(varied) and ("num_layers" in varied) == ("hidden_size" in varied)
    rule = f"must be default, as {cls.__name__} varies nothing or half a network"
    require(is_whole, "agent_hparams", rule, got="varied", use="default")
    # Traced options first: the order decides which key draws which option.
    names = sorted(varied, key=lambda name: not marks_of[name].get("traced"))
    return {name: _range(varied[name], getattr(config, name), hints[name] is int) for name in names}


def _range(varied: str, value: float, integer: bool) -> Range:
    match varied:
        case "triple":
            low = max(1, value // 3) if integer else value / 3
            return Range(low, 3 * value, log=True, integer=integer)
        case "one_more_or_less":
            return Range(max(1, value - 1), value + 1, log=False, integer=True)
        case "tenth_to_one":
            return Range(0.1, 1.0, log=False, integer=False)
    raise ValueError(f"varied must be triple, one_more_or_less or tenth_to_one; got {varied!r}.")


def draw_value(key: Array, bounds: Range) -> Array:
    """One value, `[]` float32. Integers are drawn uniformly, or log-uniformly and rounded."""
    low, high = bounds.low, bounds.high
    if bounds.integer:  # so that rounding gives each integer its share
        low, high = low - 0.5, high + 0.5
    if bounds.log:
        value = jnp.exp(jax.random.uniform(key, minval=math.log(low), maxval=math.log(high)))
    else:
        value = jax.random.uniform(key, minval=low, maxval=high)
    if bounds.integer:
        value = jnp.round(value)
    return jnp.clip(value, bounds.low, bounds.high)


def hidden_sizes(bounds: Range, num_layers: int) -> tuple[int, ...]:
    """Evenly spaced sizes of networks; the last network has room for all sizes in the range."""
    parts = cpu.NUM_SIZES if num_layers == 1 else cpu.NUM_SIZES_DEEP
    step = cpu.whole_vectors(-(-math.ceil(bounds.high) // parts))
    smallest = math.ceil(bounds.low / step) * step
    return tuple(range(smallest, math.ceil(bounds.high) + step, step))


def make_varied(config: AgentConfig, make: Callable[[AgentConfig], Agent]) -> Agent:
    """An agent whose options are drawn anew for each training; see `Agent.with_hparams`.

    Args:
      config: configuration around which options are drawn.
      make: builds an agent from such a configuration.

    Returns:
      The agent that `config` describes, with variants that have room for all possible values.

    Raises:
      ConfigError: if no option has `varied` set.
    """
    ranges = ranges_of(config)
    shapes: list[tuple[int, int]] = []  # layers and hidden units of each variant, ascending
    agent = make(config)
    if "hidden_size" in ranges:
        depths = ranges["num_layers"]
        for layers in range(int(depths.low), int(depths.high) + 1):
            shapes += [(layers, size) for size in hidden_sizes(ranges["hidden_size"], layers)]
    networks = [{"num_layers": layers, "hidden_size": size} for layers, size in shapes] or [{}]
    batch = {"batch_size": int(ranges["batch_size"].high)} if "batch_size" in ranges else {}
    variants = [make(dataclasses.replace(config, **batch, **network)) for network in networks]

    def draw(key: Array) -> Drawn:
        key = jax.random.fold_in(key, 0x48_50)  # the key itself is split for training and tests
        drawn = map(draw_value, jax.random.split(key, len(ranges)), ranges.values())
        values = dict(zip(ranges, drawn, strict=True))
        traced = {name: x for name, x in values.items() if name != "num_layers"}
        hparams = variants[0].hparams.replace_innermost(**traced)
        depth = values.get("num_layers", jnp.zeros(()))
        units = values.get("hidden_size", jnp.zeros(()))
        too_small = [(n < depth) | ((n == depth) & (size < units)) for n, size in shapes]
        # So many are too small: the index of the smallest that has room.
        return Drawn(jnp.int32(sum(too_small)), hparams, values)

    spec = agent.spec
    if len(variants) > 1:  # under vmap all branches would run
        spec = dataclasses.replace(spec, cpu_num_parallel=1)
    return dataclasses.replace(agent, spec=spec, varied=Varied(agents=tuple(variants), draw=draw))


def for_keys(agent: Agent, keys: Array) -> Agent:
    """The agent with the variants that trainings with these keys `[agent]` take, and no others.

    Its numbers are the same, and it compiles sooner: ten PPOs in a third of the time.
    """
    if (varied := agent.varied) is None:
        return agent
    variants = jax.vmap(lambda key: varied.draw(key).variant)(keys)
    return _with_variants(agent, tuple(sorted({*variants.tolist()})))


@functools.cache
def _with_variants(agent: Agent, used: tuple[int, ...]) -> Agent:
    variants, draw = cast(Varied, agent.varied)

    def draw_used(key: Array) -> Drawn:
        drawn = draw(key)
        return drawn._replace(variant=jnp.searchsorted(jnp.array(used), drawn.variant))

    return dataclasses.replace(agent, varied=Varied(tuple(variants[i] for i in used), draw_used))
