"""Tables: means with intervals as columns, columns as texts, and writing a table."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from experiments.common.experiment import Settings
from experiments.common.statistics import ENOUGH, mean_interval
from sejax.ops.files import write_text


def mean_columns(values: pd.Series, name: str, groups: pd.Series | None = None) -> dict[str, float]:
    """Mean, std and `mean_interval` as columns `NAME_mean`, `NAME_std`, `NAME_low`, `NAME_high`.

    Args:
      values: `[n]`.
      name: of the columns.
      groups: labels of the values, such as the proxies of agents. Values of one group are not
        independent: the interval is that of the groups' means.
    """
    low, high = mean_interval(values if groups is None else values.groupby(groups).mean())
    each = values.to_numpy(float)
    columns = {"mean": each.mean(), "std": each.std(), "low": low, "high": high}
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


WORST_NOTE = " Worst tenth: the mean of the lowest tenth of what the mean is over."


def brackets(low: float, high: float, digits: int) -> str:
    """An interval as it stands behind a mean; empty if there is none."""
    return f" [{low:,.{digits}f}, {high:,.{digits}f}]" if np.isfinite(low) else ""


def known_text(value: float, form: str) -> str:
    """A number in this format; empty if it is not known or inf."""
    return format(value, form) if np.isfinite(value) else ""


def steps_text(steps: float) -> str:
    """A number of steps as tables have it, in millions if there are many; - if not known."""
    if steps < 1e5:
        return f"{steps:,.0f}"
    return f"{steps / 1e6:.1f}M" if np.isfinite(steps) else "-"


def mean_text(name: str, digits: int, std: bool = False) -> Callable[[Any], str]:
    """Makes `mean ± std [low, high]` of a row with the columns of `mean_columns`."""

    def text(row: Any) -> str:
        mean, deviation, low, high = (
            getattr(row, f"{name}_{statistic}") for statistic in ("mean", "std", "low", "high")
        )
        spread = f" ± {deviation:,.{digits}f}" if std else ""
        return f"{mean:,.{digits}f}{spread}{brackets(low, high, digits)}"

    return text


def interval_note(of: str) -> str:
    """What a reader must know of means' intervals, and what they take as independent."""
    return f"In brackets Student's 95% interval over {of}, none for fewer than {ENOUGH}."


def drawn_text(number: int, what: str) -> str:
    """What an interval draws, as a cell of a column `interval over`; empty if there is none."""
    return f"{number} {what}" if number >= ENOUGH else ""


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
    """Writes texts as `table.md`, prints and returns them.

    The title names a folder of its own, as studies of one task differ in it. The numbers go to
    `summary.csv` in the folder `work`, as rows give them again.
    """
    folder = settings.folder
    if settings.out and folder.name not in title:
        title += f": {folder.name}"
    write_text(settings.summary_file, summary.to_csv(index=False))
    rows = [table.columns, ["---"] * len(table.columns), *table.itertuples(index=False)]
    lines = "\n".join("| " + " | ".join(map(str, row)) + " |" for row in rows)
    text = f"# {title}\n\n`{settings.command()}`\n\n{lines}\n\n{note}\n"
    write_text(folder / "table.md", text)
    print(f"{title}\n\n{table.to_string(index=False)}\n")
    print(f"{folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}")
    return table
