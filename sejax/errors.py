"""The error that bad input raises, the checks that raise it, and that of failed computing.

Every message has one form: what must hold, why, what came, and how to mend it.
"""

import difflib
import math
import numbers
from collections.abc import Collection, Iterable
from typing import Any

SMALLEST_FLOAT, LARGEST_FLOAT = 1e-30, 1e30  # far within those of 32 bits
LARGEST = 2**31 - 1  # steps, episodes and sizes are counted in 32 bits


class ConfigError(ValueError):
    """Input that cannot work. Commands print its message and exit with status 2.

    Attributes:
      field: the field or group at fault, such as `agent.batch_size`; empty where it is none.
    """

    def __init__(self, message: str, field: str = ""):
        super().__init__(message)
        self.field = field


class FailedError(RuntimeError):
    """Computing that cannot go on. Commands print its message and exit with status 1."""


def unknown_name(field: str, got: object, known: Iterable[str]) -> ConfigError:
    """Error for an unknown choice; lists the known ones, nearest first, and names the override."""
    ranked = nearest(got, known)
    return ConfigError(
        f"{field} must be one of {', '.join(ranked)}; got {shortened(got)!r}. "
        f"Did you mean {field}={ranked[0]}?",
        field,
    )


def nearest(got: object, known: Iterable[str]) -> list[str]:
    """The known names, the most similar first."""
    start = str(got)[:200]  # comparing takes time that grows with the square of the length
    return sorted(known, key=lambda name: -difflib.SequenceMatcher(None, start, name).ratio())


def shortened(value: object, length: int = 200) -> str:
    """A value as text that leaves room for the rest of a message."""
    text = str(value)
    return text if len(text) <= length else f"{text[:length]}... ({len(text)} characters)"


def told(error: BaseException) -> str:
    """Kind and message of somebody else's error, on one line."""
    return f"{type(error).__name__}: {shortened(' '.join(str(error).split()))}"


def require(holds: Any, field: str, rule: str, reason: str, got: object, fix: str) -> None:
    """Raises `ConfigError` in the project's one form of message unless `holds`."""
    if not holds:
        raise ConfigError(
            f"{field} must {rule}, because {reason}; got {shortened(got)}. Set {fix}.", field
        )


def at_least(minimum: float, name: str, value: Any, reason: str, fix: Any) -> None:
    """Checks a number that has a least value.

    Raises:
      ConfigError: if it is below, or no number.
    """
    require(
        is_number(value) and value >= minimum,
        name,
        f"be at least {minimum}",
        reason,
        value,
        f"{name}={fix}",
    )


def whole(minimum: int, name: str, value: Any, reason: str, fix: Any, most: int = LARGEST) -> None:
    """Checks a count: at least `minimum`, and at most what can be counted or built.

    Raises:
      ConfigError: if it is less, more, or no whole number.
    """
    at_least(minimum, name, value, reason, fix)
    require(value == value // 1, name, "be a whole number", reason, value, f"{name}={fix}")
    limit = "it is counted in 32 bits" if most == LARGEST else "each is built by itself"
    require(value <= most, name, f"be at most {most}", limit, value, f"{name}={fix}")


def positive(name: str, value: Any, reason: str, fix: Any, at_most: float = math.inf) -> None:
    """Checks a finite number above 0.

    Raises:
      ConfigError: if it is none, or above `at_most`.
    """
    require(
        is_number(value) and 0 < value < math.inf,
        name,
        "be above 0 and finite",
        reason,
        value,
        f"{name}={fix}",
    )
    require(
        value <= at_most,
        name,
        f"be at most {at_most:g}",
        "the numbers that come of it would not be finite",
        value,
        f"{name}={fix}",
    )


def fraction(name: str, value: Any, fix: Any) -> None:
    """Checks a number in [0, 1].

    Raises:
      ConfigError: if it is none.
    """
    require(
        is_number(value) and 0 <= value <= 1,
        name,
        "lie in [0, 1]",
        "it is a fraction",
        value,
        f"{name}={fix}",
    )


def one_of(name: str, value: str, known: Collection[str]) -> None:
    """Checks a choice.

    Raises:
      ConfigError: if it is none of the known ones.
    """
    if value not in known:
        raise unknown_name(name, value, known)


def each_of(name: str, values: Iterable[str], known: Collection[str]) -> None:
    """As `one_of`, for several."""
    for value in values:
        one_of(name, value, known)


def require_seed(name: str, seed: Any) -> None:
    """Checks that a seed is one that `jax.random.key` takes as it is.

    Raises:
      ConfigError: if it is not.
    """
    require(
        is_number(seed) and 0 <= seed < 2**31,
        name,
        "lie in [0, 2**31)",
        "it is a 32-bit number",
        seed,
        f"{name}=0",
    )


def is_number(value: Any) -> bool:
    """Whether it is an int or a float, which a bool is not here; see `as_python`."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def as_python(value: Any) -> Any:
    """A number or bool of NumPy or jax as Python's; all else, traced ones too, as it is."""
    is_one = getattr(value, "shape", None) == () and hasattr(value, "item")
    if not is_one or isinstance(value, type):
        return value
    try:
        number = value.item()
    except (TypeError, NotImplementedError):  # a traced one has no value yet, a key has none
        return value
    return (
        float(number)
        if isinstance(number, numbers.Real) and not isinstance(number, bool | int | float)
        else number
    )
