"""Checkpoints of a run's whole state: one small sealed file each, and the one before.

A file holds the leaves of a pytree, and in its manifest what they are and a record of the caller.
It is on the disk before it takes its name, so that a kill leaves the checkpoints before, and
after a power cut at least the one before is there; damage is noticed by the file's digest.
"""

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sejax.ops import sealed
from sejax.ops.files import write_bytes

KEPT = 2
FORMAT_VERSION = 1
_KIND = "sejax_checkpoint"
_NAME = re.compile(r"sejax-generation-(0|[1-9][0-9]{0,17})\.safetensors")
# What safetensors stores as it is; other dtypes go in as bytes.
_STORED = {
    "float64",
    "float32",
    "float16",
    "int64",
    "uint64",
    "int32",
    "uint32",
    "int16",
    "uint16",
    "int8",
    "uint8",
    "bool",
    "complex64",
}


class UnusableError(ValueError):
    """A checkpoint that cannot be gone on from; the message is a clause that says why."""


def save(folder: Path, generation: int, state: Any, record: Any) -> None:
    """Writes the state after `generation` generations, then drops all but the newest two.

    Only checkpoints are dropped: whole files of ours, of earlier generations, behind no link.

    Args:
      folder: the run's checkpoint folder.
      generation: generations finished.
      state: pytree of arrays; PRNG keys may be among them.
      record: plain values to keep with it, or None.

    Raises:
      OSError: if it cannot be written; the checkpoints before stay as they were.
    """
    paths, leaves, _ = _flatten(state)
    manifest = {
        "format_version": FORMAT_VERSION,
        "generation": generation,
        "leaves": _describe(paths, leaves),
        "record": record,
    }
    tensors = dict(zip(_tensor_names(paths), _to_numpy(leaves), strict=True))
    write_bytes(path_of(folder, generation), sealed.seal(tensors, _KIND, manifest))
    _prune(folder, generation)


def restore_newest(folder: Path, template: Any) -> tuple[Any, int, Any, list[str]]:
    """Restores the newest checkpoint that is whole and of the template's structure.

    Args:
      folder: the run's checkpoint folder; need not exist.
      template: a state of the same tree, shapes and dtypes.

    Returns:
      The state (the template if there is no checkpoint), the generations it has finished, the
      record it was saved with, and a sentence for each checkpoint that was passed over.
    """
    problems: list[str] = []
    for path in _newest_first(folder):
        try:
            tensors, manifest = _read(path)
            state = _fill(template, tensors, manifest["leaves"])
        except UnusableError as error:
            problems.append(f"Checkpoint {path} is passed over: {error}.")
        else:
            return state, manifest["generation"], manifest["record"], problems
    return template, 0, None, problems


def newest_record(folder: Path) -> tuple[int, Any] | None:
    """Generation and record of the newest whole checkpoint, whatever its state; without jax."""
    for path in _newest_first(folder):
        with contextlib.suppress(UnusableError):
            _, manifest = _read(path)
            return manifest["generation"], manifest["record"]
    return None


def generations(folder: Path) -> list[int]:
    """Generations for which there is a checkpoint by its name, whole or not, newest first."""
    try:
        names = os.listdir(folder)
    except OSError:
        return []
    found = (int(name[1]) for name in map(_NAME.fullmatch, names) if name)
    return sorted((n for n in found if path_of(folder, n).is_file()), reverse=True)


def path_of(folder: Path, generation: int) -> Path:
    """The file of a checkpoint."""
    return folder / f"sejax-generation-{generation}.safetensors"


def _newest_first(folder: Path) -> Iterator[Path]:
    return (path_of(folder, generation) for generation in generations(folder))


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Tensors and manifest.

    Raises:
      UnusableError: if the file is not a whole checkpoint of that name.
    """
    try:
        tensors, manifest = sealed.unseal(path.read_bytes(), _KIND)
    except OSError as error:
        raise UnusableError(f"it cannot be read ({error})") from error
    except sealed.DamagedError as error:
        raise UnusableError(f"it is damaged, as {error}") from error
    if manifest.keys() != {"format_version", "generation", "leaves", "record"}:
        raise UnusableError("its manifest is not that of a checkpoint")
    if manifest["format_version"] != FORMAT_VERSION:
        raise UnusableError(
            f"its format is {manifest['format_version']!r}, and this version of "
            f"sejax reads {FORMAT_VERSION}"
        )
    generation = manifest["generation"]
    if type(generation) is not int or path != path_of(path.parent, generation):
        raise UnusableError(f"it is that of generation {generation!r}")
    return tensors, manifest


def _prune(folder: Path, generation: int) -> None:
    """Removes what is older than the newest `KEPT` up to `generation`; damaged files stay."""
    if folder.is_symlink():
        return
    whole = 1  # the one just written
    for older in generations(folder):
        path = path_of(folder, older)
        if older >= generation or path.is_symlink():
            continue
        with contextlib.suppress(UnusableError, OSError):
            _read(path)
            whole += 1
            if whole > KEPT:
                path.unlink()


def _flatten(state: Any) -> tuple[list[str], list[Any], Any]:
    """Paths of the leaves (`.es_state.mean`), the leaves, and the tree."""
    import jax  # here, as what only reads a record must be quick

    flat, tree = jax.tree_util.tree_flatten_with_path(state)
    return [jax.tree_util.keystr(path) for path, _ in flat], [leaf for _, leaf in flat], tree


def _tensor_names(paths: list[str]) -> list[str]:
    return [f"{i:04d}{path}" for i, path in enumerate(paths)]


def _describe(paths: list[str], leaves: list[Any]) -> list[list[str]]:
    """Each leaf's path, and its dtype and shape as `float32[2,3]`."""
    return [
        [path, f"{_dtype(leaf)}[{','.join(map(str, np.shape(leaf)))}]"]
        for path, leaf in zip(paths, leaves, strict=True)
    ]


def _dtype(leaf: Any) -> Any:
    return leaf.dtype if hasattr(leaf, "dtype") else np.asarray(leaf).dtype


def _is_key(leaf: Any) -> bool:
    import jax

    return jax.dtypes.issubdtype(_dtype(leaf), jax.dtypes.prng_key)


def _to_numpy(leaves: list[Any]) -> list[np.ndarray]:
    """The leaves as arrays that safetensors can store; fetched from their devices all at once."""
    import jax

    bare = [jax.random.key_data(leaf) if _is_key(leaf) else leaf for leaf in leaves]
    arrays = [np.asarray(leaf) for leaf in jax.device_get(bare)]
    return [x if x.dtype.name in _STORED else np.frombuffer(x.tobytes(), np.uint8) for x in arrays]


def _fill(template: Any, tensors: dict[str, np.ndarray], found: Any) -> Any:
    """The template's tree with the tensors as leaves.

    Raises:
      UnusableError: if the tensors are those of another tree.
    """
    paths, leaves, tree = _flatten(template)
    difference = _difference(found, _describe(paths, leaves))
    if difference:
        raise UnusableError(f"its state has another structure ({difference})")
    try:
        arrays = [tensors[name] for name in _tensor_names(paths)]
        filled = [_from_numpy(x, like) for x, like in zip(arrays, leaves, strict=True)]
    except (KeyError, TypeError, ValueError) as error:
        raise UnusableError(f"its tensors are not those of its manifest ({error})") from error
    return tree.unflatten(filled)


def _difference(found: Any, expected: list[list[str]]) -> str | None:
    """The first leaf that is not the same there and here."""
    if found == expected:
        return None
    try:
        there, here = dict(found), dict(expected)
    except (TypeError, ValueError):
        return "its leaves are not described"
    for path in [*here, *there]:
        if there.get(path) != here.get(path):
            return f"{path} is {there.get(path, 'missing')} there, {here.get(path, 'missing')} here"
    return "its leaves have another order"


def _key_impl(like: Any) -> Any:
    """The implementation of a key, also where there is only its shape and dtype."""
    import jax

    found: list[Any] = []
    jax.eval_shape(lambda key: found.append(jax.random.key_impl(key)), like)
    return found[0]


def _from_numpy(stored: np.ndarray, like: Any) -> Any:
    """A leaf of its own memory, tied to no device, of the kind of `like`."""
    import jax

    if _is_key(like):
        return jax.random.wrap_key_data(jax.numpy.array(stored), impl=_key_impl(like))
    array = stored.view(_dtype(like)).reshape(np.shape(like)).copy()
    if isinstance(like, np.ndarray | np.generic):
        return array if isinstance(like, np.ndarray) else array[()]
    return jax.numpy.array(array) if hasattr(like, "dtype") else array.item()
