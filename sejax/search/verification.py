"""The best settings of a search on a proxy, tried on the real task."""

from typing import Any

import optuna

from sejax.files import write_text
from sejax.search import results
from sejax.search.settings import Search
from sejax.search.study import trial_folder
from sejax.search.tuning import Tuning

FILE = "verification.csv"


def verify(study: optuna.Study, search: Search, runner: Tuning) -> Any:
    """Trains agents with the best settings on the proxy and on the real task, and writes a table.

    Rows of an earlier session are kept.

    Returns:
      A row for each of the best `search.config.verify` trials, as a data frame, the best on the
      real task first: of settings that solve it those that need fewer steps there.
    """
    import pandas as pd

    path, best = search.folder / FILE, results.ranked(study)[: search.config.verify]
    known = pd.read_csv(path).set_index("trial").to_dict("index") if path.exists() else {}
    rows = []
    for rank, trial in enumerate(best, 1):
        words = results.words_of(trial, search)
        values = known.get(trial.number)
        if values is None:
            values = runner.verify(runner.config(words, trial_folder(search, trial.number)))
        rows.append({**values, "trial": trial.number, "rank": rank, "score": trial.value})
        write_text(path, pd.DataFrame(rows).to_csv(index=False))
    solved = runner.solved_reward(runner.config([]))
    ordered = sorted(rows, key=lambda row: (-min(row["real_return"], solved), row["real_steps"]))
    table = pd.DataFrame(ordered)
    write_text(path, table.to_csv(index=False))
    return table


def print_table(table: Any, search: Search, num_agents: int) -> None:
    """Prints the rows, and how the two orders agree."""
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
