"""Settings that were measured or published, one file for each task and proxy.

A file `conf/presets/<env>-<proxy>.yaml` has a section for each preset: nested values of a run's
configuration, `with_agent`, `with_es` and `with_objective` for those that only hold with an agent,
a strategy or an objective, and `like` for a section of the same file that it builds on.
`general-<proxy>.yaml` serves tasks without a file of their own, and those whose section says
`like: general`.
"""

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

FOLDER = Path(__file__).parents[1] / "conf" / "presets"
GENERAL = "general"


def names() -> list[str]:
    """All presets that some file has."""
    found = {preset for file in FOLDER.glob("*.yaml") for preset in _sections(file.stem)}
    return sorted(found)


def tuned(proxy: str, preset: str = "best") -> list[str]:
    """Tasks that have settings of their own for a proxy."""
    stems = sorted(file.stem for file in FOLDER.glob(f"*-{proxy}.yaml"))
    envs = {stem.removesuffix(f"-{proxy}"): preset in _sections(stem) for stem in stems}
    return [env for env, there in envs.items() if there and env != GENERAL]


def is_tuned(env: str, proxy: str) -> bool:
    """Whether a task has a file of its own for a proxy."""
    return _file(env, proxy).exists()


def settings(env: str, proxy: str) -> Iterator[tuple[str, str, str, dict[str, Any]]]:
    """All settings for a task and proxy.

    Yields:
      `(preset, kind, choice, values)` with kind "tuned" (choice empty), "tuned_agent", "tuned_es"
      or "tuned_objective" (choice: the agent, the strategy or the objective).
    """
    stem = f"{env}-{proxy}"
    if not is_tuned(env, proxy):
        stem = f"{GENERAL}-{proxy}"
        if not _file(GENERAL, proxy).exists():  # a proxy of a user's own
            yield "best", "tuned", "", {"generations": 50}
            return
    for preset, section in _sections(stem).items():
        common = {k: v for k, v in section.items() if not k.startswith("with_")}
        yield preset, "tuned", "", common
        for kind in ("agent", "es", "objective"):
            for choice, values in section.get(f"with_{kind}", {}).items():
                yield preset, f"tuned_{kind}", choice, values


def _file(env: str, proxy: str) -> Path:
    return FOLDER / f"{env}-{proxy}.yaml"


@functools.cache
def _sections(stem: str) -> dict[str, Any]:
    """A file's sections, each with what it builds on merged in."""
    raw = yaml.safe_load((FOLDER / f"{stem}.yaml").read_text())
    merged: dict[str, Any] = {}
    for name, section in raw.items():  # a section stands after the one that it builds on
        section = dict(section)
        like = section.pop("like", None)
        if like == GENERAL:
            base = _sections(f"{GENERAL}-{stem.rpartition('-')[2]}")[name]
        else:
            base = merged[like] if like else {}
        merged[name] = _merge(base, section)
    return merged


def _merge(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        nested = isinstance(value, dict) and isinstance(base.get(key), dict)
        merged[key] = _merge(base[key], value) if nested else value
    return merged
