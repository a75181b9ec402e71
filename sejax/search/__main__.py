"""`python -m sejax.search`: the command."""

from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

import filelock

from sejax.cli import commands, runtime
from sejax.errors import ConfigError
from sejax.search import settings
from sejax.search.settings import Search


def main(words: Sequence[str]) -> None:
    """Searches as the words say; the same words go on where it stopped.

    Raises:
      ConfigError: for words or a study that cannot be searched, or without Optuna.
      OSError: if a file cannot be written.
    """
    search = settings.read(words)
    if find_spec("optuna") is None:
        raise ConfigError(
            "sejax.search needs Optuna, because it decides what is tried. Install it "
            "with pip install 'sejax[search]'."
        )
    from sejax.search import results, study

    usual = None
    if not search.names_study_alone:  # before a study is made of it
        config = study.runner_of(search).config([])
        settings.require_fields(search, config)
        usual = settings.fields_of(search, config)
    found, search = study.open_study(search, usual)
    runner = study.runner_of(search)
    runtime.configure_jax()
    print(f"Study {search.study} in {search.folder}: {', '.join(search.space)}.", flush=True)
    try:
        if search.machines.is_elsewhere:
            from sejax.search import cluster

            cluster.work(found, search, _say)
        else:
            study.work(found, search, runner, _say)
    except KeyboardInterrupt:
        print(
            f"Interrupted. What has ended is saved in {search.folder}, and the trial at hand is "
            f"queued again; the same command goes on from there."
        )
        commands.leave(commands.INTERRUPTED)
    best = results.write(found, search, runner.command)
    results.print_table(found, search)
    if not best:
        print("No trial was completed.")
        return
    if search.num_verified:
        best = _verified(found, search, runner) or best
    print(f"\nThe best:\n  {results.override_line(best, search, runner.command)}")
    print(f"The same:\n  {results.preset_line(search, runner.command)}")
    print(f"{search.folder}/trials.csv, pareto.png, best.txt and preset.yaml hold what was found.")


def _say(text: str) -> None:
    print(text, flush=True)


def _verified(found: Any, search: Search, runner: Any) -> list[str]:
    """The overrides of those that were best when they were tried again.

    Empty if another worker is at it.
    """
    from sejax.search import results, verification

    lock = filelock.FileLock(search.folder / "verification.lock", timeout=0)
    try:
        lock.acquire()
    except filelock.Timeout:
        print("Another worker is at it to try the best ones again.")
        return []
    try:
        table = verification.verify(found, search, runner)
    except KeyboardInterrupt:
        print(
            f"Interrupted. Those of the best that were tried again are in {search.folder}; the "
            f"same command goes on with the others."
        )
        commands.leave(commands.INTERRUPTED)
    finally:
        lock.release()
    verification.print_table(table, search)
    best = found.get_trials(deepcopy=False)[int(table["trial"].iloc[0])]
    words = results.words_of(best, search)
    results.write_best(words, search, runner.command)
    return words


if __name__ == "__main__":
    commands.start_with_words(main, settings.help_text())
