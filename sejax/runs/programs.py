"""Compiled programs that trials share: those whose configurations differ in traced numbers alone.

Which numbers a program may take as arguments the options say (`sejax.options.option(traced=True)`):
learning rates, discounts and the like of agents, and the step size and noise of NES. Everything
else shapes the program. With the numbers as arguments it computes what it does with them as
constants, up to rounding.
"""

import copy
import dataclasses
import json
from collections.abc import Callable, Container
from functools import partial
from typing import Any

import jax
from jaxtyping import PyTree

from sejax.agents.mixture import Mixture, MixtureConfig
from sejax.bilevel import Bilevel, make_bilevel
from sejax.options import Options, marks, traced_options
from sejax.options.plain import to_plain
from sejax.runs import config as configuration
from sejax.runs.config import LearnConfig
from sejax.runs.session import Chunks

# Fields of a run that shape no program; a chunk's length and seeds are counted by themselves.
_FREE = (
    "preset",
    "seed",
    "num_seeds",
    "generations",
    "checkpoint_every",
    "run_dir",
    "tracker",
    "machines",
)
KEPT = 16  # shapes whose programs stay in memory


class Programs:
    """Programs by their shape.

    Attributes:
      shapes: chunks of those that were used last, with the numbers of the first of their kind.
    """

    def __init__(self) -> None:
        self.shapes: dict[str, Chunks] = {}

    def chunks(self, config: LearnConfig) -> Chunks:
        """The chunks of a run, compiled if none of its shape was."""
        program, numbers = make_bilevel(**config.parts()), numbers_of(config)
        key, make = shape_of(config, numbers), partial(_with_numbers, config, program.num_dims)
        chunks = kept(self.shapes, key, lambda: Chunks(program, make, (numbers,)))
        return chunks.sharing(program, (numbers,))


def kept(cache: dict[str, Any], key: str, make: Callable[[], Any]) -> Any:
    """What is cached under a key, made if it is not; the `KEPT` that were used last stay."""
    value = cache.pop(key, None) or make()
    cache[key] = value  # the last used is the last to go
    if len(cache) > KEPT:
        del cache[next(iter(cache))]
    return value


def numbers_of(config: LearnConfig) -> dict[str, Any]:
    """What the program of a configuration takes as arguments, a pytree of Python numbers.

    Where an agent's hyperparameters are drawn for each training, its own are no arguments.
    """
    varied = config.agent_hparams == "varied"
    learners = () if varied else Mixture.of(config.parts()["agent"]).agents
    return {"agents": tuple(x.hparams for x in learners), "es": traced_options(config.es)}


def shape_of(config: LearnConfig, numbers: dict[str, Any]) -> str:
    """A key that is equal for configurations of one program."""
    plain = {k: v for k, v in configuration.plain(config).items() if k not in _FREE}
    plain["es"] = _without(plain["es"], numbers["es"])
    if numbers["agents"]:
        learners = Mixture.of(config.parts()["agent"])
        plain["agent"] = [static_of(agent) for agent in config.agents.values()]
        shared = {
            f.name: getattr(learners.config, f.name) for f in dataclasses.fields(MixtureConfig)
        }
        plain["agents"] = [learners.names, learners.weights, shared]
        plain["exploration"] = static_of(config.exploration)
    return json.dumps([plain, structure_of(numbers)], sort_keys=True, default=str)


def structure_of(numbers: PyTree) -> list[Any]:
    """What shapes a program of its arguments: which are left open (None), which are whole."""
    leaves, structure = jax.tree.flatten(numbers)
    return [str(structure), [type(leaf).__name__ for leaf in leaves]]


def _with_numbers(config: LearnConfig, num_dims: int, numbers: dict[str, Any]) -> Bilevel:
    """The program of a configuration with other numbers, which may be traced."""
    parts = config.parts()
    if numbers["agents"]:
        mixture = Mixture.of(parts["agent"])
        learners = tuple(
            dataclasses.replace(agent, hparams=hparams)
            for agent, hparams in zip(mixture.agents, numbers["agents"], strict=True)
        )
        parts["agent"] = dataclasses.replace(mixture, agents=learners)
    if numbers["es"]:
        es = copy.copy(config.es)  # not checked again: a traced number is none
        for name, number in numbers["es"].items():
            object.__setattr__(es, name, number)
        parts["es"] = es.make(num_dims)
    return make_bilevel(**parts)


def static_of(config: Options) -> dict[str, Any]:
    """A configuration's class, and its fields that are not traced, or left open."""
    traced = [
        f.name for f in dataclasses.fields(config) if marks(type(config), f.name).get("traced")
    ]
    fields = _without(to_plain(config), [x for x in traced if getattr(config, x) is not None])
    return {"class": f"{type(config).__module__}:{type(config).__qualname__}", **fields}


def _without(fields: dict[str, Any], names: Container[str]) -> dict[str, Any]:
    return {k: v for k, v in fields.items() if k not in names}
