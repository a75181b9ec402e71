"""Tables: means with intervals as columns, columns as texts, and writing a table."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from experiments.common.experiment import Settings
from experiments.common.statistics import bootstrap_interval, interquartile_mean
from sejax.ops.files import write_text

LEAST_FOR_INTERVAL = 5  # independent values: two bracket the truth half of the time


def interval(draws: Any, least: int = LEAST_FOR_INTERVAL) -> tuple[float, float]:
    """95% bootstrap interval of the mean of what is drawn again; nan for fewer than `least`."""
    return bootstrap_interval(draws) if len(draws) >= least else (np.nan, np.nan)


def mean_columns(
    values: Any, name: str, draws: Any = None, least: int = LEAST_FOR_INTERVAL
) -> dict[str, float]:
    """Mean, std and `interval` as columns `NAME_mean`, `NAME_std`, `NAME_low`, `NAME_high`.

    Args:
      values: `[n]`.
      name: of the columns.
      draws: what the interval draws again, such as the means of groups; the values if not given.
      least: how many of them give an interval.
    """
    values = np.asarray(values, float)
    low, high = interval(values if draws is None else draws, least)
    columns = {"mean": values.mean(), "std": values.std(), "low": low, "high": high}
    return {f"{name}_{statistic}": value for statistic, value in columns.items()}


def summary_by(
    rows: pd.DataFrame, by: Sequence[str], statistics: Callable[[pd.DataFrame], Mapping[str, Any]]
) -> pd.DataFrame:
    """A row for each combination of values of the columns `by`, in the order of the rows.

    Args:
      rows: the table.
      by: names of columns, which the summary has too.
      statistics: further columns of a row, of the rows with its values.
    """
    groups = rows.groupby(list(by), sort=False)
    return pd.DataFrame(
        [dict(zip(by, values, strict=True)) | {**statistics(mine)} for values, mine in groups]
    )


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


def brackets(low: float, high: float, digits: int) -> str:
    """An interval as it stands behind a mean; empty if there is none."""
    return f" [{low:,.{digits}f}, {high:,.{digits}f}]" if np.isfinite(low) else ""


def mean_text(name: str, digits: int, std: bool = False) -> Callable[[Any], str]:
    """Makes `mean ± std [low, high]` of a row with the columns of `mean_columns`."""

    def text(row: Any) -> str:
        mean, low, high = (getattr(row, f"{name}_{end}") for end in ("mean", "low", "high"))
        spread = f" ± {getattr(row, f'{name}_std'):,.{digits}f}" if std else ""
        return f"{mean:,.{digits}f}{spread}{brackets(low, high, digits)}"

    return text


def iqm_text(name: str) -> str:
    """The format of the columns of `iqm_columns` for `as_texts`."""
    return f"{{{name}_iqm:,.1f}} [{{{name}_iqm_low:,.1f}}, {{{name}_iqm_high:,.1f}}]"


def iqm_note(where: str = "", of: str = "agents") -> str:
    """What a reader must know of such columns, and within what is drawn."""
    return (
        f" IQM: the interquartile mean over {of}, in brackets a stratified bootstrap 95% "
        f"interval, which draws {' '.join(filter(None, (of, where)))}."
    )


def as_texts(
    summary: pd.DataFrame, columns: Mapping[str, str | Callable[[Any], Any]]
) -> pd.DataFrame:
    """A table of texts: each column is a format of the summary's, or a function of its row."""
    rows = list(summary.itertuples(index=False))
    return pd.DataFrame(
        {
            name: [how(row) if callable(how) else how.format_map(row._asdict()) for row in rows]
            for name, how in columns.items()
        }
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
