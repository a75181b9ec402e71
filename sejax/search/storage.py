"""The database of a study."""

import contextlib
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from typing import Any

import optuna
import sqlalchemy
import sqlalchemy.exc
from optuna.storages._rdb.models import TrialModel
from optuna.trial import TrialState

from sejax.errors import ConfigError, told
from sejax.search.settings import Search

GRACE = 4  # heartbeats that may be missed
ATTEMPTS = 3  # to open a storage, with a second between them
LONGEST_WAIT = 3600  # s, for another worker's write to SQLite; one that was stopped in it blocks


class Storage(optuna.storages.RDBStorage):
    """A storage of which no two workers get the same waiting trial, or fail the same running one.

    Optuna reads a trial's state, and then changes it, with a lock on its row meanwhile. SQLite has
    none: two workers that start together had the same trial 26 times of 30. Here both are one
    statement that looks by itself, on any database.
    """

    def set_trial_state_values(
        self, trial_id: int, state: TrialState, values: Sequence[float] | None = None
    ) -> bool:
        if state == TrialState.RUNNING:
            return self._move(trial_id, TrialState.WAITING, state, "datetime_start")
        is_failure = state == TrialState.FAIL and values is None
        if is_failure and self._move(trial_id, TrialState.RUNNING, state, "datetime_complete"):
            return True
        return super().set_trial_state_values(trial_id, state, values)

    def _move(self, trial_id: int, before: TrialState, after: TrialState, when: str) -> bool:
        """Whether the trial had that state, and has the other one from now on."""
        now = datetime.now(UTC).replace(tzinfo=None)  # as Optuna has it
        moved = (
            sqlalchemy.update(TrialModel)
            .where(TrialModel.trial_id == trial_id, TrialModel.state == before)
            .values(**{"state": after, when: now})
        )
        try:
            with self.engine.begin() as connection:
                return bool(connection.execute(moved).rowcount)
        except sqlalchemy.exc.SQLAlchemyError as error:
            raise optuna.exceptions.StorageInternalError(told(error)) from error


def open_storage(
    search: Search, on_stale: Callable[[optuna.Study, optuna.trial.FrozenTrial], None]
) -> "Storage":
    """The database of a search, made if it is not there.

    Args:
      search: what is searched.
      on_stale: called with a trial of which nothing was heard for `GRACE` heartbeats.

    Raises:
      ConfigError: if it cannot be used.
    """
    url, heartbeat = search.storage, search.config.heartbeat
    if search.config.storage is None:
        search.folder.mkdir(parents=True, exist_ok=True)
    options: dict[str, Any] = {"pool_pre_ping": True}
    if url.startswith("sqlite"):
        options = {"connect_args": {"timeout": LONGEST_WAIT}}
    attempts = ATTEMPTS
    while True:
        attempts -= 1
        try:
            with quietly():
                storage = Storage(
                    url,
                    engine_kwargs=options,
                    heartbeat_interval=heartbeat,
                    grace_period=GRACE * heartbeat,
                    heartbeat_stale_trial_callback=on_stale,
                )
            if url.startswith("sqlite"):
                with storage.engine.connect() as connection:  # shorter locks, and none for readers
                    connection.exec_driver_sql("PRAGMA journal_mode=WAL")
            return storage
        except sqlalchemy.exc.DatabaseError as error:  # another worker makes the tables just now
            if not attempts:
                raise unusable(search, error) from error
            time.sleep(1.0)
        except Exception as error:  # of SQLAlchemy, of any driver, or that there is none
            raise unusable(search, error) from error


def unusable(search: Search, error: Exception) -> ConfigError:
    """The error of a database that cannot be used, which does not tell its password."""
    cause = error.__cause__ or error
    fix = "Set storage=null for a file in search_dir."
    if isinstance(cause, ImportError) and search.storage.startswith("postgresql:"):
        fix = "Install its driver with pip install 'psycopg[binary]'."
    return ConfigError(
        f"storage must be a database that can be used, because the study is kept there; got "
        f"{search.storage.partition('://')[0]} ({told(cause)}). {fix}"
    )


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Without Optuna's warnings that heartbeats may change."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        yield
