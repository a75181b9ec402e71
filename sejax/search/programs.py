"""Compiled programs that trials share: those whose configurations differ in traced numbers alone.

Which numbers a program may take as arguments the options say (`sejax.options.option(traced=True)`):
learning rates, discounts and the like of agents, and the step size and noise of NES. Everything
else shapes the program. With the numbers as arguments it computes what it does with them as
constants, up to rounding.
"""

import copy
import dataclasses
import json
from typing import Any

import jax

from sejax.app import build
from sejax.app.families import families_of
from sejax.app.session import Chunks
from sejax.bilevel import Program, make_program
from sejax.families import Families
from sejax.options import marks, traced_options
from sejax.parallel import compiler_options
from sejax.serialize import to_plain

# Fields of a run that shape no program; a chunk's length and seeds are counted by themselves.
_FREE = ("preset", "seed", "num_seeds", "generations", "checkpoint_every", "run_dir", "tracker")
KEPT = 16  # shapes whose programs stay in memory


class Programs:
    """Programs by their shape.

    Attributes:
      shapes: those that were used last.
    """

    def __init__(self) -> None:
        self.shapes: dict[str, Shape] = {}

    def chunks(self, config: build.LearnConfig) -> Chunks:
        """The chunks of a run, compiled if none of its shape was."""
        numbers = numbers_of(config)
        key = shape_of(config, numbers)
        shape = self.shapes.pop(key, None) or Shape(config)
        self.shapes[key] = shape  # the last used is the last to go
        if len(self.shapes) > KEPT:
            del self.shapes[next(iter(self.shapes))]
        return SharedChunks(make_program(**config.parts()), shape, numbers)


def numbers_of(config: build.LearnConfig) -> dict[str, Any]:
    """What the program of a configuration takes as arguments, a pytree of Python numbers.

    Where an agent's hyperparameters are drawn for each training, its own are no arguments.
    """
    varied = config.agent_hparams == "varied"
    learners = () if varied else Families.of(config.parts()["agent"]).agents
    return {"agents": tuple(x.hparams for x in learners), "es": traced_options(config.es)}


def shape_of(config: build.LearnConfig, numbers: dict[str, Any]) -> str:
    """A key that is equal for configurations of one program."""
    plain = {k: v for k, v in build.to_plain(config).items() if k not in _FREE}
    plain["es"] = _without(plain["es"], numbers["es"])
    if numbers["agents"]:
        learners = Families.of(config.parts()["agent"])
        plain["agent"] = [static_of(family.agent) for family in families_of(config)]
        plain["agents"] = [learners.names, learners.weights, to_plain(learners.config)]
        plain["exploration"] = static_of(config.exploration)
    return json.dumps([plain, structure_of(numbers)], sort_keys=True, default=str)


def structure_of(numbers: Any) -> list[Any]:
    """What shapes a program of its arguments: which are left open (None), which are whole."""
    leaves, structure = jax.tree.flatten(numbers)
    return [str(structure), [type(leaf).__name__ for leaf in leaves]]


class Shape:
    """The programs of one shape, and what was compiled of them.

    Attributes:
      compiled: executables by what they are for.
    """

    def __init__(self, config: build.LearnConfig):
        self._config = config
        self._num_dims = make_program(**config.parts()).num_dims
        self.compiled: dict[tuple[int, int], Any] = {}
        self.init = jax.jit(lambda keys, numbers: self.program(numbers).init(keys))

    def program(self, numbers: dict[str, Any]) -> Program:
        """The program with these numbers, which may be traced."""
        parts = self._config.parts()
        if numbers["agents"]:
            families = Families.of(parts["agent"])
            learners = tuple(dataclasses.replace(agent, hparams=hparams) for agent, hparams in
                             zip(families.agents, numbers["agents"], strict=True))  # fmt: skip
            parts["agent"] = dataclasses.replace(families, agents=learners)
        if numbers["es"]:
            es = copy.copy(self._config.es)  # not checked again: a traced number is none
            for name, number in numbers["es"].items():
                object.__setattr__(es, name, number)
            parts["es"] = es.make(self._num_dims)
        return make_program(**parts)


class SharedChunks(Chunks):
    """A run's chunks, whose executables are those of its shape."""

    def __init__(self, program: Program, shape: Shape, numbers: dict[str, Any]):
        super().__init__(program)
        self._shape, self._numbers = shape, numbers
        self._compiled = shape.compiled

    def init(self, keys: Any) -> Any:
        return self._shape.init(keys, self._numbers)

    def advance(self, state: Any, length: int) -> tuple[Any, Any]:
        num_seeds = state.generation.shape[0]
        if not self.is_ready(num_seeds, length):
            self.compile(num_seeds, length)
        return self._compiled[num_seeds, length](state, self._numbers)

    def compile(self, num_seeds: int, length: int) -> None:
        def chunk(state: Any, numbers: dict[str, Any]) -> Any:
            program = self._shape.program(numbers)
            return jax.lax.scan(lambda state, _: program.generation(state), state, length=length)

        keys = jax.random.split(jax.random.key(0), num_seeds)
        state = jax.eval_shape(self._shape.init, keys, self._numbers)
        program = jax.jit(chunk, donate_argnums=0, compiler_options=compiler_options())
        self._compiled[num_seeds, length] = program.lower(state, self._numbers).compile()


def static_of(config: Any) -> dict[str, Any]:
    """A configuration's class, and its fields that are not traced, or left open."""
    traced = [
        f.name for f in dataclasses.fields(config) if marks(type(config), f.name).get("traced")
    ]
    fields = _without(to_plain(config), [x for x in traced if getattr(config, x) is not None])
    return {"class": f"{type(config).__module__}:{type(config).__qualname__}", **fields}


def _without(fields: dict[str, Any], names: Any) -> dict[str, Any]:
    return {k: v for k, v in fields.items() if k not in names}
