"""The files of a run: configuration, metrics, proxies, checkpoints, picture.

All are replaced atomically and in an order that a kill at any moment leaves consistent: metrics
and proxies first, the checkpoint last; when a run goes on, rows past the checkpoint are dropped.
"""

import csv
import io
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sejax.configs import LearnConfig, to_dict
from sejax.errors import ConfigError, require
from sejax.files import write_text

COLUMNS = (
    "generation", "seed", "incumbent_mean", "incumbent_std", "population_mean", "population_max",
    "best_so_far", "train_steps_mean", "train_steps_max", "train_episodes_mean", "num_nonfinite",
    "env_steps_total", "wall_s",
)  # fmt: skip

# Fields that say how or how long to compute, not what: they may change between two sessions.
FREE_FIELDS = {"generations", "devices", "checkpoint_every", "run_dir"}


@dataclass
class RunDirectory:
    """One run's folder."""

    path: Path
    config: LearnConfig
    rows: list[dict[str, Any]] = field(default_factory=list)
    # Generation of the best proxy of each seed that this process has written: few are new.
    _stored: dict[int, int] = field(default_factory=dict)

    @classmethod
    def open(cls, config: LearnConfig) -> "RunDirectory":
        """Makes the folder, or opens that of an earlier session of the same run.

        Raises:
          ConfigError: if it holds a run of another configuration, or cannot be written.
        """
        path = config.resolved_run_dir
        existing = path / "config.yaml"
        try:
            if existing.exists():
                _refuse_other_config(path, yaml.safe_load(existing.read_text()), to_dict(config))
            else:
                path.mkdir(parents=True, exist_ok=True)
                write_text(existing, _yaml(config))
        except (OSError, yaml.YAMLError) as error:
            raise ConfigError(
                f"run_dir must be a folder that can be written, because the run's files go there; "
                f"got {path} ({error}). Set run_dir=FOLDER."
            ) from error
        directory = cls(path=path, config=config)
        directory.rows = directory._read_metrics()
        return directory

    @property
    def metrics(self) -> Path:
        return self.path / "metrics.csv"

    @property
    def checkpoints(self) -> Path:
        return self.path / "checkpoint"

    @property
    def proxy(self) -> Path:
        return self.path / "proxy.safetensors"

    def go_on_from(self, generation: int) -> None:
        """Forgets metrics of generations that the checkpoint does not include.

        Free fields of the configuration, which may differ from those stored, are written here: a
        run that is refused keeps its files as they are.

        Raises:
          ConfigError: if there is no checkpoint of a run that had one, as in a clone: it would
            start anew and replace its metrics and proxies.
        """
        made = int(self.rows[-1]["generation"]) + 1 if self.rows else 0
        require(generation > 0 or made <= self.config.checkpoint_every, "run_dir", "keep the "
                "checkpoints of a run that is to go on", "it would start anew and replace what is "
                "there", f"{self.path} with {made} generations and no whole checkpoint",
                "run_dir=FOLDER (--out=FOLDER in an experiment)")  # fmt: skip
        self.rows = [row for row in self.rows if int(row["generation"]) < generation]
        write_text(self.path / "config.yaml", _yaml(self.config))

    def add_rows(self, info: Any, wall_s: float) -> None:
        """Appends the rows of a chunk, `info` leaves `[generation, seed]`, and writes the file."""
        num_generations, num_seeds = np.shape(info.generation)
        for g in range(num_generations):
            for s in range(num_seeds):
                if info.active[g, s]:
                    row = {"seed": self.config.seed + s, "wall_s": f"{wall_s:.3f}"}
                    for column in COLUMNS:
                        if column not in row:
                            row[column] = _format(getattr(info, column)[g, s])
                    self.rows.append(row)
        text = io.StringIO()
        writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        write_text(self.metrics, text.getvalue())

    def save_proxies(self, program: Any, state: Any) -> None:
        """Writes the best proxy and the last one; with several seeds also the best of each."""
        best = int(np.argmax(state.best_score))
        last = int(np.argmax(state.incumbent_score))
        self._save(self.proxy, program, state.best, state.best_score, state.best_generation, best)
        self._save(
            self.path / "proxy_last.safetensors", program, state.incumbent,
            state.incumbent_score, state.generation - 1, last,
        )  # fmt: skip
        for seed in range(self.config.num_seeds) if self.config.num_seeds > 1 else ():
            path = self.path / "proxies" / f"seed{self.config.seed + seed}.safetensors"
            generation = int(state.best_generation[seed])
            if self._stored.get(seed) != generation:
                self._stored[seed] = generation
                self._save(
                    path, program, state.best, state.best_score, state.best_generation, seed
                )  # fmt: skip

    def write_summary(self, **values: Any) -> None:
        """Writes `run.json`."""
        write_text(self.path / "run.json", json.dumps(values, indent=2) + "\n")

    def _save(
        self, path: Path, program: Any, flat: Any, score: Any, generation: Any, index: int
    ) -> None:
        from sejax.proxies import io as proxy_io

        proxy_io.save(
            path,
            self.config,
            program.unravel(flat[index]),
            score=float(score[index]),
            generation=int(generation[index]),
            seed=self.config.seed + index,
        )

    def _read_metrics(self) -> list[dict[str, Any]]:
        if not self.metrics.exists():
            return []
        with self.metrics.open(newline="") as file:
            return list(csv.DictReader(file))


def _format(value: Any) -> str:
    """Shortest text that reads back as the same float32 or integer."""
    return str(int(value)) if np.issubdtype(np.asarray(value).dtype, np.integer) else f"{value:.9g}"


def _yaml(config: LearnConfig) -> str:
    return yaml.safe_dump(to_dict(config), sort_keys=False)


def _refuse_other_config(path: Path, stored: dict[str, Any], new: dict[str, Any]) -> None:
    old, asked = flatten(stored), flatten(new)
    differing = [
        f"{name} ({old.get(name)} there, {asked.get(name)} here)"
        for name in sorted(old.keys() | asked.keys())
        if name not in FREE_FIELDS and old.get(name) != asked.get(name)
    ]
    if differing:
        raise ConfigError(
            f"run_dir must be new or hold a run of the same configuration, because a run goes on "
            f"where it stopped; {path} differs in {', '.join(differing)}. Set run_dir=FOLDER for a "
            f"new run, or use the values there."
        )


def flatten(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as `{"group.field": value}`."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat
