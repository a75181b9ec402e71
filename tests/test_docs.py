"""The examples in docstrings and documents run as they stand, and the pages are one site.

`make docs` checks more: it builds the site, and runs its notebooks.
"""

import doctest
import importlib
import inspect
import re
from importlib.util import find_spec
from pathlib import Path

import pytest

import sejax

ROOT = Path(__file__).parents[1]
MODULES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for path in sorted((ROOT / "sejax").rglob("*.py"))
    if ">>>" in path.read_text()
]
PAGES = [
    *sorted(ROOT.glob("*.md")),
    *(page for page in sorted((ROOT / "docs").rglob("*.md")) if "_build" not in page.parts),
    *sorted((ROOT / "results").rglob("*.md")),
]


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples_run(name):
    module = importlib.import_module(name)
    results = doctest.testmod(module, extraglobs={"sejax": importlib.import_module("sejax")})
    assert results.attempted > 0 and results.failed == 0


def python_blocks(page):
    return re.findall(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


@pytest.mark.slow
@pytest.mark.parametrize("page", ["docs/howto/jax.md", "docs/distill.md"])
def test_the_python_of_a_page_runs(page, tmp_path, monkeypatch):
    blocks = python_blocks(ROOT / page)
    assert blocks
    monkeypatch.chdir(tmp_path)  # some of it writes files
    for block in blocks:
        exec(compile(block, page, "exec"), {})


def test_the_python_of_all_pages_can_be_read():
    for page in PAGES:
        for block in python_blocks(page):
            compile(block, page, "exec")


def anchors(page):
    """What the forge and the site call the headings of a page."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_links_lead_somewhere():
    for page in PAGES:
        for link in re.findall(r"\]\((?!http)([^)\s]+)\)", page.read_text()):
            target, _, anchor = link.partition("#")
            path = page.parent / target if target else page
            assert path.exists(), f"{page.name} links to {link}"
            assert not anchor or anchor in anchors(path), f"{page.name} links to {link}"


def test_every_page_is_in_a_table_of_contents():
    listed = {ROOT / "docs/index.md"}
    for page in PAGES:
        for tree in re.findall(r"^```{toctree}\n(.*?)^```", page.read_text(), re.DOTALL | re.M):
            for entry in re.findall(r"^(?!:)(?:.*<)?(.+?)>?$", tree, re.M):
                listed |= {path.resolve() for path in page.parent.glob(f"{entry}.md")}
    assert set(PAGES) == listed


def test_every_public_name_and_experiment_is_in_the_api_reference():
    pages = "".join(page.read_text() for page in (ROOT / "docs/api").glob("*.md"))
    blocks = re.findall(r"^\.\. currentmodule:: sejax$(.*?)^```", pages, re.DOTALL | re.M)
    documented = set(re.findall(r"^\.\. auto\w+:: (\w+)$", "".join(blocks), re.M))
    assert {name for name in sejax.__all__ if not find_spec(f"sejax.{name}")} <= documented
    for module in (ROOT / "experiments").glob("*.py"):
        if "\nEXPERIMENT = " in module.read_text():
            assert f".. automodule:: experiments.{module.stem}\n" in pages


@pytest.mark.parametrize("name", sorted(sejax.__all__))
def test_every_public_name_is_there_and_says_what_it_is(name):
    value = getattr(sejax, name)
    assert value.__doc__ and not value.__doc__.startswith(f"{getattr(value, '__name__', '')}(")
    for member, method in vars(value).items() if isinstance(value, type) else ():
        is_field = member in getattr(value, "__dataclass_fields__", ())
        if inspect.isfunction(method) and not member.startswith("_") and not is_field:
            assert inspect.getdoc(getattr(value, member)), f"{name}.{member}"
