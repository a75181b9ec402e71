"""A run's compiled generations; `sejax.runs.ray` has those that a cluster computes."""

import contextlib
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import jax

from sejax.bilevel import LearnState, make_bilevel
from sejax.ops.parallel import compiler_options
from sejax.runs.config import LearnConfig, MachinesConfig
from sejax.scoring import GenerationInfo

Chunk: TypeAlias = Callable[[LearnState], tuple[LearnState, GenerationInfo]]
Pool: TypeAlias = Callable[[Callable[..., Any], Sequence[tuple[Any, ...]]], Any]


class Chunks:
    """Chunks of generations of Algorithm 1; each length is compiled once, ahead of time.

    `jax.jit` would compile again for a new state, a restored one, and one that a chunk returned,
    because their placements differ.

    Args:
      config: of the runs, which may differ in the seed.
      **parts: arguments of `make_bilevel` in place of the configuration's.

    Attributes:
      bilevel: the functions of Algorithm 1.
      cpu_s: CPU seconds of other processes.
      compiled: the programs of chunks, by their lengths.
    """

    cpu_s = 0.0

    def __init__(self, config: LearnConfig, **parts: Any):
        self.bilevel = make_bilevel(**config.parts() | parts)
        self.init: Callable[[jax.Array], LearnState] = jax.jit(self.bilevel.init)
        self.compiled: dict[int, Chunk] = {}

    def compile(self, length: int) -> None:
        """Compiles a chunk of this length."""
        chunk = functools.partial(self.bilevel.generations, length=length)
        state = jax.eval_shape(self.init, jax.random.key(0))
        jitted = jax.jit(chunk, donate_argnums=0, compiler_options=compiler_options())
        self.compiled[length] = jitted.lower(state).compile()

    def advance(self, state: LearnState, length: int) -> tuple[LearnState, GenerationInfo]:
        """Runs `length` generations, after `compile`; the buffers of the state are donated.

        Returns:
          The state, and an info with leaves `[length, ...]`.

        Raises:
          FailedError: if workers compute the trainings, and one fails or the cluster is lost.
        """
        return self.compiled[length](state)


@dataclass(frozen=True, kw_only=True)
class LocalConfig(MachinesConfig):
    """This process computes everything: one compiled program over its devices."""

    def make(self, config: LearnConfig) -> contextlib.AbstractContextManager[Chunks]:
        return contextlib.nullcontext(Chunks(config))
