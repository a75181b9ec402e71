"""`metrics.csv`: a row per generation and seed, added to at its end.

A checkpoint vouches for the rows: it keeps how many bytes there were, their SHA-256, which runs
along as they are written, and how many generations each seed had. Rows after those are of
generations that the checkpoint does not have, and are dropped when the run goes on.
"""

import hashlib
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sejax.ops.files import append

COLUMNS = (
    "generation",
    "seed",
    "incumbent_mean",
    "incumbent_std",
    "population_mean",
    "population_max",
    "best_so_far",
    "train_steps_mean",
    "train_steps_max",
    "train_episodes_mean",
    "num_nonfinite",
    "env_steps_total",
    "wall_s",
)
# For each of several families of agents, with its key at the end; see `columns_of`.
FAMILY_COLUMNS = ("incumbent_mean", "population_mean", "train_steps_mean", "num_nonfinite")
_INTEGER = re.compile(rb"-?[0-9]{1,20}")


class MetricsError(ValueError):
    """The rows are not those that they must be; the message is a clause that says why."""


def columns_of(families: Sequence[str] = ()) -> tuple[str, ...]:
    """The columns of a run: with several families of agents, four more for each of them."""
    several = families if len(families) > 1 else ()
    return COLUMNS + tuple(f"{name}_{key}" for key in several for name in FAMILY_COLUMNS)


class Metrics:
    """The rows of a run.

    Attributes:
      path: the file.
      columns: the names of its columns.
      generations: finished generations of each seed.
    """

    def __init__(self, path: Path, seeds: list[int], families: Sequence[str] = ()):
        self.path = path
        self.columns = columns_of(families)
        self.generations = [0] * len(seeds)
        self._families = families if len(families) > 1 else ()
        self._seeds = seeds
        self._size = 0
        self._hash = hashlib.sha256()
        self._rows: list[dict[str, str]] | None = None

    @property
    def rows(self) -> list[dict[str, str]]:
        """The rows as text, read on first use."""
        if self._rows is None:
            lines = self._read().decode("utf-8", "replace").split("\n")[1:-1]
            cells = (line.split(",") for line in lines)
            self._rows = [dict(zip(self.columns, row, strict=False)) for row in cells]
        return self._rows

    def vouch(self) -> dict[str, Any]:
        """What a checkpoint keeps of the rows, as plain values."""
        return {
            "bytes": self._size,
            "sha256": self._hash.hexdigest(),
            "generations": dict(zip(map(str, self._seeds), self.generations, strict=True)),
        }

    def fits(self, vouched: dict[str, Any]) -> bool:
        """Whether that is of the same seeds."""
        return list(vouched["generations"]) == [str(seed) for seed in self._seeds]

    def check(self, vouched: dict[str, Any]) -> None:
        """Sees whether the file begins with the rows vouched for; changes nothing.

        Raises:
          MetricsError: if a row is missing, changed or there twice.
        """
        data = self._read()
        kept = data[: vouched["bytes"]]
        if hashlib.sha256(kept).hexdigest() != vouched["sha256"]:
            raise MetricsError(self._what_is_wrong(data, vouched["generations"]))
        self._count(data, len(kept), [vouched["generations"][str(seed)] for seed in self._seeds])

    def go_on_from(self, vouched: dict[str, Any] | None) -> None:
        """Drops what comes after the rows vouched for, which were checked.

        Raises:
          OSError: if the file cannot be written.
        """
        self._size = vouched["bytes"] if vouched else 0
        self._rows = None
        if vouched:
            self.generations = [vouched["generations"][str(seed)] for seed in self._seeds]
        data = self._read()
        self._hash = hashlib.sha256(data[: self._size])
        if len(data) > self._size:
            os.truncate(self.path, self._size)

    def begun(self) -> int:
        """Generations that the file has begun, of a run that has no checkpoint.

        Raises:
          MetricsError: if it does not hold rows of a run from its beginning.
        """
        data = self._read()
        counts = self._count(data, 0, [0] * len(self._seeds))
        torn = bool(data) and not data.endswith(b"\n")
        return max(max(counts), min(counts) + torn)

    def append(self, info: Any, wall_s: float) -> None:
        """Adds the rows of a chunk; they are on the disk when this returns.

        Args:
          info: `[generation, seed]` arrays called as the columns, and `active`, which masks rows;
            in `families` those of the families, `[generation, seed, family]`.
          wall_s: seconds since the start of the run.

        Raises:
          ValueError: if a generation does not follow on its seed's last.
          OSError: if the file cannot be written; it is then as it was.
        """
        counts = list(self.generations)
        rows = self._rows_of(info, wall_s, counts)
        data = b"".join(",".join(row).encode() + b"\n" for row in rows)
        if not data:
            return
        data = data if self._size else self._header + data
        append(self.path, data, at=self._size)
        self._size += len(data)
        self._hash.update(data)
        self.generations = counts
        if self._rows is not None:
            self._rows += [dict(zip(self.columns, row, strict=True)) for row in rows]

    def _rows_of(self, info: Any, wall_s: float, counts: list[int]) -> list[list[str]]:
        """Cells of the active rows, generation by generation; counts them."""
        given = [name for name in COLUMNS if name not in ("seed", "wall_s")]
        values = {name: np.asarray(getattr(info, name)) for name in given}
        for i, key in enumerate(self._families):
            values |= {
                f"{name}_{key}": np.asarray(getattr(info.families, name))[..., i]
                for name in FAMILY_COLUMNS
            }
        rows = []
        for g, s in np.argwhere(np.asarray(info.active)):
            cells = {name: _format(column[g, s]) for name, column in values.items()}
            if cells["generation"] != str(counts[s]):
                raise ValueError(
                    f"seed {self._seeds[s]} has {counts[s]} generations, and the next "
                    f"row is of generation {cells['generation']}"
                )
            counts[s] += 1
            cells |= {"seed": str(self._seeds[s]), "wall_s": f"{wall_s:.3f}"}
            rows.append([cells[name] for name in self.columns])
        return rows

    @property
    def _header(self) -> bytes:
        return ",".join(self.columns).encode() + b"\n"

    def _read(self) -> bytes:
        try:
            return self.path.read_bytes()
        except FileNotFoundError:
            return b""

    def _count(self, data: bytes, start: int, counts: list[int]) -> list[int]:
        """Generations of each seed with the rows from `start` on, the last of which may be torn.

        Raises:
          MetricsError: if a row does not follow on those before.
        """
        counts = list(counts)
        first = data.count(b"\n", 0, start) + 1
        lines = data[start:].split(b"\n")[:-1]
        if not start and lines and lines.pop(0) + b"\n" != self._header:
            raise MetricsError("line 1 does not name the columns")
        for number, line in enumerate(lines, first + (not start)):
            generation, seed = self._key(line, number)
            if seed not in self._seeds:
                raise MetricsError(f"line {number} is of seed {seed}, which the run does not have")
            expected = counts[self._seeds.index(seed)]
            if generation < expected:
                raise MetricsError(
                    f"line {number} has generation {generation} of seed {seed} once more"
                )
            if generation > expected:
                raise MetricsError(
                    f"generation {expected} of seed {seed} is missing before line {number}"
                )
            counts[self._seeds.index(seed)] += 1
        return counts

    def _key(self, line: bytes, number: int) -> tuple[int, int]:
        """Generation and seed of a row."""
        cells = line.split(b",")
        if len(cells) != len(self.columns) or not all(map(_INTEGER.fullmatch, cells[:2])):
            raise MetricsError(f"line {number} is not a row")
        return int(cells[0]), int(cells[1])

    def _what_is_wrong(self, data: bytes, vouched: dict[str, int]) -> str:
        """A clause about rows whose digest is not the one vouched for."""
        if not data:
            return "it is empty" if self.path.exists() else "it is missing"
        try:
            counts = self._count(data, 0, [0] * len(self._seeds))
        except MetricsError as error:
            return str(error)
        for seed, count in zip(self._seeds, counts, strict=True):
            if count < vouched[str(seed)]:
                return f"seed {seed} has {count} of {vouched[str(seed)]} generations"
        return "its rows are not those that were written"


def _format(value: Any) -> str:
    """Shortest text that reads back as the same float32, or the integer, however large."""
    is_integer = isinstance(value, int) or np.asarray(value).dtype.kind in "biu"
    return str(int(value)) if is_integer else f"{value:.9g}"
