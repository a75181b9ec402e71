"""What the experiments' tables share: intervals, columns of texts, and how a table is published."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

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


def spread(values: pd.Series, draws: Any, name: str) -> dict[str, float]:
    """Mean, std and interval of values as columns `NAME_mean`, ...; `draws` are drawn again."""
    low, high = bootstrap_interval(draws)
    columns = {"mean": values.mean(), "std": values.std(ddof=0), "low": low, "high": high}
    return {f"{name}_{statistic}": value for statistic, value in columns.items()}


def as_texts(
    summary: pd.DataFrame, columns: Mapping[str, str | Callable[[Any], Any]]
) -> pd.DataFrame:
    """A table of texts: each column is a format of the summary's, or a function of its row."""
    return pd.DataFrame([
        {name: how(row) if callable(how) else how.format_map(row._asdict())
         for name, how in columns.items()}
        for row in summary.itertuples(index=False)
    ])  # fmt: skip


def publish(
    settings: Settings, title: str, table: pd.DataFrame, summary: pd.DataFrame, note: str
) -> pd.DataFrame:
    """Writes texts as `table.md` and numbers as `summary.csv`; prints and returns the texts."""
    folder = settings.folder
    write_text(folder / f"{settings.files}summary.csv", summary.to_csv(index=False))
    rows = [table.columns, ["---"] * len(table.columns), *table.itertuples(index=False)]
    lines = "\n".join("| " + " | ".join(map(str, row)) + " |" for row in rows)
    text = f"# {title}\n\n`{settings.command()}`\n\n{lines}\n\n{note}\n"
    write_text(folder / f"{settings.files}table.md", text)
    printed = Table(*map(str, table.columns), title=title)
    for row in table.itertuples(index=False):
        printed.add_row(*map(str, row))
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = 220  # a file has room for whole rows
    console.print(printed)
    print(f"{folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}")
    return table
