"""What an experiment keeps on the disk: cached shards while it computes, and its rows.

A shard is a table that takes minutes to compute (the agents of one SE). It is written as soon as it
is computed, so that the same command computes only what is missing. Its file is a CSV file below a
line with a checksum and the settings that it was computed with.
"""

import hashlib
import io
import json
import lzma
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sejax.ops.files import atomic_path, write_text
from sejax.options import ConfigError
from sejax.options.plain import differences

# Training steps grow along each curve: kept as differences, a table takes two thirds of the room.
_GROWING, _DIFFERENCES = "steps", "steps_since_the_row_before"


class Shards:
    """The cached shards of an experiment, in one folder.

    Attributes:
      made_with: for people, what the shards that were asked for are made with, by their name.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.made_with: dict[str, dict[str, Any]] = {}

    def compute(
        self, name: str, settings: dict[str, Any], compute: Callable[[], pd.DataFrame]
    ) -> pd.DataFrame:
        """A shard's table: read if it is there, else computed and written.

        Args:
          name: of its file.
          settings: plain values that it depends on.
          compute: makes it.

        Raises:
          ConfigError: if the shard of that name was made with other settings.
        """
        self.made_with[name] = settings
        (table,) = self.compute_all({name: settings}, lambda _: [compute()])
        return table

    def compute_all(
        self,
        settings: Mapping[str, dict[str, Any]],
        compute: Callable[[list[str]], list[pd.DataFrame]],
    ) -> list[pd.DataFrame]:
        """As `compute` for several shards, of which `compute(names)` makes all that are missing."""
        settings = json.loads(json.dumps(settings, default=str))
        found = {name: self._read(name, mine) for name, mine in settings.items()}
        missing = [name for name, table in found.items() if table is None]
        for name, table in zip(missing, compute(missing) if missing else [], strict=True):
            text = table.to_csv(index=False)
            header = {"sha256": _digest(settings[name], text), "settings": settings[name]}
            write_text(self.folder / f"{name}.csv", f"{json.dumps(header)}\n{text}")
            found[name] = pd.read_csv(io.StringIO(text))  # as it will be read again
        return [table for table in found.values() if table is not None]

    def _read(self, name: str, settings: dict[str, Any]) -> pd.DataFrame | None:
        """A shard that was made with these settings; None if it is missing or damaged."""
        path = self.folder / f"{name}.csv"
        if not path.exists():
            return None
        try:
            header, _, text = path.read_text(encoding="utf-8").partition("\n")
            stored = json.loads(header)
            is_whole = stored["sha256"] == _digest(stored["settings"], text)
        except (ValueError, TypeError, KeyError):
            is_whole = False
        if not is_whole:
            print(f"{path} is damaged: it is computed again.", flush=True)
            return None
        differing = differences(stored["settings"], settings, most=3)
        if differing:
            raise ConfigError(
                f"work must be a new folder or that of the same experiment; {path} differs in "
                f"{differing}. Set work=DIR.",
                "work",
            )
        return pd.read_csv(io.StringIO(text))


def _digest(settings: Any, text: str) -> str:
    content = json.dumps(settings, sort_keys=True) + "\n" + text
    return hashlib.sha256(content.encode()).hexdigest()


def write_rows(path: Path, rows: pd.DataFrame) -> None:
    """Writes the rows of an experiment, compressed; xz keeps a checksum."""
    if _GROWING in rows and pd.api.types.is_integer_dtype(rows[_GROWING]):
        differences = np.diff(rows[_GROWING], prepend=0)  # over the whole table, not by curve
        rows = rows.assign(**{_GROWING: differences}).rename(columns={_GROWING: _DIFFERENCES})
    with atomic_path(path) as temporary:
        rows.to_csv(temporary, index=False, compression="xz")


def read_rows(path: Path) -> pd.DataFrame:
    """The rows that `write_rows` has written.

    Raises:
      ConfigError: if they are missing or damaged.
    """
    try:
        rows = pd.read_csv(path, low_memory=False)  # a column has one type throughout
    except FileNotFoundError as error:
        raise ConfigError(
            f"from_rows needs stored rows; there is no {path}. Set from_rows=false, or out=DIR.",
            "from_rows",
        ) from error
    except (EOFError, lzma.LZMAError, ValueError) as error:  # pandas' errors are ValueErrors
        raise ConfigError(
            f"from_rows needs whole rows; {path} is damaged ({' '.join(str(error).split())[:80]}). "
            "Restore the file, or set from_rows=false to make it again.",
            "from_rows",
        ) from error
    if _DIFFERENCES in rows:
        rows = rows.assign(**{_DIFFERENCES: rows[_DIFFERENCES].cumsum()})
    return rows.rename(columns={_DIFFERENCES: _GROWING})


def stack(tables: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Several tables as one, told apart by the column `table`."""
    named = [table.assign(table=name) for name, table in tables.items()]
    return pd.concat(named, ignore_index=True)


def unstack(rows: pd.DataFrame, name: str) -> pd.DataFrame:
    """A table of `stack`, without the columns of the others."""
    mine = rows[rows["table"] == name].drop(columns="table")
    return mine.dropna(axis=1, how="all").infer_objects().reset_index(drop=True)
