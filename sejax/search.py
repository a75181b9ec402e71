"""`python -m sejax.search`: search hyperparameters with Optuna.

A trial is a run, whose generations are the budget; the same command goes on where it stopped.
"""

from collections.abc import Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING

from sejax.options import ConfigError
from sejax.runs import commands, runtime

if TYPE_CHECKING:
    from sejax.searching.config import Search


def main(overrides: Sequence[str]) -> None:
    """Searches as the overrides say.

    Raises:
      ConfigError: for overrides or a study that cannot be searched, or without Optuna.
      OSError: if a file cannot be written.
    """
    if find_spec("optuna") is None:
        raise ConfigError("sejax.search needs Optuna. Install it with pip install 'sejax[search]'.")
    from sejax.searching import config as search_config
    from sejax.searching import results as search_results

    search = search_config.read(overrides)
    try:
        command, settings = _study(search)
    except KeyboardInterrupt as stop:
        message = (
            f"Interrupted. What has ended is saved in {search.folder}; the same command goes on "
            f"from there."
        )
        commands.interrupted(message, stop)
    if not settings:
        _say("No trial was completed.")
        return
    _say(f"\nThe best:\n  {search_results.command_line(settings, search, command)}")
    _say(f"The same:\n  {search_results.preset_line(search, command)}")
    _say(f"{search.folder} holds trials.csv, best.txt and preset.yaml.")


def _study(search: "Search") -> tuple[str, list[str]]:
    """Works on the study of a search.

    Returns:
      The command that repeats the best trial, and the overrides of its settings; none if no trial
      was completed.
    """
    from sejax.runs.workers import RayConfig
    from sejax.searching import (
        config as search_config,
    )
    from sejax.searching import (
        results as search_results,
    )
    from sejax.searching import (
        study,
    )
    from sejax.searching import (
        workers as search_workers,
    )
    from sejax.searching.trials import runner_of

    runner = runner_of(search)
    current = search_config.require_fields(search, runner.config([]))
    found = study.open_study(search, current)
    runtime.configure_jax()
    _say(f"Study {search.study} in {search.folder}: {', '.join(search.space)}.")
    if isinstance(search.machines, RayConfig):
        search_workers.work(found, search, search.machines, _say)
    else:
        study.work(found, search, runner, _say)
    search_results.write(found, search, runner.command)
    search_results.print_table(found, search)
    best = search_results.ranked(found)
    if not best:
        return runner.command, []
    settings = search_results.overrides_of(best[0], search)
    if search.num_verified:
        settings = search_results.verified(found, search, runner)
    return runner.command, settings


def _say(text: str) -> None:
    print(text, flush=True)


def help_text(overrides: Sequence[str]) -> str:
    """What `--help` prints."""
    if find_spec("optuna") is None:
        return f"{__doc__}\nIt needs pip install 'sejax[search]'."
    from sejax.searching import config as search_config

    return search_config.help_text()


if __name__ == "__main__":
    commands.start(main, help_text)
