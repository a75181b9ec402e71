"""`python -m sejax.search`: search hyperparameters with Optuna.

A trial is a run, whose generations are the budget; the same command goes on where it stopped.
"""

from collections.abc import Sequence
from importlib.util import find_spec

from sejax.options import ConfigError
from sejax.runs import commands, runtime


def main(overrides: Sequence[str]) -> None:
    """Searches as the overrides say.

    Raises:
      ConfigError: for overrides or a study that cannot be searched, or without Optuna.
      OSError: if a file cannot be written.
    """
    if find_spec("optuna") is None:
        raise ConfigError("sejax.search needs Optuna. Install it with pip install 'sejax[search]'.")
    from sejax.searching import config, study

    search = config.read(overrides)
    with study.usable(search):
        current = study.open_study(search)
        runtime.configure_jax()
        print(f"Study {search.study} in {search.folder}: {', '.join(search.space)}.", flush=True)
        try:
            study.work(current, search)
            study.report(current, search)
        except KeyboardInterrupt as stop:
            message = (
                f"Interrupted. What has ended is saved in {search.folder}; the same command goes "
                "on from there."
            )
            commands.interrupted(message, stop)


def help_text(overrides: Sequence[str]) -> str:
    """What `--help` prints."""
    if find_spec("optuna") is None:
        return f"{__doc__}\nIt needs pip install 'sejax[search]'."
    from sejax.searching import config

    return config.help_text()


if __name__ == "__main__":
    commands.start(main, help_text)
