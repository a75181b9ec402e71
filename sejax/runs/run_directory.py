"""A run's folder, in which only `checkpoint.safetensors` counts.

The checkpoint holds the configuration, the state of the search, and all rows of `metrics.csv`; see
`sejax.runs.store`. All other files are made again from it when the run resumes. A run that is
refused changes nothing.
"""

import secrets
from collections.abc import Iterable, Mapping
from typing import Any, Self, TypeVar

import jax
import numpy as np
import yaml
from jaxtyping import PyTree

from sejax.ops.files import remove_leftovers, write_text
from sejax.options import ConfigError
from sejax.options.plain import differences
from sejax.runs import runtime
from sejax.runs.config import LearnConfig
from sejax.runs.store import Store
from sejax.scoring import AgentInfo, GenerationInfo

_FIELDS = tuple(GenerationInfo.__dataclass_fields__)
_NUMBERS = _FIELDS[1 : _FIELDS.index("by_agent")]  # all after `generation`
# `env_steps_total` counts steps on the real task, none in an SE.
COLUMNS = ("generation", "seed", *_NUMBERS, "env_steps_total", "wall_s")
# Columns that a mixture also has for each agent, with the agent's name at the end.
AGENT_COLUMNS = tuple(AgentInfo.__dataclass_fields__)

_CHECKPOINT, _METRICS, _CONFIG = "checkpoint", "metrics.csv", "config.yaml"
_STATE, _ROWS = "state", "metrics"  # names of the checkpoint's tensors begin so
# A killed session may leave temporaries of these files.
_WRITTEN = ("*.safetensors", _METRICS, _CONFIG, "learning_curve.png", "run.json")
# Files that a run would replace. Without a checkpoint they are not its own, or it was lost.
_SIGNS = (_METRICS, _CONFIG, "run.json", "proxy.safetensors", "checkpoint", "distill.safetensors")
State = TypeVar("State")


class RunDirectory(Store):
    """One run's folder, which only this process may use within `with`.

    Call `restore` once, then `save` after each chunk of generations.

    The stored configuration is compared as plain values: if only the folder names a module, it is
    not imported.

    Args:
      config: the run's configuration.
      field: the field that names the folder, for messages.

    Attributes:
      folder: new, or from an earlier session of the same run.
      settings: the configuration, plain values in nested mappings.
      columns: the columns of `metrics.csv`; several agents have `AGENT_COLUMNS` each.
      rows: the rows of `metrics.csv`, one for each saved generation, each as text by column.
      id: 8 hexadecimal digits, drawn when the run began.
      cpu_s: CPU seconds of all sessions up to the checkpoint.
      versions: versions of the packages that decide the numbers, from the time of the checkpoint.
    """

    def __init__(self, config: LearnConfig, field: str = "run_dir"):
        super().__init__(config.folder, config.plain(), field=field, free=config.free)
        self.rows: list[dict[str, str]] = []
        self.id = secrets.token_hex(4)
        self.cpu_s = 0.0
        self.versions: object = runtime.versions()
        self._agents = tuple(config.agents) if len(config.agents) > 1 else ()
        of_agents = [f"{name}_{agent}" for agent in self._agents for name in AGENT_COLUMNS]
        self.columns = (*COLUMNS, *of_agents)
        self._tensors: dict[str, np.ndarray] | None = None

    def __enter__(self) -> Self:
        """Locks the folder, and reads the checkpoint if there is one.

        Raises:
          ConfigError: if the folder holds another run or a damaged one, is in use by another
            process, or cannot be written.
        """
        super().__enter__()
        try:
            self._open()
        except BaseException:
            self.__exit__()
            raise
        return self

    def completed(self, stored: dict[str, Any]) -> dict[str, Any]:
        """Stored settings with the defaults of fields that an older version did not write.

        These defaults change no number.
        """
        try:
            return LearnConfig.of_stored(stored, self.settings).plain()
        except ConfigError:
            return stored

    def last(self, column: str) -> str:
        """A column's value in the last saved row; 0 if there is none."""
        return self.rows[-1][column] if self.rows else "0"

    def restore(self, like: State) -> State | None:
        """Returns the checkpoint's state, and makes the tables again; None for a new run.

        Args:
          like: a state of the run, or its shapes.

        Raises:
          ConfigError: if the checkpoint's state has another structure.
          OSError: if a file cannot be written.
        """
        tensors = self._tensors
        if tensors is None:
            return None
        asked = jax.eval_shape(_named, like)
        if differing := differences(_shapes(tensors), _shapes(asked)):
            got = f"{self.folder}, whose state differs in {differing}"
            raise self.refused(f"must be of this version; got {got}")
        self._remake()

        def stored(path: jax.tree_util.KeyPath, leaf: jax.Array) -> jax.Array:
            """The inverse of `_named` for a leaf: with its own memory, tied to no device."""
            array = jax.numpy.array(tensors[_STATE + jax.tree_util.keystr(path)])
            return jax.random.wrap_key_data(array) if _is_key(leaf) else array

        return jax.tree.map_with_path(stored, like)

    def save(
        self, state: PyTree[jax.Array], info: GenerationInfo, wall_s: float, cpu_s: float
    ) -> list[dict[str, str]]:
        """Writes the checkpoint after a chunk of generations, then the files made from it.

        Args:
          state: pytree of arrays.
          info: the chunk's info, leaves `[generation, ...]`; a generation counts if it is `active`.
          wall_s: seconds of all sessions.
          cpu_s: CPU seconds of all sessions.

        Returns:
          The new rows.

        Raises:
          OSError: if a file cannot be written; the new or the previous checkpoint is then whole.
        """
        new = self._rows_of(info, wall_s)
        csv = self._as_csv([*self.rows, *new])
        tensors = jax.device_get(_named(state))  # all at once
        tensors[_ROWS] = np.frombuffer(csv.encode(), np.uint8)
        self.put(_CHECKPOINT, tensors, id=self.id, cpu_s=cpu_s, versions=runtime.versions())
        self.rows += new
        self.cpu_s = cpu_s
        write_text(self.folder / _METRICS, csv)
        if not (self.folder / _CONFIG).exists():
            self._remake()
        return new

    def _as_csv(self, rows: Iterable[Mapping[str, str]]) -> str:
        """The text of `metrics.csv`; no cell has a comma."""
        cells = [self.columns, *(row.values() for row in rows)]
        return "".join(",".join(row) + "\n" for row in cells)

    def _open(self) -> None:
        """Reads the checkpoint, if there is one."""
        entry = self.get(_CHECKPOINT)
        if entry is None:  # then the folder must hold no run, also none of an older sejax
            signs = [name for name in _SIGNS if (self.folder / name).exists()]
            if signs:
                got = f"{self.folder}, whose {signs[0]} would be replaced"
                raise self.refused(f"must be new or hold the checkpoint of its run; got {got}")
            return
        tensors, values = entry
        try:
            header, *lines = tensors.pop(_ROWS).tobytes().decode().splitlines()
            rows = [dict(zip(header.split(","), x.split(","), strict=True)) for x in lines]
            # A column is nan if an older version did not write it.
            self.rows = [{name: row.get(name, "nan") for name in self.columns} for row in rows]
            self.id = str(values["id"])
            self.cpu_s = float(values["cpu_s"])
            self.versions = values.get("versions", self.versions)
            # The two raise for texts that are no numbers.
            float(self.last("wall_s"))
            int(self.last("env_steps_total"))
        except (KeyError, TypeError, ValueError) as error:
            raise self.damaged(_CHECKPOINT, error) from error
        self._tensors = tensors

    def _rows_of(self, info: GenerationInfo, wall_s: float) -> list[dict[str, str]]:
        """The rows of the active generations of a chunk."""
        columns = dict(vars(info))
        steps = np.asarray(info.real_steps, np.int64).sum(axis=1)
        columns["env_steps_total"] = int(self.last("env_steps_total")) + steps.cumsum()
        for i, agent in enumerate(self._agents):
            for name in AGENT_COLUMNS:
                columns[f"{name}_{agent}"] = getattr(info.by_agent, name)[:, i]
        same = {"seed": str(self.settings["seed"]), "wall_s": f"{wall_s:.3f}"}  # in all rows
        return [
            {name: same.get(name) or _as_text(columns[name][i]) for name in self.columns}
            for i in np.flatnonzero(info.active)
        ]

    def _remake(self) -> None:
        """Writes the text files that differ from the checkpoint."""
        remove_leftovers(self.folder, _WRITTEN)
        config = yaml.safe_dump(self.settings, sort_keys=False)
        for name, text in ((_CONFIG, config), (_METRICS, self._as_csv(self.rows))):
            path = self.folder / name
            if not path.exists() or path.read_bytes() != text.encode():
                write_text(path, text)


def _as_text(value: np.generic) -> str:
    """Shortest text that reads back as the same float32, or the integer, however large."""
    return str(value) if value.dtype.kind in "iu" else f"{value:.9g}"


# --- pytrees as tensors by name -------------------------------------------------------------------


def _named(tree: PyTree) -> dict[str, jax.Array]:
    """The leaves by path, with PRNG keys as their data."""
    leaves = {_STATE + jax.tree_util.keystr(x): leaf for x, leaf in jax.tree.leaves_with_path(tree)}
    return {name: jax.random.key_data(x) if _is_key(x) else x for name, x in leaves.items()}


def _is_key(leaf: jax.Array) -> bool:
    return bool(jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key))


def _shapes(arrays: Mapping[str, np.ndarray | jax.Array]) -> dict[str, str]:
    return {name: f"{x.dtype}{list(x.shape)}" for name, x in arrays.items()}
