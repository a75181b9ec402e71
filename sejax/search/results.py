"""What a search found: a table, what mattered, what it cost, and the best to go on with."""

import shlex
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import optuna
from optuna.trial import FrozenTrial, TrialState

from sejax import registry
from sejax.cli.words import file_text, word
from sejax.ops.files import atomic_path, write_text
from sejax.search.settings import Search

SHOWN = 10
NEEDED = 10  # completed trials, before importances say anything
HOW = (
    "seed",
    "devices",
    "num_parallel",
    "tracker",
)  # fields of how trials ran, which are no settings
NUMBER = (24, 12)  # pixels of a number in the picture
ENDED = (TrialState.COMPLETE, TrialState.PRUNED)


def ranked(study: optuna.Study) -> list[FrozenTrial]:
    """Completed trials, the best first; of equal ones that which cost less."""
    done = [t for t in study.get_trials(deepcopy=False) if t.state == TrialState.COMPLETE]
    return sorted(done, key=lambda trial: (-float(trial.value or 0.0), trial.user_attrs["cost"]))


def num_best(trials: Sequence[FrozenTrial]) -> int:
    """How many of ranked trials are as good as the best."""
    return sum(trial.value == trials[0].value for trial in trials)


def words_of(trial: FrozenTrial, search: Search) -> list[str]:
    """The overrides that make the trial's settings."""
    return [f"{name}={x.of(trial.params)}" for name, x in search.space.items()]


def preset_file(search: Search) -> Path:
    """Where the best settings are, for `preset=`."""
    return search.folder / "preset.yaml"


def override_line(words: Sequence[str], search: Search, command: str) -> str:
    """The command that runs with these settings."""
    return shlex.join(["python", "-m", command, *search.fixed, *words])


def preset_line(search: Search, command: str) -> str:
    """The command that reads these settings from their file."""
    preset = f"preset={word(str(preset_file(search)))}"
    own = [
        text for text in search.fixed if registry.paths_in([text])
    ]  # no file is believed in these
    return shlex.join(["python", "-m", command, preset, *own])


def table(study: optuna.Study, search: Search) -> Any:
    """A row for each trial that ended, as a data frame."""
    import pandas as pd

    rows = []
    for trial in study.get_trials(deepcopy=False):
        if trial.state in ENDED:
            kept = trial.user_attrs
            rows.append(
                {
                    "trial": trial.number,
                    "state": trial.state.name.lower(),
                    **{
                        name: kept.get(name)
                        for name in ("mean", "worst", "generations", "cost", "seconds")
                    },
                    **{
                        name: x.of(trial.params)
                        for name, x in search.space.items()
                        if x.parameter in trial.params
                    },
                }
            )
    return pd.DataFrame(rows)


def saved_by_pruning(rows: Any, search: Search) -> str:
    """A sentence on the generations that pruned trials did not run; what was refused had none."""
    begun = rows.dropna(subset=["generations"])
    pruned, most = begun[begun["state"] == "pruned"], search.config.max_generations
    saved, all_of_them = len(pruned) * most - pruned["generations"].sum(), len(begun) * most
    num_refused = len(rows) - len(begun)
    refused = f" Refused: {num_refused}." if num_refused else ""
    return (
        f"{len(pruned)} of {len(begun)} trials were pruned, which saved {saved:,.0f} of "
        f"{all_of_them:,} generations "
        f"({saved / max(all_of_them, 1):.0%}).{refused}"
    )


def equally_good(trials: Sequence[FrozenTrial], search: Search) -> str:
    """A sentence on ranked trials that share the best score, and what may tell them apart."""
    sentence = f"{num_best(trials)} of {len(trials)} share the best score."
    if search.is_of_agent:
        return (
            f"{sentence} Agents that train for less on the proxy may differ: training_from="
            f"config training.stop_rule=never training.max_steps=1000"
        )
    hint = " To reward learning early: measure=mean" if search.measure != "mean" else ""
    return sentence + hint


def importances(study: optuna.Study, search: Search) -> dict[str, float]:
    """The share of each field in what makes scores differ, the largest first; by PED-ANOVA.

    Empty where fewer than ten trials are complete, half of them equally good, or fewer than two
    fields searched. Pruned trials are left out, so that it is about the better settings.

    Source: Watanabe et al., 2023, "PED-ANOVA" (Optuna's default).
    """
    done = ranked(study)
    if len(done) < NEEDED or 2 * num_best(done) >= len(done) or len(search.space) < 2:
        return {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # fields that all good trials have alike
        found = optuna.importance.get_param_importances(study)
    names = {x.parameter: name for name, x in search.space.items()}
    return {names[parameter]: share for parameter, share in found.items() if parameter in names}


def pareto_front(rows: Any, score: str) -> Any:
    """The rows that none beats in score at the same cost or less, by cost."""
    ordered = rows.dropna(subset=[score]).sort_values(["cost", score], ascending=[True, False])
    before = ordered[score].cummax().shift(fill_value=float("-inf"))
    return ordered[ordered[score] > before]


def draw_pareto(rows: Any, search: Search, path: Path) -> None:
    """Draws score against cost, a point for each trial, and the front."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    from sejax.cli.plots import INCUMBENT, POPULATION

    score = search.config.score
    front = pareto_front(rows, score)
    with plt.rc_context({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False}):
        figure, axis = plt.subplots(figsize=(7, 4.2), layout="constrained")
        for state, color in (("pruned", "0.6"), ("complete", INCUMBENT)):
            some = rows[(rows["state"] == state) & rows[score].notna()]
            axis.plot(
                some["cost"],
                some[score],
                "o",
                ms=5,
                mew=0,
                alpha=0.75,
                color=color,
                label=f"{state} ({len(some)})",
            )
        axis.step(
            front["cost"],
            front[score],
            where="post",
            color=POPULATION,
            lw=1.4,
            label="best for its cost, with numbers",
        )
        axis.set_xscale("log")
        figure.draw_without_rendering()  # which lays the axes out
        places = axis.transData.transform(front[["cost", score]])
        named: list[Any] = []
        for place, (_, row) in reversed(list(zip(places, front.iterrows(), strict=True))):
            if all((abs(place - other) > NUMBER).any() for other in named):
                axis.annotate(
                    f"{row['trial']:.0f}",
                    (row["cost"], row[score]),
                    fontsize=8,
                    textcoords="offset points",
                    xytext=(4, -10),
                )
                named.append(place)
        axis.set_xlabel("training steps of all agents of the trial")
        many = f", {score} of {search.config.seeds} seeds" if search.config.seeds > 1 else ""
        axis.set_ylabel(f"score ({search.measure} of generations{many})")
        axis.legend(frameon=False, fontsize=9, loc="best")
        with atomic_path(path) as temporary:
            figure.savefig(temporary, dpi=150)
        plt.close(figure)


def write(study: optuna.Study, search: Search, command: str) -> list[str]:
    """Writes the files of what was found.

    `trials.csv`, `pareto.png`, and of the best trial `best.txt` and `preset.yaml`.

    Returns:
      The best trial's overrides; empty if none is complete.
    """
    rows = table(study, search)
    write_text(search.folder / "trials.csv", rows.to_csv(index=False))
    if len(rows) and rows[search.config.score].notna().any():
        draw_pareto(rows, search, search.folder / "pareto.png")
    done = ranked(study)
    if not done:
        return []
    words = words_of(done[0], search)
    write_best(words, search, command)
    return words


def write_best(words: Sequence[str], search: Search, command: str) -> None:
    """Writes the settings as a command and as a preset."""
    line = override_line(words, search, command)
    write_text(search.folder / "best.txt", line + "\n")
    settings = [
        word
        for word in [*search.fixed, *words]
        if word.partition("=")[0].partition(".")[0] not in HOW
    ]
    write_text(preset_file(search), f"# {line}\n{file_text(settings)}")


def print_table(study: optuna.Study, search: Search) -> None:
    """Prints the best trials, what mattered, and what pruning saved."""
    from rich.console import Console
    from rich.table import Table

    console, done = Console(highlight=False), ranked(study)
    shown = Table(
        title=f"{search.study}: the best {min(SHOWN, len(done))} of {len(done)} trials "
        "that were not pruned"
    )
    scores = ("mean", "worst") if search.config.seeds > 1 else ("mean",)
    for column in ("trial", *scores, "genera-\ntions", "training\nsteps"):
        shown.add_column(column, justify="right")
    shown.add_column("settings", no_wrap=True)
    for trial in done[:SHOWN]:
        kept = trial.user_attrs
        shown.add_row(
            str(trial.number),
            *(f"{kept[name]:.4g}" for name in scores),
            str(kept["generations"]),
            f"{kept['cost']:,}",
            "\n".join(f"{name}={x.shown(trial.params)}" for name, x in search.space.items()),
        )
    console.print(shown)
    if done and num_best(done) > 1:
        console.print(equally_good(done, search), soft_wrap=True)
    rows = table(study, search)
    if len(rows):
        console.print(saved_by_pruning(rows, search))
    shares = importances(study, search)
    if shares:
        listed = ", ".join(f"{name} {share:.0%}" for name, share in shares.items())
        console.print(f"What mattered (PED-ANOVA): {listed}", soft_wrap=True)
