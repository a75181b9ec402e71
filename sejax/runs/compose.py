"""From the overrides that a user types to nested plain values: the first half of `runs.config`.

An override is `group=choice`, `group.field=value` or `field=value`. `read` splits them into names
and texts, and puts the values of a preset file beneath them. `compose` finds the choice of every
group (the given one, else what the task and the proxy suggest), checks that each name is a field
of these choices, and merges the preset's values for them with the overrides.
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
from typing import TYPE_CHECKING, Any

from sejax import agents
from sejax.agents.mixture import MixtureConfig
from sejax.ops.files import as_file_name
from sejax.options import (
    ConfigError,
    as_text,
    help_texts,
    registry,
    require,
    shortened,
    unknown_name,
)
from sejax.options.plain import (
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

# Choices where neither an override nor the task or the proxy makes one.
DEFAULTS = {
    "env": "cartpole",
    "proxy": "se",
    "agent": "ddqn",
    "exploration": "none",
    "es": "nes",
    "objective": "max_reward",
    "tracker": "none",
    "machines": "local",
}
NAME = re.compile(r"[A-Za-z_][\w.-]*")  # of a field
MIXTURE = "Set agents=[ddqn,ppo]."


@dataclass(frozen=True)
class Composed:
    """What overrides compose.

    Attributes:
      given: values of the overrides and of the preset file, by their names.
      fields: default and help text of each field of the choices, by their full names.
      values: nested plain values; fields that neither overrides nor the preset set are left out.
    """

    given: dict[str, Any]
    fields: dict[str, tuple[Any, str]]
    values: dict[str, Any]


def compose(schema: "type[CommandConfig]", overrides: Sequence[str]) -> Composed:
    """Composes a command's overrides over its preset and its defaults.

    Args:
      schema: the command's configuration.
      overrides: as typed after the command.

    Raises:
      ConfigError: for an override that cannot be.
    """
    given = read(overrides)
    mixture = mixture_of(given)
    chosen = _choices(schema, given, mixture)
    fields = _fields(schema, chosen, mixture)
    settings = {k: x for k, x in given.items() if k not in (*schema.groups, "agents")}
    own = fields_of(schema).items()
    values = {name: to_plain(x) for name, x in own if isinstance(x, TrainingConfig)}
    if schema.learns:
        preset = preset_files.values_of(given.get("preset", "best"), chosen, mixture)
        values = merge(values, preset)
    for name, value in settings.items():
        _require_field(name, value, chosen, fields)
        values = merge(values, _nested(name, value))
    values = merge({group: {"name": name} for group, name in chosen.items()}, values)
    each = {key: {"name": name} for key, name in mixture.items()}
    return Composed(given, fields, merge({"agents": each}, values) if each else values)


def _nested(name: str, value: object) -> dict[str, Any]:
    first, _, rest = name.partition(".")
    return {first: _nested(rest, value) if rest else value}


# --- overrides -----------------------------------------------------------------------------------


def read(overrides: Sequence[str]) -> dict[str, Any]:
    """Names and values of overrides, over those of the file that `preset=FILE.yaml` names.

    Raises:
      ConfigError: for what is no override, or several values, and for a file that cannot be read.
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
        given = preset_files.read_file(Path(expanded(given.pop("preset")))) | given
    return given


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
    """The overrides of each run of a sweep: commas outside of brackets separate values.

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


# --- choices -------------------------------------------------------------------------------------


def key_of(name: str) -> str:
    """The key of an agent in a mixture; `my_module_MyAgent` of `my_module:MyAgent`."""
    return re.sub(r"[^\w-]+", "_", name)


@contextlib.contextmanager
def named(field: str) -> Iterator[None]:
    """Errors about `agent` in here name a mixture's field, such as `agents.ddqn`."""
    try:
        yield
    except ConfigError as error:
        if field == "agent":
            raise
        text = re.sub(r"\bagent(?=\.\w| must )", field, str(error))
        at_fault = re.sub(r"^agent\b", field, error.field)
        raise ConfigError(re.sub(r"\bagent=", "agents=", text), at_fault) from error


def mixture_of(given: Mapping[str, Any]) -> dict[str, str]:
    """The names of a mixture's agents by their keys; empty without `agents=[...]`.

    A key is the agent's name, or any word with `agents.KEY.name`.
    """
    asked = given.get("agents")
    names = parsed(asked) if isinstance(asked, str) else asked
    if names is None:
        return {}
    names = names if isinstance(names, list) else [names]
    require(names, "agents", f"must hold an agent; got none. {MIXTURE}")
    for name in names:
        if not isinstance(name, str):
            raise unknown_name("agents", name, registry.names("agent"))
    keys = {key_of(name): name for name in names}
    mixture = {key: str(given.get(f"agents.{key}.name", name)) for key, name in keys.items()}
    several = shortened(",".join(dict.fromkeys(names)))
    require(
        len(mixture) == len(names),
        "agents",
        f"must name each agent once; got {shortened(asked)}. Set agents=[{several}].",
    )
    extra = next((name for name in given if re.fullmatch(r"agent(\..*)?", name)), "")
    got, option = shortened(given.get(extra)), extra.removeprefix("agent")
    fix = f"agents.{key_of(names[0])}{option}={got}" if option else f"agents=[{several},{got}]"
    require(not extra, extra, f"must be left out with agents=[{several}]; got {got}. Set {fix}.")
    return mixture


def _choices(
    schema: "type[CommandConfig]", given: Mapping[str, Any], mixture: Mapping[str, str]
) -> dict[str, str]:
    """The choice of every group; without the agent where there is a mixture."""
    chosen = {group: given.get(group, DEFAULTS[group]) for group in schema.groups}
    for group, choice in chosen.items():
        names = parsed(choice) if isinstance(choice, str) else choice
        if isinstance(names, list):
            first = as_text(names[0] if names else DEFAULTS[group])
            fix = f"agents={as_text(names)}" if group == "agent" else f"{group}={first}"
            message = f"must be one choice; got {shortened(choice)}. Set {shortened(fix)}."
            raise ConfigError(f"{group} {message}", group)
        registry.find(group, choice)
    for name in mixture.values():
        with named("agents"):
            registry.find("agent", name)
    if mixture:
        del chosen["agent"]
    elif "agent" not in given:
        with contextlib.suppress(ConfigError):  # what is wrong is said when the task is made
            chosen["agent"] = agents.default_for(schema.spec_for(given))
    if schema.learns and "objective" not in given:
        preset, names = given.get("preset", "best"), (chosen["env"], chosen["proxy"])
        default = registry.find("proxy", chosen["proxy"]).default_objective
        chosen["objective"] = preset_files.objective_of(preset, *names) or default
    return chosen


def _fields(
    schema: "type[CommandConfig]", chosen: Mapping[str, str], mixture: Mapping[str, str]
) -> dict[str, tuple[Any, str]]:
    """Defaults and help texts of the fields that these choices have, by their full names."""
    groups = {group: registry.find(group, name) for group, name in chosen.items()}
    if mixture and schema.learns:
        groups["agents"] = MixtureConfig
    groups |= {f"agents.{key}": registry.find("agent", name) for key, name in mixture.items()}
    own = fields_of(schema)
    groups |= {name: TrainingConfig for name, x in own.items() if isinstance(x, TrainingConfig)}
    found = {}
    for group, cls in {"": schema, **groups}.items():
        texts = help_texts(cls)
        for name, default in fields_of(cls).items():
            full = f"{group}.{name}".lstrip(".")
            if name != "name" and full not in (*schema.groups, *groups, "agents"):
                found[full] = default, texts.get(name, "")
    if schema.learns:
        share = 1.0, "share of the candidates that train it"
        found |= {f"agents.{key}.weight": share for key in mixture}
    found |= {f"agents.{key}.name": (name, "kind of agent") for key, name in mixture.items()}
    return found


def _require_field(
    name: str, value: object, chosen: Mapping[str, str], fields: Mapping[str, tuple[Any, str]]
) -> None:
    """Checks that an override names a field of these choices.

    Raises:
      ConfigError: if it does not, with what may be meant.
    """
    if any(name == field or name.startswith(f"{field}.") for field in fields):
        return
    group, _, last = name.rpartition(".")
    known = registry.GROUPS[group].built_in if group in registry.GROUPS else ()
    others = [choice for choice in known if last in fields_of(registry.find(group, choice))]
    got = shortened(value)
    if last == "name" and group in chosen:
        message = f"must be left out; got {got}. Set {group}={got}."
    elif name.startswith("agents.") and "agent" in chosen:
        message = f"must come with a mixture; got {got}. {MIXTURE}"
    elif others:
        choice = shortened(chosen.get(group))
        message = f"is no field of {group}={choice}; got {got}. Set {group}={others[0]}."
    else:
        raise unknown_field(name, list(fields))
    raise ConfigError(f"{name} {message}", name)


# --- help ----------------------------------------------------------------------------------------


def help_text(schema: "type[CommandConfig]", overrides: Sequence[str]) -> str:
    """What `--help` lists: the choices of each group, and the fields that these overrides compose.

    Args:
      schema: the command's configuration.
      overrides: as typed after the command.

    Raises:
      ConfigError: for overrides that cannot be composed.
    """
    composed = compose(schema, overrides)
    values = flatten(composed.values)
    lines = ["Choices (group=choice):"]
    for group in schema.groups:
        prefixes = [f"{start}ID" for start in registry.GROUPS[group].prefixes]
        known = [*registry.names(group), *prefixes, "module:attribute"]
        lines += [f"  {group}: {', '.join(known)}"]
    if schema.learns:
        lines += [f"  preset: {', '.join([*preset_files.names(), 'FILE.yaml'])}"]
    lines += ["", "Fields of these choices (field=value), with their values:"]
    for name, (default, text) in composed.fields.items():
        value = values.get(name, None if default is dataclasses.MISSING else to_plain(default))
        lines += [f"  {name}={as_text(value)}" + (f"  # {text}" if text else "")]
    wrap = textwrap.TextWrapper(98, subsequent_indent="      ", break_long_words=False)
    return "\n".join(wrap.fill(line) for line in lines)
