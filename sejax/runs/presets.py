"""Presets: the settings of a task and proxy that were measured or published.

They are `presets/<env>-<proxy>.yaml`, with a section for each preset. A section has values, and
more values under `with_agent`, `with_es` and `with_objective`, for one agent, strategy or objective
each. `like` names the section that it builds on, in its file or in `bases.yaml`.
`general-<proxy>.yaml` serves tasks without a file of their own, and sections with `like: general`.
A user's file holds overrides.
"""

import functools
from pathlib import Path

import yaml

from sejax.options import registry, require_known
from sejax.options.plain import merge
from sejax.runs.words import Tree, agent_names

# The text of sejax's own preset files, by their stems.
FILES = sorted(Path(__file__).parents[1].glob("presets/*.yaml"))
PRESETS = {path.stem: path.read_text(encoding="utf-8") for path in FILES}
BASES, GENERAL = "bases", "general"  # files of sections to build on, and for tasks without a file


@functools.cache
def sections_of(env: str, proxy: str) -> dict[str, Tree]:
    """The presets of a task and proxy by name: those of its file, and those of all tasks.

    Each preset includes the section that it builds on. That section must stand before it.
    """
    bases = _sections_in(BASES, {})
    general: dict[str, Tree] = {"best": {}} | _sections_in(f"{GENERAL}-{proxy}", bases)
    return general | _sections_in(f"{env}-{proxy}", bases | {GENERAL: general["best"]})


def _sections_in(stem: str, known: dict[str, Tree]) -> dict[str, Tree]:
    """The sections of a file, which may build on known ones."""
    sections: dict[str, Tree] = {}
    for name, section in yaml.safe_load(PRESETS.get(stem, "{}")).items():
        like = section.pop("like", None)
        sections[name] = merge((known | sections)[like] if like else {}, section)
    return sections


def choice_in(tree: Tree, group: str) -> str:
    """The name of a group's choice in a tree; sejax's own first one if the tree has none."""
    return str((registry.DEFAULTS[group] | tree.get(group, {}))["name"])


def preset_of(typed: Tree) -> Tree:
    """The settings of a preset, for typed choices.

    A section's `with_agent` may also set fields of other groups; they count only if there is one
    agent.

    Args:
      typed: the merged `trees_of`, with the names of all agents.

    Raises:
      ConfigError: for an unknown proxy or preset, or a preset that the task does not have.

    Example:
      >>> settings = preset_of({"agents": {"mine": {"name": "ddqn"}}, "preset": "paper"})
      >>> settings["generations"], settings["agents"]["mine"]["batch_size"]
      (200, 199)
    """
    name = str(typed.get("preset", "best"))
    env, proxy, es = (choice_in(typed, group) for group in ("env", "proxy", "es"))
    sections = sections_of(env, proxy)
    require_known("preset", name, sections)
    section = sections[name]
    default = {"objective": {"name": registry.find("proxy", proxy).default_objective}}
    objective = choice_in(merge(default, section, typed), "objective")
    of_names = section.get("with_agent", {})
    by_key = {key: of_names.get(x, {}) for key, x in agent_names(typed["agents"]).items()}
    settings = merge(
        {key: x for key, x in section.items() if not key.startswith("with_")},
        section.get("with_es", {}).get(es, {}),
        section.get("with_objective", {}).get(objective, {}),
        *(by_key.values() if len(by_key) == 1 else ()),
        {"objective": {"name": objective}, "preset": name},
        {"agents": {key: x.get("agent", {}) for key, x in by_key.items()}},
    )
    # The fields of an only agent, which stand under its key too.
    return {key: x for key, x in settings.items() if key != "agent"}
