"""The site, built by `make docs` from the repository's own Markdown and docstrings.

The source directory is the repository: README, changelog and the tables in `results/` are pages as
they stand, and a link that leads somewhere in the repository leads there on the site too.
"""

import os
import sys
import typing
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs" / "_ext")]
os.environ["PYTHONPATH"] = str(ROOT)  # notebooks import experiments/, which is not installed

typing.GENERATING_DOCUMENTATION = "sejax"  # type: ignore[attr-defined] # jaxtyping then names `Array` plainly

import sejax  # noqa: E402

project = "sejax"
author = "The sejax authors"
copyright = author
version = release = sejax.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
    "field_tables",
    "mathml",
    "page_links",
    "root_page",
]
highlight_language = "text"
root_doc = "docs/index"
include_patterns = [
    "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "docs/**.md", "results/**.md",
]  # fmt: skip
exclude_patterns = ["docs/_build"]

# --- Markdown and notebooks ----------------------------------------------------------------------

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 4  # as the forge names them
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = -1  # however slow the machine
nb_merge_streams = True

# --- the API reference ---------------------------------------------------------------------------

default_role = "code"  # docstrings have single backticks
autodoc_class_signature = "mixed"
autodoc_default_options = {
    "members": True,
    "special-members": "__call__",
    "exclude-members": "replace",  # of flax's dataclasses, one as the other
    "member-order": "bysource",
}
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
maximum_signature_line_length = 88
napoleon_numpy_docstring = False
napoleon_custom_sections = [("Attributes", "params_style")]
nitpick_ignore_regex = [
    ("py:.*", r"(?!sejax\b).*"),  # other projects': no inventory is at hand
    # Type variables, and what only signatures name.
    (
        "py:class",
        r"sejax\.(agents\.(base\.T|buffers\.State)|es\.base\.T|proxies\.synthetic\.Vector|envs\.environment\.(State|Params))",
    ),
    (
        "py:class",
        r"sejax\.(options\.(T|Details|registry\.(T|Makes))|scoring\.Scoring|evaluation\.Tests"
        r"|ops\.networks\.MLP|runs\.store\.Store)",
    ),
]

# --- HTML ----------------------------------------------------------------------------------------

html_theme = "furo"
html_title = "sejax"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
copybutton_exclude = ".linenos, .gp, .go"
