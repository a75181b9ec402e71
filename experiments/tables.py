"""What the experiments' tables share: intervals, columns of texts, and how a table is published."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from experiments.settings import Settings
from experiments.statistics import bootstrap_interval, interquartile_mean
from sejax.ops.files import write_text

LEAST_FOR_INTERVAL = 5  # independent values: two bracket the truth half of the time


def interval(draws: Any) -> tuple[float, float]:
    """95% bootstrap interval of the mean of what is drawn again; nan for fewer than five."""
    return bootstrap_interval(draws) if len(draws) >= LEAST_FOR_INTERVAL else (np.nan, np.nan)


def brackets(low: float, high: float, digits: int) -> str:
    """An interval as it stands behind a mean; empty if there is none."""
    return f" [{low:,.{digits}f}, {high:,.{digits}f}]" if np.isfinite(low) else ""


def spread(values: pd.Series, draws: Any, name: str) -> dict[str, float]:
    """Mean, std and `interval` of values as columns `NAME_mean`, ...; `draws` are drawn again."""
    low, high = interval(draws)
    columns = {"mean": values.mean(), "std": values.std(ddof=0), "low": low, "high": high}
    return {f"{name}_{statistic}": value for statistic, value in columns.items()}


def in_strata(values: pd.Series, labels: pd.Series | None) -> list[pd.Series]:
    """Values apart by their labels; all together where there are none."""
    return [values] if labels is None else [mine for _, mine in values.groupby(labels)]


def iqm_columns(values: pd.Series, name: str, strata: pd.Series | None = None) -> dict[str, float]:
    """Interquartile mean and its interval as columns `NAME_iqm`, `NAME_iqm_low`, `NAME_iqm_high`.

    The values are drawn again within their strata, which are labels of them.
    """
    ends = bootstrap_interval(*in_strata(values, strata), statistic=interquartile_mean)
    columns = {"iqm": interquartile_mean(values), "iqm_low": ends[0], "iqm_high": ends[1]}
    return {f"{name}_{statistic}": value for statistic, value in columns.items()}


def iqm_text(name: str) -> str:
    """The format of these columns for `as_texts`."""
    return f"{{{name}_iqm:,.1f}} [{{{name}_iqm_low:,.1f}}, {{{name}_iqm_high:,.1f}}]"


def iqm_note(where: str = "", of: str = "agents") -> str:
    """What is to be known of such columns, and within what is drawn."""
    return (
        f" IQM: the interquartile mean over {of}, in brackets a stratified bootstrap 95% "
        f"interval, which draws {' '.join(filter(None, (of, where)))}."
    )


def as_texts(
    summary: pd.DataFrame, columns: Mapping[str, str | Callable[[Any], Any]]
) -> pd.DataFrame:
    """A table of texts: each column is a format of the summary's, or a function of its row."""
    return pd.DataFrame(
        [
            {
                name: how(row) if callable(how) else how.format_map(row._asdict())
                for name, how in columns.items()
            }
            for row in summary.itertuples(index=False)
        ]
    )


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
