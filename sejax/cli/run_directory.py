"""The files of a run: configuration, metrics, proxies, checkpoints, summary.

They are written in an order that a kill at any moment leaves consistent: metrics and proxies
first, the checkpoint last, which vouches for the metrics. A run that is refused keeps all its
files as they are. Nothing here imports jax before a state is restored: a refusal is quick.
"""

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeGuard

import yaml

from sejax.cli import checkpoints
from sejax.cli.metrics import Metrics, MetricsError
from sejax.cli.run_lock import RunLock, acquire
from sejax.errors import ConfigError
from sejax.ops.files import remove_leftovers, write_text
from sejax.serialize import differences

__all__ = ["FREE_FIELDS", "RunDirectory", "open_for"]

# Fields, and groups of them, that say how or how long to compute, not what: they may change between
# two sessions.
FREE_FIELDS = {"generations", "devices", "checkpoint_every", "run_dir", "tracker", "machines"}
HINT = "Set run_dir=FOLDER."


class RunDirectory:
    """One run's folder, which this process alone uses until `close`.

    Call `resume` once, then for each chunk `append`, the proxies, and `commit`.
    """

    def __init__(
        self,
        path: Path,
        config: dict[str, Any],
        seeds: list[int],
        hint: str,
        lock: RunLock,
        families: Sequence[str] = (),
        completed: Callable[[dict[str, Any]], dict[str, Any]] = dict,
    ):
        self.path = path
        self._completed = completed
        self.config = json.loads(json.dumps(config))  # as it reads back: tuples are lists
        self.seeds = seeds
        self._hint = hint
        self._lock = lock
        self._table = Metrics(self.metrics, seeds, families)
        self._stored = self._stored_config()
        newest = checkpoints.newest_record(self.checkpoints)
        self._record = newest[1] if newest else None

    @classmethod
    def open(
        cls,
        path: str | Path,
        config: dict[str, Any],
        seeds: list[int],
        hint: str = HINT,
        families: Sequence[str] = (),
        completed: Callable[[dict[str, Any]], dict[str, Any]] = dict,
    ) -> "RunDirectory":
        """Makes the folder, or opens that of an earlier session of the same run.

        Args:
          path: the folder.
          config: the configuration, plain values in nested mappings; `checkpoint_every` is read.
          seeds: the `seed` column of the metrics.
          hint: last sentence of a refusal: how to choose another folder.
          families: of agents, as the metrics call them; several have columns of their own.
          completed: a stored configuration with the fields that a former version did not write;
            new ones have a default that changes no number.

        Raises:
          ConfigError: if it holds a run of another configuration, is in use by another process, or
            cannot be written.
        """
        path = Path(path)
        try:
            path.mkdir(parents=True, exist_ok=True)
            lock = acquire(path / "sejax.lock", hint)
        except OSError as error:
            raise ConfigError(
                f"run_dir must be a folder that can be written, because the run's files go there; "
                f"got {path} ({error}). {hint}"
            ) from error
        try:
            directory = cls(
                path, config, [int(seed) for seed in seeds], hint, lock, families, completed
            )
            directory._refuse_another_run()
            for folder in (path, path / "proxies", directory.checkpoints):
                remove_leftovers(folder)
        except BaseException:
            lock.release()
            raise
        return directory

    def close(self) -> None:
        """Lets other processes use the folder."""
        self._lock.release()

    def __enter__(self) -> "RunDirectory":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    @property
    def metrics(self) -> Path:
        return self.path / "metrics.csv"

    @property
    def checkpoints(self) -> Path:
        return self.path / "checkpoint"

    @property
    def proxy(self) -> Path:
        return self.path / "proxy.safetensors"

    @property
    def rows(self) -> list[dict[str, str]]:
        """Rows of the metrics as text; after `resume`, those of the run as it goes on."""
        return self._table.rows

    @property
    def finished_generations(self) -> int:
        """Generations with rows that the newest checkpoint has: what a kill would leave."""
        metrics = self._record["metrics"] if _is_record(self._record) else {"generations": {}}
        return max(metrics["generations"].values(), default=0)

    @property
    def cpu_s(self) -> float:
        """CPU seconds of the sessions up to the newest checkpoint; nan if it does not say."""
        return self._record.get("cpu_s", math.nan) if _is_record(self._record) else 0.0

    def resume(self, template: Any) -> tuple[Any, int, list[str]]:
        """Restores the newest whole checkpoint and drops metrics that it does not include.

        All checks come first. Then the metrics are cut, and the configuration is written, as its
        free fields may differ from those stored.

        Args:
          template: a state of the run before its first generation.

        Returns:
          The state to go on from, the generations it has finished, and a sentence for each
          checkpoint that was passed over.

        Raises:
          ConfigError: if the metrics are not those that the checkpoint vouches for, or there is no
            whole checkpoint of a run that had one: it would start anew and replace what is there.
          OSError: if a file cannot be written.
        """
        state, generation, record, problems = checkpoints.restore_newest(self.checkpoints, template)
        vouched = None
        if generation or record is not None:
            vouched = self._vouched(generation, record)
            self._record = record
        else:
            self._refuse_to_start_anew(problems)
        self._table.go_on_from(vouched)  # first: what may be there without a checkpoint goes by the
        if self._stored != self.config:  # `checkpoint_every` that is stored
            write_text(self.path / "config.yaml", yaml.safe_dump(self.config, sort_keys=False))
            self._stored = self.config
        return state, generation, problems

    def append(self, info: Any, wall_s: float) -> None:
        """Adds the rows of a chunk to the metrics, in a time that does not grow with their number.

        Args:
          info: leaves `[generation, seed]`; rows that are not `active` are left out.
          wall_s: seconds since the start of the run.

        Raises:
          ValueError: if a generation does not follow on its seed's last.
          OSError: if the file cannot be written; it is then as it was.
        """
        self._table.append(info, wall_s)

    def commit(self, generation: int, state: Any, cpu_s: float = 0.0) -> None:
        """Writes the checkpoint of what was appended: the chunk now counts.

        Args:
          generation: generations finished.
          state: pytree of arrays.
          cpu_s: CPU seconds since the start of the run, of all sessions.

        Raises:
          OSError: if it cannot be written; the run goes on from the checkpoint before.
        """
        record = {"config": self.config, "metrics": self._table.vouch(), "cpu_s": cpu_s}
        checkpoints.save(self.checkpoints, generation, state, record)
        self._record = record

    def write_summary(self, **values: Any) -> None:
        """Writes `run.json`."""
        write_text(self.path / "run.json", json.dumps(values, indent=2) + "\n")

    def _stored_config(self) -> dict[str, Any] | None:
        """`config.yaml`, or None if there is none.

        Raises:
          ConfigError: if it is not what a run writes there.
        """
        path = self.path / "config.yaml"
        try:
            stored = yaml.safe_load(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except UnicodeDecodeError:
            problem = "is not UTF-8 text"
        except (OSError, yaml.YAMLError, RecursionError, ValueError) as error:
            problem = f"cannot be read ({' '.join(str(error).split())})"
        else:
            if isinstance(stored, dict):
                return stored
            problem = "is empty" if stored is None else f"holds a {type(stored).__name__}"
        has_copy = checkpoints.newest_record(self.checkpoints) is not None
        fix = (
            "Remove it, as the newest checkpoint has it too, or put it back"
            if has_copy
            else ("Put it back")
        )
        raise ConfigError(
            f"run_dir must hold the configuration of its run, because a run goes on only with the "
            f"same; got {path}, which {problem}. {fix}; for a new run take a new folder. "
            f"{self._hint}"
        )

    def _refuse_another_run(self) -> None:
        """Compares the configuration with those stored.

        Raises:
          ConfigError: if one differs, or files of a run are there and no configuration.
        """
        known = [self._stored] if self._stored is not None else []
        known += [self._record["config"]] if _is_record(self._record) else []
        lost = [file.name for file in (self.metrics, self.proxy) if file.exists()]
        lost += ["checkpoints"] if checkpoints.generations(self.checkpoints) else []
        if not lost:
            return  # a run that failed before its first generation is in nobody's way
        for stored in known:
            self._refuse_other_config(stored)
        if not known:
            raise ConfigError(
                f"run_dir must be new or hold a run with its configuration, because what is there "
                f"would be replaced; got {self.path} with {lost[0]} and without config.yaml. Put "
                f"it back, or take a new folder. {self._hint}"
            )

    def _refuse_other_config(self, stored: dict[str, Any]) -> None:
        if differences(stored, self.config, FREE_FIELDS):
            differing = differences(self._completed(stored), self.config, FREE_FIELDS)
            if differing:
                raise ConfigError(
                    f"run_dir must be new or hold a run of the same configuration, because a run "
                    f"goes on where it stopped; {self.path} differs in {differing}. Take a new "
                    f"folder, or use the values there. {self._hint}"
                )

    def _vouched(self, generation: int, record: Any) -> dict[str, Any]:
        """What the checkpoint keeps of the metrics, which were compared with it.

        Raises:
          ConfigError: if they differ.
        """
        if not _is_record(record) or not self._table.fits(record["metrics"]):
            raise ConfigError(
                f"run_dir must hold checkpoints of its own run, because a run goes on from them; "
                f"got {checkpoints.path_of(self.checkpoints, generation)}, which is of another. "
                f"Remove it, or take a new folder. {self._hint}"
            )
        try:
            self._table.check(record["metrics"])
        except (MetricsError, OSError) as error:
            raise ConfigError(
                f"run_dir must keep the metrics.csv that its checkpoint of generation {generation} "
                f"vouches for, because the run goes on from both; got {self.metrics}, where "
                f"{error}. Put it back as it was, or take a new folder. {self._hint}"
            ) from error
        return record["metrics"]

    def _refuse_to_start_anew(self, problems: list[str]) -> None:
        """Allows a start without a checkpoint only where a kill can have left the files so.

        Raises:
          ConfigError: if more was made than what comes before a first checkpoint.
        """
        stored = (self._stored or {}).get("checkpoint_every")
        first = stored if isinstance(stored, int) else self.config.get("checkpoint_every", 1)
        try:
            made = max([self._table.begun(), *checkpoints.generations(self.checkpoints)])
        except (MetricsError, OSError) as error:
            found = f"{self.metrics}, where {error},"
        else:
            found = f"{self.path} with {made} generations"
            if self.proxy.exists() and not self.metrics.exists():
                found = f"{self.path} with {self.proxy.name}, without {self.metrics.name}"
            elif made <= first:
                return
        raise ConfigError(
            f"run_dir must keep the checkpoints of a run that is to go on, because it would start "
            f"anew and replace what is there; got {found} and no whole checkpoint. "
            f"{' '.join([*problems, self._hint])}"
        )


def open_for(config: Any, hint: str = HINT) -> RunDirectory:
    """The folder of a run; made, or opened to go on.

    What it stores is compared as plain values: nothing that only the folder names is imported.

    Args:
      config: a `LearnConfig`.
      hint: last sentence of a refusal: how to choose another folder.

    Raises:
      ConfigError: if it holds another run, is in use, or cannot be written.
    """
    from sejax.cli import build  # which imports jax
    from sejax.cli.families import families_of

    seeds = [config.seed + i for i in range(config.num_seeds)]
    keys = [family.key for family in families_of(config)]

    return RunDirectory.open(
        config.resolved_run_dir,
        build.to_plain(config),
        seeds,
        hint,
        keys,
        completed=lambda stored: build.completed(stored, config),
    )


def _is_record(record: Any) -> TypeGuard[dict[str, Any]]:
    """Whether a checkpoint's record is one of `commit`."""
    match record:
        case {
            "config": dict(),
            "metrics": {"bytes": int(), "sha256": str(), "generations": dict(generations)},
        }:
            return all(type(count) is int for count in generations.values())
    return False
