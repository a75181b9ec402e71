"""Parts of a program, each given as it is or as a configuration that makes it."""

from collections.abc import Callable
from typing import Any, Protocol, TypeVar, cast, runtime_checkable

from sejax.options import registry, require, shortened

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


@runtime_checkable
class Makes(Protocol[T_co]):
    """A configuration that makes a part, of a task or of whatever such a part is for."""

    @property
    def make(self) -> Callable[..., T_co]: ...


@runtime_checkable
class RunConfig(Protocol):
    """What `sejax.config` returns; `parts` are the arguments of `make_bilevel`."""

    @property
    def generations(self) -> int: ...

    def parts(self) -> dict[str, Any]: ...


def make_part(group: str, cls: type[T], part: T | Makes[T], *arguments: Any) -> T:
    """The part itself.

    Args:
      group: the field that it is given as.
      cls: its class.
      part: the part, or its configuration.
      *arguments: of `Makes.make`.

    Raises:
      ConfigError: for anything else.
    """
    if not isinstance(part, cls) and isinstance(part, Makes):
        part = registry.make(group, part, *arguments)
    return require_part(group, cls, part)


def require_part(
    group: str,
    cls: type[T],
    part: object,
    fix: str = "Pass an object; sejax.config([...]) takes names.",
) -> T:
    """The part, if it is one of this class.

    Raises:
      ConfigError: for anything else.
    """
    got = shortened(repr(part))
    require(isinstance(part, cls), group, f"must be a sejax.{cls.__name__}; got {got}. {fix}")
    return cast(T, part)
