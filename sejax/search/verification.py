"""The best settings of a search, tried again: the best score of many is the luckiest too."""

from typing import Any

import optuna

from sejax.files import write_text
from sejax.search import results
from sejax.search.settings import Search
from sejax.search.study import Runner

FILE = "verification.csv"


def verify(study: optuna.Study, search: Search, runner: Runner) -> Any:
    """Tries the best settings again and writes a table; rows of an earlier session are kept.

    Returns:
      A row for each of the best trials, as a data frame; what came of them now decides the order.
    """
    import pandas as pd

    path, best = search.folder / FILE, results.ranked(study)[: search.num_verified]
    known = pd.read_csv(path).set_index("trial").to_dict("index") if path.exists() else {}
    rows = []
    for rank, trial in enumerate(best, 1):
        words = results.words_of(trial, search)
        values = known.get(trial.number) or runner.verify(words, trial.number)
        rows.append({**values, "trial": trial.number, "rank": rank, "score": trial.value})
        write_text(path, pd.DataFrame(rows).to_csv(index=False))
    table = pd.DataFrame(sorted(rows, key=runner.order))
    write_text(path, table.to_csv(index=False))
    return table


def print_table(table: Any, search: Search, num_agents: int) -> None:
    """Prints the rows; `num_agents` are those of a search on a proxy."""
    if search.is_of_agent:
        _print_agents(table, num_agents)
    else:
        _print_proxies(table, search)


def _print_proxies(table: Any, search: Search) -> None:
    from rich.console import Console
    from rich.table import Table

    shown = Table(title=f"the best {len(table)}, again with {search.config.fresh_seeds} other "
                  "seeds")  # fmt: skip
    for column in ("trial", "rank before", "score before", "mean", "worst", "generations"):
        shown.add_column(column, justify="right")
    for row in table.itertuples():
        shown.add_row(str(row.trial), str(row.rank), f"{row.score:.4g}", f"{row.mean:.4g}",
                      f"{row.worst:.4g}", f"{row.generations:.1f}")  # fmt: skip
    Console(highlight=False).print(shown)


def _print_agents(table: Any, num_agents: int) -> None:
    """The rows, and how the two orders agree."""
    from rich.console import Console
    from rich.table import Table
    from scipy.stats import spearmanr

    shown = Table(title=f"the best {len(table)} with {num_agents} fresh agents each, tested on the "
                  "real task")  # fmt: skip
    for column in ("trial", "rank on the proxy", "trained on the proxy",
                   "trained on the real task", "steps there"):  # fmt: skip
        shown.add_column(column, justify="right")
    for row in table.itertuples():
        shown.add_row(str(row.trial), str(row.rank),
                      f"{row.proxy_return:.1f} ± {row.proxy_std:.1f}",
                      f"{row.real_return:.1f} ± {row.real_std:.1f}",
                      f"{row.real_steps:,.0f}")  # fmt: skip
    console = Console(highlight=False)
    console.print(shown)
    if (
        len(table) > 2
        and table["proxy_return"].nunique() > 1
        and table["real_return"].nunique() > 1
    ):
        agreed = spearmanr(table["proxy_return"], table["real_return"]).statistic
        console.print(f"Rank correlation of the two columns: {agreed:.2f}.")
