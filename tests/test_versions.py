"""constraints-lowest.txt holds the oldest versions that pyproject.toml allows; both are by hand."""

import re
import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[1]
TESTED_EXTRAS = ("gym", "hub", "mujoco")  # by `make test-lowest`


def pins(name):
    """Versions by package in a file of constraints."""
    lines = [re.sub(r"\s*#.*", "", line) for line in (ROOT / name).read_text().splitlines()]
    pairs = [line.split("==") for line in lines if line]
    return {canonical(package): Version(version) for package, version in pairs}


def canonical(package):
    return re.sub(r"[-_.]+", "-", package).lower()


def requirements():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [x for name in TESTED_EXTRAS for x in project["optional-dependencies"][name]]
    return [Requirement(x) for x in (*project["dependencies"], *extras)]


def test_the_lowest_constraints_are_the_lower_bounds_of_what_is_required():
    lowest = pins("constraints-lowest.txt")
    least = {canonical(requirement.name): Version(bound.version) for requirement in requirements()
             for bound in requirement.specifier if bound.operator == ">="}  # fmt: skip
    assert {package: lowest.get(package) for package in least} == least
    assert set(lowest) - set(least) == {"jaxlib", "pyparsing"}  # what is not required by name


def test_the_tested_versions_are_within_the_bounds():
    tested = pins("constraints.txt")
    for requirement in requirements():
        assert requirement.specifier.contains(tested[canonical(requirement.name)]), requirement
