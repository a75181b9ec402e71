"""The study of a search: its storage, and the loop in which a worker takes one trial after another.

Workers of a study share its database alone. Each shows by heartbeats that it lives. Optuna fails a
trial whose worker has not done so for some time, and queues it again under a new number.
"""

import contextlib
import logging
import math
import shutil
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import filelock
import numpy as np
import optuna
from optuna.exceptions import ExperimentalWarning, TrialPruned, UpdateFinishedTrialError
from optuna.storages import RDBStorage, RetryHeartbeatStaleTrialCallback
from optuna.trial import FrozenTrial, Trial, TrialState

from sejax.ops.files import require_writable
from sejax.options import ConfigError, shortened, told
from sejax.searching.config import REDUCTION_FACTOR, SQLITE, Search
from sejax.searching.trials import Progress, Runner, worth

STORED = "sejax"  # the study's attribute that holds what is searched
RETRIES = 3  # of a trial whose worker was lost
GRACE = 4  # heartbeats that may be missed
LONGEST_WAIT_S = 3600  # for another worker's write to SQLite
ENDED = (TrialState.COMPLETE, TrialState.PRUNED)


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """Without Optuna's warnings that heartbeats may change."""
    with warnings.catch_warnings(action="ignore", category=ExperimentalWarning):
        yield


@_quietly()
def open_study(search: Search, current: Mapping[str, object] | None = None) -> optuna.Study:
    """Makes the study, or opens it if it is there.

    Args:
      search: what is searched.
      current: values of the searched fields that a new study tries first: they are to be beaten.
        Not tried if one of them is not among what is searched.

    Raises:
      ConfigError: if the storage cannot be used, or the study is one of another search.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    logging.getLogger("alembic").setLevel(logging.WARNING)
    one_by_one: contextlib.AbstractContextManager[object] = contextlib.nullcontext()
    if search.config.storage is None:  # or two workers would make the tables of a new file
        require_writable("search_dir", search.folder)
        search.folder.mkdir(parents=True, exist_ok=True)
        one_by_one = filelock.FileLock(search.folder / "study.lock")
    with one_by_one:
        study = optuna.create_study(
            study_name=search.study,
            storage=_storage(search),
            pruner=_pruner(search),
            direction="maximize",
            load_if_exists=True,
        )
        if STORED in study.user_attrs:
            search.require_same(study.user_attrs[STORED])
            return study
        study.set_user_attr(STORED, search.stored())
    values = current or {}
    first = {x.parameter: x.parameter_of(values.get(name)) for name, x in search.space.items()}
    if values and None not in first.values():
        study.enqueue_trial(first, skip_if_exists=True)
    return study


@_quietly()
def work(
    study: optuna.Study, search: Search, runner: Runner, say: Callable[[str], None] = print
) -> None:
    """Takes trials until as many as asked for have ended.

    With several workers a few more may end, as each looks before it takes one.

    Raises:
      KeyboardInterrupt: after queueing the trial at hand again, as after the following.
      ConfigError, OSError: of a trial that cannot be written.
    """
    started, objective = time.monotonic(), _Objective(search, runner)
    timeout = math.inf if search.config.timeout is None else search.config.timeout
    while time.monotonic() - started < timeout:
        trials = study.get_trials(deepcopy=False)
        if sum(trial.state in ENDED for trial in trials) >= search.config.trials:
            return
        study.sampler = _sampler(search, trials)
        objective.number, objective.error = None, None
        try:
            study.optimize(
                objective, n_trials=1, callbacks=[lambda _, trial: say(sentence(trial, search))]
            )
        except optuna.exceptions.StorageInternalError as error:
            raise _unusable(search, error) from error
        except (Exception, KeyboardInterrupt):
            number, own = objective.number, objective.error
            if number is None:  # Optuna could not begin one
                raise
            if own is not None:
                RetryHeartbeatStaleTrialCallback(RETRIES)(study, study.trials[number])
                raise own from None
            say(f"trial {number}: was taken for dead and is another worker's now")


class _Objective:
    """What Optuna calls for a trial.

    Attributes:
      number: of the last trial.
      error: what it has raised, if it shall be tried again.
    """

    def __init__(self, search: Search, runner: Runner):
        self._search, self._runner = search, runner
        self.number: int | None = None
        self.error: BaseException | None = None

    def __call__(self, trial: Trial) -> float:
        self.number = trial.number
        try:
            return self._score(trial)
        except (TrialPruned, UpdateFinishedTrialError):
            raise
        except BaseException as error:
            self.error = error
            raise

    def _score(self, trial: Trial) -> float:
        overrides = [dimension.suggest(trial) for dimension in self._search.space.values()]
        try:
            config = self._runner.config(overrides)
        except ConfigError as error:  # settings that cannot work together
            trial.set_user_attr("refused", str(error))
            raise TrialPruned from error
        folder = trial_folder(self._search, trial.number)
        folder.parent.mkdir(parents=True, exist_ok=True)
        # Two workers may draw the same trial from SQLite: the second waits, and finds it done.
        with filelock.FileLock(folder.with_suffix(".lock")):
            _take_over(folder, self._search, trial)
            num_reported = 0
            for rung in self._search.rungs:
                progress = self._runner.run(config, folder, rung)
                for step in range(num_reported + 1, rung + 1):
                    trial.report(self._worth(progress, step), step)
                num_reported = rung
                # Asked at the last rung too, so that the pruner knows of it.
                is_behind = trial.should_prune() and not progress.is_over
                if is_behind and rung < self._search.config.max_generations:
                    break
            self._keep(trial, progress, rung)
        score = self._worth(progress, rung)
        if rung < self._search.config.max_generations or not math.isfinite(score):
            raise TrialPruned
        return score

    def _worth(self, progress: Progress, step: int) -> float:
        return worth(progress, step, self._search)[self._search.config.score]

    def _keep(self, trial: Trial, progress: Progress, step: int) -> None:
        """Keeps with the trial what the table says of it."""
        values = {
            **worth(progress, step, self._search),
            "generations": progress.generations,
            "cost": progress.cost,
            "seconds": round(progress.seconds, 1),
        }
        for name, value in values.items():
            trial.set_user_attr(name, value if np.isfinite(value) else None)


def trial_folder(search: Search, number: int) -> Path:
    return search.folder / "trials" / f"{number:04d}"


def sentence(trial: FrozenTrial, search: Search) -> str:
    """What is said of a trial that has ended."""
    kept = trial.user_attrs
    if "refused" in kept:
        return f"trial {trial.number}: refused: {kept['refused']}"
    score = kept.get(search.config.score)
    shown = "not finite" if score is None else f"{score:.4g}"
    overrides = " ".join(x.override(trial.params) for x in search.space.values())
    return (
        f"trial {trial.number}: {shown} after {kept['generations']:g} of "
        f"{search.config.max_generations} generations: {overrides}"
    )


def _take_over(folder: Path, search: Search, trial: Trial) -> None:
    """Copies the folder of the trial that this one is queued in the place of, if it is here.

    A copy, as a process that was only slow may still write to the other one.
    """
    frozen = trial.study.get_trials(deepcopy=False)[trial.number]
    history = RetryHeartbeatStaleTrialCallback.retry_history(frozen)
    found = [trial_folder(search, number) for number in reversed(history)]
    before = next((path for path in found if path.is_dir()), None)
    if before is None or folder.exists():
        return
    partial = folder.with_name(f"{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    with contextlib.suppress(shutil.Error):  # a file was replaced meanwhile: the trial begins anew
        shutil.copytree(before, partial, ignore=shutil.ignore_patterns("*.lock", ".*"))
        partial.rename(folder)


def _sampler(search: Search, trials: Sequence[FrozenTrial]) -> optuna.samplers.BaseSampler:
    """The sampler of the next trial: with a seed, a search that was stopped draws the same.

    What is queued again is no new draw.
    """
    seed = search.config.sampler_seed
    if seed is not None:
        retried = RetryHeartbeatStaleTrialCallback.retried_trial_number
        drawn = sum(retried(trial) is None for trial in trials)
        seed = int(np.random.SeedSequence([seed, drawn]).generate_state(1)[0])
    if search.config.sampler == "random":
        return optuna.samplers.RandomSampler(seed=seed)
    return optuna.samplers.TPESampler(seed=seed)


def _pruner(search: Search) -> optuna.pruners.BasePruner:
    config = search.config
    match config.pruner:
        case "hyperband":
            return optuna.pruners.HyperbandPruner(
                config.min_generations, config.max_generations, REDUCTION_FACTOR
            )
        case "median":
            return optuna.pruners.MedianPruner(n_warmup_steps=config.min_generations)
    return optuna.pruners.NopPruner()


def _storage(search: Search) -> RDBStorage:
    """The database of a search, made if it is not there.

    Raises:
      ConfigError: if it cannot be used.
    """
    is_file, heartbeat = search.storage.startswith(SQLITE), search.config.heartbeat
    options = {"connect_args": {"timeout": LONGEST_WAIT_S}} if is_file else {}
    try:
        return RDBStorage(
            search.storage,
            engine_kwargs={"pool_pre_ping": True, **options},
            heartbeat_interval=heartbeat,
            grace_period=GRACE * heartbeat,
            heartbeat_stale_trial_callback=RetryHeartbeatStaleTrialCallback(RETRIES),
        )
    except Exception as error:  # of SQLAlchemy, of any driver, or that there is none
        raise _unusable(search, error) from error


def _unusable(search: Search, error: Exception) -> ConfigError:
    """The error of a database that cannot be used, which does not tell its password."""
    field = "search_dir" if search.config.storage is None else "storage"
    cause = error.__cause__ or error
    fix = "Set storage=null for a file in search_dir, or search_dir=FOLDER."
    if isinstance(cause, ImportError) and search.storage.startswith("postgresql:"):
        fix = "Install its driver with pip install 'psycopg[binary]'."
    return ConfigError(
        f"{field} must hold a database that can be used; got "
        f"{shortened(search.storage.partition('://')[0])} ({told(cause)[:150]}). {fix}",
        field,
    )
