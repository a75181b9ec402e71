"""Checks that several configurations share; each raises one clear `ConfigError`."""

import math
from collections.abc import Collection, Iterable
from typing import Any

from sejax.errors import require, unknown_name


def at_least(minimum: float, name: str, value: Any, reason: str, fix: Any) -> None:
    require(value >= minimum, name, f"be at least {minimum}", reason, value, f"{name}={fix}")


def positive(name: str, value: float, reason: str, fix: Any) -> None:
    require(value > 0 and math.isfinite(value), name, "be above 0 and finite", reason, value,
            f"{name}={fix}")  # fmt: skip


def fraction(name: str, value: float, fix: Any) -> None:
    require(0 <= value <= 1, name, "lie in [0, 1]", "it is a fraction", value, f"{name}={fix}")


def one_of(name: str, value: str, known: Collection[str]) -> None:
    if value not in known:
        raise unknown_name(name, value, known)


def each_of(name: str, values: Iterable[str], known: Collection[str]) -> None:
    for value in values:
        one_of(name, value, known)


def default(schema: type, name: str) -> Any:
    return schema.__dataclass_fields__[name].default
