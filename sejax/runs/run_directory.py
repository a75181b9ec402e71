"""A run's folder, of which one file counts: `checkpoint.safetensors`.

It holds the configuration, the state of the learner, and all rows of `metrics.csv`. It is written
to a temporary file, put on the disk, and renamed over the one before, so that a kill at any moment
leaves a whole checkpoint. All other files are remade from it when the run goes on. A run that is
refused changes nothing.

Nothing here imports jax before a state is restored or saved, so that a refusal is quick.
"""

import json
import secrets
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import numpy as np
import yaml

from sejax.ops import checksummed
from sejax.ops.files import FolderLock, remove_leftovers, write_bytes, write_text
from sejax.options import ConfigError
from sejax.options.plain import differences
from sejax.runs import runtime

if TYPE_CHECKING:  # which import jax
    from jax import Array
    from jax.tree_util import KeyPath
    from jaxtyping import PyTree

    from sejax.runs.config import LearnConfig
    from sejax.scoring import GenerationInfo

COLUMNS = (
    "generation",
    "seed",
    "incumbent_mean",
    "incumbent_std",
    "population_mean",
    "population_max",
    "best_so_far",
    "train_steps_mean",
    "train_steps_max",
    "train_episodes_mean",
    "num_nonfinite",
    "env_steps_total",
    "wall_s",
)
# Columns that each agent of a mixture has too, with its name at the end.
AGENT_COLUMNS = ("incumbent_mean", "population_mean", "train_steps_mean", "num_nonfinite")
# Fields and groups that say how or how long to compute, not what: they may change between two
# sessions of a run.
FREE_FIELDS = {
    "generations",
    "stop_when_solved",
    "devices",
    "checkpoint_every",
    "run_dir",
    "tracker",
    "machines",
}
HINT = "Set run_dir=FOLDER."

_CHECKPOINT = "checkpoint.safetensors"
_METRICS, _CONFIG = "metrics.csv", "config.yaml"
_KIND, _FORMAT_VERSION, _STATE, _ROWS = "sejax_run", 1, "state", "metrics"
# Files whose temporaries a killed session leaves.
_WRITTEN = (
    _CHECKPOINT,
    _METRICS,
    _CONFIG,
    "proxy.safetensors",
    "proxy_last.safetensors",
    "learning_curve.png",
    "run.json",
)
# Files that only a run leaves; without its checkpoint they come from an older sejax, or it is lost.
_SIGNS_OF_A_RUN = (_METRICS, "proxy.safetensors", "checkpoint")
State = TypeVar("State")


class RunDirectory:
    """One run's folder, which this process alone uses until `close`.

    Call `restore` once, then `save` after each block of generations.

    Attributes:
      path: the folder.
      config: the configuration, plain values in nested mappings.
      rows: the rows of `metrics.csv`, each as text by column.
      id: 8 hexadecimal digits, drawn when the run began.
      cpu_s: CPU seconds of all sessions up to the checkpoint.
      versions: of the packages that decide the numbers, as the checkpoint was written.
    """

    def __init__(
        self,
        path: str | Path,
        config: dict[str, Any],
        agents: Sequence[str] = (),
        hint: str = HINT,
        completed: Callable[[dict[str, Any]], dict[str, Any]] = dict,
    ):
        """Makes the folder, or opens that of an earlier session of the same run.

        Args:
          path: the folder.
          config: the configuration, plain values in nested mappings; `seed` is read.
          agents: names of the agents; each of several has columns of its own.
          hint: last sentence of messages: how to choose another folder.
          completed: adds to a stored configuration the fields that an older version did not write.

        Raises:
          ConfigError: if the folder holds another run or a damaged one, is in use by another
            process, or cannot be written.
        """
        self.path = Path(path)
        self.config: dict[str, Any] = json.loads(json.dumps(config))  # tuples as lists, as stored
        self.columns = columns_of(agents)
        self.rows: list[dict[str, str]] = []
        self.id, self.cpu_s = secrets.token_hex(4), 0.0
        self.versions: object = runtime.versions()
        self._agents, self._hint = agents if len(agents) > 1 else (), hint
        self._csv = _as_csv([self.columns])
        self._state: dict[str, np.ndarray] | None = None
        self._lock = FolderLock(self.path, hint)
        try:
            self._open(completed)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Lets other processes use the folder; without a run there, leaves nothing behind."""
        self._lock.release(is_used=(self.path / _CHECKPOINT).exists())

    def __enter__(self) -> "RunDirectory":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    @property
    def metrics(self) -> Path:
        return self.path / _METRICS

    @property
    def finished_generations(self) -> int:
        """Generations that are saved."""
        return len(self.rows)

    @property
    def wall_s(self) -> float:
        """Seconds of all sessions up to the checkpoint."""
        return float(self.rows[-1]["wall_s"]) if self.rows else 0.0

    @property
    def real_steps(self) -> int:
        """Steps on the real task up to the checkpoint."""
        return int(self.rows[-1]["env_steps_total"]) if self.rows else 0

    def restore(self, like: State) -> State | None:
        """The state of the checkpoint, and the files beside it remade; None for a new run.

        Args:
          like: a state of the run, or its shapes.

        Raises:
          ConfigError: if the checkpoint's state has another structure.
          OSError: if a file cannot be written.
        """
        if self._state is None:
            return None
        try:
            state = _as_state(self._state, like)
        except checksummed.DamagedError as error:
            self._refuse_checkpoint(error)
        self._state = None
        self._remake()
        return state

    def save(
        self, state: "PyTree[Array]", info: "GenerationInfo", wall_s: float, cpu_s: float
    ) -> list[dict[str, str]]:
        """Writes the checkpoint after a block of generations, then the files remade from it.

        Args:
          state: pytree of arrays.
          info: of the block, leaves `[generation, ...]`; generations that are not `active` do not
            count.
          wall_s: seconds of all sessions.
          cpu_s: CPU seconds of all sessions.

        Returns:
          The new rows.

        Raises:
          OSError: if a file cannot be written; the checkpoint is then whole, this one or the one
            before.
        """
        if not (self.path / FolderLock.NAME).exists():
            raise FileNotFoundError(f"{self.path} was removed while its run went on")
        rows = self._rows_of(info, wall_s)
        csv = self._csv + _as_csv([row.values() for row in rows])
        tensors = _as_tensors(state) | {_ROWS: np.frombuffer(csv.encode(), np.uint8)}
        manifest = {
            "format_version": _FORMAT_VERSION,
            "config": self.config,
            "id": self.id,
            "cpu_s": cpu_s,
            "versions": runtime.versions(),
        }
        is_first = not self.rows
        write_bytes(self.path / _CHECKPOINT, checksummed.pack(tensors, _KIND, manifest))
        self.rows += rows
        self._csv, self.cpu_s = csv, cpu_s
        if is_first:
            self._remake()
        else:
            write_text(self.metrics, csv)
        return rows

    def write_summary(self, **values: Any) -> None:
        """Writes `run.json`."""
        write_text(self.path / "run.json", json.dumps(values, indent=2) + "\n")

    def _open(self, completed: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
        """Reads the checkpoint, if there is one, and compares the configuration with its own."""
        try:
            tensors, manifest = checksummed.read(self.path / _CHECKPOINT, _KIND)
            stored = self._read(tensors, manifest)
        except FileNotFoundError:
            self._refuse_files_without_checkpoint()
            return
        except (checksummed.DamagedError, OSError) as error:
            self._refuse_checkpoint(error)
        differing = differences(stored, self.config, FREE_FIELDS, most=3)
        if differing:
            differing = differences(completed(stored), self.config, FREE_FIELDS, most=3)
        if differing:
            self._refuse(
                f"must be new or hold a run of the same configuration; got {self.path}, which "
                f"differs in {differing}"
            )

    def _read(self, tensors: dict[str, np.ndarray], manifest: dict[str, Any]) -> dict[str, Any]:
        """Takes over what a checkpoint holds, and returns its configuration.

        Raises:
          DamagedError: if this is no checkpoint that this version writes.
        """
        try:
            if manifest["format_version"] != _FORMAT_VERSION:
                raise ValueError(f"its format is {manifest['format_version']}")
            csv = tensors.pop(_ROWS).tobytes().decode()
            header, *lines = [line.split(",") for line in csv.splitlines()]
            # A column that an older version did not write is nan.
            rows = [dict(zip(header, line, strict=True)) for line in lines]
            self.rows = [{name: row.get(name, "nan") for name in self.columns} for row in rows]
            self._csv = _as_csv([self.columns, *(row.values() for row in self.rows)])
            self.id, self.cpu_s = str(manifest["id"]), float(manifest["cpu_s"])
            self.versions = manifest.get("versions", self.versions)
            self._state, stored = tensors, dict(manifest["config"])
            _ = self.wall_s, self.real_steps
        except (KeyError, TypeError, ValueError) as error:
            raise checksummed.DamagedError(f"it is none of this version ({error})") from error
        return stored

    def _rows_of(self, info: "GenerationInfo", wall_s: float) -> list[dict[str, str]]:
        """The rows of the active generations of a block."""
        real_steps = np.asarray(info.real_steps, np.int64).sum(axis=1).cumsum() + self.real_steps
        made = {"seed", "env_steps_total", "wall_s"}
        values = {name: np.asarray(vars(info)[name]) for name in COLUMNS if name not in made}
        values["env_steps_total"] = real_steps
        for i, agent in enumerate(self._agents):
            for name in AGENT_COLUMNS:
                values[f"{name}_{agent}"] = np.asarray(vars(info.by_agent)[name])[:, i]
        fixed = {"seed": str(self.config["seed"]), "wall_s": f"{wall_s:.3f}"}
        cells = [
            fixed | {name: _as_text(column[i]) for name, column in values.items()}
            for i in np.flatnonzero(info.active)
        ]
        return [{name: row[name] for name in self.columns} for row in cells]

    def _remake(self) -> None:
        """Writes the text files that are not as the checkpoint has them."""
        remove_leftovers(self.path, _WRITTEN)
        config = yaml.safe_dump(self.config, sort_keys=False)
        for name, text in ((_CONFIG, config), (_METRICS, self._csv)):
            path = self.path / name
            if not path.exists() or path.read_bytes() != text.encode():
                write_text(path, text)

    def _refuse_files_without_checkpoint(self) -> None:
        """Refuses to replace the files of a run without its checkpoint, or of an older sejax."""
        for name in _SIGNS_OF_A_RUN:
            if (self.path / name).exists():
                self._refuse(
                    f"must be new or hold the {_CHECKPOINT} of its run; got {self.path}, whose "
                    f"{name} would be replaced"
                )

    def _refuse_checkpoint(self, error: Exception) -> NoReturn:
        self._refuse(f"must hold a whole checkpoint; got {self.path / _CHECKPOINT}: {error}")

    def _refuse(self, message: str) -> NoReturn:
        raise ConfigError(f"run_dir {message}. {self._hint}", "run_dir")


def open_for(config: "LearnConfig", hint: str = HINT) -> RunDirectory:
    """The folder of a run; made, or opened to go on.

    What it stores is compared as plain values: nothing that only the folder names is imported.

    Args:
      config: of the run.
      hint: last sentence of messages: how to choose another folder.

    Raises:
      ConfigError: as of `RunDirectory`.
    """
    from sejax.runs import config as configuration  # which imports jax

    return RunDirectory(
        config.resolved_run_dir,
        configuration.plain(config),
        config.scored_agents,
        hint,
        completed=lambda stored: configuration.completed(stored, config),
    )


def columns_of(agents: Sequence[str] = ()) -> tuple[str, ...]:
    """The columns of `metrics.csv`: with several agents, four more for each of them."""
    several = agents if len(agents) > 1 else ()
    return COLUMNS + tuple(f"{name}_{agent}" for agent in several for name in AGENT_COLUMNS)


def _as_csv(rows: Iterable[Iterable[str]]) -> str:
    return "".join(",".join(row) + "\n" for row in rows)


def _as_text(value: np.generic) -> str:
    """Shortest text that reads back as the same float32, or the integer, however large."""
    return str(value) if value.dtype.kind in "iu" else f"{value:.9g}"


def _as_tensors(state: "PyTree[Array]") -> dict[str, np.ndarray]:
    """The leaves of a pytree by their paths, as arrays that safetensors can store."""
    import jax

    flat, _ = jax.tree_util.tree_flatten_with_path(state)
    arrays = jax.device_get([_bare(leaf) for _, leaf in flat])  # all at once
    return {_name(path): array for (path, _), array in zip(flat, arrays, strict=True)}


def _as_state(tensors: dict[str, np.ndarray], like: State) -> State:
    """The inverse of `_as_tensors`; leaves of their own memory, tied to no device.

    Args:
      tensors: leaves by path.
      like: a pytree of the same structure; its shapes are enough.

    Raises:
      DamagedError: if the structure is another one.
    """
    import jax

    flat, tree = jax.tree_util.tree_flatten_with_path(like)
    bare = {_name(path): jax.eval_shape(_bare, leaf) for path, leaf in flat}
    there, here = ({name: _describe(x) for name, x in each.items()} for each in (tensors, bare))
    for name in [*here, *there]:
        if there.get(name) != here.get(name):
            raise checksummed.DamagedError(
                f"{name} is {there.get(name, 'missing')}, and {here.get(name, 'missing')} in this "
                f"version"
            )
    leaves = [_as_leaf(tensors[_name(path)], leaf) for path, leaf in flat]
    state: State = jax.tree.unflatten(tree, leaves)
    return state


def _name(path: "KeyPath") -> str:
    import jax

    return f"{_STATE}{jax.tree_util.keystr(path)}"


def _describe(array: "np.ndarray | Array") -> str:
    return f"{array.dtype}{list(array.shape)}"


def _bare(leaf: "Array") -> "Array":
    """The data of a PRNG key, the bits of a dtype that only jax has, or the leaf itself."""
    import jax

    if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return jax.random.key_data(leaf)
    return leaf.view(f"uint{8 * leaf.dtype.itemsize}") if leaf.dtype.kind == "V" else leaf


def _as_leaf(array: np.ndarray, like: "Array") -> "Array":
    import jax

    if jax.dtypes.issubdtype(like.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(jax.numpy.array(array))
    return jax.numpy.array(array).view(like.dtype)
