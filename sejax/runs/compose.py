"""From the words that a user types to nested plain values: the first half of `runs.config`.

A word is `group=choice`, `group.field=value` or `field=value`. `read` splits words into names and
texts. `compose` finds the choice of every group (the given one, else what the task and the proxy
suggest), checks that each name is a field of these choices, and lays the layers on each other:
defaults, the preset or what a stored proxy was learned with, the user's file, the words.
"""

import contextlib
import hashlib
import itertools
import re
import textwrap
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from sejax import agents
from sejax.agents.mixture import MixtureConfig
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
    unknown_name,
)
from sejax.options.plain import (
    MISSING,
    expanded,
    fields_of,
    flatten,
    merge,
    parsed,
    split,
    to_plain,
    unknown_field,
    unquoted,
)
from sejax.runs import preset_files
from sejax.training import TrainingConfig

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
SEVERAL = "Set agents=[ddqn,ppo]."


@dataclass(frozen=True, kw_only=True)
class Share(Options):
    """An agent's part in a mixture: `agents.KEY.weight`."""

    group: ClassVar[str] = "share"

    weight: float = option(
        1.0,
        between(0, 1e6, "it is a share of the candidates"),
        help="share of the candidates that train it; with 0 it only judges incumbents",
    )


@dataclass(frozen=True)
class Composed:
    """What words compose.

    Attributes:
      values: nested plain values; fields that no layer sets are left out.
      fields: default and help text of each field of the choices, by their full names.
      layers: where the values come from, in the order in which one lies on another.
      imports: each `module:attribute` that the words name, which may be imported.
    """

    values: dict[str, Any]
    fields: dict[str, tuple[Any, str]]
    layers: dict[str, Mapping[str, Any]]
    imports: frozenset[str]


def compose(
    schema: "type[CommandConfig]",
    overrides: Sequence[str],
    stored: Mapping[str, Any] | None = None,
) -> Composed:
    """Composes a command's words over its preset and its defaults.

    Args:
      schema: the command's configuration.
      overrides: as typed after the command.
      stored: what a stored proxy was learned with, nested plain values.

    Raises:
      ConfigError: for words that cannot be.
    """
    given, stored = read(overrides), stored or {}
    imports = imports_of(overrides)
    keys = agents_of(given) or {key: x["name"] for key, x in stored.get("agents", {}).items()}
    chosen = _choices(schema, given, stored, imports)
    keys = keys or {key_of(name): name for name in [_default_agent(schema, given, imports)]}
    for name in keys.values():
        with errors_of("agent", "agents" if len(keys) > 1 else "agent"):
            registry.find("agent", name, imports)
    fields = _fields(schema, chosen, keys, imports)
    settings = {}
    chosen_by = {*schema.groups, "agent", "agents", *(f"agents.{key}.name" for key in keys)}
    for name, value in given.items():
        if name not in chosen_by:
            shown = _shown(name, keys)
            _require_field(shown, value, chosen, fields)
            settings[_path(shown, keys)] = value
    choices: dict[str, Any] = {group: {"name": name} for group, name in chosen.items()}
    choices |= {"agents": {key: {"name": name} for key, name in keys.items()}}
    trainings = {k: x for k, x in fields_of(schema).items() if isinstance(x, TrainingConfig)}
    preset = given.get("preset", "best")
    layers: dict[str, Mapping[str, Any]] = {
        "default": choices | to_plain(trainings),
        f"preset={preset}": preset_files.values_of(preset, chosen, keys) if schema.learns else {},
        "proxy": stored,
        "typed": merge(*(_nested(name, x) for name, x in settings.items())),
    }
    return Composed(merge(*layers.values()), fields, layers, imports)


def _nested(name: str, value: object) -> dict[str, Any]:
    first, _, rest = name.partition(".")
    return {first: _nested(rest, value) if rest else value}


# --- words ---------------------------------------------------------------------------------------


def read(overrides: Sequence[str]) -> dict[str, Any]:
    """Names and values of words, over those of the file that `preset=FILE.yaml` names.

    Raises:
      ConfigError: for what is no word of this form, or several values, and for a file that cannot
        be read.
    """
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
    return given


def imports_of(overrides: Sequence[str]) -> frozenset[str]:
    """Each `module:attribute` that words name, by itself or in a list."""
    texts = (parsed(override.partition("=")[2]) for override in overrides)
    items = itertools.chain.from_iterable(x if isinstance(x, list) else [x] for x in texts)
    return frozenset(x for x in items if isinstance(x, str) and ":" in x)


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


def _path(name: str, keys: Collection[str]) -> str:
    """Where a word's value has its place: `agents.KEY.field` for `agent.field`."""
    first, _, rest = name.partition(".")
    return f"agents.{next(iter(keys))}.{rest}" if first == "agent" else name


def _shown(name: str, keys: Collection[str]) -> str:
    """The one name of a word's field: of one agent `agent.field`, also if given as `agents.KEY`."""
    own = f"agents.{next(iter(keys))}."
    return f"agent.{name.removeprefix(own)}" if len(keys) == 1 and name.startswith(own) else name


@contextlib.contextmanager
def errors_of(group: str, where: str) -> Iterator[None]:
    """Errors about a group in here name the place where it stands, such as `agents.ddqn`."""
    try:
        yield
    except ConfigError as error:
        raise error.moved(group, where) from None


def agents_of(given: Mapping[str, Any]) -> dict[str, str]:
    """The names of the agents by their keys, which `agent=ddqn` or `agents=[ddqn,ppo]` chooses.

    A key is the agent's name, or any word with `agents.KEY.name`. Empty where none is chosen.
    """
    field = "agents" if given.get("agents") is not None else "agent"
    asked = given.get(field)
    names = parsed(asked) if isinstance(asked, str) else asked
    if names is None:
        return {}
    is_one = field == "agent" or not isinstance(names, list)
    names = [names] if is_one else names
    require(names, field, f"must hold an agent; got none. {SEVERAL}")
    for name in names:
        require(
            not isinstance(name, list),
            field,
            f"must be one agent; got {shortened(asked)}. Set agents={shortened(as_text(name))}.",
        )
        if not isinstance(name, str):
            raise unknown_name(field, name, registry.names("agent"))
    keys = {key_of(name): name for name in names}
    several = shortened(",".join(dict.fromkeys(names)))
    require(
        len(keys) == len(names),
        field,
        f"must name each agent once; got {shortened(asked)}. Set agents=[{several}].",
    )
    extra = next((x for x in given if x == "agent" or x.startswith("agent.")), "")
    got, rest = shortened(given.get(extra)), extra.removeprefix("agent")
    fix = f"agents.{key_of(names[0])}{rest}={got}" if rest else f"agents=[{several},{got}]"
    is_clear = field == "agent" or not extra or (rest and len(keys) == 1)
    require(is_clear, extra, f"must be left out with agents=[{several}]; got {got}. Set {fix}.")
    return {key: str(given.get(f"agents.{key}.name", name)) for key, name in keys.items()}


# --- choices -------------------------------------------------------------------------------------


def _default_agent(
    schema: "type[CommandConfig]", given: Mapping[str, Any], imports: Collection[str]
) -> str:
    with contextlib.suppress(ConfigError):  # what is wrong is said when the task is made
        return agents.default_for(schema.spec_for(given, imports))
    return agents.DEFAULTS[0]


def _choices(
    schema: "type[CommandConfig]",
    given: Mapping[str, Any],
    stored: Mapping[str, Any],
    imports: Collection[str],
) -> dict[str, str]:
    """The choice of every group but the agents."""
    known = DEFAULTS | {group: stored[group]["name"] for group in schema.groups if group in stored}
    chosen = {group: given.get(group, known[group]) for group in schema.groups}
    for group, choice in chosen.items():
        names = parsed(choice) if isinstance(choice, str) else choice
        if isinstance(names, list):
            first = shortened(as_text(names[0] if names else DEFAULTS[group]))
            message = f"must be one choice; got {shortened(choice)}. Set {group}={first}."
            raise ConfigError(f"{group} {message}", group)
        registry.find(group, choice, imports)
    if schema.learns and "objective" not in given:
        preset, names = given.get("preset", "best"), (chosen["env"], chosen["proxy"])
        default = registry.find("proxy", chosen["proxy"], imports).default_objective
        chosen["objective"] = preset_files.objective_of(preset, *names) or default
    return chosen


def _fields(
    schema: "type[CommandConfig]",
    chosen: Mapping[str, str],
    keys: Mapping[str, str],
    imports: Collection[str],
) -> dict[str, tuple[Any, str]]:
    """Defaults and help texts of the fields that these choices have, by their full names."""
    classes: list[tuple[str, type]] = [("", schema)]
    classes += [(group, registry.find(group, name, imports)) for group, name in chosen.items()]
    for key, name in keys.items():
        classes += [(field_of(key, keys), registry.find("agent", name, imports))]
        classes += [(field_of(key, keys), Share)] if len(keys) > 1 and schema.learns else []
    classes += [("agents", MixtureConfig)] if len(keys) > 1 and schema.learns else []
    own = fields_of(schema).items()
    classes += [(name, type(x)) for name, x in own if isinstance(x, TrainingConfig)]
    found = {}
    for group, cls in classes:
        texts = help_texts(cls)
        for name, default in fields_of(cls).items():
            full = f"{group}.{name}".lstrip(".")
            if name != "name" and full not in (*schema.groups, *dict(classes), *schema.made):
                found[full] = default, texts.get(name, "")
    return found


def _require_field(
    name: str, value: object, chosen: Mapping[str, str], fields: Mapping[str, tuple[Any, str]]
) -> None:
    """Checks that a word names a field of these choices.

    Raises:
      ConfigError: if it does not, with what may be meant.
    """
    if any(name == field or name.startswith(f"{field}.") for field in fields):
        return
    group, _, last = name.rpartition(".")
    known = registry.GROUPS[group].built_in if group in registry.GROUPS else ()
    others = [choice for choice in known if last in fields_of(registry.find(group, choice))]
    got = shortened(value)
    if last == "name" and group in registry.GROUPS:
        message = f"must be left out; got {got}. Set {group}={got}."
    elif name.startswith("agents.") and not any(x.startswith("agents.") for x in fields):
        message = f"must come with several agents; got {got}. {SEVERAL}"
    elif others:
        choice = shortened(chosen.get(group, "this one"))
        message = f"is no field of {group}={choice}; got {got}. Set {group}={others[0]}."
    else:
        raise unknown_field(name, list(fields))
    raise ConfigError(f"{name} {message}", name)


# --- help ----------------------------------------------------------------------------------------


def help_text(schema: "type[CommandConfig]", composed: Composed) -> str:
    """What `--help` lists: the choices of each group, and the fields of these choices.

    A value that is no default has the layer beside it that it comes from.

    Args:
      schema: the command's configuration.
      composed: what the words beside `--help` compose.
    """
    lines = ["Choices (group=choice):"]
    for group in ("agent", *schema.groups):
        prefixes = [f"{start}ID" for start in registry.GROUPS[group].prefixes]
        known = [*registry.names(group), *prefixes, "module:attribute"]
        lines += [f"  {group}: {', '.join(known)}"]
    lines += ["  agents: [agent,agent,...]"]
    if schema.learns:
        lines += [f"  preset: {', '.join([*preset_files.names(), 'FILE.yaml'])}"]
    keys = composed.values["agents"]
    values: dict[str, Any] = {}
    sources: dict[str, str] = {}
    for layer, nested in composed.layers.items():
        flat = flatten(nested)
        values |= flat
        sources |= dict.fromkeys(flat, "" if layer == "default" else f" ({layer})")
    lines += ["", "Fields of these choices (field=value), with their values:"]
    for name, (default, text) in composed.fields.items():
        path = _path(name, keys)
        value = values.get(path, None if default is MISSING else to_plain(default))
        about = f"  # {text}" if text else ""
        lines += [f"  {name}={as_text(value)}{about}{sources.get(path, '')}"]
    wrap = textwrap.TextWrapper(98, subsequent_indent="      ", break_long_words=False)
    return "\n".join(wrap.fill(line) for line in lines)
