"""Finished steps of a command in its folder, so that the same command goes on with the others."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sejax.ops import checksummed
from sejax.ops.files import write_bytes, write_text
from sejax.options import ConfigError, require

SETTINGS = "distill.yaml"
_KIND = "sejax_step"
Arrays = dict[str, np.ndarray]


class Store:
    """What the steps of a command have computed, each in a file of the folder."""

    def __init__(self, folder: Path, settings: dict[str, Any]):
        """Opens a folder, which may be new. Nothing is written before a step is finished.

        Args:
          folder: the command's folder.
          settings: what the numbers depend on, as plain values.

        Raises:
          ConfigError: for a folder of other settings, or of a run of `sejax.run`.
        """
        self._folder, self._settings = folder, yaml.safe_dump(settings, sort_keys=False)
        path, is_run = folder / SETTINGS, (folder / "checkpoint.safetensors").exists()
        is_same = not path.exists() or path.read_bytes() == self._settings.encode()
        require(
            is_same and not is_run,
            "run_dir",
            f"must be new or hold what the same command made; got {folder}, "
            f"{'a run of sejax.run' if is_run else f'whose {SETTINGS} differs'}. Set "
            "run_dir=FOLDER.",
        )

    def once(self, name: str, compute: Callable[[], Arrays]) -> Arrays:
        """The arrays of a step, which is computed unless its file is there.

        Raises:
          ConfigError: for a damaged file.
          OSError: if a file cannot be written.
        """
        path = self._folder / f"{name}.safetensors"
        if not path.exists():
            arrays = compute()
            write_text(self._folder / SETTINGS, self._settings)
            write_bytes(path, checksummed.pack(arrays, _KIND, {}))
        try:
            return checksummed.read(path, _KIND)[0]
        except checksummed.DamagedError as error:
            raise ConfigError(
                f"run_dir must hold whole files; got {path} ({error}). Set run_dir=FOLDER.",
                "run_dir",
            ) from error
