"""From the words that a user types to nested plain values: the first half of `command_config`.

A word is `group=choice`, `group.field=value` or `field=value`. `words` splits words into names and
texts; `trees_of` makes a tree of them, and of the file that `preset=FILE.yaml` names.
`command_config` lays this tree over the layers below it: the choices that no word makes, and the
preset, or the settings that a stored proxy was learned with. Names are checked later, when the tree
becomes dataclasses.

sejax's own presets are `presets/<env>-<proxy>.yaml`, with a section for each preset. A section has
values, and more values under `with_agent`, `with_es` and `with_objective`, for one agent, strategy
or objective each. `like` names the section that it builds on, in its file or in `bases.yaml`.
`general-<proxy>.yaml` serves tasks without a file of their own, and sections with `like: general`.
A user's file holds overrides.
"""

import functools
import itertools
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from sejax.options import ConfigError, old, registry, require, require_known, shortened
from sejax.options.plain import expanded, flatten, merge, split, unquoted
from sejax.runs import agent_words
from sejax.runs.agent_words import Tree, names_of

NAME = re.compile(r"[A-Za-z_][\w.-]*")  # a field's name
# A choice may stand beside its fields, as in config.yaml.
CHOICES = {f"{group}.name": group for group in registry.GROUPS}
# The text of sejax's own preset files, by their stems.
FILES = sorted(Path(__file__).parents[1].glob("presets/*.yaml"))
PRESETS = {path.stem: path.read_text(encoding="utf-8") for path in FILES}
BASES, GENERAL = "bases", "general"  # files of sections to build on, and for tasks without a file
# What reading a file of YAML may raise.
UNREADABLE = (OSError, yaml.YAMLError, ValueError, TypeError, AttributeError, RecursionError)


# --- words ---------------------------------------------------------------------------------------


def words(overrides: Sequence[str]) -> dict[str, str]:
    """Splits any command's words into names and texts; of words with one name the last counts.

    Raises:
      ConfigError: for a word that is not of the form NAME=TEXT, or has several values.

    Example:
      >>> words(["env=acrobot", "agents=[ddqn,ppo]"])
      {'env': 'acrobot', 'agents': '[ddqn,ppo]'}
    """
    is_list = isinstance(overrides, list | tuple) and all(isinstance(x, str) for x in overrides)
    require(is_list, "overrides", "must be a list of text", got=overrides, use='["env=cartpole"]')
    texts = {}
    for override in overrides:
        name, equals, text = override.partition("=")
        if not (equals and NAME.fullmatch(name)):
            field = shortened(name.strip("- ") or "NAME")
            is_field = name.startswith("-") or name.partition(".")[0] in registry.GROUPS
            value = f"{field}={shortened(text) or 'VALUE'}"
            fix = f"Write {value if is_field else f'env={field} or proxy={field}'}."
            raise ConfigError("an override", "must read FIELD=VALUE", got=override, fix=fix)
        first, *others = split(text)
        is_open = text.startswith("[") and not text.endswith("]")
        use = shortened(f"{text.rstrip(',')}]" if is_open else first)
        rule = "must be one value; a list stands in brackets, without spaces"
        require(not (others or is_open), name, rule, got=text, use=use)
        texts[CHOICES.get(name, name)] = text
    return texts


def trees_of(overrides: Sequence[str], groups: Collection[str]) -> list[Tree]:
    """The tree of words; before it the one of the file that `preset=FILE.yaml` names.

    Args:
      overrides: as typed after a command.
      groups: groups of plugins whose choices are fields of the command.

    Raises:
      ConfigError: as `words`, and for a file that cannot be read.

    Example:
      >>> trees_of(["agent=ddqn", "es.noise_std=0.1"], ["es"])
      [{'agents': {'ddqn': {'name': 'ddqn'}}, 'es': {'noise_std': '0.1'}}]
    """
    texts: Tree = {name: unquoted(text) for name, text in words(overrides).items()}
    if not texts.get("preset", "").endswith((".yaml", ".yml")):
        return [_tree(texts, groups)]
    path, typed = Path(expanded(texts.pop("preset"))), _tree(texts, groups)
    try:
        values = flatten(old.of_today(yaml.safe_load(path.read_text(encoding="utf-8"))))
        file = _tree({CHOICES.get(name, name): x for name, x in values.items()}, groups)
        for group in groups:  # fields of a choice that a typed one replaces
            name = typed.get(group, {}).get("name")
            if name is not None and file.get(group, {}).get("name", name) != name:
                del file[group]
        is_whole = bool(agent_words.WORDS & texts.keys())
        return [agent_words.without_replaced(file, typed, is_whole), typed]
    except ConfigError:  # it is readable
        raise
    except UNREADABLE as error:
        must = f"must be a name or a YAML file; got {shortened(path, 40)} ({shortened(error)})"
        raise ConfigError("preset", must, use="best") from error


def _tree(values: Mapping[str, Any], groups: Collection[str]) -> Tree:
    """Values by their names in words as a tree; see `sejax.runs.agent_words` for agents."""
    tree: Tree = {"agents": agent_words.chosen(values)}
    for name in [name for name in values if name not in agent_words.WORDS]:
        value, is_choice = values[name], name in groups or agent_words.BY_KEY.fullmatch(name)
        for part in reversed([*name.split("."), *(["name"] if is_choice else [])]):
            value = {part: value}
        tree = merge(tree, value)
    return old.of_today(tree)


def expand(overrides: Sequence[str]) -> list[list[str]]:
    """The words of each run of a sweep: commas outside of brackets separate values.

    Example:
      >>> expand(["env=acrobot", "seed=0,1"])
      [['env=acrobot', 'seed=0'], ['env=acrobot', 'seed=1']]
    """
    pairs = (override.partition("=") for override in overrides)
    values = [[f"{name}{equals}{value}" for value in split(text)] for name, equals, text in pairs]
    return [list(of_run) for of_run in itertools.product(*values)]


# --- presets -------------------------------------------------------------------------------------


@functools.cache
def sections_of(env: str, proxy: str) -> dict[str, dict[str, Any]]:
    """The presets of a task and proxy by name: those of its file, and those of all tasks.

    Each preset includes the section that it builds on. That section must stand before it.
    """
    sections: dict[str, dict[str, Any]] = {"best": {}}
    bases: dict[str, dict[str, Any]] = {}
    for stem in (BASES, f"{GENERAL}-{proxy}", f"{env}-{proxy}"):
        known = bases | {GENERAL: sections["best"]}
        for name, section in yaml.safe_load(PRESETS.get(stem, "{}")).items():
            like = section.pop("like", None)
            known[name] = merge(known[like] if like else {}, section)
            (bases if stem == BASES else sections)[name] = known[name]
    return sections


def choice(fields: Mapping[str, Any], group: str) -> str:
    """The name of a group's choice in its fields; sejax's own first one if none is typed."""
    return str(fields.get("name", next(iter(registry.BUILT_IN[group]))))


def preset_of(typed: Tree) -> Tree:
    """The settings of a preset, for typed choices.

    A section's `with_agent` may also set fields of other groups; they count only if there is one
    agent.

    Args:
      typed: the merged `trees_of`, with the names of all agents.

    Raises:
      ConfigError: for an unknown proxy or preset, or a preset that the task does not have.
    """
    name = str(typed.get("preset", "best"))
    env, proxy, es = (choice(typed.get(group, {}), group) for group in ("env", "proxy", "es"))
    sections = sections_of(env, proxy)
    require_known("preset", name, sections)
    section = sections[name]
    default = registry.find("proxy", proxy).default_objective
    objective = merge({"name": default}, section.get("objective", {}), typed.get("objective", {}))
    of_names = section.get("with_agent", {})
    beside = {key: of_names.get(x, {}) for key, x in names_of(typed["agents"]).items()}
    settings = merge(
        {key: x for key, x in section.items() if not key.startswith("with_")},
        section.get("with_es", {}).get(es, {}),
        section.get("with_objective", {}).get(str(objective["name"]), {}),
        *(beside.values() if len(beside) == 1 else ()),
        {"objective": {"name": objective["name"]}, "preset": name},
        {"agents": {key: x.get("agent", {}) for key, x in beside.items()}},
    )
    return {key: x for key, x in settings.items() if key != "agent"}
