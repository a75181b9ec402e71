"""The study of a search: its database, the loop in which a worker takes trials, and what is found.

Workers of a study share its folder. A worker holds a lock on its trial, which ends with its
process, however that ends; the next one that looks goes on with a trial whose lock is free.
"""

import contextlib
import logging
import math
import shlex
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import filelock
import numpy as np
import optuna
import pandas as pd
from optuna.distributions import BaseDistribution
from optuna.trial import Trial, TrialState
from sqlalchemy.exc import SQLAlchemyError

from sejax.ops.files import require_writable, write_text
from sejax.options import ConfigError, as_text, told
from sejax.runs.preset_files import file_text
from sejax.searching import trials
from sejax.searching.config import REDUCTION_FACTOR, Search
from sejax.searching.trials import Progress

STORED = "sejax"  # the study's attribute that holds what is searched
ATTEMPTS = 10  # at a trial whose workers are lost
LONGEST_WAIT_S = 3600  # for another worker's write to the database
UNUSABLE: tuple[type[Exception], ...] = (optuna.exceptions.OptunaError, SQLAlchemyError)
DAMAGED = (*UNUSABLE, KeyError, TypeError, ValueError)  # also of what a database holds
ENDED = (TrialState.COMPLETE, TrialState.PRUNED)
ATTRIBUTES = ("number", "state", "value", "user_attrs")  # of a trial, in tables
SHOWN = 10
HOW = ("seed", "devices", "num_parallel", "tracker")  # fields of how trials ran, no settings


@contextlib.contextmanager
def usable(search: Search, errors: tuple[type[Exception], ...] = UNUSABLE) -> Iterator[None]:
    """Within it, trouble with the database is told in one line.

    Raises:
      ConfigError: in the place of these errors.
    """
    try:
        yield
    except ConfigError:
        raise
    except errors as error:
        raise ConfigError(
            f"search_dir must hold a database that can be used; got {search.folder / 'study.db'} "
            f"({told(error.__cause__ or error)}). Set search_dir=FOLDER.",
            "search_dir",
        ) from error


def open_study(search: Search) -> optuna.Study:
    """Makes the study, whose first trial has the current settings, or opens it if it is there.

    Raises:
      ConfigError: if the folder cannot be used, or the study is one of another search.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    logging.getLogger("alembic").setLevel(logging.WARNING)
    config, current = search.config, search.current()
    require_writable("search_dir", search.folder)
    (search.folder / "trials").mkdir(parents=True, exist_ok=True)
    with _lock(search, "study"), usable(search, DAMAGED):
        study = optuna.create_study(
            study_name=search.study,
            storage=optuna.storages.RDBStorage(
                f"sqlite:///{search.folder / 'study.db'}",
                engine_kwargs={"connect_args": {"timeout": LONGEST_WAIT_S}},
            ),
            pruner=optuna.pruners.HyperbandPruner(
                config.min_generations, config.max_generations, REDUCTION_FACTOR
            ),
            direction="maximize",
            load_if_exists=True,
        )
        study.get_trials(deepcopy=False)  # reads all of it
        if STORED in study.user_attrs:
            search.require_same(study.user_attrs[STORED])
            return study
        first = {x.parameter: x.parameter_of(current[name]) for name, x in search.space.items()}
        if None not in first.values():
            study.enqueue_trial(first, skip_if_exists=True)
        study.set_user_attr(STORED, search.stored())
    return study


# --- trials ---------------------------------------------------------------------------------------


def work(study: optuna.Study, search: Search) -> None:
    """Takes trials until as many as asked for have ended.

    With several workers a few more may end, as each looks before it takes one.

    Raises:
      ConfigError, OSError: of a trial that cannot be written.
    """
    while True:
        with contextlib.ExitStack() as held:
            with _lock(search, "study"):
                trial = _claimed(study, search, held)
            if trial is None:
                return
            print(f"trial {trial.number}: {_computed(trial, search)}", flush=True)


def _claimed(study: optuna.Study, search: Search, held: contextlib.ExitStack) -> Trial | None:
    """A trial whose worker is lost, or a new one, with its lock held; None if enough have ended."""
    known = study.get_trials(deepcopy=False)
    space: dict[str, BaseDistribution] = {
        x.parameter: x.distribution for x in search.space.values()
    }
    for frozen in known:
        if frozen.state != TrialState.RUNNING:
            continue
        try:
            held.enter_context(_lock(search, _name(frozen.number), timeout=0))
        except filelock.Timeout:  # its worker is there
            continue
        attempts = frozen.user_attrs.get("attempts", 1)
        if attempts < ATTEMPTS:
            trial = Trial(study, frozen._trial_id)
            trial.set_user_attr("attempts", attempts + 1)
            for name, distribution in space.items():  # of which it may lack some
                trial._suggest(name, distribution)
            return trial
        study.tell(frozen.number, state=TrialState.FAIL)
    if sum(trial.state in ENDED for trial in known) >= search.config.trials:
        return None
    if not any(trial.state == TrialState.WAITING for trial in known):
        # Drawn at once: whoever is killed meanwhile leaves no half of it, and draws the same again.
        seed = np.random.SeedSequence([search.plain["seed"], len(known)]).generate_state(1)[0]
        draft = _copy(study)
        draft.sampler = optuna.samplers.TPESampler(seed=int(seed))
        study.enqueue_trial(draft.ask(space).params)
    trial = study.ask(space)
    held.enter_context(_lock(search, _name(trial.number)))
    return trial


def _copy(study: optuna.Study) -> optuna.Study:
    """A copy in memory, where trying leaves nothing."""
    copy = optuna.create_study(
        study_name=study.study_name, pruner=study.pruner, direction="maximize"
    )
    copy.add_trials(study.get_trials(deepcopy=False))
    return copy


def _is_behind(trial: Trial, rung: int) -> bool:
    """Whether a trial is pruned at a rung.

    The answer is kept before Optuna hears that the trial has come so far: it answers once.
    """
    study, name = trial.study, f"pruned_at_{rung}"
    if name not in trial.user_attrs:
        copy = _copy(study)
        trial.set_user_attr(name, study.pruner.prune(copy, copy.trials[trial.number]))
    trial.should_prune()
    return bool(trial.user_attrs[name])


def _computed(trial: Trial, search: Search) -> str:
    """Computes a trial rung by rung, until it is pruned or complete; what is said of it."""
    overrides, last = search.overrides(trial.params), search.config.max_generations
    study, folder = trial.study, search.folder / _name(trial.number)
    settings = shlex.join(overrides)
    trial.set_user_attr("settings", settings)
    try:
        run = _begun(search, overrides, folder)
    except ConfigError as error:  # settings that cannot work together
        trial.set_user_attr("refused", str(error))
        study.tell(trial, state=TrialState.PRUNED)
        return f"refused: {error}"
    num_reported = len(study.get_trials(deepcopy=False)[trial.number].intermediate_values)
    for rung in (rung for rung in search.config.rungs if rung >= num_reported):
        progress = run(rung)
        for step in range(num_reported + 1, rung + 1):
            trial.report(float(progress.scores[step - 1]), step)
        num_reported = rung
        if rung < last and not progress.is_over and _is_behind(trial, rung):
            break
    trial.set_user_attr("generations", progress.generations)
    trial.set_user_attr("train_steps", progress.train_steps)
    score = float(progress.scores[-1])
    if rung == last and math.isfinite(score):
        study.tell(trial, score)
    else:
        study.tell(trial, state=TrialState.PRUNED)
    return f"{score:.4g} after {progress.generations:g} of {last} generations: {settings}"


def _begun(search: Search, overrides: Sequence[str], folder: Path) -> Callable[[int], Progress]:
    """What computes a trial up to a generation."""
    config = search.trial_config(overrides)
    if search.is_of_agent:
        return trials.tuning(config, search.config.seeds)
    return trials.learning(config, folder, range(search.config.seeds))


def _name(number: int) -> str:
    return f"trials/{number:04d}"


def _lock(search: Search, name: str, timeout: float = -1) -> filelock.FileLock:
    return filelock.FileLock(search.folder / f"{name}.lock", timeout=timeout)


# --- what is found --------------------------------------------------------------------------------


def report(study: optuna.Study, search: Search) -> None:
    """Prints and writes what was found; the best settings are tried again.

    Raises:
      OSError: if a file cannot be written.
    """
    rows = study.trials_dataframe(ATTRIBUTES)
    rows = rows.rename(columns=lambda name: name.removeprefix("user_attrs_"))
    write_text(search.folder / "trials.csv", rows.to_csv(index=False))
    best = rows[rows["state"] == "COMPLETE"]
    if best.empty:
        print("No trial was completed.")
        return
    best = best[["number", "value", "generations", "train_steps", "settings"]]
    best = best.sort_values(["value", "train_steps"], ascending=[False, True], kind="stable")
    print(f"\nThe best of {len(rows)} trials, of which {len(best)} are complete:")
    print(best.head(SHOWN).to_string(index=False))
    if search.config.verify:
        best = verified(study, search, best.head(search.config.verify))
    line = write_best(_overrides(study, search, best["number"].iloc[0]), search)
    # A module that a file names is not imported, so it is typed beside it.
    typed = [word for word in search.fixed if ":" in word]
    preset = f"preset={as_text(str(search.folder / 'preset.yaml'))}"
    print(f"\nThe best:\n  {line}")
    print(f"The same:\n  {shlex.join(['python', '-m', search.command, preset, *typed])}")
    print(f"{search.folder} holds trials.csv, best.txt and preset.yaml.", flush=True)


def verified(study: optuna.Study, search: Search, best: pd.DataFrame) -> pd.DataFrame:
    """Tries settings again, as the best score of many is the luckiest too.

    Writes `verification.csv`, a row for each. What has been tried is kept with the study.

    Returns:
      The rows, the best ones first.
    """
    rows = []
    with _lock(search, "verification"):  # another worker may be at it
        for row in best.drop(columns=["generations", "train_steps"]).to_dict("records"):
            name = f"verified/{row['number']:04d}-{search.config.fresh_seeds}"
            if name not in study.user_attrs:
                overrides = _overrides(study, search, row["number"])
                study.set_user_attr(name, _tried_again(search, overrides, search.folder / name))
            rows.append({**row, **study.user_attrs[name]})
    order = ["verified", "verified_cost"]
    found = pd.DataFrame(rows).sort_values(order, ascending=[False, True], kind="stable")
    write_text(search.folder / "verification.csv", found.to_csv(index=False))
    print(f"\nThe best {len(found)}, tried again:\n{found.to_string(index=False)}")
    returns = ["proxy_return", "real_return"]
    if len(found) > 2 and {*returns} <= {*found} and (found[returns].nunique() > 1).all():
        agreed = found[returns].corr(method="spearman").iloc[0, 1]
        print(f"Rank correlation of the two returns: {agreed:.2f}.")
    return found


def _overrides(study: optuna.Study, search: Search, number: int) -> list[str]:
    """The settings of a trial; of what a study stores only values of searched fields are used."""
    return search.overrides(study.get_trials(deepcopy=False)[number].params)


def _tried_again(search: Search, overrides: Sequence[str], folder: Path) -> dict[str, float]:
    """What settings are worth with seeds that no trial has had, and what that costs."""
    own, config = search.config, search.trial_config(overrides)
    if search.is_of_agent:
        return trials.tested(config, own.max_generations)
    fresh = range(own.seeds, own.seeds + own.fresh_seeds)
    progress = trials.learning(config, folder, fresh)(own.max_generations)
    return {"verified": float(progress.scores[-1]), "verified_cost": progress.generations}


def write_best(overrides: Sequence[str], search: Search) -> str:
    """Writes settings as a command, which is returned, and as a preset."""
    words = [*search.fixed, *overrides]
    line = shlex.join(["python", "-m", search.command, *words])
    write_text(search.folder / "best.txt", f"{line}\n")
    settings = [x for x in words if x.partition("=")[0].partition(".")[0] not in HOW]
    write_text(search.folder / "preset.yaml", f"# {line}\n{file_text(settings)}")
    return line
