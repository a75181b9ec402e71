"""Links from docstrings, which name pages by their files, and from sources back to the pages."""

import re
from typing import Any

from sphinx.application import Sphinx

SOURCES = "_modules/"


def link_pages(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Makes of `docs/zoo.md` a link with that text."""
    lines[:] = [re.sub(r"`?(docs/(\w+)\.md)`?", r":doc:`\1 </docs/\2>`", line) for line in lines]


def link_back(app: Sphinx, page: str, template: str, context: Any, doctree: Any) -> None:
    """Links an object by the anchor that its page has.

    Sphinx names all objects of a module as the first one that is documented, which may be an alias.
    """
    if not page.startswith(SOURCES):
        return
    module = page.removeprefix(SOURCES).replace("/", ".")
    known = app.env.domaindata["py"]["objects"]

    def own(match: re.Match[str]) -> str:
        name = f"{module}.{match[2]}"
        return f'{match[1]}#{known[name].node_id}"' if name in known else match[0]

    back = r'(<a class="viewcode-back" href="[^"#]*)#sejax\.([^"]*)"'
    context["body"] = re.sub(back, own, context["body"])


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("autodoc-process-docstring", link_pages)
    app.connect("html-page-context", link_back)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
