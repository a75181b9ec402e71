"""From the words that a user types to nested plain values: the first half of `runs.config`.

A word is `group=choice`, `group.field=value` or `field=value`. `read` splits words into names and
texts. `compose` finds the choice of every group (the given one, else what the task and the proxy
suggest), and lays the layers on each other: the choices, the preset or what a stored proxy was
learned with, the user's file and the words. Whether their names are fields of the choices shows
when dataclasses are made of them.
"""

import contextlib
import dataclasses
import hashlib
import itertools
import re
import textwrap
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from sejax import agents
from sejax.ops.files import as_file_name
from sejax.options import (
    ConfigError,
    Options,
    as_text,
    between,
    help_texts,
    option,
    registry,
    require,
    shortened,
)
from sejax.options.plain import (
    expanded,
    flatten,
    merge,
    parsed,
    split,
    to_plain,
    unquoted,
)
from sejax.runs import preset_files

if TYPE_CHECKING:
    from sejax.runs.config import CommandConfig

# Choices where neither a word nor the task or the proxy makes one.
DEFAULTS = {
    "env": "cartpole",
    "proxy": "se",
    "exploration": "none",
    "es": "nes",
    "objective": "max_reward",
    "tracker": "none",
    "machines": "local",
}
NAME = re.compile(r"[A-Za-z_][\w.-]*")  # of a field


@dataclass(frozen=True, kw_only=True)
class Share(Options):
    """An agent's part in a mixture: `agents.KEY.weight`.

    Attributes:
      weight: share of the candidates that train it; with 0 it only judges incumbents
    """

    group: ClassVar[str] = "share"

    weight: float = option(1.0, between(0, 1e6, "it is a share of the candidates"))


@dataclass(frozen=True)
class Composed:
    """What words compose.

    Attributes:
      values: nested plain values; fields that no layer sets are left out.
      layers: the same, where they come from, in the order in which one lies on another.
      imports: each `module:attribute` that the words name, which may be imported.
    """

    values: dict[str, Any]
    layers: dict[str, Mapping[str, Any]]
    imports: frozenset[str]


def compose(
    schema: "type[CommandConfig]",
    overrides: Sequence[str],
    stored: Mapping[str, Any] | None = None,
) -> Composed:
    """Composes a command's words over its preset and its choices.

    Args:
      schema: the command's configuration.
      overrides: as typed after the command.
      stored: what a stored proxy was learned with, nested plain values.

    Raises:
      ConfigError: for words that cannot be, and for a choice or a preset that is not there.
    """
    given, stored = read(overrides), stored or {}
    imports = frozenset(registry.paths_in(overrides))
    of_stored = {group: x["name"] for group, x in stored.items() if group in schema.groups}
    usual: dict[str, Any] = DEFAULTS | of_stored
    chosen = {name: given.get(name, usual[name]) for name in schema.groups}
    names = agents_of(given) or {key: x["name"] for key, x in stored.get("agents", {}).items()}
    names = names or {x: x for x in [_default_agent(schema, given, imports)]}
    preset, of_preset = str(given.get("preset", "best")), {}
    if schema.learns:
        usual_objective = registry.find("proxy", chosen["proxy"], imports).default_objective
        section = preset_files.section_of(preset, chosen["env"], chosen["proxy"])
        objective = section.get("objective", {}).get("name", usual_objective)
        chosen["objective"] = given.get("objective", objective)
        of_preset = {"preset": preset} | preset_files.settings_of(section, chosen, names)
    typed = {_choice(word.partition("=")[0]) for word in overrides}
    choices = {group: {"name": name} for group, name in chosen.items()}
    layers = {
        "default": choices | {"agents": {key: {"name": name} for key, name in names.items()}},
        f"preset={preset}": of_preset,
        "proxy": stored,
        "file": _nested({k: x for k, x in given.items() if k not in typed}, names, schema.groups),
        "typed": _nested({k: x for k, x in given.items() if k in typed}, names, schema.groups),
    }
    return Composed(merge(*layers.values()), layers, imports)


def _default_agent(
    schema: "type[CommandConfig]", given: Mapping[str, Any], imports: Collection[str]
) -> str:
    with contextlib.suppress(ConfigError):  # what is wrong is said when the task is made
        return agents.default_for(schema.spec_for(given, imports))
    return agents.DEFAULTS[0]


def _nested(
    given: Mapping[str, Any], agents: Collection[str], groups: Collection[str]
) -> dict[str, Any]:
    """The words' values as a tree, those of `agent.FIELD` as the only agent's."""
    tree: dict[str, Any] = {}
    for name, value in given.items():
        first, *rest = name.split(".")
        if name in (*groups, "agent", "agents"):
            continue
        path = [first, *rest]
        if first == "agent":
            key, got = next(iter(agents)), shortened(value)
            message = f"must be one agent's; got {got}. Set agents.{key}{name[5:]}={got}."
            require(len(agents) == 1, name, message)
            path = ["agents", key, *rest]
        for part in reversed(path):
            value = {part: value}
        tree = merge(tree, value)
    return tree


# --- words ---------------------------------------------------------------------------------------


def read(overrides: Sequence[str]) -> dict[str, Any]:
    """Names and values of words, over those of the file that `preset=FILE.yaml` names.

    Raises:
      ConfigError: for what is no word of this form, or several values, and for a file that cannot
        be read.
    """
    require(
        isinstance(overrides, list | tuple) and all(isinstance(x, str) for x in overrides),
        "overrides",
        f"must be a list of text; got {shortened(repr(overrides))}. Set "
        'overrides=["env=cartpole"].',
    )
    given: dict[str, Any] = {}
    for i, override in enumerate(overrides):
        name, equals, text = override.partition("=")
        require(
            equals and NAME.fullmatch(name),
            "an override",
            f"must read FIELD=VALUE; got {shortened(override)}. Write {meant(overrides[i:])}.",
        )
        require(
            not text.startswith("[") or text.endswith("]"),
            name,
            f"must close its bracket, with no space in it; got {shortened(text)}. Set "
            f"{name}={shortened(text.rstrip(','))}].",
        )
        values = split(text)
        require(
            len(values) == 1,
            name,
            f"must be one value: a comma outside of brackets and quotes makes a sweep; got "
            f"{shortened(text)}. Set {name}={shortened(values[0])}.",
        )
        given[name] = unquoted(text)
    if str(given.get("preset", "")).endswith(preset_files.ENDING):
        of_file = preset_files.read_file(Path(expanded(given.pop("preset"))))
        rechosen = ("agent", "agents") if {"agent", "agents"} & given.keys() else ()
        given = {k: x for k, x in of_file.items() if k not in rechosen} | given
    # A choice may stand beside its fields, as in a run's config.yaml.
    return {_choice(name): value for name, value in given.items()}


def _choice(name: str) -> str:
    group = name.removesuffix(".name")
    return group if group in registry.GROUPS else name


def meant(words: Sequence[str]) -> str:
    """What may be meant by words of which the first is no FIELD=VALUE."""
    name, *values = [*filter(None, (word.strip("-=") for word in words[:3])), "VALUE"]
    if "=" in name:  # after dashes
        return shortened(name)
    value = "VALUE" if "=" in values[0] else values[0]
    is_field = words[0].startswith("-") or name in registry.GROUPS or value != "VALUE"
    if is_field and NAME.fullmatch(name) and not registry.is_registered("env", name):
        return f"{shortened(name)}={shortened(value)}"
    return f"env={shortened(name)} or proxy={shortened(name)}, if that is meant"


def expand(overrides: Sequence[str]) -> list[list[str]]:
    """The words of each run of a sweep: commas outside of brackets separate values.

    Example:
      >>> expand(["env=acrobot", "seed=0,1"])
      [['env=acrobot', 'seed=0'], ['env=acrobot', 'seed=1']]
    """
    pairs = (override.partition("=") for override in overrides)
    values = [[f"{name}{equals}{value}" for value in split(text)] for name, equals, text in pairs]
    return [list(each) for each in itertools.product(*values)]


def name_in_sweep(overrides: Sequence[str], of_run: Sequence[str], known: Collection[str]) -> str:
    """What tells a run of a sweep from the others, for the name of its folder.

    Args:
      overrides: of the sweep.
      of_run: those of one run, as from `expand`.
      known: fields that the folder's name has already.

    Example:
      >>> sweep = ["seed=0,1", "es.noise_std=0.1,0.2"]
      >>> name_in_sweep(sweep, ["seed=1", "es.noise_std=0.2"], ["seed"])
      'es.noise_std_0.2'
    """
    swept = [one for one, each in zip(of_run, overrides, strict=True) if one != each]
    name = as_file_name(",".join(x for x in swept if x.partition("=")[0] not in known))
    return name if len(name) <= 120 else hashlib.sha256(name.encode()).hexdigest()[:16]


# --- agents --------------------------------------------------------------------------------------


def key_of(name: str) -> str:
    """The key of an agent; `my_module_MyAgent` of `my_module:MyAgent`."""
    return re.sub(r"[^\w-]+", "_", name)


def field_of(key: str, keys: Collection[str]) -> str:
    """The name of an agent's fields in words and messages: `agent`, or `agents.KEY` of several."""
    return f"agents.{key}" if len(keys) > 1 else "agent"


@contextlib.contextmanager
def errors_of(group: str, where: str) -> Iterator[None]:
    """Errors about a group in here name the place where it stands, such as `agents.ddqn`."""
    try:
        yield
    except ConfigError as error:
        raise error.moved(group, where) from None


def agents_of(given: Mapping[str, Any]) -> dict[str, str]:
    """The names of agents by their keys; empty where none is chosen.

    `agent=ddqn` and `agents=[ddqn,ppo]` choose them, and `agents.KEY.name=ddqn` by any key.
    """
    asked = {name: given[name] for name in ("agents", "agent") if given.get(name) is not None}
    chosen: dict[str, str] = {}
    for field, value in asked.items():
        names = parsed(value) if isinstance(value, str) else value
        names = names if isinstance(names, list) else [names]
        names = [x if isinstance(x, str) else as_text(x) for x in names]
        got = shortened(value)
        several = shortened(",".join(dict.fromkeys([*chosen.values(), *names])))
        require(names, field, f"must hold an agent; got {got}. Set agents=[ddqn,ppo].")
        is_clear = not chosen and len({*names}) == len(names)
        require(is_clear, field, f"must name each agent once; got {got}. Set agents=[{several}].")
        chosen = {key_of(name): name for name in names}
    by_key = re.compile(r"agents\.([\w-]+)\.name")
    named = {match[1]: str(x) for name, x in given.items() if (match := by_key.fullmatch(name))}
    return chosen | named


# --- help ----------------------------------------------------------------------------------------


def list_fields(config: "CommandConfig", layers: Mapping[str, Mapping[str, Any]]) -> str:
    """What `--help` lists: the choices of each group, and the fields of these choices.

    A value that is no default has the layer beside it that it comes from.

    Args:
      config: what the words beside `--help` describe.
      layers: from which it was composed.
    """
    lines = ["Choices (group=choice):"]
    for group in ("agent", *config.groups):
        prefixes = [f"{start}ID" for start in registry.GROUPS[group].prefixes]
        known = [*registry.names(group), *prefixes, "module:attribute"]
        lines += [f"  {group}: {', '.join(known)}"]
    lines += ["  agents: [agent,agent,...]"]
    if config.learns:
        lines += [f"  preset: {', '.join([*preset_files.names(), 'FILE.yaml'])}"]
    lines += ["", "Fields of these choices (field=value), with their values:"]
    sources: dict[str, str] = {}
    for layer, values in layers.items():
        sources |= dict.fromkeys(flatten(values), "" if layer == "default" else f" ({layer})")
    for shown, path, part in config.sections():
        texts = help_texts(type(part))
        for name, value in vars(part).items():
            if name in ("name", "agents", "weights") or dataclasses.is_dataclass(value):
                continue
            about = f"  # {texts[name]}" if name in texts else ""
            source = sources.get(f"{path}.{name}".lstrip("."), "")
            field = f"{shown}.{name}".lstrip(".")
            lines += [f"  {field}={as_text(to_plain(value))}{about}{source}"]
    wrap = textwrap.TextWrapper(98, subsequent_indent="      ", break_long_words=False)
    return "\n".join(wrap.fill(line) for line in lines)
