"""What a stored proxy is, for Gymnasium: its tensors and the header of its file."""

from pathlib import Path

import numpy as np

from sejax.proxies import header
from sejax.proxies.header import Header

Source = str | Path


def read(source: Source, kind: str | None = None) -> tuple[dict[str, np.ndarray], Header]:
    """Tensors and header of a file of one proxy.

    Args:
      source: a run directory, a safetensors file, or the name of a shipped proxy.
      kind: "se" or "rn", which it must be; None for either.

    Raises:
      ConfigError: if there is no such file, it is damaged, or it holds several proxies or one of
        another kind.
    """
    weights, stored = header.read(source, kinds=(kind,) if kind else ("se", "rn"))
    header.require_single(len(stored.proxies), source)
    return weights, stored
