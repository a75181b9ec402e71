"""Dataclasses to plain values, as files and overrides hold them, and back.

`to_plain` writes a configuration as plain values: numbers, texts, None, lists, dictionaries.
`from_plain` and, for a plugin, `configure` read it back. Pydantic converts each value to its
field's type: `1` to a float, a list to a tuple, the text of an override to a number.
"""

import dataclasses
import functools
import os
import re
import typing
from collections.abc import Collection, Mapping
from contextlib import suppress
from difflib import get_close_matches
from typing import Any

from sejax.options import (
    ConfigError,
    checked,
    errors_of,
    hints_of,
    listed,
    marks,
    nearest,
    old,
    registry,
    require,
    shortened,
)

T = typing.TypeVar("T")

MISSING = dataclasses.MISSING
NAMED = 2  # fields of a message about settings that differ
# Our names of fields, by the names that others use.
SYMBOLS = {"sigma": "noise_std", "alpha": "step_size", "lr": "learning_rate"}
# Last parts of the names of fields whose text may be a `module:attribute`, or code's address.
NAMES_CODE = ("name", "env", "policy", "proxy_kind", "score_transform", "algorithms", "address")
_CONSTANTS = {"null": None, "true": True, "True": True, "false": False, "False": False}


# --- dataclasses ---------------------------------------------------------------------------------


def to_plain(value: object, group: str | None = None) -> Any:
    """A value as plain values; a dataclass as a dictionary of its fields.

    Args:
      value: any value.
      group: of a plugin's configuration, whose name is then written too. Fields that hold plugins
        have their groups.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [field.name for field in dataclasses.fields(value) if field.init]
        groups = {field: marks(type(value), field).get("plugin") for field in fields}
        name = {"name": registry.name_of(group, value)} if group else {}
        return name | {field: to_plain(getattr(value, field), groups[field]) for field in fields}
    if isinstance(value, tuple | list):
        return [to_plain(x, group) for x in value]
    if isinstance(value, Mapping):
        return {str(key): to_plain(x, group) for key, x in value.items()}
    if hasattr(value, "tolist") and not isinstance(value, type):  # arrays of NumPy and jax
        return value.tolist()
    return os.fspath(value) if isinstance(value, os.PathLike) else value


def plugin(group: str) -> Any:
    """A dataclass field with a plugin's configuration; the default is sejax's own first plugin."""
    factory = functools.partial(configure, group, registry.DEFAULTS[group])
    return dataclasses.field(default_factory=factory, metadata={"plugin": group})


def configure(group: str, values: Any, where: str = "") -> Any:
    """The configuration of a plugin that plain values describe: its `name`, and its fields.

    Imports the module of a `module:attribute`; see `require_typed`.

    Args:
      group: one of `sejax.options.registry.GROUPS`.
      values: plain values by field name.
      where: its name in messages; by default the group.

    Raises:
      ConfigError: for an unknown name or field, or a bad value.

    Example:
      >>> configure("agent", {"name": "q_learning", "discount": 0.9}).discount
      0.9
    """
    is_choice = isinstance(values, Mapping) and isinstance(values.get("name"), str)
    where = where or group
    fix = f"Set {where}=NAME{', or agent.FIELD of an only agent' if group == 'agent' else ''}."
    require(is_choice, where, "must be a choice with its fields", got=values, fix=fix)
    with errors_of(group, where):
        cls = registry.find(group, values["name"])
    known = defaults_of(cls)
    fields = {k: v for k, v in values.items() if k != "name" or k in known}
    for field in [name for name in fields if name not in known]:
        built_in = registry.BUILT_IN[group]
        others = [x for x in built_in if field in defaults_of(registry.find(group, x))]
        rule = f"is no field of {values['name']}, but of {group}={', '.join(others)}"
        fix = "Leave it out, or set it for one of these alone."
        require(not others, f"{where}.{field}", rule, fix=fix)
    return from_plain(cls, fields, where)


def from_plain(cls: type[T], values: Mapping[str, Any], where: str) -> T:
    """Inverse of `to_plain`.

    Args:
      cls: a dataclass.
      values: plain values by field name; missing fields have their defaults.
      where: its name in messages, as `agent` in `agent.batch_size`; may be empty.

    Raises:
      ConfigError: for an unknown field, a missing one, or a value of another type.
    """
    hints = hints_of(cls, where)
    defaults = defaults_of(cls)
    fields = {}
    group = getattr(cls, "group", where)
    full = {name: f"{where}.{name}".lstrip(".") for name in defaults}
    for name, value in values.items():
        if name in defaults:
            plugins = marks(cls, name).get("plugin")
            fields[name] = _read(value, hints[name], full[name], defaults[name], plugins)
        elif not old.is_gone(f"{group}.{name}", value):
            raise unknown_field(f"{where}.{name}".lstrip("."), full.values())
    for name, default in defaults.items():
        is_known = name in fields or default is not MISSING
        require(is_known, full[name], "must be given; it has no default", use="VALUE")
    with errors_of(group, where):
        return cls(**fields)


def require_typed(values: Mapping[str, Any], typed: Mapping[str, Any] | None = None) -> None:
    """Checks that plain values of a file name no code but what the user has typed.

    Args:
      values: nested plain values, by the names of fields or groups.
      typed: nested plain values of the user, whose code may be imported.

    Raises:
      ConfigError: for the first field of `NAMES_CODE` that names another one.
    """
    rule = "must be typed, as names in files are never imported"
    known, stored = (
        {k: str(x) for k, x in flatten(tree).items() if k.rpartition(".")[2] in NAMES_CODE}
        for tree in (typed or {}, values)
    )
    for name, text in stored.items():
        if ":" in text and text not in known.values():
            use = f"{shortened(text, 60)}, if you trust it"
            raise ConfigError(name.removesuffix(".name"), rule, got=text, use=use)


def defaults_of(cls: type) -> dict[str, Any]:
    """The defaults of a dataclass's fields by their names; `MISSING` for a field without one."""
    return {
        field.name: field.default if field.default_factory is MISSING else field.default_factory()
        for field in dataclasses.fields(cls)  # type: ignore[arg-type]
        if field.init
    }


def unknown_field(field: str, known: Collection[str]) -> ConfigError:
    """The error for an unknown field, with the nearest known fields."""
    if field in old.INSTEAD:
        return ConfigError(field, "is no field", fix=f"Set {old.INSTEAD[field]}.")
    last = field.rpartition(".")[2]
    field = shortened(field, 40)
    same = [name for name in known if name.rpartition(".")[2] == SYMBOLS.get(last, last)]
    close = same or get_close_matches(field, known, 1, 0.7)
    fix = f"Did you mean {close[0]}? " if close else ""
    fix += "" if len(same) == 1 else f"Fields: {listed(same or nearest(field, known))}."
    return ConfigError(field, "is no field", fix=fix)


def _read(value: Any, hint: Any, name: str, default: Any, group: str | None) -> Any:
    """A value as its field's type: values by key, sorted; a plugin; a dataclass; or a leaf.

    A leaf is a number, a text or a list. As an override's text it is read, or else stays as it is.

    Args:
      value: plain values.
      hint: the type.
      name: the field's full name, for messages.
      default: the field's default.
      group: of the plugins that the field holds; None if it holds none.
    """
    of_key = typing.get_args(hint)[1] if typing.get_origin(hint) is dict else Any
    if isinstance(value, Mapping) and of_key is not Any:
        only = group if len(value) == 1 else None  # an only agent's fields are `agent.FIELD`
        names = {key: only or f"{name}.{shortened(key, 40)}" for key in sorted(value, key=str)}
        return {str(k): _read(value[k], of_key, names[k], MISSING, group) for k in names}
    if group:
        if isinstance(value, Mapping) and default is not MISSING:
            value = {**registry.DEFAULTS[group], **value}
        return configure(group, value, name)
    if isinstance(hint, type) and dataclasses.is_dataclass(hint) and not isinstance(value, hint):
        rule = f"must have fields, as {name}.{next(iter(defaults_of(hint)), 'name')}"
        require(isinstance(value, Mapping), name, rule, got=repr(value), fix="Leave it out.")
        base = to_plain(default) if isinstance(default, hint) else {}
        return from_plain(hint, base | value, name)
    reading = value
    if isinstance(value, str):
        value = with_home(value)
        reading = parsed(value)
    elif type(value) in (int, float):
        value = str(value)  # it may be a name of digits, such as a folder's
    for read in (reading, value):
        with suppress(ConfigError):
            return checked(read, hint, name, default)
    return checked(reading if isinstance(reading, list) else value, hint, name, default)


# --- nested dictionaries -------------------------------------------------------------------------


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as `{"group.field": value}`."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        nested = isinstance(value, Mapping)
        flat |= flatten(value, f"{prefix}{key}.") if nested else {f"{prefix}{key}": value}
    return flat


def merge(*layers: Mapping[str, Any]) -> dict[str, Any]:
    """Nested settings, each layer over those before it."""
    merged: dict[str, Any] = {}
    for layer in layers:
        for key, value in layer.items():
            is_nested = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
            merged[key] = merge(merged[key], value) if is_nested else value
    return merged


def differences(
    there: Mapping[str, Any], here: Mapping[str, Any], free: Collection[str] = ()
) -> str:
    """The fields in which two nested settings differ, for a message; empty if they are equal.

    Args:
      there: settings that were stored.
      here: settings that the user asks for.
      free: groups and fields of the first level that may differ.

    Example:
      >>> differences({"es": {"noise_std": 0.1}, "seed": 0}, {"es": {"noise_std": 0.2}, "seed": 0})
      'es.noise_std (0.1 there, 0.2 here)'
    """
    stored, asked = flatten(there), flatten(here)
    names = [x for x in sorted(stored | asked) if x.partition(".")[0] not in free]
    pairs = {x: (stored.get(x), asked.get(x)) for x in names}
    names = [x for x, (one, other) in pairs.items() if repr(one) != repr(other) and one != other]
    choices = {name.removesuffix(".name") for name in names if name.endswith(".name")}
    names = [x for x in names if x.endswith(".name") or x.rpartition(".")[0] not in choices]
    values = {x: [shortened(value, 60) for value in pairs[x]] for x in names[:NAMED]}
    texts = [f"{x} ({one} there, {other} here)" for x, (one, other) in values.items()]
    return ", ".join(texts) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")


# --- texts ---------------------------------------------------------------------------------------


def split(text: str) -> list[str]:
    """Splits a text at its commas outside of brackets and quotes.

    Example:
      >>> split("0.1,[1,2],'a,b'")
      ['0.1', '[1,2]', "'a,b'"]
    """
    parts, depth, quote = [""], 0, ""
    for character in text:
        if quote:
            quote = "" if character == quote else quote
        elif character in "'\"" and not parts[-1].strip():
            quote = character
        depth += (character in "[(" and not quote) - (character in "])" and not quote)
        if character == "," and depth <= 0 and not quote:
            parts.append("")
        else:
            parts[-1] += character
    return [part.strip() for part in parts] if len(parts) > 1 else parts


def with_home(text: str) -> str:
    """A text in which the user's home folder replaces a path's `~`.

    Example:
      >>> with_home("ppo:~/model.zip") == "ppo:" + os.path.expanduser("~/model.zip")
      True
    """
    return re.sub(r"(^|:|:///)~(?=/|$)", lambda match: match[1] + os.path.expanduser("~"), text)


def unquoted(text: str) -> str:
    """A text without the quotes around it."""
    is_quoted = len(text) > 1 and text[0] == text[-1] and text[0] in "'\""
    return text[1:-1] if is_quoted else text


def parsed(text: str) -> Any:
    """An override's text, read without a type: null, true, a number, a list, or the text itself.

    Example:
      >>> parsed("[1e-3,2,true,ddqn]")
      [0.001, 2, True, 'ddqn']
    """
    if text in _CONSTANTS:
        return _CONSTANTS[text]
    if text[:1] == "[" and text[-1:] == "]":
        return [parsed(part) for part in split(text[1:-1])] if text[1:-1].strip() else []
    for number in (int, float):
        with suppress(ValueError):
            return number(text)
    return unquoted(text)
