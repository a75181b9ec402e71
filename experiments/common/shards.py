"""What an experiment keeps on the disk: cached shards while it computes, and its rows.

A shard is a table that takes minutes to compute (the agents of one SE). It is written as soon as it
is computed, so that the same command computes only what is missing. Its file is a CSV file below a
line with the settings that it was computed with. All files are compressed by xz, which keeps a
checksum.
"""

import io
import json
import lzma
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sejax.ops.files import atomic_path, write_bytes
from sejax.options import ConfigError
from sejax.options.plain import differences

DAMAGE = (EOFError, lzma.LZMAError, ValueError)  # what reading raises; pandas' are ValueErrors
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
        (table,) = self.compute_all({name: settings}, lambda _: [compute()])
        return table

    def compute_all(
        self,
        settings: Mapping[str, dict[str, Any]],
        compute: Callable[[list[str]], list[pd.DataFrame]],
    ) -> list[pd.DataFrame]:
        """As `compute` for several shards, of which `compute(names)` makes all that are missing."""
        settings = json.loads(json.dumps(settings, default=str))
        self.made_with |= settings
        tables = {name: self._read(name, mine) for name, mine in settings.items()}
        missing = [name for name, table in tables.items() if table is None]
        for name, table in zip(missing, compute(missing) if missing else [], strict=True):
            text = f"{json.dumps(settings[name])}\n{table.to_csv(index=False)}"
            write_bytes(self.path(name), lzma.compress(text.encode(), preset=1))
            tables[name] = self._read(name, settings[name])  # as it will be read again
        return [table for table in tables.values() if table is not None]

    def path(self, name: str) -> Path:
        """Where a shard is kept."""
        return self.folder / f"{name}.csv.xz"

    def _read(self, name: str, settings: dict[str, Any]) -> pd.DataFrame | None:
        """A shard that was made with these settings; None if it is missing or damaged."""
        path = self.path(name)
        try:
            made_with, _, text = lzma.decompress(path.read_bytes()).partition(b"\n")
            differing = differences(json.loads(made_with), settings)
            table = pd.read_csv(io.BytesIO(text))
        except FileNotFoundError:
            return None
        except DAMAGE:
            print(f"{path} is damaged: it is computed again.", flush=True)
            return None
        if differing:
            must = "must be a new folder or that of the same experiment"
            raise ConfigError("work", f"{must}; {path} differs in {differing}", use="DIR")
        return table


def write_rows(path: Path, rows: pd.DataFrame) -> None:
    """Writes the rows of an experiment."""
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
        needs = f"needs stored rows; there is no {path}"
        raise ConfigError("from_rows", needs, use="false, or out=DIR") from error
    except DAMAGE as error:
        damage = f"{path} is damaged ({' '.join(str(error).split())[:80]})"
        fix = "Restore the file, or set from_rows=false to make it again."
        raise ConfigError("from_rows", f"needs whole rows; {damage}", fix=fix) from error
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
