"""`python -m sejax.report RUN_DIR...`: a page about a run, or one that compares several.

The page is one HTML file that needs nothing else. Beside an evaluation in the run directory
(`python -m sejax.evaluate`), it shows that too.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from sejax.cli import commands
from sejax.options import registry, require
from sejax.options.plain import expanded

USAGE = """python -m sejax.report RUN_DIR... [out=FILE]

Writes a page about a run, or one that compares several: curves, tables, settings, versions, and the
commands to go on. It is one HTML file that needs nothing else.

  RUN_DIR    a folder that python -m sejax.run has made
  out=FILE   the page; report.html in the run directory, of several runs in the current folder"""


def main(words: Sequence[str] | None = None) -> None:
    """Writes the report that the command line asks for; bad input ends it with one message."""
    words = [expanded(word) for word in (sys.argv[1:] if words is None else words)]
    if {"--help", "-h"} & {*words}:
        print(USAGE)
        return
    outs = [expanded(word.removeprefix("out=")) for word in words if word.startswith("out=")]
    folders = [Path(word) for word in words if not word.startswith("out=")]
    with commands.messages():
        print(report(folders, Path(outs[-1]) if outs else None))


def report(folders: Sequence[Path], out: Path | None = None) -> Path:
    """Writes the page about these run directories.

    Args:
      folders: run directories.
      out: the file; `report.html` in the only run directory, or in the current folder.

    Returns:
      The file.

    Raises:
      ConfigError: if there is no run, or one that cannot be read, or no place for the file.
      OSError: if the file cannot be written.
    """
    from sejax.cli import report as pages
    from sejax.ops.files import require_writable, write_text

    require(folders, "RUN_DIR", "must be given; got none. Set it to the run_dir of a run.")
    with registry.only_typed(()):  # nothing that a run directory names is imported
        page = pages.page(pages.read(folders))
    if out is None:
        out = Path(folders[0] if len(folders) == 1 else ".", "report.html")
    fix = f"Set out={out / 'report.html'}."
    require(not out.is_dir(), "out", f"must be a file; got the folder {out}. {fix}")
    require_writable("out", out.parent)
    write_text(out, page)
    return out


if __name__ == "__main__":
    main()
