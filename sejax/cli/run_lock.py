"""A run directory is used by one process at a time.

The lock is the kernel's, on the file `sejax.lock`, and ends with the process, however that ends.
The file says who holds it. Where the file system has no locks (some Lustre and FUSE mounts), the
file itself is the lock: it counts unless its process is dead and was one of this machine.
"""

import contextlib
import json
import os
import platform
import weakref
from pathlib import Path
from typing import Any

from sejax.errors import ConfigError
from sejax.ops.files import is_at, try_lock, write_all


class RunLock:
    """A lock that is held until `release`, or until the process ends."""

    def __init__(self, path: Path, handle: int):
        self._finalizer = weakref.finalize(self, _release, path, handle, os.getpid())

    def release(self) -> None:
        """Gives the lock back and removes its file; a second call does nothing."""
        self._finalizer()


def acquire(path: Path, hint: str) -> RunLock:
    """Takes the lock, also that of a process that was killed.

    Args:
      path: the lock's file, in a folder that exists.
      hint: last sentence of the error's message: how to choose another folder.

    Raises:
      ConfigError: if another process, or another place in this one, holds it.
      OSError: if the file cannot be written.
    """
    while True:
        handle, is_new = _open(path)
        try:
            locked = try_lock(handle)
            owner = _owner(handle)
            if locked is False or (locked is None and not is_new and not _is_dead(owner)):
                raise ConfigError(_message(path, owner, hint, locked))
            if locked is None and not is_new:
                path.unlink(missing_ok=True)  # of a dead process: made anew in the next round
            elif is_at(handle, path):
                _sign(handle)
                held, handle = handle, -1
                return RunLock(path, held)
        finally:
            if handle >= 0:
                os.close(handle)


def _open(path: Path) -> tuple[int, bool]:
    """The file's handle, and whether it was made here."""
    with contextlib.suppress(FileExistsError):
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666), True
    return os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666), False


def _sign(handle: int) -> None:
    os.ftruncate(handle, 0)
    os.lseek(handle, 0, os.SEEK_SET)
    write_all(handle, json.dumps({"pid": os.getpid(), "host": _host()}).encode())


def _owner(handle: int) -> dict[str, Any]:
    """Who the file says holds the lock; empty if that cannot be read."""
    try:
        os.lseek(handle, 0, os.SEEK_SET)
        owner = json.loads(os.read(handle, 1000))
    except (OSError, ValueError, RecursionError):
        return {}
    return owner if isinstance(owner, dict) and type(owner.get("pid")) is int else {}


def _is_dead(owner: dict[str, Any]) -> bool:
    """Whether it was a process of this machine that is no more; another machine's may live."""
    if not owner or owner.get("host") != _host() or os.name == "nt":
        return False
    try:
        os.kill(owner["pid"], 0)
    except (ProcessLookupError, OverflowError):
        return True
    except OSError:
        return False
    return False


def _host() -> str:
    return platform.node()


def _message(path: Path, owner: dict[str, Any], hint: str, locked: bool | None) -> str:
    who = f"process {owner['pid']} on {owner.get('host')}" if owner else "another process"
    remove = "" if locked is False else f" If it is no more, remove {path}."
    return (
        f"run_dir must be used by one process at a time, because two would mix their files; got "
        f"{path.parent}, in use by {who}. Wait until it ends, or stop it.{remove} {hint}"
    )


def _release(path: Path, handle: int, pid: int) -> None:
    try:
        with contextlib.suppress(OSError):
            if os.getpid() == pid and is_at(handle, path):  # a forked child only closes its copy
                path.unlink()
    finally:
        os.close(handle)
