"""Safetensors files with a checksum, so that a change of any bit is noticed.

The metadata has one entry, a JSON object. Its `sha256` is the digest of the whole file, computed
with 64 zeros in the digest's place.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load, save

_BLANK = "0" * 64


def pack(tensors: dict[str, np.ndarray], kind: str, manifest: dict[str, Any]) -> bytes:
    """The content of a checksummed file.

    Args:
      tensors: arrays by name, of dtypes that safetensors knows under NumPy.
      kind: name of the metadata's entry, which says what sort of file it is.
      manifest: plain values.

    Raises:
      TypeError: if the manifest is not plain.

    Example:
      >>> data = pack({"x": np.zeros(2, np.float32)}, "note", {"text": "two zeros"})
      >>> tensors, manifest = unpack(data, "note")
      >>> tensors["x"].tolist(), manifest
      ([0.0, 0.0], {'text': 'two zeros'})
    """
    text = json.dumps({"sha256": _BLANK, **manifest})
    tensors = {name: np.asarray(x, order="C") for name, x in tensors.items()}
    # One entry, because safetensors writes several in random order.
    data = save(tensors, metadata={kind: text})
    return data.replace(_BLANK.encode(), hashlib.sha256(data).hexdigest().encode(), 1)


def unpack(data: bytes, kind: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Inverse of `pack`: tensors and manifest, after the checksum was verified.

    Raises:
      ValueError: if a byte has changed, it is another kind of file, or the manifest has 50 levels;
        the message says why.
    """
    try:
        end = 8 + int.from_bytes(data[:8], "little")
        manifest: dict[str, Any] = json.loads(json.loads(data[8:end])["__metadata__"][kind])
        if f"\n{'':50}" in json.dumps(manifest, indent=1):  # too many levels to be shown
            raise ValueError
        digest = manifest.pop("sha256").encode("ascii")
        blank = data.replace(digest, _BLANK.encode(), 1)
        tensors = load(data)
        is_whole = hashlib.sha256(blank).hexdigest().encode() == digest
    except Exception as error:  # the bytes may be anything
        raise ValueError("it cannot be read") from error
    if not is_whole:
        raise ValueError("its content does not match its digest")
    return tensors, manifest


def read(path: Path, kind: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """As `unpack`, of a file.

    Raises:
      ValueError: as `unpack`. A file whose size does not fit its header is not read.
      OSError: if it cannot be read.
    """
    try:
        with path.open("rb"), safe_open(path, "np"):  # safe_open raises no OSError for a folder
            pass
    except SafetensorError as error:
        raise ValueError("it has no header that fits its size") from error
    return unpack(path.read_bytes(), kind)
