"""constraints-lowest.txt holds the oldest versions that pyproject.toml allows; both are by hand."""

import re
import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name as canonical
from packaging.version import Version

ROOT = Path(__file__).parents[1]
TESTED_EXTRAS = ("gym", "hub", "mujoco")  # by `make test-lowest`


def pins(name):
    """Versions by package in a file of constraints."""
    lines = [re.sub(r"\s*#.*", "", line) for line in (ROOT / name).read_text().splitlines()]
    pairs = [line.split("==") for line in lines if line]
    return {canonical(package): Version(version) for package, version in pairs}


def test_the_lowest_constraints_are_the_lower_bounds_of_what_is_required():
    """And the tested versions are within the bounds."""
    lowest, tested = pins("constraints-lowest.txt"), pins("constraints.txt")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [project["optional-dependencies"][name] for name in TESTED_EXTRAS]
    least = {}
    for requirement in map(Requirement, sum(extras, project["dependencies"])):
        name, specifier = canonical(requirement.name), requirement.specifier
        assert specifier.contains(tested[name]), requirement
        for bound in specifier:
            if bound.operator == ">=":
                least[name] = Version(bound.version)
    assert {package: lowest.get(package) for package in least} == least
    assert set(lowest) - set(least) == {"jaxlib", "pyparsing"}  # what is not required by name
