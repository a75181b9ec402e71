"""Dataclasses as plain values and back: what files, the command line and messages hold.

Values are taken as they are meant (`1` for a float, a list for a tuple) and never guessed: nothing
in them is resolved, imported or executed.
"""

import contextlib
import dataclasses
import types
import typing
from collections.abc import Collection, Mapping
from typing import Any

from sejax.errors import ConfigError, nearest, require, shortened

_WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a word"}


# Fields that had another name in files of older versions.
RENAMED = {
    "init_episodes": "warmup_episodes",
    "target_update_rate": "tau",
    "lanes": "num_parallel",
    "first_test_steps": "first_eval_steps",
}


def to_plain(config: Any) -> dict[str, Any]:
    """The fields of a dataclass as plain values: numbers, words, None, lists and dictionaries."""
    fields = [field.name for field in dataclasses.fields(config) if field.init]
    return {name: plain(getattr(config, name)) for name in fields}


def from_plain(cls: Any, values: Mapping[str, Any], where: str) -> Any:
    """Inverse of `to_plain`.

    Args:
      cls: a dataclass.
      values: by the names of its fields; those left out have their defaults.
      where: what messages call it, as `agent` in `agent.batch_size`; may be empty.

    Raises:
      ConfigError: for a field that is not there, is missing, or has a value of another type.
    """
    fields = {field.name: field for field in dataclasses.fields(cls) if field.init}
    try:
        hints = typing.get_type_hints(cls)
    except NameError as error:
        raise ConfigError(
            f"{where or cls.__name__} must have fields of known types, because values are read by "
            f"them; got {cls.__name__}, where {error}. Import it where the class is defined."
        ) from error
    given = {}
    for stored_name, value in values.items():
        name = stored_name if stored_name in fields else RENAMED.get(stored_name, stored_name)
        if name not in fields:
            known = nearest(str(name), fields)
            raise ConfigError(
                f"{_join(where, name)} must be a field of {cls.__name__}, because nothing else is "
                f"read; got {shortened(value)}. Fields there: {', '.join(known) or 'none'}."
            )
        given[name] = _convert(value, hints[name], _join(where, name), fields[name])
    for name, field in fields.items():
        has_default = field.default is not dataclasses.MISSING
        if name not in given and not has_default and field.default_factory is dataclasses.MISSING:
            raise ConfigError(
                f"{_join(where, name)} must be given, because it has no default; got none. "
                f"Set {_join(where, name)}=VALUE."
            )
    return cls(**given)


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as `{"group.field": value}`."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


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


def _join(where: str, name: str) -> str:
    return f"{where}.{shortened(name)}" if where else shortened(name)


def plain(value: Any) -> Any:
    """One value as `to_plain` has it."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return to_plain(value)
    if isinstance(value, tuple | list):
        return [plain(x) for x in value]
    if isinstance(value, Mapping):
        return {str(key): plain(x) for key, x in value.items()}
    is_array = hasattr(value, "tolist") and not isinstance(value, type)  # NumPy's and jax's
    return value.tolist() if is_array else value


def _convert(value: Any, hint: Any, name: str, field: Any) -> Any:
    """A value as its field's type, or an error that says which that is."""
    if hint is Any:
        return value
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        if type(value) in arguments:  # None too
            return value
        *others, last = (kind for kind in arguments if kind is not type(None))
        for kind in others:
            with contextlib.suppress(ConfigError):
                return _convert(value, kind, name, field)
        return _convert(value, last, name, field)
    if origin is typing.Literal:
        require(
            value in arguments,
            name,
            f"be one of {', '.join(map(str, arguments))}",
            "nothing else is known",
            value,
            f"{name}={arguments[0]}",
        )
        return value
    if origin in (tuple, list) or hint in (tuple, list):
        require(
            isinstance(value, list | tuple),
            name,
            "be a list",
            "it holds several values",
            repr(value),
            f"{name}=[...]",
        )
        kind = arguments[0] if arguments else Any
        return (origin or hint)(_convert(x, kind, name, field) for x in value)
    if isinstance(hint, type) and dataclasses.is_dataclass(hint) and not isinstance(value, hint):
        known = ", ".join(x.name for x in dataclasses.fields(hint))
        require(
            isinstance(value, Mapping),
            name,
            f"have the fields {known}",
            "it is more than one value",
            repr(value),
            f"{name}.{known.partition(',')[0]}=VALUE",
        )
        return from_plain(hint, value, name)
    if hint in _WORDS:
        return _scalar(value, hint, name, field)
    return value


def _scalar(value: Any, kind: type, name: str, field: Any) -> Any:
    fits = type(value) is kind
    if kind is float and type(value) is int and abs(value) < 2**1000:
        return float(value)
    if kind is int and type(value) is float and value.is_integer() and abs(value) < 2**53:
        return int(value)
    if kind is str and type(value) in (int, float):  # a name of digits, as of a folder
        return str(value)
    usual = "VALUE" if field.default is dataclasses.MISSING else _text(field.default)
    require(fits, name, f"be {_WORDS[kind]}", "that is its type", repr(value), f"{name}={usual}")
    return value


def _text(value: Any) -> str:
    """A value as the command line takes it."""
    return (
        {None: "null", True: "true", False: "false"}.get(value, str(value))
        if isinstance(value, bool | None)
        else str(value)
    )
