"""An experiment's settings: typed, checked, and complete as soon as they are made.

A field is written once: its default, that of `quick=true`, what must hold, and what it is about.
"""

import dataclasses
import functools
import shlex
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self, get_origin, get_type_hints

from experiments.pieces import Pieces
from sejax import errors, serialize
from sejax.options import Options, Rule, counts

RUN_PREFIX = "run."  # of a word about the NES runs: run.es.population_size=8
_SAME = object()


def setting(default: Any, rule: Rule | None = None, *, about: str, quick: Any = _SAME) -> Any:
    """A field of `Settings`: its default, None where it may be left open, and with `quick=true`.

    The rule says what must hold, as those of `sejax.options`; `about` is for `--help`.
    """
    metadata = {"rule": rule, "about": about, "quick": default if quick is _SAME else quick}
    return dataclasses.field(default=default, metadata=metadata)


def count(default: int | None, things: str, *, about: str, quick: Any = _SAME) -> Any:
    """A field that counts things."""
    return setting(default, counts(f"it counts {things}"), about=about, quick=quick)


def each_of(known: Collection[str]) -> Rule:
    """A list of these names."""
    return lambda name, values, default: errors.each_of(name, values, known)


@dataclass(frozen=True, kw_only=True)
class Settings(Options):
    """What every experiment is told. `of` makes them; a subclass adds its own fields.

    A folder of results holds what is kept: tables, pictures, learned proxies and the raw rows. What
    makes an experiment go on where it stopped, in `work`, may be thrown away.
    """

    name: ClassVar[str]  # of the experiment's module
    files: ClassVar[str] = ""  # prefix of its files in `out`

    quick: bool = setting(False, about="a small version, in minutes")
    from_rows: bool = setting(False, about="remake tables and pictures from the rows in `out`")
    out: str | None = setting(
        None,
        about="folder of the results; results/NAME[/TASK], quick "
        "runs/experiments/NAME-quick[/TASK]",
    )
    work: str | None = setting(
        None,
        about="folder of what is not kept; runs/experiments/... for "
        "results/..., else work/ in `out`",
    )
    seed: int = setting(
        0, lambda name, value, _: errors.require_seed(name, value), about="first random seed"
    )
    devices: int | None = setting(
        None, counts("something must compute"), about="devices to use; all"
    )

    @classmethod
    def of(cls, **given: Any) -> Self:
        """Settings from those that are given, by name; what is None or left out has its default."""
        known = {name: value for name, value in given.items() if value is not None}
        lists = {name for name, kind in get_type_hints(cls).items() if get_origin(kind) is tuple}
        known |= {name: [known[name]] for name in lists & {*known} if isinstance(known[name], str)}
        return serialize.from_plain(cls, cls.defaults(known) | known, "")

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> dict[str, Any]:
        """Values of the fields; they may depend on those that are given, as on `quick`."""
        return {
            field.name: field.metadata["quick"] if given.get("quick") else field.default
            for field in dataclasses.fields(cls)
        }

    @property
    def folder(self) -> Path:
        """Where the results go."""
        return self._usual_folder if self.out is None else Path(self.out)

    @property
    def _usual_folder(self) -> Path:
        root = f"runs/experiments/{self.name}-quick" if self.quick else f"results/{self.name}"
        return Path(root, getattr(self, "env", None) or "")  # else tasks replace each other

    @property
    def work_folder(self) -> Path:
        """Where finished pieces and NES runs are kept until the experiment is done."""
        return work_beside(self.folder, "work") if self.work is None else Path(self.work)

    @functools.cached_property
    def pieces(self) -> Pieces:
        """The finished pieces, which know what was asked of them."""
        return Pieces(self.work_folder / "pieces")

    def values(self, *names: str) -> dict[str, Any]:
        """These fields, for what pieces depend on."""
        return {name: getattr(self, name) for name in names}

    @property
    def rows_file(self) -> Path:
        """The raw rows, from which everything else is made."""
        return self.folder / f"{self.files}rows.csv.xz"

    @property
    def made_with_file(self) -> Path:
        """What the rows were measured with: `pieces.by_pattern`."""
        return self.folder / f"{self.files}settings.json"

    def command(self) -> str:
        """The command that makes these results; of the fields, those that are not as usual."""
        mine = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        usual = self.defaults(mine)
        apart = {"work", "devices", "from_rows", "run"}
        if self.folder.parts[:1] != ("results",) or self.folder == self._usual_folder:
            apart |= {"out"}  # a folder of somebody's own is no part of what is done
        words = ["python", "-m", f"experiments.{self.name}"]
        for name, value in mine.items():
            if name not in apart and value != (usual[name] if name != "quick" else False):
                words.append(f"{name}={as_word(value)}")
        return shlex.join([*words, *(RUN_PREFIX + word for word in getattr(self, "run", ()))])


def work_beside(folder: Path, name: str) -> Path:
    """Where what may be thrown away goes: into the folder itself, unless it is of results."""
    if folder.parts[:1] == ("results",):
        return Path("runs/experiments", *folder.parts[1:])
    return folder / name


def as_word(value: Any) -> str:
    """A value as the command line takes it."""
    if isinstance(value, tuple | list):
        return f"[{','.join(map(as_word, value))}]"
    return {"None": "null", "True": "true", "False": "false"}.get(str(value), str(value))
