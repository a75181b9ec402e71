"""Writing files so that a kill or a full disk never leaves half of one."""

import contextlib
import os
import re
import secrets
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from sejax.options import ConfigError


def cache_folder() -> Path | None:
    """The folder for files that sejax can make again. It need not exist.

    Returns:
      `SEJAX_CACHE_DIR`, else `sejax` in the user's folder for caches (`XDG_CACHE_HOME`, by default
      `~/.cache`). None if `SEJAX_CACHE_DIR` is set to nothing, or if no home folder is found.
    """
    default = os.path.join(os.environ.get("XDG_CACHE_HOME") or "~/.cache", "sejax")
    path = os.path.expanduser(os.environ.get("SEJAX_CACHE_DIR", default))
    return Path(path) if path and not path.startswith("~") else None


def require_writable(field: str, folder: Path) -> None:
    """Checks that files can be written in a folder, which may be new. Leaves nothing there.

    Raises:
      ConfigError: for this field, if files cannot be written.
    """
    new_folders = missing(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
        remove_empty(new_folders)
    except (OSError, ValueError) as error:
        raise ConfigError(field, "must be a writable folder", got=error, use="FOLDER") from error


def missing(folder: Path) -> list[Path]:
    """A folder and its parents, as far as they do not exist; the innermost first."""
    return [path for path in (folder, *folder.parents) if not os.path.exists(path)]


def remove_empty(folders: Iterable[Path]) -> None:
    """Removes the empty folders among these."""
    for folder in folders:
        with contextlib.suppress(OSError):  # it is not empty
            folder.rmdir()


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside `path`. Its file replaces `path` when the block succeeds.

    The content is on the disk before the file is replaced. A power cut may undo the replacement:
    the older file is then there, whole. A kill leaves the temporary file; see `remove_leftovers`.

    Raises:
      OSError: if the folder cannot be written or the disk is full; `path` is then as it was.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # It keeps the ending: some writers choose the format by the ending.
    temporary = path.with_name(f".{path.name}.sejax-{secrets.token_hex(4)}{path.suffix}")
    try:
        yield temporary
        with temporary.open("r+b") as file:  # Windows syncs only what may be written
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Replaces the file's text atomically."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path, data: bytes) -> None:
    """Replaces the file's content atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def remove_leftovers(folder: Path, names: Iterable[str]) -> None:
    """Removes the temporary files of `atomic_path` that killed processes left.

    Args:
      folder: the folder; no other process may be writing these files.
      names: names of the files whose temporary files are removed.
    """
    for name in names:
        for path in folder.glob(f".{name}.sejax-{'[0-9a-f]' * 8}{Path(name).suffix}"):
            if path.is_file():
                path.unlink()


def as_file_name(text: str) -> str:
    """The text, with an underscore for each run of characters that are unsafe in file names.

    Example:
      >>> as_file_name("env=mine:Task,seed=1")
      'env_mine_Task_seed_1'
    """
    return re.sub(r"[^\w.+-]+", "_", text)
