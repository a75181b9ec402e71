"""A table of a dataclass's fields, under its docstring: type, default, and what it is.

What a field of options is stands in the docstring, under `Attributes:`, which the table replaces;
what another field is stands beside it in the source, in a comment.
"""

import ast
import dataclasses
import inspect
import io
import re
import textwrap
import tokenize
from collections.abc import Iterator
from typing import Annotated, Any, get_args, get_origin

from sphinx.application import Sphinx

from experiments.common.experiment import Settings
from sejax import options
from sejax.options import Options
from sejax.runs.commands import help_texts

BOUNDED_TYPES = {x: n for n, x in vars(options).items() if get_origin(x) is Annotated}


def type_text(hint: Any) -> str:
    """A field's type, by its name in `sejax.options` if it has one there."""
    if type(None) in get_args(hint):
        return " | ".join(map(type_text, get_args(hint)))
    if get_origin(hint) is Annotated:
        return BOUNDED_TYPES.get(hint) or type_text(get_args(hint)[0])
    text = re.sub(r"(\w+\.)+(?=\w)", "", inspect.formatannotation(hint))
    return text.replace("NoneType", "None")


def comments_of_fields(cls: type) -> dict[str, str]:
    """The comment above or behind each field that the class itself has."""
    source = textwrap.dedent(inspect.getsource(cls))
    above: dict[int, str] = {}  # by line: comments that have it for themselves
    behind: dict[int, str] = {}
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and not token.string.startswith("# fmt:"):
            alone = token.line.lstrip().startswith("#")
            (above if alone else behind)[token.start[0]] = token.string.lstrip("# ")
    found = {}
    for node in ast.parse(source).body[0].body:  # type: ignore[attr-defined]
        if isinstance(node, ast.AnnAssign):
            first = node.lineno
            while first - 1 in above:
                first -= 1
            lines = [above.get(i) or behind.get(i, "") for i in range(first, node.end_lineno + 1)]
            found[ast.unparse(node.target)] = " ".join(filter(None, lines))
    return found


def rows(cls: type) -> Iterator[tuple[str, str, str, str]]:
    """Name, type, default and meaning of each field; of an experiment, of those of its own."""
    comments: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if dataclasses.is_dataclass(base):
            comments |= {name: text for name, text in comments_of_fields(base).items() if text}
    comments |= help_texts(cls)
    shared = (
        dataclasses.fields(Settings) if cls is not Settings and issubclass(cls, Settings) else ()
    )
    for field in dataclasses.fields(cls):
        if field.init and not field.name.startswith("_") and field not in shared:
            default = "" if field.default is dataclasses.MISSING else repr(field.default)
            yield field.name, type_text(field.type), default, comments.get(field.name, "")


def add_table(app: Sphinx, what: str, name: str, cls: Any, options: Any, lines: list[str]) -> None:
    """Adds the table to options, and to a dataclass whose docstring lists no attributes."""
    if what != "class" or not dataclasses.is_dataclass(cls):
        return
    if "Attributes:" in lines:
        if not issubclass(cls, Options):
            return
        start = lines.index("Attributes:")
        end = next((i for i in range(start + 1, len(lines)) if lines[i][:1].strip()), len(lines))
        del lines[start:end]
    table = list(rows(cls))
    if not table:
        return
    columns = [0, 1, 2, 3] if any(default for _, _, default, _ in table) else [0, 1, 3]
    cells = [("field", "type", "default", "what it is")]
    cells += [(*(f"``{x}``" if x else "" for x in row), escape(about)) for *row, about in table]
    lines += ["", ".. list-table::", "   :header-rows: 1", ""]
    for row in cells:
        lines += [f"   {' ' if i else '*'} - {row[i]}" for i in columns]
    lines.append("")


def escape(text: str) -> str:
    """A comment as reStructuredText that means nothing else."""
    return re.sub(r"([*|_\\])", r"\\\1", text)


def shorten_signature(
    app: Sphinx, what: str, name: str, cls: Any, options: Any, signature: str, returns: str
) -> tuple[str, str] | None:
    """Leaves out of a signature what the table says."""
    is_tabled = what == "class" and dataclasses.is_dataclass(cls)
    return ("(**fields)", "") if is_tabled else None


def skip_aliases(
    app: Sphinx, what: str, name: str, member: Any, skip: bool, options: Any
) -> bool | None:
    """Leaves out the fields of named tuples, which the signature names."""
    return True if (member.__doc__ or "").startswith("Alias for field number") else None


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("autodoc-process-docstring", add_table, priority=400)  # before napoleon's
    app.connect("autodoc-process-signature", shorten_signature)
    app.connect("autodoc-skip-member", skip_aliases)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
