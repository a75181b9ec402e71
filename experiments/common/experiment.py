"""The frame of an experiment: settings, rows that are computed, and a report made of the rows.

A new experiment is one page in `experiments/`: a subclass of `Settings`, the functions `compute`
and `report`, and an `Experiment` of the three. The command `python -m experiments.NAME` reads
overrides `field=value`, and everything is checked before anything that takes long is imported.
"""

import dataclasses
import functools
import json
import lzma
import shlex
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self, get_origin, get_type_hints

import pandas as pd

from experiments.common.shards import Shards, read_rows, write_rows
from sejax import options
from sejax.ops.files import write_bytes
from sejax.options import Count, as_text, require, require_known, shortened
from sejax.options.plain import from_plain, parsed
from sejax.runs import commands
from sejax.runs.words import texts_of

RUN_PREFIX = "run."  # of an override for the NES runs: run.es.population_size=8
# Fields that no result depends on, and `run`.
NOT_SHOWN = {"work", "devices", "from_rows", "run", "theirs", "finished"}


def setting(default: Any, choices: Collection[str] = (), *, quick: Any = None) -> Any:
    """A field of `Settings`, whose docstring has its help text.

    Args:
      default: its default; None where it may be left open.
      choices: the names that it may have, or each of it.
      quick: its default with `quick=true`, if it is another one.
    """
    metadata = {"choices": choices, "quick": default if quick is None else quick}
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True, kw_only=True)
class Settings(options.Options):
    """The fields that every experiment has. `of` makes them; a subclass adds its own.

    The folder of the results holds what is kept: table, figures, learned proxies and rows. The
    folder `work` holds what a stopped experiment goes on from, and may be deleted.

    Attributes:
      quick: a small version, in minutes
      from_rows: make table and figures again from the stored rows
      out: Folder of the results; results/NAME[/TASK], quick: runs/experiments/NAME-quick.
      work: Folder of what is not kept; runs/experiments/... for results/..., or out/work.
      seed: first seed
      devices: to use; all
    """

    name: ClassVar[str]  # of the experiment's module

    quick: bool = setting(False)
    from_rows: bool = setting(False)
    out: str | None = setting(None)
    work: str | None = setting(None)
    seed: options.WholeNumber = setting(0)
    devices: Count | None = setting(None)

    def __post_init__(self) -> None:
        super().__post_init__()
        fields = vars(self)
        for field in dataclasses.fields(self):
            value, choices = fields[field.name], field.metadata["choices"]
            for name in (value if isinstance(value, tuple) else [value]) if choices else []:
                require_known(field.name, name, choices)
        for word in fields.get("run", ()):
            name = word.partition("=")[0]
            must = f"must be given as {name}, as results are filed by it"
            fix = f"Set {shortened(word)}."
            require(name not in fields, RUN_PREFIX + name, must, got=word, fix=fix)

    @classmethod
    def of(cls, **given: Any) -> Self:
        """Settings from the given fields; a field that is None or left out has its default.

        Raises:
          ConfigError: for an unknown field or a value that breaks its rule.
        """
        given = {name: value for name, value in given.items() if value is not None}
        for name, kind in get_type_hints(cls).items():
            if get_origin(kind) is tuple and isinstance(given.get(name), str):
                given[name] = [given[name]]
        return from_plain(cls, cls.defaults(given) | given, "")

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> dict[str, Any]:
        """The defaults of all fields; they may depend on what is given, as on `quick`."""
        return {
            field.name: field.metadata["quick"] if given.get("quick") else field.default
            for field in dataclasses.fields(cls)
        }

    @property
    def folder(self) -> Path:
        """Where the results go."""
        return self._default_folder if self.out is None else Path(self.out)

    @property
    def _default_folder(self) -> Path:
        root = f"runs/experiments/{self.name}-quick" if self.quick else f"results/{self.name}"
        task = vars(self).get("env") or ""  # so that tasks do not replace each other's results
        return Path(root, task)

    @property
    def work_folder(self) -> Path:
        """Where shards and NES runs are kept until the experiment is done."""
        return work_beside(self.folder, "work") if self.work is None else Path(self.work)

    @functools.cached_property
    def shards(self) -> Shards:
        """The cached shards of this experiment."""
        return Shards(self.work_folder / "shards")

    @property
    def rows_file(self) -> Path:
        """The rows, from which table and figures are made."""
        return self.folder / "rows.csv.xz"

    @property
    def settings_file(self) -> Path:
        """What the rows were computed with."""
        return self.folder / "settings.json.xz"

    @property
    def summary_file(self) -> Path:
        """The numbers of the table, which are not kept: the rows give them again."""
        return self.work_folder / "summary.csv"

    def values(self, *names: str) -> dict[str, Any]:
        """These fields."""
        return {name: getattr(self, name) for name in names}

    def command(self) -> str:
        """The command that makes these results: the fields that differ from their defaults."""
        mine = self.values(*(field.name for field in dataclasses.fields(self)))
        default = self.defaults(mine) | {"quick": False}
        is_kept = self.folder.parts[:1] == ("results",) and self.folder != self._default_folder
        hidden = NOT_SHOWN if is_kept else NOT_SHOWN | {"out"}
        words = ["python", "-m", f"experiments.{self.name}"]
        for name, value in mine.items():
            if name not in hidden and value != default[name]:
                words.append(f"{name}={as_text(value)}")
        return shlex.join([*words, *(RUN_PREFIX + word for word in mine.get("run", ()))])


def work_beside(folder: Path, name: str) -> Path:
    """A folder for what may be deleted: within `folder`, but not within results/."""
    if folder.parts[:1] == ("results",):
        return Path("runs/experiments", *folder.parts[1:])
    return folder / name


def parse(words: Iterable[str]) -> dict[str, Any]:
    """The fields that overrides `field=value` set; a list is `[a,b]`, and the last one counts.

    Overrides `run.FIELD=VALUE` become the list `run`, which configures the NES runs.

    Raises:
      ConfigError: for anything else.
    """
    texts = texts_of(list(words))
    given = {name: parsed(text) for name, text in texts.items() if not name.startswith(RUN_PREFIX)}
    of_runs = [name for name in texts if name.startswith(RUN_PREFIX)]
    run = [f"{name.removeprefix(RUN_PREFIX)}={texts[name]}" for name in of_runs]
    return given | ({"run": [*(given.get("run") or []), *run]} if run else {})


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """A table or figure, of the paper or of ours."""

    settings: type[Settings]
    compute: Callable[[Any], pd.DataFrame]  # settings -> rows; computes the shards that are missing
    report: Callable[[Any, pd.DataFrame], pd.DataFrame]  # (settings, rows) -> table; writes it
    about: str | None  # the module's docstring

    def run(self, settings: Settings) -> pd.DataFrame:
        """Computes what is missing, writes rows, table and figures, and returns the table.

        Raises:
          ConfigError: for settings or files that cannot work, or a folder of other settings.
        """
        if not settings.from_rows:
            write_rows(settings.rows_file, self.compute(settings))
            made_with = json.dumps(settings.shards.made_with, indent=1)
            write_bytes(settings.settings_file, lzma.compress(f"{made_with}\n".encode()))
        return self.report(settings, read_rows(settings.rows_file))

    def main(self) -> None:
        """The command; bad input ends it with one message."""
        commands.start(self._run_command, lambda _: self.help())

    def _run_command(self, words: Sequence[str]) -> None:
        settings = self.settings.of(**parse(words))
        try:
            self.run(settings)
        except KeyboardInterrupt:
            print(f"Interrupted. The same command goes on from {settings.work_folder}.")
            commands.leave(commands.INTERRUPTED)

    def help(self) -> str:
        """The text of `--help`: all fields with their defaults."""
        settings: Any = self.settings
        full, quick = (settings.defaults({"quick": quick}) for quick in (False, True))
        texts, lines = commands.help_texts(settings), []
        for name, value in full.items():
            default, other = as_text(value), as_text(quick[name])
            differs = f" (quick: {other})" if default != other else ""
            lines.append(f"  {f'{name}={default}':34}  {texts.get(name, '')}{differs}")
        if "run" in full:
            lines.append(f"  {RUN_PREFIX + 'FIELD=VALUE':34}  override of the NES runs")
        usage = f"python -m experiments.{self.settings.name} [FIELD=VALUE ...]"
        return "\n".join([usage, "", (self.about or "").strip(), "", "Fields:", *lines])
