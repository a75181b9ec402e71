"""Checkpoints of the outer loop's whole state: orbax, a checksum, and the one before.

A checkpoint counts only with its manifest, which is written last and holds a hash of each file:
a kill while one is written, or a truncated file, is noticed and the previous one is used.
"""

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp

from sejax.files import write_text

KEPT = 2


def save(folder: Path, generation: int, state: Any) -> None:
    """Writes the state after `generation` generations, then drops all but the newest two.

    Args:
      folder: the run's checkpoint folder.
      generation: generations finished; the checkpoint's name.
      state: pytree of arrays; PRNG keys may be among them.

    Raises:
      OSError: if it cannot be written; the checkpoints before stay as they were.
    """
    target = (folder / str(generation)).resolve()
    _manifest(target).unlink(missing_ok=True)
    with ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(target, _without_keys(state), force=True)
    write_text(_manifest(target), json.dumps(_hashes(target), indent=1))
    for old in _generations(folder)[KEPT:]:
        _manifest(folder / str(old)).unlink(missing_ok=True)
        shutil.rmtree(folder / str(old), ignore_errors=True)


def restore_newest(folder: Path, template: Any) -> tuple[Any, int, list[str]]:
    """Restores the newest checkpoint that is whole.

    Args:
      folder: the run's checkpoint folder; need not exist.
      template: a state of the same structure, shapes and dtypes.

    Returns:
      The state (the template if there is no checkpoint), the generations it has finished, and a
      sentence for each damaged checkpoint that was passed over.
    """
    problems: list[str] = []
    for generation in _generations(folder):
        path = (folder / str(generation)).resolve()
        problem = _problem(path)
        if problem is None:
            with ocp.StandardCheckpointer() as checkpointer:
                restored = checkpointer.restore(path, _without_keys(template))
            return _with_keys(restored, template), generation, problems
        problems.append(f"Checkpoint {path} is damaged ({problem}); using the one before.")
    return template, 0, problems


def _problem(path: Path) -> str | None:
    """What is wrong with a checkpoint, if anything."""
    try:
        expected = json.loads(_manifest(path).read_text())
    except (OSError, ValueError):
        return "its manifest is missing or unreadable, so it was not finished"
    actual = _hashes(path)
    changed = sorted(name for name, digest in expected.items() if actual.get(name) != digest)
    return f"{changed[0]} is missing or does not match its checksum" if changed else None


def _hashes(path: Path) -> dict[str, str]:
    return {
        str(file.relative_to(path)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(path.rglob("*"))
        if file.is_file()
    }


def _manifest(path: Path) -> Path:
    return path.with_name(f"{path.name}.json")


def _generations(folder: Path) -> list[int]:
    """Generations for which there is a checkpoint, whole or not, newest first."""
    if not folder.is_dir():
        return []
    found = (path.name for path in folder.iterdir() if path.is_dir())
    return sorted((int(name) for name in found if name.isdigit()), reverse=True)


def _is_key(x: Any) -> bool:
    return jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)


def _without_keys(state: Any) -> Any:
    return jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else x, state)


def _with_keys(restored: Any, template: Any) -> Any:
    """Keys wrapped again; through NumPy, so that no leaf is tied to the device it was read on."""
    return jax.tree.map(
        lambda x, like: jax.random.wrap_key_data(x) if _is_key(like) else jnp.asarray(x),
        jax.device_get(restored),
        template,
    )
