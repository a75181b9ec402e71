"""What a stored proxy is, for Gymnasium: its tensors and the header of its file."""

from pathlib import Path
from typing import Any

import numpy as np

from sejax.errors import require, shortened
from sejax.proxies import stored

Source = str | Path
KINDS = {"se": "a synthetic environment", "rn": "a reward network"}


def read(source: Source, kind: str | None = None) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Tensors and header of a file of one proxy.

    Args:
      source: a run directory, a safetensors file, or the name of a shipped proxy.
      kind: "se" or "rn", which it must be; None for either.

    Raises:
      ConfigError: if there is no such file, it is damaged, or it holds several proxies or one of
        another kind.
    """
    path = stored.find(source)
    weights, header = stored.read(path, "source")
    require(
        not header["is_set"],
        "source",
        "be a single proxy",
        "an agent trains in one world",
        f"{path}, a set",
        "source to a run directory",
    )
    there, wanted = header["config"]["proxy"].get("name"), [kind] if kind else list(KINDS)
    require(
        there in wanted,
        "source",
        f"be {' or '.join(KINDS[each] for each in wanted)}",
        "this takes its networks" if kind else "other proxies are JAX code",
        f"proxy={shortened(there)} in {path}",
        "source to such a proxy; sejax.load reads all proxies",
    )
    return weights, header
