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
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple
from unittest import mock

from experiments.common import experiment, figures


class Remade(NamedTuple):
    """What the rows of an experiment give."""

    path: Path  # of the table, `results/.../table.md`
    table: str  # its text
    summary_file: Path  # of the numbers behind it if it were kept, `results/.../summary.csv`
    summary: str  # its numbers, as CSV

    @property
    def differs(self) -> bool:
        """Whether the stored table is not what its rows give."""
        return self.path.read_text(encoding="utf-8") != self.table


def remake(root: Path) -> list[Remade]:
    """The tables of a project's experiments, made of their rows."""
    stored = (root / "results").resolve()
    paths = sorted(stored.rglob("*table.md"))
    with TemporaryDirectory() as folder:
        ignore = shutil.ignore_patterns("*table.md", "*.png")  # what no experiment reads
        shutil.copytree(stored, f"{folder}/results", ignore=ignore, copy_function=os.symlink)
        context = multiprocessing.get_context("spawn")  # JAX has threads, which a fork loses
        with ProcessPoolExecutor(mp_context=context) as pool:
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
        summary = settings.summary_file
        beside = settings.folder / summary.name
        return Remade(path, table.read_text("utf-8"), beside, summary.read_text("utf-8"))
