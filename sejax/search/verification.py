"""The best settings of a search, tried again: the best score of many is the luckiest too."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import optuna

from sejax.ops.files import write_text
from sejax.search import results
from sejax.search.settings import Search
from sejax.search.study import Runner

FILE = "verification.csv"


def verify(study: optuna.Study, search: Search, runner: Runner) -> Any:
    """Tries the best settings again and writes a table, a row at a time.

    Rows of an earlier session are taken where they are of the same trial, settings and number of
    fresh seeds or agents. The file keeps the others, after those of now.

    Returns:
      A row for each of the best trials, as a data frame; what came of them now decides the order.
    """
    import pandas as pd

    path, best = search.folder / FILE, results.ranked(study)[: search.num_verified]
    known = pd.read_csv(path).to_dict("records") if path.exists() else []
    rows: list[dict[str, Any]] = []
    for rank, trial in enumerate(best, 1):
        words = results.words_of(trial, search)
        of = {
            "trial": trial.number,
            "num_fresh": runner.num_fresh(),
            "settings": _settings_of(words, search),
        }
        same = [row for row in known if all(row.get(name) == x for name, x in of.items())]
        known = [row for row in known if row not in same]
        values = same[0] if same else runner.verify(words, trial.number)
        rows.append({**values, "rank": rank, "score": trial.value, **of})
        _write(path, [*rows, *known])
    rows.sort(key=runner.order)
    _write(path, [*rows, *known])
    return pd.DataFrame(rows)


def print_table(table: Any, search: Search) -> None:
    """Prints the rows."""
    if search.is_of_agent:
        _print_agents(table)
    else:
        _print_proxies(table)


def _settings_of(words: Sequence[str], search: Search) -> str:
    """All words of a search that a row depends on."""
    config = search.config
    own = [
        f"max_generations={config.max_generations}",
        f"measure={search.measure}",
        f"seeds={config.seeds}",
    ]
    return " ".join([*search.fixed, *words, *own])


def _write(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    import pandas as pd

    write_text(path, pd.DataFrame(rows).to_csv(index=False))


def _print_proxies(table: Any) -> None:
    from rich.console import Console
    from rich.table import Table

    shown = Table(title=f"the best {len(table)}, again with {table['num_fresh'][0]} other seeds")
    for column in ("trial", "rank before", "score before", "mean", "worst", "generations"):
        shown.add_column(column, justify="right")
    for row in table.itertuples():
        shown.add_row(
            str(row.trial),
            str(row.rank),
            f"{row.score:.4g}",
            f"{row.mean:.4g}",
            f"{row.worst:.4g}",
            f"{row.generations:.1f}",
        )
    Console(highlight=False).print(shown)


def _print_agents(table: Any) -> None:
    """The rows, and how the two orders agree."""
    from rich.console import Console
    from rich.table import Table

    shown = Table(
        title=f"the best {len(table)} with {table['num_fresh'][0]} fresh agents each, "
        "tested on the real task"
    )
    worlds = {"proxy": "trained on the proxy", "real": "trained on the real task"}
    if "real_return" not in table:
        del worlds["real"]  # baseline=false
    for column in ("trial", "rank on the proxy", *worlds.values(), "steps there"):
        shown.add_column(column, justify="right")
    for row in table.to_dict("records"):
        shown.add_row(
            str(row["trial"]),
            str(row["rank"]),
            *(f"{row[f'{x}_return']:.1f} ± {row[f'{x}_std']:.1f}" for x in worlds),
            f"{row[f'{list(worlds)[-1]}_steps']:,.0f}",
        )
    console = Console(highlight=False)
    console.print(shown)
    columns = [f"{x}_return" for x in worlds]
    finite = table.dropna(subset=columns)
    if len(columns) > 1 and len(finite) > 2 and (finite[columns].nunique() > 1).all():
        from scipy.stats import spearmanr

        agreed = spearmanr(finite["proxy_return"], finite["real_return"]).statistic
        console.print(f"Rank correlation of the two columns: {agreed:.2f}.")
