"""Formulas as MathML, which browsers draw themselves: no script, and none from another server."""

from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util import logging

logger = logging.getLogger(__name__)


def mathml(node: nodes.Element, display: str) -> str:
    """A formula's MathML; one with a macro that is not known is a warning."""
    formula = node.astext().replace(r"\arg", r"\operatorname{arg}")
    converted = convert(formula, display=display)
    if "\\" in converted:
        logger.warning("formula with an unknown macro: %s", formula, location=node)
    return converted


def visit_inline(writer: Any, node: nodes.math) -> None:
    writer.body.append(mathml(node, "inline"))
    raise nodes.SkipNode


def visit_display(writer: Any, node: nodes.math_block) -> None:
    writer.body.append(f'<div class="math">{mathml(node, "block")}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_display, None))
    app.config.html_math_renderer = "mathml"
    return {"parallel_read_safe": True, "parallel_write_safe": True}
