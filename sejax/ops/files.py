"""Writing files so that a kill or a full disk never leaves half of one."""

import contextlib
import os
import re
import secrets
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from sejax.options import ConfigError, shortened


def cache_folder() -> Path | None:
    """The folder for what sejax can make again; need not exist.

    Returns:
      `SEJAX_CACHE_DIR`, else `sejax` in the user's folder for caches (`XDG_CACHE_HOME`, which is
      `~/.cache` if it is not set). None if `SEJAX_CACHE_DIR` is set to nothing, or nobody's home.
    """
    default = os.path.join(os.environ.get("XDG_CACHE_HOME") or "~/.cache", "sejax")
    path = os.path.expanduser(os.environ.get("SEJAX_CACHE_DIR", default))
    return Path(path) if path and not path.startswith("~") else None


def require_writable(field: str, folder: Path) -> None:
    """Checks that files can be written in a folder, which may be new; leaves nothing there.

    Raises:
      ConfigError: of this field, if they cannot.
    """
    new_folders = missing(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        remove_empty(new_folders)
    except (OSError, ValueError) as error:
        message = f"{field} must be a folder that can be written; got {shortened(error)}."
        raise ConfigError(f"{message} Set {field}=FOLDER.", field) from error


def missing(folder: Path) -> list[Path]:
    """A folder and those above it that are not there, the innermost first."""
    return [path for path in (folder, *folder.parents) if not os.path.exists(path)]


def remove_empty(folders: Iterable[Path]) -> None:
    """Removes those of the folders that are empty."""
    for folder in folders:
        with contextlib.suppress(OSError):  # it is not empty
            folder.rmdir()


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside `path` that takes its place when the block succeeds.

    The content is on the disk before the file takes its place. A power cut may forget that it did:
    the file before is then there, whole. A kill leaves the temporary; see `remove_leftovers`.

    Raises:
      OSError: if the folder cannot be written or the disk is full; `path` is then as it was.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # It keeps the ending, as some writers choose the format by it.
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
    """Removes the temporaries of `atomic_path` that killed processes left.

    Args:
      folder: must be in use by this process alone, as far as these files go.
      names: of the files whose temporaries are removed.
    """
    for name in names:
        for path in folder.glob(f".{name}.sejax-{'[0-9a-f]' * 8}{Path(name).suffix}"):
            if path.is_file():
                path.unlink()


def as_file_name(text: str) -> str:
    """The text, with each run of characters that file names had better not have as an underscore.

    Example:
      >>> as_file_name("env=mine:Task,seed=1")
      'env_mine_Task_seed_1'
    """
    return re.sub(r"[^\w.+-]+", "_", text)
