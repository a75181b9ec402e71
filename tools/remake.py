"""Makes the tables of `results/` again from the stored rows.

Each `table.md` begins with its command, which does so with `from_rows=true`. Figures are left out,
so that all take less than a minute on two cores.
"""

import contextlib
import importlib
import io
import itertools
import multiprocessing
import os
import shlex
import shutil
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple
from unittest import mock

from experiments.common import experiment, figures
from sejax.ops.files import write_text

MADE = ("*table.md", "*.png")  # what no experiment reads; it is made again


class Remade(NamedTuple):
    """What the rows of an experiment give."""

    path: Path  # of the table, `results/.../table.md`
    table: str  # its text
    summary: str  # its numbers, as CSV


def remake(root: Path) -> list[Remade]:
    """The tables of a project's experiments, made of their rows."""
    root = root.resolve()
    paths = sorted((root / "results").rglob("*table.md"))
    with TemporaryDirectory() as folder:
        ignore = shutil.ignore_patterns(*MADE)
        there = Path(folder, "results")
        shutil.copytree(root / "results", there, copy_function=os.symlink, ignore=ignore)
        num_processes = min(len(paths), os.cpu_count() or 1) or 1
        context = multiprocessing.get_context("spawn")  # JAX has threads, which a fork loses
        with ProcessPoolExecutor(num_processes, context) as pool:
            return list(pool.map(report, paths, itertools.repeat(folder)))


def report(path: Path, folder: str) -> Remade:
    """Runs the command of a table on the stored rows in a folder, without figures."""
    command = path.read_text(encoding="utf-8").splitlines()[2].strip("`")
    _, _, module, *words = shlex.split(command)
    with (
        contextlib.chdir(folder),
        contextlib.redirect_stdout(io.StringIO()),
        mock.patch.object(figures, "save"),
    ):
        made = importlib.import_module(module).EXPERIMENT
        settings = made.settings.of(**experiment.parse([*words, "from_rows=true"]))
        made.run(settings)
        table = settings.folder / path.name
        return Remade(path, table.read_text("utf-8"), settings.summary_file.read_text("utf-8"))


def differing(made: Iterable[Remade]) -> Iterator[Remade]:
    """The tables that are not what their rows give."""
    return (each for each in made if each.path.read_text(encoding="utf-8") != each.table)


def check(root: Path, made: Iterable[Remade]) -> Iterator[str]:
    """A message for each table that is not what its rows give."""
    for each in differing(made):
        yield f"{each.path.relative_to(root.resolve())} is not what its rows give"


def write(made: Iterable[Remade]) -> None:
    """Writes those that differ."""
    for each in differing(made):
        write_text(each.path, each.table)
        print(f"{each.path} is written.")
