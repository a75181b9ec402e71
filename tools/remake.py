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
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock

import pandas as pd

from experiments.common import experiment, figures
from sejax.ops.files import write_text

MADE = ("*table.md", "*.png")  # what no experiment reads; it is made again, as are summaries
RTOL = 1e-12  # of summaries: the order of a sum differs between processors, a changed digit is more


def remake(root: Path, skipped: Sequence[str] = ()) -> Iterator[tuple[Path, str]]:
    """The tables and summaries of a project's experiments, with the text that their rows give.

    Args:
      root: folder of the project.
      skipped: tables whose rows are not kept.
    """
    root = root.resolve()
    with TemporaryDirectory() as folder:
        there = Path(folder, "results")
        ignore = shutil.ignore_patterns(*MADE)
        shutil.copytree(root / "results", there, copy_function=os.symlink, ignore=ignore)
        tables = [
            path
            for path in sorted((root / "results").rglob("*table.md"))
            if str(path.relative_to(root)) not in skipped
        ]
        num_processes = min(len(tables), os.cpu_count() or 1) or 1
        context = multiprocessing.get_context("spawn")  # JAX has threads, which a fork loses
        with ProcessPoolExecutor(num_processes, context) as pool:
            made = pool.map(report, tables, itertools.repeat(folder))
            for table, _ in zip(tables, made, strict=True):
                summary = table.with_name(table.name.replace("table.md", "summary.csv"))
                for path in (table, summary):
                    yield path, (there / path.relative_to(root / "results")).read_text("utf-8")


def report(table: Path, folder: str) -> None:
    """Runs the command of a table on the stored rows in a folder, without figures."""
    command = table.read_text(encoding="utf-8").splitlines()[2].strip("`")
    _, _, module, *words = shlex.split(command)
    with (
        contextlib.chdir(folder),
        contextlib.redirect_stdout(io.StringIO()),
        mock.patch.object(figures, "save"),
    ):
        made = importlib.import_module(module).EXPERIMENT
        made.run(made.settings.of(**experiment.parse([*words, "from_rows=true"])))


def is_same(path: Path, text: str) -> bool:
    """Whether a stored table or summary is what its rows give."""
    if not path.exists() or path.suffix != ".csv":
        return path.exists() and path.read_text(encoding="utf-8") == text
    stored, made = pd.read_csv(path), pd.read_csv(io.StringIO(text))
    try:
        pd.testing.assert_frame_equal(stored, made, rtol=RTOL, atol=0)
    except AssertionError:
        return False
    return True


def check(root: Path, skipped: Sequence[str] = ()) -> Iterator[str]:
    """The tables and summaries that are not what their rows give, a message each."""
    for path, text in remake(root, skipped):
        if not is_same(path, text):
            yield f"{path.relative_to(root.resolve())} is not what its rows give"


def write(root: Path, skipped: Sequence[str] = ()) -> None:
    """Writes those that differ."""
    for path, text in remake(root, skipped):
        if not is_same(path, text):
            write_text(path, text)
            print(f"{path} is written.")
