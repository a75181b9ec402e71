"""Plain values and dataclasses: what files and overrides hold, read by the types of the fields.

A configuration is written as plain values (`to_plain`): numbers, texts, None, lists, dictionaries.
It is read back (`from_plain`) by the types of its fields: `1` for a float, a list for a tuple, the
text of an override for a number. Nothing is guessed, resolved, imported or executed.
"""

import dataclasses
import os
import re
import types
import typing
from collections.abc import Collection, Mapping
from contextlib import suppress
from typing import Any

from sejax.options import (
    ConfigError,
    as_text,
    listed,
    nearest,
    require,
    shortened,
    told,
    unknown_name,
)

T = typing.TypeVar("T")

MISSING = dataclasses.MISSING
_CONSTANTS = {"null": None, "true": True, "True": True, "false": False, "False": False}
_KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
_NO = object()  # what a value of another type is converted to


# --- dataclasses ---------------------------------------------------------------------------------


def to_plain(value: object) -> Any:
    """A value as plain values; a dataclass as a dictionary of its fields."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in dataclasses.fields(value) if field.init]
        return {name: to_plain(getattr(value, name)) for name in names}
    if isinstance(value, tuple | list):
        return [to_plain(x) for x in value]
    if isinstance(value, Mapping):
        return {str(key): to_plain(x) for key, x in value.items()}
    if hasattr(value, "tolist") and not isinstance(value, type):  # arrays of NumPy and jax
        return value.tolist()
    return value


def from_plain(cls: type[T], values: Mapping[str, Any], where: str) -> T:
    """Inverse of `to_plain`.

    Args:
      cls: a dataclass.
      values: by the names of its fields; those left out have their defaults.
      where: what messages call it, as `agent` in `agent.batch_size`; may be empty.

    Raises:
      ConfigError: for a field that is not there, is missing, or has a value of another type.
    """
    fields = fields_of(cls)
    try:
        hints = typing.get_type_hints(cls)
    except NameError as error:
        raise ConfigError(
            f"{where} must have fields of known types; {cls.__name__} raised {told(error)}. Import "
            "that type where the class is defined.",
            where,
        ) from error
    full = {name: f"{where}.{name}".lstrip(".") for name in fields}
    read = {}
    for name, value in values.items():
        if name not in fields:
            raise unknown_field(f"{where}.{shortened(name)}".lstrip("."), full.values())
        read[name] = _read(value, hints[name], full[name], fields[name])
    for name in fields.keys() - read.keys():
        is_open = fields[name] is not MISSING
        require(is_open, full[name], f"must be given; it has no default. Set {full[name]}=VALUE.")
    return cls(**read)


def fields_of(cls: type) -> dict[str, Any]:
    """The defaults of a dataclass's fields by their names; `MISSING` for a field without one."""
    return {
        field.name: field.default if field.default_factory is MISSING else field.default_factory()
        for field in dataclasses.fields(cls)  # type: ignore[arg-type]
        if field.init
    }


def unknown_field(field: str, known: Collection[str]) -> ConfigError:
    """Error for a field that is not there, with the nearest of those that are."""
    field, last = shortened(field, 40), field.rpartition(".")[2]
    ranked = [name for name in known if name.rpartition(".")[2] == last] or nearest(field, known)
    fix = f" Did you mean {ranked[0]}?" if ranked else ""
    return ConfigError(f"{field} is no field.{fix} Fields: {listed(ranked)}.", field)


def _read(value: Any, hint: Any, name: str, default: Any) -> Any:
    """A value as its field's type, or an error that says which that is."""
    kinds = typing.get_args(hint) if is_union(hint) else (hint,)
    if types.NoneType in kinds and (value is None or value == "null"):
        return None
    *others, last = (kind for kind in kinds if kind is not types.NoneType)
    if type(value) in (*others, last) and not isinstance(value, str):
        return value
    for kind in others:
        with suppress(ConfigError):
            return _as(kind, value, name, default)
    return _as(last, value, name, default)


def _as(kind: Any, value: Any, name: str, default: Any) -> Any:
    """A value as one type."""
    origin, arguments = typing.get_origin(kind) or kind, typing.get_args(kind)
    is_open = default is MISSING or dataclasses.is_dataclass(default)
    fix = "VALUE" if is_open else as_text(to_plain(default))

    def needs(holds: bool, must: str) -> None:
        require(holds, name, f"must {must}; got {shortened(repr(value))}. Set {name}={fix}.")

    if kind is Any:
        return parsed(value) if isinstance(value, str) else value
    if origin is typing.Literal:
        read = parsed(value) if isinstance(value, str) and value not in arguments else value
        if read not in arguments:
            raise unknown_name(name, value, map(str, arguments))
        return read
    if origin in (tuple, list):
        items = parsed(value) if isinstance(value, str) else value
        needs(isinstance(items, list | tuple), "be a list")
        if isinstance(value, str):  # each is read by its own type
            items = split(value[1:-1]) if items else []
        if origin is tuple and arguments and arguments[-1] is not Ellipsis:
            needs(len(items) == len(arguments), f"have {len(arguments)} values")
        else:
            arguments = (*arguments, Any)[:1] * len(items)
        each = zip(items, arguments, strict=True)
        return origin(_read(item, argument, name, default) for item, argument in each)
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        if isinstance(value, kind):
            return value
        needs(isinstance(value, Mapping), f"have fields, as {name}.{next(iter(fields_of(kind)))}")
        return from_plain(kind, value, name)
    if kind not in _KINDS:
        return value
    if isinstance(value, Mapping) and value:
        own = f"{name}.{next(iter(value))}"
        require(False, name, f"must be {_KINDS[kind]}, without fields; got {own}. Leave {own} out.")
    scalar = _scalar(value, kind)
    needs(scalar is not _NO, f"be {_KINDS[kind]}")
    return scalar


def _scalar(value: Any, kind: type) -> Any:
    """A value as a bool, int, float or str; `_NO` if it is none."""
    if kind is str:
        is_name = type(value) in (int, float)  # a name of digits, as of a folder
        return expanded(value) if isinstance(value, str) else str(value) if is_name else _NO
    if isinstance(value, str):
        value = parsed(value)
    if kind is float and type(value) is int and abs(value) < 2**1000:
        return float(value)
    if kind is int and type(value) is float and value.is_integer() and abs(value) < 2**53:
        return int(value)
    return value if type(value) is kind else _NO


def is_union(hint: object) -> bool:
    """Whether a type is one of several, such as `int | None`."""
    return typing.get_origin(hint) in (types.UnionType, typing.Union)


# --- nested dictionaries -------------------------------------------------------------------------


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as `{"group.field": value}`."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        nested = isinstance(value, Mapping)
        flat |= flatten(value, f"{prefix}{key}.") if nested else {f"{prefix}{key}": value}
    return flat


def merge(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Nested settings with changes over them."""
    merged = dict(base)
    for key, value in changes.items():
        nested = isinstance(value, Mapping) and isinstance(base.get(key), Mapping)
        merged[key] = merge(base[key], value) if nested else value
    return merged


def differences(
    there: Mapping[str, Any], here: Mapping[str, Any], free: Collection[str] = (), most: int = 10
) -> str:
    """The fields in which two nested settings differ, for a message; empty if in none.

    Args:
      there: settings that were stored.
      here: those that are asked for.
      free: groups and fields of the first level that may differ.
      most: fields that are named.

    Example:
      >>> differences({"es": {"noise_std": 0.1}, "seed": 0}, {"es": {"noise_std": 0.2}, "seed": 0})
      'es.noise_std (0.1 there, 0.2 here)'
    """
    old, asked = flatten(there), flatten(here)
    differing = [
        f"{name} ({shortened(old.get(name), 60)} there, {shortened(asked.get(name), 60)} here)"
        for name in sorted(old.keys() | asked.keys())
        if name.partition(".")[0] not in free
        # In the second way nan is nan.
        and old.get(name) != asked.get(name)
        and repr(old.get(name)) != repr(asked.get(name))
    ]
    more = f" and {len(differing) - most} more" if len(differing) > most else ""
    return ", ".join(differing[:most]) + more


# --- texts ---------------------------------------------------------------------------------------


def split(text: str) -> list[str]:
    """The parts of a text between commas that are outside of brackets and quotes.

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


def expanded(text: str) -> str:
    """A text with the user's home folder in the place of a path's `~`.

    Example:
      >>> expanded("ppo:~/model.zip") == "ppo:" + os.path.expanduser("~/model.zip")
      True
    """
    return re.sub(r"(^|:|:///)~(?=/|$)", lambda found: found[1] + os.path.expanduser("~"), text)


def unquoted(text: str) -> str:
    """A text without the quotes around it."""
    is_quoted = len(text) > 1 and text[0] == text[-1] and text[0] in "'\""
    return text[1:-1] if is_quoted else text


def parsed(text: str) -> Any:
    """What the text of an override says by itself: null, true, a number, a list, or the text.

    Example:
      >>> parsed("[1e-3,2,true,ddqn]")
      [0.001, 2, True, 'ddqn']
    """
    if text in _CONSTANTS:
        return _CONSTANTS[text]
    if text[:1] == "[" and text[-1:] == "]":
        return [parsed(part) for part in split(text[1:-1])] if text[1:-1].strip() else []
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return unquoted(text)
