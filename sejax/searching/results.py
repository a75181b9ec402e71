"""What a search found: tables, what mattered, and the best settings, tried again."""

import shlex
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import filelock
import optuna
import pandas as pd
from optuna.trial import FrozenTrial, TrialState
from rich.console import Console
from rich.table import Table

from sejax.ops.files import write_text
from sejax.options import as_text, registry
from sejax.runs.preset_files import file_text
from sejax.searching.config import Search
from sejax.searching.study import ENDED
from sejax.searching.trials import Runner

SHOWN = 10
NEEDED = 10  # completed trials, before importances say anything
# Fields of how trials ran, which are no settings.
HOW = ("seed", "devices", "num_parallel", "tracker")


def ranked(study: optuna.Study) -> list[FrozenTrial]:
    """Completed trials, the best first; of equal ones that which cost less."""
    done = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    return sorted(done, key=lambda trial: (-float(trial.value or 0.0), trial.user_attrs["cost"]))


def overrides_of(trial: FrozenTrial, search: Search) -> list[str]:
    """The overrides that make the trial's settings."""
    return [dimension.override(trial.params) for dimension in search.space.values()]


def command_line(overrides: Sequence[str], search: Search, command: str) -> str:
    """The command that runs with these settings."""
    return shlex.join(["python", "-m", command, *search.fixed, *overrides])


def preset_line(search: Search, command: str) -> str:
    """The command that reads the best settings from their file.

    Modules are typed beside it, as those that a file names are not imported.
    """
    preset = f"preset={as_text(str(preset_file(search)))}"
    typed = [override for override in search.fixed if registry.paths_in([override])]
    return shlex.join(["python", "-m", command, preset, *typed])


def preset_file(search: Search) -> Path:
    """Where the best settings are, for `preset=`."""
    return search.folder / "preset.yaml"


def table(study: optuna.Study, search: Search) -> pd.DataFrame:
    """A row for each trial that ended."""
    columns = ("mean", "worst", "generations", "cost", "seconds")
    return pd.DataFrame(
        {
            "trial": trial.number,
            "state": trial.state.name.lower(),
            **{name: trial.user_attrs.get(name) for name in columns},
            **{name: x.value(trial.params) for name, x in search.space.items()},
        }
        for trial in study.get_trials(deepcopy=False, states=ENDED)
        if all(x.parameter in trial.params for x in search.space.values())
    )


def importances(study: optuna.Study, search: Search) -> dict[str, float]:
    """The share of each field in what makes scores differ, the largest first; by PED-ANOVA.

    Empty where fewer than ten trials are complete, half of them equally good, or fewer than two
    fields searched. Pruned trials are left out, so that it is about the better settings.

    Source: Watanabe et al., 2023, "PED-ANOVA" (Optuna's default).
    """
    done = ranked(study)
    num_best = sum(trial.value == done[0].value for trial in done)
    if len(done) < NEEDED or 2 * num_best >= len(done) or len(search.space) < 2:
        return {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # fields that all good trials have alike
        found = optuna.importance.get_param_importances(study)
    names = {x.parameter: name for name, x in search.space.items()}
    return {names[parameter]: share for parameter, share in found.items() if parameter in names}


def write(study: optuna.Study, search: Search, command: str) -> None:
    """Writes `trials.csv`, and of the best trial `best.txt` and `preset.yaml`.

    Raises:
      OSError: if a file cannot be written.
    """
    write_text(search.folder / "trials.csv", table(study, search).to_csv(index=False))
    if done := ranked(study):
        write_best(overrides_of(done[0], search), search, command)


def write_best(overrides: Sequence[str], search: Search, command: str) -> None:
    """Writes settings as a command and as a preset."""
    line = command_line(overrides, search, command)
    write_text(search.folder / "best.txt", f"{line}\n")
    settings = [
        override
        for override in [*search.fixed, *overrides]
        if override.partition("=")[0].partition(".")[0] not in HOW
    ]
    write_text(preset_file(search), f"# {line}\n{file_text(settings)}")


def print_table(study: optuna.Study, search: Search) -> None:
    """Prints the best trials, what mattered, and what pruning saved."""
    console, done, rows = Console(highlight=False), ranked(study), table(study, search)
    if not len(rows):
        return
    shown = Table(title=f"{search.study}: the best of {len(done)} trials that were not pruned")
    scores = ("mean", "worst") if search.config.seeds > 1 else ("mean",)
    for column in ("trial", *scores, "genera-\ntions", "training\nsteps"):
        shown.add_column(column, justify="right")
    shown.add_column("settings", no_wrap=True)
    for trial in done[:SHOWN]:
        kept = trial.user_attrs
        shown.add_row(
            str(trial.number),
            *(f"{kept[name]:.4g}" for name in scores),
            f"{kept['generations']:g}",
            f"{kept['cost']:,}",
            "\n".join(overrides_of(trial, search)),
        )
    console.print(shown)
    num_best = sum(trial.value == done[0].value for trial in done)
    if num_best > 1:
        console.print(f"{num_best} of {len(done)} share the best score: see docs/search.md.")
    begun = rows.dropna(subset=["generations"])  # those that were refused have none
    computed, most = begun["generations"].sum(), len(begun) * search.config.max_generations
    console.print(
        f"{(begun['state'] == 'pruned').sum()} of {len(begun)} trials were pruned; {computed:,.0f} "
        f"of {most:,} generations were run. Refused: {len(rows) - len(begun)}."
    )
    shares = importances(study, search)
    if shares:
        listed = ", ".join(f"{name} {share:.0%}" for name, share in shares.items())
        console.print(f"What mattered (PED-ANOVA): {listed}", soft_wrap=True)


def verified(study: optuna.Study, search: Search, runner: Runner) -> list[str]:
    """Tries the best settings again, as the best score of many is the luckiest too.

    Writes `verification.csv`, a row for each, and the best of them in the place of what `write`
    took for the best.

    Returns:
      The overrides of the settings that are the best now.

    Raises:
      ConfigError: if a folder is of other settings.
      OSError: if a file cannot be written.
    """
    rows: list[dict[str, Any]] = []
    with filelock.FileLock(search.folder / "verification.lock"):  # another worker may be at it
        for rank, trial in enumerate(ranked(study)[: search.num_verified], 1):
            overrides = overrides_of(trial, search)
            name = f"{trial.number:04d}-{search.config.fresh_seeds}"
            values = runner.verify(overrides, search.folder / "verified" / name)
            settings = " ".join([*search.fixed, *overrides])
            own = {"trial": trial.number, "rank": rank, "score": trial.value, "settings": settings}
            rows.append({**values, **own})
        rows.sort(key=runner.order)
        found = pd.DataFrame(rows)
        write_text(search.folder / "verification.csv", found.to_csv(index=False))
    print_verified(found, search)
    best = overrides_of(study.get_trials(deepcopy=False)[rows[0]["trial"]], search)
    write_best(best, search, runner.command)
    return best


def print_verified(rows: pd.DataFrame, search: Search) -> None:
    """Prints the rows of `verification.csv`, and for agents how the orders on both tasks agree."""
    console, numbers = Console(highlight=False), rows.drop(columns="settings")
    what = "fresh agents" if search.is_of_agent else f"{search.config.fresh_seeds} other seeds"
    shown = Table(title=f"the best {len(rows)}, again with {what}")
    for column in numbers:
        shown.add_column(str(column).replace("_", "\n"), justify="right")
    for row in numbers.itertuples(index=False):
        shown.add_row(*(f"{x:,.0f}" if abs(x) >= 1000 else f"{x:.4g}" for x in row))
    console.print(shown)
    returns = ["proxy_return", "real_return"]
    if len(rows) > 2 and set(returns) <= set(rows) and (rows[returns].nunique() > 1).all():
        agreed = rows[returns].corr(method="spearman").iloc[0, 1]
        console.print(f"Rank correlation of the two returns: {agreed:.2f}.")
