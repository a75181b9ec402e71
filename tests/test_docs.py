"""The examples in docstrings and in the README run as they stand."""

import doctest
import importlib
import inspect
import re
from pathlib import Path

import pytest

import sejax

ROOT = Path(__file__).parents[1]
MODULES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in sorted((ROOT / "sejax").rglob("*.py"))
    if ">>>" in path.read_text()
]


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples_run(name):
    module = importlib.import_module(name)
    results = doctest.testmod(module, extraglobs={"sejax": importlib.import_module("sejax")})
    assert results.attempted > 0 and results.failed == 0


@pytest.mark.slow
def test_the_readmes_python_runs():
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert blocks
    for block in blocks:
        exec(compile(block, "README.md", "exec"), {})


def test_links_of_the_readme_and_docs_lead_somewhere():
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            if not target.startswith("http"):
                assert (page.parent / target).exists(), f"{page.name} links to {target}"


@pytest.mark.parametrize("name", sorted(sejax.__all__))
def test_every_public_name_is_there_and_says_what_it_is(name):
    value = getattr(sejax, name)
    assert value.__doc__ and not value.__doc__.startswith(f"{getattr(value, '__name__', '')}(")
    for member, method in vars(value).items() if isinstance(value, type) else ():
        is_field = member in getattr(value, "__dataclass_fields__", ())
        if inspect.isfunction(method) and not member.startswith("_") and not is_field:
            documented = [getattr(base, member, None) for base in value.__mro__]
            assert any(getattr(each, "__doc__", None) for each in documented), f"{name}.{member}"
