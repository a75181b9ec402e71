"""The one error that bad input raises, and the message for an unknown name."""

import difflib
from collections.abc import Iterable


class ConfigError(ValueError):
    """Input that cannot work. Commands print its message and exit with status 2."""


def unknown_name(field: str, got: str, known: Iterable[str]) -> ConfigError:
    """Error for an unknown choice; lists the known ones, nearest first, and names the override."""
    ranked = nearest(got, known)
    return ConfigError(
        f"{field} must be one of {', '.join(ranked)}; got {got!r}. "
        f"Did you mean {field}={ranked[0]}?"
    )


def nearest(got: str, known: Iterable[str]) -> list[str]:
    """The known names, the most similar first."""
    return sorted(known, key=lambda name: -difflib.SequenceMatcher(None, got, name).ratio())


def require(holds: bool, field: str, rule: str, reason: str, got: object, fix: str) -> None:
    """Raises `ConfigError` in the project's one form of message unless `holds`."""
    if not holds:
        raise ConfigError(f"{field} must {rule}, because {reason}; got {got}. Set {fix}.")
