"""A worker: the compiled trainings of a run, for shares of a generation.

Nothing here imports jax before a scorer is told to: a worker process chooses its devices first.
"""

import os
import socket
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from sejax.errors import ConfigError


@dataclass(frozen=True)
class Work:
    """A share of a generation as it is sent: trials of one family, at most a scorer's capacity.

    Attributes:
      family: index.
      keys: raw data of the trials' keys, `[n, ...]` uint32.
      candidates: `[n, dims]` float32.
      active: `[n]` bool; where not, nothing is trained.
      eval_steps: how much of the test episodes is scored, `[n]`, or None for all.
    """

    family: int
    keys: np.ndarray
    candidates: np.ndarray
    active: np.ndarray
    eval_steps: np.ndarray | None

    @property
    def nbytes(self) -> int:
        arrays = (self.keys, self.candidates, self.active, self.eval_steps)
        return sum(x.nbytes for x in arrays if x is not None)


@dataclass(frozen=True)
class Scored:
    """What comes back of a share.

    Attributes:
      outcome: leaves of `sejax.objectives.Outcome` by name, `[n, ...]`.
      seconds: that the worker computed, by the wall clock.
      cpu_s: CPU seconds of its process meanwhile.
    """

    outcome: dict[str, np.ndarray]
    seconds: float
    cpu_s: float


@dataclass(frozen=True)
class About:
    """Who a worker is."""

    node: str
    pid: int
    cpu_s: float  # that it took to get ready


class Scorer:
    """The compiled trainings of a run; one to a process."""

    def __init__(
        self,
        config: dict[str, Any],
        capacities: tuple[int, ...],
        versions: dict[str, str],
        gpu_share: float,
    ):
        """Of a run's plain configuration, most trials in a share by family, and the driver's.

        `gpu_share` is the part of a GPU that this process has; 0 for a CPU core.
        """
        self._config, self._capacities, self._versions = config, capacities, versions
        self._gpu_share = gpu_share
        self._programs: list[Any] = []

    def prepare(self) -> About:
        """Compiles.

        Raises:
          ConfigError: if this machine has other versions of what decides the numbers.
        """
        from sejax.cli import runtime

        runtime.configure_xla(1)
        runtime.take_share_of_gpu(self._gpu_share)
        from sejax.bilevel import make_program
        from sejax.cli import build

        own = versions()
        differing = [f"{name} {own[name]}" for name in own if own[name] != self._versions[name]]
        if differing:
            there = ", ".join(f"{name} {self._versions[name]}" for name in own)
            raise ConfigError(
                f"All machines must have the same versions, because numbers differ otherwise; got "
                f"{', '.join(differing)} on {socket.gethostname()}, where the driver has {there}. "
                f"Install the same there."
            )
        runtime.configure_jax()
        config = build.learn_config(self._config)
        program = make_program(**config.parts() | {"devices": 1})
        self._programs = [
            compile_share(program, family, capacity)
            for family, capacity in enumerate(self._capacities)
        ]
        return About(socket.gethostname(), os.getpid(), time.process_time())

    def score(self, work: Work) -> Scored:
        """Trains and tests an agent for each trial of a share."""
        started, cpu_started = time.perf_counter(), time.process_time()
        outcome = score(self._programs[work.family], self._capacities[work.family], work)
        return Scored(outcome, time.perf_counter() - started, time.process_time() - cpu_started)


def versions() -> dict[str, str]:
    """Of the packages that decide a run's numbers."""
    import jax
    import jaxlib

    from sejax import __version__

    return {"sejax": __version__, "jax": jax.__version__, "jaxlib": jaxlib.__version__}


def compile_share(program: Any, family: int, capacity: int) -> Any:
    """The compiled `share_of` a `sejax.bilevel.Program`, for shares of up to `capacity` trials."""
    import jax
    import jax.numpy as jnp

    from sejax.ops.parallel import compiler_options

    evaluate = program.share_of(family)

    def share(key_data: Any, candidates: Any, active: Any, eval_steps: Any) -> Any:
        return evaluate(jax.random.wrap_key_data(key_data), candidates, active, eval_steps)

    def shape(one: Any) -> Any:
        return jax.ShapeDtypeStruct((capacity, *one.shape), one.dtype)

    key = jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0)))
    state = jax.eval_shape(program.init, jax.random.split(jax.random.key(0), 1))
    eval_steps = jax.eval_shape(program.eval_steps, state)
    shapes = (
        shape(key),
        jax.ShapeDtypeStruct((capacity, program.num_dims), jnp.float32),
        jax.ShapeDtypeStruct((capacity,), jnp.bool_),
        eval_steps and jax.ShapeDtypeStruct((capacity,), eval_steps.dtype),
    )
    return jax.jit(share, compiler_options=compiler_options()).lower(*shapes).compile()


def score(compiled: Any, capacity: int, work: Work) -> dict[str, np.ndarray]:
    """The outcomes of a share by a program of `compile_share`, `[n, ...]`."""
    import jax

    n = len(work.active)
    places = np.minimum(np.arange(capacity), n - 1)  # filled up with copies that are not trained
    active = work.active[places] & (np.arange(capacity) < n)
    eval_steps = None if work.eval_steps is None else work.eval_steps[places]
    outcome = compiled(work.keys[places], work.candidates[places], active, eval_steps)
    host = jax.device_get(outcome)
    return {name: np.asarray(x)[:n] for name, x in vars(host).items()}
