"""A folder of results, with which a computation of the same settings goes on after a kill.

Each entry is one file, `NAME.safetensors`, with a checksum and the settings that it was made with.
It is written to a temporary file, put on the disk, and renamed over the previous entry. So a kill
at any moment leaves a whole entry, the new or the previous one.
"""

import contextlib
import json
import os
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, Self, TypeAlias

import filelock
import numpy as np

from sejax.ops import checksummed
from sejax.ops.files import missing, remove_empty, write_bytes
from sejax.options import ConfigError, shortened
from sejax.options.plain import differences

Plain: TypeAlias = Mapping[str, Any]  # plain values in nested mappings
Tensors: TypeAlias = Mapping[str, np.ndarray]  # by name
# In all files since the first release.
KIND = "sejax_run"
FORMAT_VERSION = 1
LOCK = "sejax.lock"  # the file that a process locks while it uses the folder


class Store:
    """Entries of the same settings in a folder; within `with`, only this process may use it.

    Args:
      folder: the folder, made with the first entry or lock.
      settings: what all entries depend on.
      field: the field that names the folder, for messages.
      free: groups and fields of the first level that may differ: they say how to compute, not what.

    Attributes:
      settings: the settings as they are stored, with lists for tuples.

    Example:
      >>> import tempfile
      >>> folder = Path(tempfile.mkdtemp())
      >>> with Store(folder, {"seed": 0}) as store:
      ...     store.put("rounds", {"x": np.arange(2)}, count=2)
      >>> Store(folder, {"seed": 0}).get("rounds")
      ({'x': array([0, 1])}, {'count': 2})
      >>> Store(folder, {"seed": 1}).get("rounds")  # doctest: +IGNORE_EXCEPTION_DETAIL
      Traceback (most recent call last):
      sejax.options.ConfigError: run_dir must be new ... seed (0 there, 1 here). Set run_dir=FOLDER.
    """

    def __init__(
        self, folder: Path, settings: Plain, *, field: str = "run_dir", free: Collection[str] = ()
    ):
        self.folder = folder
        self.settings: dict[str, Any] = json.loads(json.dumps(settings))
        self._field = field
        self._free = free
        self._lock = filelock.FileLock(folder / LOCK, timeout=0, thread_local=False)
        self._has_entry = False

    def __enter__(self) -> Self:
        """Makes the folder and locks it; the lock ends with the process, even if it is killed.

        Raises:
          ConfigError: if another process uses it, or it cannot be written.
        """
        self._new_folders = missing(self.folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock.acquire()
            self._locked = os.stat(self.folder / LOCK)
        except (OSError, ValueError, NotImplementedError) as error:
            is_used = isinstance(error, filelock.Timeout)
            why = "which another process uses" if is_used else shortened(error)
            got = f"{shortened(self.folder)}, {why}"
            raise self.refused(f"must be a folder that can be written; got {got}") from error
        return self

    def __exit__(self, *_: object) -> None:
        """Unlocks the folder; if it has no entry, removes what `with` has made."""
        if self._is_held() and not self._has_entry:
            (self.folder / LOCK).unlink(missing_ok=True)
            remove_empty(self._new_folders)
        self._lock.release()

    def _is_held(self) -> bool:
        """Whether the lock in the folder is this process's: a removed one may be another's now."""
        with contextlib.suppress(OSError):
            locked = os.stat(self.folder / LOCK)
            return self._lock.is_locked and os.path.samestat(locked, self._locked)
        return False

    def file(self, name: str) -> Path:
        """The file of an entry."""
        return self.folder / f"{name}.safetensors"

    def get(self, name: str) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
        """An entry's tensors and plain values; None if there is no entry of this name.

        Raises:
          ConfigError: if it is damaged, or was made with other settings.
        """
        try:
            tensors, values = checksummed.read(self.file(name), KIND)
            identity = values.pop("format_version"), values.pop("entry", name)
            stored = dict(values.pop("config"))
            if identity != (FORMAT_VERSION, name):
                raise ValueError(f"its format and name are {shortened(identity)}")
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise self.damaged(name, error) from error
        self._has_entry = True
        differing = differences(stored, self.settings, self._free)
        # An older version may have left fields out. Reading the others anew could change them.
        differing = differing and differences(self.completed(stored), self.settings, self._free)
        if differing:
            rule = "must be new or made with the same settings"
            raise self.refused(f"{rule}; got {self.folder}, which differs in {differing}")
        return tensors, values

    def put(self, name: str, tensors: Tensors | None = None, **values: object) -> None:
        """Writes an entry over the previous one of this name.

        Args:
          name: the entry's name.
          tensors: arrays by name.
          **values: plain values.

        Raises:
          OSError: if it cannot be written, or the folder was removed since it was locked; the
            previous entry is then whole.
        """
        if self._lock.is_locked and not self._is_held():
            raise FileNotFoundError(f"{self.folder} was removed while it was in use")
        manifest = {"format_version": FORMAT_VERSION, "config": self.settings, "entry": name}
        write_bytes(self.file(name), checksummed.pack(dict(tensors or {}), KIND, manifest | values))
        self._has_entry = True

    def once(self, name: str, compute: Callable[[], Tensors]) -> dict[str, np.ndarray]:
        """The tensors of an entry; computes and writes them if there is none.

        Raises:
          ConfigError: as `get`.
          OSError: as `put`.
        """
        entry = self.get(name)
        if entry is not None:
            return entry[0]
        tensors = dict(compute())
        self.put(name, tensors)
        return tensors

    def completed(self, stored: dict[str, Any]) -> dict[str, Any]:
        """Stored settings with the fields that an older version did not write."""
        return stored

    def damaged(self, name: str, error: Exception) -> ConfigError:
        """The error for an entry that cannot be read, with the reason."""
        self._has_entry = True
        return self.refused(f"must hold whole files; got {self.file(name)}: {error}")

    def refused(self, message: str) -> ConfigError:
        """The error for a folder that cannot be used; the message follows its field."""
        return ConfigError(self._field, message, use="FOLDER")
