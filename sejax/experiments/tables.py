"""What the experiments' tables share: intervals, and how a table is published."""

from typing import Any

import numpy as np
import pandas as pd

from sejax.experiments.settings import Settings
from sejax.files import write_text


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


def publish(
    settings: Settings, title: str, table: pd.DataFrame, summary: pd.DataFrame, note: str
) -> pd.DataFrame:
    """Writes `table.md` and `summary.csv`, prints the table and returns it.

    Args:
      settings: of the experiment.
      title: of the table.
      table: texts.
      summary: the numbers behind them.
      note: what to know about it.
    """
    folder = settings.folder
    write_text(folder / f"{settings.files}summary.csv", summary.to_csv(index=False))
    text = f"# {title}\n\n`{settings.command()}`\n\n{as_markdown(table)}\n\n{note}\n"
    write_text(folder / f"{settings.files}table.md", text)
    print_table(title, table)
    print(f"{folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}")
    return table


def as_markdown(table: pd.DataFrame) -> str:
    """A table of texts as Markdown."""
    rows = [table.columns, ["---"] * len(table.columns), *table.itertuples(index=False)]
    return "\n".join("| " + " | ".join(map(str, row)) + " |" for row in rows)


def print_table(title: str, table: pd.DataFrame) -> None:
    """Prints a table of texts."""
    from rich.console import Console
    from rich.table import Table

    printed = Table(title=title)
    for column in table.columns:
        printed.add_column(str(column))
    for row in table.itertuples(index=False):
        printed.add_row(*map(str, row))
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = 220  # a file has room for whole rows
    console.print(printed)
