"""Links from docstrings, which name pages by their files, to the pages of the site."""

import re
from typing import Any

from sphinx.application import Sphinx


def link_pages(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Makes of `docs/zoo.md` a link with that text."""
    lines[:] = [re.sub(r"`?(docs/(\w+)\.md)`?", r":doc:`\1 </docs/\2>`", line) for line in lines]


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("autodoc-process-docstring", link_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
