"""Safetensors files that notice when a bit of them has changed.

The file's metadata has one entry, a JSON object, in which `sha256` is the digest of the whole file
as it is with 64 zeros in the digest's place: of tensors, metadata and all.
"""

import hashlib
import json
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load
from safetensors.numpy import save as serialize

_BLANK = "0" * 64


class DamagedError(ValueError):
    """The bytes are not those of a sealed file; the message is a clause that says why."""


def seal(tensors: dict[str, np.ndarray], kind: str, manifest: dict[str, Any]) -> bytes:
    """The content of a sealed file.

    Args:
      tensors: of the dtypes that safetensors knows under NumPy.
      kind: what the file is; the name of the metadata's entry.
      manifest: plain values.

    Raises:
      TypeError: if the manifest is not plain.

    Example:
      >>> data = seal({"x": np.zeros(2, np.float32)}, "note", {"text": "two zeros"})
      >>> tensors, manifest = unseal(data, "note")
      >>> tensors["x"].tolist(), manifest
      ([0.0, 0.0], {'text': 'two zeros'})
    """
    text = json.dumps({"sha256": _BLANK, **manifest})
    tensors = {name: np.asarray(x, order="C") for name, x in tensors.items()}
    # One entry: safetensors writes several in random order.
    data = serialize(tensors, metadata={kind: text})
    return data.replace(_BLANK.encode(), hashlib.sha256(data).hexdigest().encode(), 1)


def unseal(data: bytes, kind: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Tensors and manifest of a sealed file, which is checked first.

    Raises:
      DamagedError: if a byte has changed, or it is another kind of file.
    """
    manifest = _manifest(data, kind)
    digest = manifest.pop("sha256", None)
    if not isinstance(digest, str) or len(digest) != len(_BLANK):
        raise DamagedError("its manifest has no digest")
    blank = data.replace(digest.encode("ascii", "replace"), _BLANK.encode(), 1)
    if hashlib.sha256(blank).hexdigest() != digest:
        raise DamagedError("its content does not match its digest")
    try:
        return load(data), manifest
    except (SafetensorError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DamagedError(f"its tensors cannot be read: {error}") from error


def _manifest(data: bytes, kind: str) -> dict[str, Any]:
    """The manifest as it stands there; by hand, as the bytes are at hand and may be anything."""
    size = int.from_bytes(data[:8], "little")
    try:
        manifest = json.loads(json.loads(data[8 : 8 + size])["__metadata__"][kind])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise DamagedError("it has no manifest that can be read") from error
    if not isinstance(manifest, dict):
        raise DamagedError("its manifest is not a mapping")
    return manifest
