"""Pieces of an experiment that are computed once, and the rows that it leaves behind.

A piece takes minutes (the agents of one SE). It is written as a CSV file as soon as it is done,
with the settings that it was made with beside it: the same command again computes only what is
missing.
"""

import fnmatch
import itertools
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sejax.errors import ConfigError
from sejax.ops.files import atomic_path, write_text
from sejax.serialize import flatten


class Pieces:
    """The finished pieces of an experiment, in a folder below that of the setting `work`."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.made_with: dict[str, dict[str, Any]] = {}  # settings of those that were asked for

    def compute(
        self, name: str, settings: dict[str, Any], compute: Callable[[], pd.DataFrame]
    ) -> pd.DataFrame:
        """A piece's table: read if it is there, else computed and written.

        Raises:
          ConfigError: if a piece of that name was made with other settings; these are plain values.
        """
        (table,) = self.compute_all({name: settings}, lambda _: [compute()])
        return table

    def compute_all(
        self,
        settings: dict[str, dict[str, Any]],
        compute: Callable[[list[str]], list[pd.DataFrame]],
    ) -> list[pd.DataFrame]:
        """As `compute` for several pieces, of which `compute(names)` makes the missing at once."""
        settings = json.loads(json.dumps(settings, default=str))
        missing = [name for name, mine in settings.items() if not self._is_there(name, mine)]
        for name, table in zip(missing, compute(missing) if missing else [], strict=True):
            write_text(self._file(name, "csv"), table.to_csv(index=False))
            write_text(self._file(name, "json"), json.dumps(settings[name], indent=2))
        self.made_with |= settings
        return [pd.read_csv(self._file(name, "csv")) for name in settings]

    def _file(self, name: str, kind: str) -> Path:
        return self.folder / f"{name}.{kind}"

    def _is_there(self, name: str, settings: dict[str, Any]) -> bool:
        table, made_with = self._file(name, "csv"), self._file(name, "json")
        if not (table.exists() and made_with.exists()):
            return False
        there, asked = flatten(json.loads(made_with.read_text())), flatten(settings)
        differing = sorted(key for key in {*there, *asked} if there.get(key) != asked.get(key))
        if differing:
            raise ConfigError(
                f"work must be a new folder or that of the same experiment, because "
                f"finished pieces are used again; got {table} with another "
                f"{', '.join(differing)}. Set work=DIR."
            )
        return True


_SEPARATOR = "-"  # between the parts of a piece's name
_ABSENT = object()


def by_pattern(made_with: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Settings of many pieces by patterns of their names, so that what they share is there once.

    A piece has the settings of all patterns that `fnmatch.fnmatchcase` finds in its name, such as
    `*` and `default-*-00`: those by the fewest parts that tell which pieces have which value.

    Args:
      made_with: settings of each piece, by its name; nested ones become `a.b`.
    """
    flat = {name: flatten(dict(settings)) for name, settings in made_with.items()}
    levels = [  # patterns by ever more parts, with the pieces that each finds
        {pattern: fnmatch.filter(flat, pattern) for pattern in {_pattern(n, kept) for n in flat}}
        for kept in _subsets(max((name.count(_SEPARATOR) + 1 for name in flat), default=0))
    ]
    levels.append({name: [name] for name in flat})
    found: dict[str, dict[str, Any]] = {}
    for key in sorted({key for settings in flat.values() for key in settings}):
        values = {name: settings.get(key, _ABSENT) for name, settings in flat.items()}
        level = next(
            level
            for level in levels
            if all(values[name] == values[names[0]] for names in level.values() for name in names)
        )
        for pattern, names in sorted(level.items()):
            if values[names[0]] is not _ABSENT:
                found.setdefault(pattern, {})[key] = values[names[0]]
    return {
        pattern: found[pattern] for level in levels for pattern in sorted(level) if pattern in found
    }


def _subsets(size: int) -> Iterator[tuple[int, ...]]:
    """Places of parts, counted from a name's end, where all names have the same."""
    for count in range(size):
        yield from itertools.combinations(range(-1, -size - 1, -1), count)


def _pattern(name: str, kept: tuple[int, ...]) -> str:
    """The name with `*` for all parts but those kept."""
    parts = name.split(_SEPARATOR)
    if not kept:
        return "*"
    shown = [part if i - len(parts) in kept else "*" for i, part in enumerate(parts)]
    return _SEPARATOR.join(shown)


# Training steps grow along each curve: kept as differences, a table takes two thirds of the room.
_GROWING, _DIFFERENCES = "steps", "steps_since_the_row_before"


def write_rows(path: Path, rows: pd.DataFrame) -> None:
    """Writes the raw rows of an experiment, compressed."""
    if _GROWING in rows and pd.api.types.is_integer_dtype(rows[_GROWING]):
        differences = np.diff(rows[_GROWING], prepend=0)
        rows = rows.assign(**{_GROWING: differences}).rename(columns={_GROWING: _DIFFERENCES})
    with atomic_path(path) as temporary:
        rows.to_csv(temporary, index=False, compression="xz")


def read_rows(path: Path) -> pd.DataFrame:
    """The rows that `write_rows` has written."""
    if not path.exists():
        raise ConfigError(
            f"from_rows must be false where no rows are kept, because tables are made from them; "
            f"got true and no {path}. Set from_rows=false, or out=DIR."
        )
    rows = pd.read_csv(path, low_memory=False)  # a column has one type throughout
    if _DIFFERENCES in rows:
        rows = rows.assign(**{_DIFFERENCES: rows[_DIFFERENCES].cumsum()})
    return rows.rename(columns={_DIFFERENCES: _GROWING})


def stack(tables: dict[str, pd.DataFrame]) -> pd.DataFrame:
    """Several tables as one, told apart by the column `table`."""
    named = [table.assign(table=name) for name, table in tables.items()]
    return pd.concat(named, ignore_index=True)


def unstack(rows: pd.DataFrame, name: str) -> pd.DataFrame:
    """A table of `stack`, without the columns of the others."""
    mine = rows[rows["table"] == name].drop(columns="table")
    return mine.dropna(axis=1, how="all").infer_objects().reset_index(drop=True)
