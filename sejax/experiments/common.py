"""What the experiments share: their options, pieces of work that are done once, and their tables.

An experiment is cut into pieces that take minutes (one SE learned, the agents of one SE). Each is
written as a CSV file under the output folder as soon as it is done, with the settings that it was
made with beside it; running the same command again computes only what is missing.
"""

import argparse
import itertools
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sejax import commands
from sejax.configs import require_seed
from sejax.errors import ConfigError, require
from sejax.files import write_text
from sejax.run_directory import flatten


def parse_args(
    name: str, description: str | None, add_options: Callable[[argparse.ArgumentParser], None]
) -> argparse.Namespace:
    """Options that every experiment takes, and its own; starts XLA with a device for each core.

    Words `name=value` before the first option mean `--name value`, as in sejax.run.

    Raises:
      ConfigError: for a seed or a number of devices that cannot be.
    """
    summary = (description or "").partition("\n")[0]
    parser = argparse.ArgumentParser(prog=f"python -m sejax.experiments.{name}",
                                     description=summary)  # fmt: skip
    parser.add_argument("--quick", action="store_true", help="a small version, in minutes")
    parser.add_argument("--out", type=Path, help=f"output folder; results/{name}[-quick], where "
                        "there is a choice of tasks a folder there")  # fmt: skip
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--devices", type=int, help="devices to use; all")
    add_options(parser)
    args = parser.parse_args(as_options(sys.argv[1:]))
    require_seed("--seed", args.seed)
    require_counts(args, "devices")
    # Pieces of several tasks in one folder would be taken for each other.
    of_task = [args.env] if getattr(args, "env", None) else []
    args.out = args.out or Path("results", f"{name}-quick" if args.quick else name, *of_task)
    from sejax.runtime import configure_xla, enable_compilation_cache

    configure_xla(args.devices)
    enable_compilation_cache()
    return args


def as_options(words: Sequence[str]) -> list[str]:
    """Turns leading words `name=value` into `--name value`."""
    leading = list(itertools.takewhile(lambda word: "=" in word and word[0] != "-", words))
    split = [(f"--{name.replace('_', '-')}", value) for name, _, value in
             (word.partition("=") for word in leading)]  # fmt: skip
    return [*itertools.chain(*split), *words[len(leading) :]]


def run_command(
    name: str,
    description: str | None,
    add_options: Callable[[argparse.ArgumentParser], None],
    run: Callable[[argparse.Namespace], Any],
) -> None:
    """Runs an experiment as the command line says; bad input ends it with one message."""
    try:
        run(parse_args(name, description, add_options))
    except ConfigError as error:
        commands.fail(str(error), commands.BAD_INPUT)


def require_counts(args: argparse.Namespace, *names: str, least: int = 1) -> None:
    """Checks options that count something; those that were not given, or that are unknown, pass.

    Raises:
      ConfigError: for a number that is too small.
    """
    for name in names:
        option, value = f"--{name.replace('_', '-')}", getattr(args, name, None)
        require(value is None or value >= least, option, f"be at least {least}", "it counts",
                value, f"{option}=10")  # fmt: skip


class Pieces:
    """The finished pieces of an experiment, in a folder that is below what `option` names."""

    def __init__(self, folder: Path, option: str = "--out"):
        self.folder = folder
        self.option = option

    def compute(
        self,
        name: str,
        settings: dict[str, Any],
        compute: Callable[[], pd.DataFrame],
        length: str | None = None,
    ) -> pd.DataFrame:
        """A piece's table: read if it is there, else computed and written.

        Args:
          name: of the files, `<name>.csv` and `<name>.json`.
          settings: what the piece depends on; plain values.
          compute: makes the table.
          length: name of the setting that says how long the work goes on, if there is one: a piece
            that was made with a smaller value is made anew.

        Raises:
          ConfigError: if a piece of that name was made with other settings.
        """
        (table,) = self.compute_all({name: settings}, lambda _: [compute()], length)
        return table

    def compute_all(
        self,
        settings: dict[str, dict[str, Any]],
        compute: Callable[[list[str]], list[pd.DataFrame]],
        length: str | None = None,
    ) -> list[pd.DataFrame]:
        """As `compute` for several pieces, of which those that are missing are made at once.

        Args:
          settings: of each piece, by its name.
          compute: makes the tables of the pieces with the given names.
          length: as for `compute`.
        """
        settings = json.loads(json.dumps(settings, default=str))
        tables = {name: self._stored(name, mine, length) for name, mine in settings.items()}
        missing = [name for name, table in tables.items() if table is None]
        for name, table in zip(missing, compute(missing) if missing else [], strict=True):
            # In this order: a longer table with the settings of the shorter one is made again.
            write_text(self.folder / f"{name}.csv", table.to_csv(index=False))
            write_text(self.folder / f"{name}.json", json.dumps(settings[name], indent=2))
            tables[name] = table
        return [table for table in tables.values() if table is not None]

    def _stored(
        self, name: str, settings: dict[str, Any], length: str | None
    ) -> pd.DataFrame | None:
        table, made_with = self.folder / f"{name}.csv", self.folder / f"{name}.json"
        if not (table.exists() and made_with.exists()):
            return None
        there, asked = flatten(json.loads(made_with.read_text())), flatten(settings)
        differing = sorted(key for key in {*there, *asked} if there.get(key) != asked.get(key))
        if length and differing == [length] and there[length] < asked[length]:
            return None
        if differing:
            raise ConfigError(
                f"{self.option} must be a new folder or that of the same experiment, because "
                f"finished pieces are used again; got {table} with another "
                f"{', '.join(differing)}. Set {self.option}=DIR."
            )
        return pd.read_csv(table)


def median(values: Any) -> float:
    """The median of numbers that may be inf."""
    values = np.sort(np.asarray(values, float))
    return float((values[(values.size - 1) // 2] + values[values.size // 2]) / 2)


def bootstrap_interval(
    values: Any, level: float = 0.95, num_resamples: int = 2000, seed: int = 0
) -> tuple[float, float]:
    """Percentile bootstrap confidence interval of the mean of independent values `[n]`.

    Average what belongs together (the agents of one proxy) before: only independent values may be
    drawn one by one.
    """
    values = np.asarray(values, float)
    draws = np.random.default_rng(seed).integers(0, values.size, (num_resamples, values.size))
    means = values[draws].mean(axis=1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def write_markdown(path: Path, title: str, command: str, table: pd.DataFrame, note: str) -> None:
    """Writes a table as Markdown, with the command that makes it and what to know about it."""
    header = "| " + " | ".join(map(str, table.columns)) + " |"
    rule = "|" + " --- |" * len(table.columns)
    rows = ["| " + " | ".join(map(str, row)) + " |" for row in table.itertuples(index=False)]
    body = "\n".join([header, rule, *rows])
    write_text(path, f"# {title}\n\n`{command}`\n\n{body}\n\n{note}\n")
