"""Writing files so that a kill or a full disk never leaves half of one.

A temporary is called `.NAME.sejax-XXXXXXXX.EXT` and is locked while its process lives, so that
`remove_leftovers` can tell those of killed processes from those in use.
"""

import contextlib
import os
import re
import secrets
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

_TEMPORARY = re.compile(r"\.(?P<name>.+)\.sejax-[0-9a-f]{8}(?P<suffix>\.[^.]*)?")


def cache_folder() -> Path | None:
    """Where sejax keeps what it can make again; need not exist.

    Returns:
      `SEJAX_CACHE_DIR`, else `sejax` in the user's folder for caches (`XDG_CACHE_HOME`, which is
      `~/.cache` if it is not set). None if `SEJAX_CACHE_DIR` is set to nothing, or nobody's home.
    """
    root = os.environ.get("SEJAX_CACHE_DIR")
    if root is not None:
        return Path(root) if root else None
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sejax"
    except RuntimeError:
        return None


def require_writable(folder: Path) -> None:
    """Makes a folder and checks that files can be written there.

    Raises:
      OSError: if they cannot.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):
        pass


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside `path` that takes its place when the block succeeds.

    What the file holds is on the disk before it takes its place. That it did may be forgotten in a
    power cut: the file before is then there, whole.

    Raises:
      OSError: if the folder cannot be written or the disk is full; `path` is then as it was.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary, handle = _make_temporary(path)
    try:
        yield temporary
        with temporary.open("rb") as file:  # again, as the block may have made the file anew
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        os.close(handle)
        temporary.unlink(missing_ok=True)


def as_file_name(text: str) -> str:
    """The text with what a file's name had better not have made underscores.

    Example:
      >>> as_file_name("env=mine:Task,seed=1")
      'env_mine_Task_seed_1'
    """
    return re.sub(r"[^\w.+-]+", "_", text)


def write_text(path: Path, text: str) -> None:
    """Replaces the file's text atomically."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path, data: bytes) -> None:
    """Replaces the file's content atomically."""
    with atomic_path(path) as temporary:
        handle = os.open(temporary, os.O_WRONLY)
        try:
            write_all(handle, data)
        finally:
            os.close(handle)


def append(path: Path, data: bytes, at: int) -> None:
    """Adds to the end of a file of `at` bytes, which is made if `at` is 0.

    The bytes are on the disk when this returns. A kill may leave some of them; whoever reads the
    file must know how many count.

    Args:
      path: the file.
      data: what to add.
      at: bytes that the file has.

    Raises:
      OSError: if the file has another length, or cannot be written; it is then as it was.
    """
    handle = os.open(path, os.O_WRONLY | (0 if at else os.O_CREAT), 0o666)
    try:
        size = os.fstat(handle).st_size
        if size != at:
            raise OSError(
                f"{path} has {size} bytes and not the {at} that were written: another "
                f"program has changed it"
            )
        try:
            os.lseek(handle, at, os.SEEK_SET)
            write_all(handle, data)
            os.fsync(handle)
        except BaseException:
            with contextlib.suppress(OSError):
                os.ftruncate(handle, at)
            raise
    finally:
        os.close(handle)
    if not at:
        sync_folder(path.parent)


def write_all(handle: int, data: bytes) -> None:
    """Writes all the bytes to an open file; `os.write` may take a part at a time."""
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(handle, rest) :]


def sync_folder(folder: Path) -> None:
    """Puts a folder's names on the disk, where the file system can."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def remove_leftovers(folder: Path) -> list[Path]:
    """Removes the temporaries of `atomic_path` whose process was killed.

    A temporary that is locked is in use and stays; so does all that is not a regular file with
    such a name, and everything behind a link or on a file system without locks.

    Args:
      folder: need not exist; its folders are not looked into.

    Returns:
      What was removed.
    """
    if folder.is_symlink() or not folder.is_dir():
        return []
    removed = []
    for path in sorted(folder.iterdir()):
        found = _TEMPORARY.fullmatch(path.name)
        if found and Path(found["name"]).suffix == (found["suffix"] or ""):
            with contextlib.suppress(OSError):
                if _remove_if_dead(path):
                    removed.append(path)
    return removed


def try_lock(handle: int) -> bool | None:
    """Locks an open file until it is closed or the process ends, however it ends.

    Returns:
      False if another holds the lock, and None where the file system has no locks.
    """
    if fcntl is None:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def is_at(handle: int, path: Path) -> bool:
    """Whether the open file is still the one of that name."""
    try:
        found = os.stat(path, follow_symlinks=False)
    except FileNotFoundError:
        return False
    return os.path.samestat(found, os.fstat(handle))


def _make_temporary(path: Path) -> tuple[Path, int]:
    """A new locked file beside `path`, with its ending, as some writers go by that."""
    while True:
        name = f".{path.name}.sejax-{secrets.token_hex(4)}{path.suffix}"
        temporary = path.with_name(name)
        try:
            handle = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            continue
        # `remove_leftovers` of another process may have come between the two.
        if try_lock(handle) is not False and is_at(handle, temporary):
            return temporary, handle
        os.close(handle)


def _remove_if_dead(path: Path) -> bool:
    if not stat.S_ISREG(path.lstat().st_mode):
        return False
    handle = os.open(path, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
    try:
        dead = try_lock(handle) is True and is_at(handle, path)
        if dead:
            path.unlink()
        return dead
    finally:
        os.close(handle)
