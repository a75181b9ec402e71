"""Turns the words that a user types into nested plain values: the first half of `runs.config`.

A word is `group=choice`, `group.field=value` or `field=value`. `words` splits words into names and
texts. `read` lays them on the file that `preset=FILE.yaml` names. `compose` finds the choice of
every group: a word's, else the default of the task and the proxy. It merges four layers: the
choices; over them the preset, or the settings that a stored proxy was learned with; over both the
words. `runs.config` checks the names later, when it makes dataclasses of the layers.

sejax's own presets are `presets/<env>-<proxy>.yaml`, with a section for each preset. A section has
values, and more values under `with_agent`, `with_es` and `with_objective`, for one agent, strategy
or objective each. `like` names the section that it builds on, in its file or in `bases.yaml`.
`general-<proxy>.yaml` serves tasks without a file of their own, and sections with `like: general`.
A user's file holds overrides.
"""

import contextlib
import dataclasses
import functools
import hashlib
import itertools
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml

from sejax import agents, envs
from sejax.ops.files import as_file_name
from sejax.options import ConfigError, Options, listed, nearest, registry, require, shortened, told
from sejax.options.plain import expanded, flatten, merge, split, unquoted

# The choice of a group if no word, task or proxy makes it.
DEFAULTS = {group: next(iter(x)) for group, x in registry.BUILT_IN.items() if group != "agent"}
AGENTS = ("agent", "agents")  # the fields that choose agents
NAME = re.compile(r"[A-Za-z_][\w.-]*")  # a field's name
# A choice may stand beside its fields, as in config.yaml.
CHOICES = {f"{group}.name": group for group in registry.GROUPS}
# The text of sejax's own preset files, by their stems.
FILES = sorted(Path(__file__).parents[1].glob("presets/*.yaml"))
PRESETS = {path.stem: path.read_text(encoding="utf-8") for path in FILES}
BASES, GENERAL = "bases", "general"  # files of sections to build on, and for tasks without a file
# What reading a file of YAML may raise.
UNREADABLE = (OSError, yaml.YAMLError, ValueError, TypeError, AttributeError, RecursionError)
Layers = dict[str, Mapping[str, Any]]
Config = TypeVar("Config", bound=Options)


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
    message = f"must be a list of text; got {shortened(overrides)}."
    require(is_list, "overrides", f'{message} Set overrides=["env=cartpole"].')
    texts = {}
    for i, override in enumerate(overrides):
        name, equals, text = override.partition("=")
        if not (equals and NAME.fullmatch(name)):
            got = f"got {shortened(override)}. Write {suggestion(overrides[i:])}."
            raise ConfigError(f"an override must read FIELD=VALUE; {got}", "an override")
        first, *others = split(text)
        is_open = text.startswith("[") and not text.endswith("]")
        fix = shortened(f"{text.rstrip(',')}]" if is_open else first)
        message = "must be one value: brackets close and hold no space, and a comma outside of them"
        message += f" makes a sweep; got {shortened(text)}. Set {name}={fix}."
        require(not (others or is_open), name, message)
        texts[CHOICES.get(name, name)] = text
    return texts


def suggestion(overrides: Sequence[str]) -> str:
    """What the user may mean by words whose first one is not FIELD=VALUE."""
    pattern = r"([-=\s]*)([^\s=]*)(?:[\s=]+([^\s=]+)(?!\S))?"
    dashes, name, value = re.findall(pattern, " ".join(overrides[:3]))[0]
    is_field = NAME.fullmatch(name) and not registry.is_registered("env", name)
    if is_field and (dashes or value or name in registry.GROUPS):
        return f"{shortened(name)}={shortened(value or 'VALUE')}"
    name = shortened(name or "NAME")
    return f"env={name} or proxy={name}, if that is meant"


def read(overrides: Sequence[str]) -> dict[str, Any]:
    """Names and values of words, laid over those in the file that `preset=FILE.yaml` names.

    Raises:
      ConfigError: as `words`, and for a file that cannot be read.
    """
    values: dict[str, Any] = {name: unquoted(text) for name, text in words(overrides).items()}
    if not values.get("preset", "").endswith(".yaml"):
        return values
    path = Path(expanded(values.pop("preset")))
    try:
        flat = flatten(dict(yaml.safe_load(path.read_text(encoding="utf-8"))))
    except UNREADABLE as error:
        got = f"{shortened(path, 40)} ({told(error)})"
        must = f"preset must be a name, or a YAML file of fields; got {got}. Set preset=best."
        raise ConfigError(must, "preset") from error
    # An older run's config.yaml has both `agent` and `agents`; the unused one is null.
    of_file = {CHOICES.get(k, k): x for k, x in flat.items() if k not in AGENTS or x is not None}
    if chosen := agents_of(values):  # they replace the file's agents
        others = tuple(f"agents.{key}." for key in agents_of(of_file) if key not in chosen)
        of_file = {k: x for k, x in of_file.items() if k not in AGENTS and not k.startswith(others)}
    return of_file | values


def expand(overrides: Sequence[str]) -> list[list[str]]:
    """The words of each run of a sweep: commas outside of brackets separate values.

    Example:
      >>> expand(["env=acrobot", "seed=0,1"])
      [['env=acrobot', 'seed=0'], ['env=acrobot', 'seed=1']]
    """
    pairs = (override.partition("=") for override in overrides)
    values = [[f"{name}{equals}{value}" for value in split(text)] for name, equals, text in pairs]
    return [list(of_run) for of_run in itertools.product(*values)]


def swept(
    overrides: Sequence[str],
    make: Callable[[list[str]], Config],
    field: str,
    folder_of: Callable[[Config, str], str],
    known: Collection[str] = (),
) -> list[Config]:
    """The configuration of each run of a sweep; each run has its own folder.

    Args:
      overrides: the sweep's words.
      make: makes a configuration of a run's words.
      field: the field that names the folder. If it is set, each run has a folder in it.
      folder_of: else gives the folder, for a configuration and a name made of the swept words.
      known: fields that default folders are already named by.
    """
    configs = []
    for of_run in expand(overrides):
        config = make(of_run)
        folder = getattr(config, field)
        named_by = known if folder is None else (field,)
        words = [word for word, values in zip(of_run, overrides, strict=True) if word != values]
        name = as_file_name(",".join(x for x in words if x.partition("=")[0] not in named_by))
        name = name if len(name) <= 120 else hashlib.sha256(name.encode()).hexdigest()[:16]
        if name:
            folder = folder_of(config, name) if folder is None else f"{folder}/{name}"
        configs.append(dataclasses.replace(config, **{field: folder}))
    return configs


# --- agents --------------------------------------------------------------------------------------


def key_of(name: str) -> str:
    """The key of an agent's name: `my_module_MyAgent` for `my_module:MyAgent`."""
    return re.sub(r"[^\w-]+", "_", name)


def field_of(key: str, keys: Collection[str]) -> str:
    """The group of an agent's fields in words: `agent`, or `agents.KEY` if there are several."""
    return f"agents.{key}" if len(keys) > 1 else "agent"


def agents_of(values: Mapping[str, Any]) -> dict[str, str]:
    """The names of the chosen agents by their keys; empty if no word chooses one.

    `agent=ddqn` and `agents=[ddqn,ppo]` choose agents, and `agents.KEY.name=ddqn` one by any key.
    """
    chosen: dict[str, str] = {}
    for field in [name for name in ("agents", "agent") if name in values]:
        text = str(values[field])
        is_list = text.startswith("[") and text.endswith("]")
        names = [unquoted(name) for name in split(text[1:-1] if is_list else text)]
        several = ",".join(dict.fromkeys(filter(None, [*chosen.values(), *names]))) or "ddqn,ppo"
        is_clear = all(names) and not chosen and len({*names}) == len(names)
        message = f"must name each agent once; got {shortened(values[field])}. Set agents="
        require(is_clear, field, f"{message}[{shortened(several)}].")
        chosen = {key_of(name): name for name in names}
    by_key = re.compile(r"agents\.([\w-]+)\.name")
    named = {match[1]: str(x) for name, x in values.items() if (match := by_key.fullmatch(name))}
    return chosen | named


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


def _of_preset(
    values: Mapping[str, Any], chosen: Mapping[str, Any], names: Mapping[str, str], objective: str
) -> dict[str, Any]:
    """The settings of a preset for these choices, nested plain values.

    Args:
      values: the words' values by name.
      chosen: the choice of each group.
      names: the agents' names by key. A section's `with_agent` may also set fields of other
        groups; they count only if there is one agent.
      objective: the objective if neither a word nor the preset chooses one.

    Raises:
      ConfigError: for an unknown preset, or one that the task does not have.
    """
    preset = str(values.get("preset", "best"))
    sections = sections_of(str(chosen["env"]), str(chosen["proxy"]))
    if preset not in sections:
        ranked = nearest(preset, sections)
        must = f"preset must be one that {shortened(chosen['env'])} has ({listed(ranked)})"
        got = f"got {shortened(preset)}. Did you mean preset={ranked[0]}?"
        raise ConfigError(f"{must}; {got}", "preset")
    section = sections[preset]
    objective = values.get("objective", section.get("objective", {}).get("name", objective))
    beside = {key: section.get("with_agent", {}).get(name, {}) for key, name in names.items()}
    settings = merge(
        {name: x for name, x in section.items() if not name.startswith("with_")},
        section.get("with_es", {}).get(str(chosen["es"]), {}),
        section.get("with_objective", {}).get(str(objective), {}),
        *(beside.values() if len(beside) == 1 else ()),
        {"objective": {"name": objective}, "preset": preset},
    )
    of_agents = {key: of_agent.get("agent", {}) for key, of_agent in beside.items()}
    return {name: x for name, x in settings.items() if name != "agent"} | {"agents": of_agents}


# --- layers --------------------------------------------------------------------------------------


def typed(overrides: Sequence[str]) -> frozenset[str]:
    """Values of words and items of lists: each `module:attribute` among them may be imported."""
    texts = (override.partition("=")[2].strip("[]") for override in overrides)
    return frozenset(x.strip("[]'\" ") for text in texts for x in split(text))


def compose(
    values: Mapping[str, Any],
    groups: Collection[str],
    learns: bool,
    stored: Mapping[str, Any],
    imports: Collection[str],
) -> Layers:
    """Composes a command's words over its preset and its choices.

    Args:
      values: the words' values by name; see `read`.
      groups: groups of plugins whose choices are fields of the command.
      learns: whether the command learns proxies, so that presets apply.
      stored: settings that a stored proxy was learned with, nested plain values.
      imports: each `module:attribute` that may be imported.

    Returns:
      The layers by their names, nested plain values; each lies over those before it.

    Raises:
      ConfigError: for bad words, and for an unknown choice or preset.
    """
    names = agents_of(values) or {key: x["name"] for key, x in stored.get("agents", {}).items()}
    if not names:
        default = agents.DEFAULTS[0]
        task = {name[4:]: x for name, x in values.items() if name.startswith("env.")}
        task["name"] = values.get("env", DEFAULTS["env"])
        with contextlib.suppress(ConfigError):  # making the task raises it again
            default = agents.default_for(envs.spec_of(registry.configure("env", task, imports)))
        names = {default: default}
    chosen: dict[str, Any] = {group: values.get(group, DEFAULTS[group]) for group in groups}
    layers: Layers = {
        "default": {group: {"name": name} for group, name in chosen.items()}
        | {"agents": {key: {"name": name} for key, name in names.items()}}
    }
    if learns:
        objective = registry.find("proxy", str(chosen["proxy"]), imports).default_objective
        of_preset = _of_preset(values, chosen, names, objective)
        layers[f"preset={of_preset['preset']}"] = of_preset
    return layers | {"proxy": stored, "typed": _nested(values, names, groups)}


def _nested(
    values: Mapping[str, Any], keys: Collection[str], groups: Collection[str]
) -> dict[str, Any]:
    """The words' values as a tree; `agent.FIELD` becomes a field of the only agent."""
    tree: dict[str, Any] = {}
    for name, value in values.items():
        if name in (*groups, *AGENTS):
            continue
        group, _, field = name.partition(".")
        if group == "agent":
            full, got = f"agents.{next(iter(keys))}.{field}", shortened(value)
            require(len(keys) == 1, name, f"must be one agent's; got {got}. Set {full}={got}.")
            name = full
        for part in reversed(name.split(".")):
            value = {part: value}
        tree = merge(tree, value)
    return tree
