"""Search hyperparameters with Optuna. A trial is a run; its budget is a number of generations.

  python -m sejax.search env=cartpole es.noise_std='tag(log, interval(0.01, 0.3))'
  python -m sejax.search env=cartpole preset=paper space=paper_se trials=60

The same command resumes a stopped study, or adds a worker to a running one. Values to search are
choice(a,b), range(1,9,2), interval(0,1), int(interval(1,10)) and tag(log, ...);
tag(log, inverse, ...) is logarithmic in 1 - x. All other overrides than the fields below go to
python -m sejax.run, also those of preset=FILE.yaml, but for its generations, seeds and folders.
"""

from collections.abc import Sequence

from sejax.options import ConfigError, require_package, told
from sejax.options.plain import to_plain
from sejax.runs import commands


def main(overrides: Sequence[str]) -> None:
    """Searches as the overrides say.

    Raises:
      ConfigError: for overrides or a study that cannot be searched, or without Optuna.
      OSError: if a file cannot be written.
    """
    require_package("sejax.search", "optuna", "search")
    from sejax.search import config, study

    plan = config.plan_of(overrides)
    plan.default.task()  # raises if this machine cannot make it, before any trial is refused
    try:
        current = study.open_study(plan)
        print(f"Study {plan.study_name} in {plan.folder}: {', '.join(plan.space)}.", flush=True)
        study.work(current, plan)
        study.report(current, plan)
    except study.UNUSABLE as error:
        got = f"{plan.folder / 'study.db'} ({told(error.__cause__ or error)})"
        raise ConfigError("search_dir", f"must hold a database; got {got}", use="FOLDER") from error


def help_text(overrides: Sequence[str]) -> str:
    """What `--help` prints."""
    require_package("sejax.search", "optuna", "search")
    from sejax.search.config import StudyConfig

    lines = commands.field_lines(to_plain(StudyConfig()), [("", StudyConfig)], {})
    return f"{__doc__}\nFields, with their defaults:\n{lines}"


if __name__ == "__main__":
    commands.start(main, help_text)
