"""What generations of NES runs cost, and runs that go on until they have spent their CPU seconds.

CPU seconds are those of this process on all of its threads, while it computes a generation;
compilation, files and pictures are left out. How many generations a budget pays for depends on the
machine, what each of them holds does not.
"""

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd

from sejax.cli import session
from sejax.ops.files import write_text

# (config, run directory, chunks) -> curve, as `proxy_runs.learn_all` takes it.
Learn = Callable[[Any, Any, session.Chunks], pd.DataFrame]
UNLIMITED = 100_000  # generations of a run that its budget ends


class BudgetSpent(Exception):
    """A run has spent its budget. All of its generations are on the disk."""


class TimedChunks(session.Chunks):
    """Chunks of one run, which keep what its generations cost and refuse to go beyond a budget.

    Costs are written before the generation itself is: after a kill there may be one too many, which
    the run writes again as it goes on.
    """

    def __init__(self, chunks: session.Chunks, path: Path, budget_s: float):
        super().__init__(chunks.program)
        self._compiled = chunks._compiled  # shared by all runs
        self._path, self._budget_s = path, budget_s

    def advance(self, state: Any, length: int) -> tuple[Any, Any]:
        """As of all chunks.

        Raises:
          BudgetSpent: if the generations so far have used it up.
        """
        before = read_costs(self._path, int(state.generation[0]))
        if before.sum() >= self._budget_s:
            raise BudgetSpent
        started = time.process_time()
        result = jax.block_until_ready(super().advance(state, length))
        each = (time.process_time() - started) / length
        costs = np.concatenate([before, np.full(length, each)])
        write_text(self._path, "".join(f"{cost:.3f}\n" for cost in costs))
        return result


def read_costs(path: Path, generations: int) -> np.ndarray:
    """CPU seconds of the first generations, `[generation]`; of fewer, if no more are known."""
    lines = path.read_text().split() if path.exists() else []
    return np.array(lines[:generations], float)


def timed(budget_s: float | None = None) -> Learn:
    """How a run is learned whose curve has a column `cpu_s`, the cost of each generation.

    Args:
      budget_s: CPU seconds after which a run begins no further generation; None for no such limit.
    """
    limit = np.inf if budget_s is None else budget_s

    def learn(config: Any, directory: Any, chunks: session.Chunks) -> pd.DataFrame:
        path = directory.path / "cpu_s.txt"
        if read_costs(path, directory.finished_generations).sum() < limit:
            with contextlib.suppress(BudgetSpent):
                session.run(config, directory, TimedChunks(chunks, path, limit))
        curve = pd.read_csv(directory.metrics)
        return curve.assign(cpu_s=read_costs(path, len(curve)))

    return learn


def within(curve: pd.DataFrame, budget_s: float | None) -> pd.DataFrame:
    """The generations of one run that began before the budget was spent."""
    if budget_s is None:
        return curve
    return curve[curve["cpu_s"].cumsum() - curve["cpu_s"] < budget_s]
