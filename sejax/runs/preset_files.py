"""Preset files: the settings of tasks and proxies, and of files that a user writes.

sejax's own are `presets/<env>-<proxy>.yaml`, with a section for each preset: values, `with_agent`,
`with_es` and `with_objective` for those that only hold with one of these, and `like` for a section
that it builds on, of its file or of `bases.yaml`. `general-<proxy>.yaml` serves tasks without a
file of their own, and sections that say `like: general`. A user's file (`preset=FILE.yaml`) holds
overrides.
"""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from sejax.options import ConfigError, listed, shortened, told, unknown_name
from sejax.options.plain import flatten, merge

PRESETS = Path(__file__).parents[1] / "presets"
GENERAL = "general"  # the presets of tasks without a file of their own
ENDING = ".yaml"  # of a preset file
# What reading a file of YAML may raise.
UNREADABLE = (OSError, yaml.YAMLError, ValueError, TypeError, AttributeError, RecursionError)
NONE = ("agent", "agents")  # fields that an older run's config.yaml has as null


@functools.cache
def _all_sections() -> dict[str, dict[str, dict[str, Any]]]:
    """The sections of all files by the files' stems, each with what it builds on merged in."""
    paths = sorted(PRESETS.glob(f"*-*{ENDING}"), key=lambda path: not path.stem.startswith(GENERAL))
    bases = _read_sections(PRESETS / f"bases{ENDING}", {})
    files: dict[str, dict[str, dict[str, Any]]] = {}
    for path in paths:  # the general ones first
        general = files.get(f"{GENERAL}-{path.stem.rpartition('-')[2]}", {})
        files[path.stem] = _read_sections(path, bases | {GENERAL: general.get("best", {})})
    return files


def _read_sections(path: Path, bases: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The sections of a file; what they build on stands before them in it, or is one of `bases`."""
    sections: dict[str, dict[str, Any]] = {}
    for name, section in yaml.safe_load(path.read_text(encoding="utf-8")).items():
        like = section.pop("like", None)
        sections[name] = merge({**bases, **sections}[like] if like else {}, section)
    return sections


def names() -> list[str]:
    """All presets that some file has."""
    return sorted({name for sections in _all_sections().values() for name in sections})


def is_tuned(env: str, proxy: str) -> bool:
    """Whether a task has a preset file of its own for a proxy."""
    return f"{env}-{proxy}" in _all_sections()


def sections_of(env: str, proxy: str) -> dict[str, dict[str, Any]]:
    """The presets of a task and proxy, by their names: its own, and what all tasks have."""
    general = _all_sections().get(f"{GENERAL}-{proxy}", {"best": {}})
    return general | _all_sections().get(f"{env}-{proxy}", {})


def section_of(preset: str, env: str, proxy: str) -> dict[str, Any]:
    """What a preset says of a task and a proxy.

    Raises:
      ConfigError: for an unknown preset, or one that the task does not have.
    """
    sections = sections_of(env, proxy)
    if preset in sections:
        return sections[preset]
    if preset not in names():
        raise unknown_name("preset", preset, names())
    must = f"must be one that {shortened(env)} has ({listed(list(sections))})"
    raise ConfigError(f"preset {must}; got {preset}. Set preset=best.", "preset")


def settings_of(
    section: Mapping[str, Any], chosen: Mapping[str, str], agents: Mapping[str, str]
) -> dict[str, Any]:
    """The settings of a preset's section for these choices, nested plain values.

    Args:
      section: as from `section_of`.
      chosen: the choice of each group.
      agents: names of the agents by their keys. What a section says of other groups beside an
        agent holds where that is the only one.
    """
    with_agent = section.get("with_agent", {})
    settings = {key: with_agent.get(name, {}) for key, name in agents.items()}
    layers = [{k: x for k, x in section.items() if not k.startswith("with_")}]
    layers += [section.get(f"with_{x}", {}).get(str(chosen[x]), {}) for x in ("es", "objective")]
    layers += settings.values() if len(agents) == 1 else []
    shared = merge(*layers, {"objective": {"name": chosen["objective"]}})
    shared["agents"] = {key: beside.get("agent", {}) for key, beside in settings.items()}
    return {k: x for k, x in shared.items() if k != "agent"}


def read_file(path: Path) -> dict[str, Any]:
    """The values of a user's file, by their full names; `preset: paper` in it is its base.

    Raises:
      ConfigError: for a file that cannot be read, or that holds no fields.
    """
    try:
        values = flatten(dict(yaml.safe_load(path.read_text(encoding="utf-8"))))
    except UNREADABLE as error:
        got = f"{shortened(path, 40)} ({told(error)})"
        must = f"preset must be a name, or a YAML file of fields; got {got}. Set preset=best."
        raise ConfigError(must, "preset") from error
    return {name: x for name, x in values.items() if x is not None or name not in NONE}
