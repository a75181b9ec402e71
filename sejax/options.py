"""Options: the fields of a dataclass that say for themselves what they may be.

A configuration is a frozen dataclass that knows how to make what it configures. Each of its fields
is written once: name, type, default, and what must hold.

Example:
  >>> @dataclasses.dataclass(frozen=True, kw_only=True)
  ... class Config(Options):
  ...     group: ClassVar[str] = "agent"
  ...     batch_size: int = option(128, counts())
  >>> Config(batch_size=0)
  Traceback (most recent call last):
  sejax.errors.ConfigError: agent.batch_size must be at least 1, because there is nothing to \
learn from or with otherwise; got 0. Set agent.batch_size=128.
"""

import dataclasses
import math
from collections.abc import Callable, Collection
from typing import Any, ClassVar

from sejax import errors

ACTIVATIONS = ("tanh", "fast_tanh", "relu", "leaky_relu", "prelu")  # of `sejax.ops.networks`
MOVES = "the agent would not move"  # otherwise: why learning rates are above 0
MOST_MEMBERS = 100_000  # of a population, each with the weights of a proxy
MOST_LAYERS = 100  # layers and blocks of a network are traced one by one

Rule = Callable[[str, Any, Any], None]  # (name, value, default) -> None, or raises ConfigError


def option(
    default: Any, rule: Rule | None = None, *, traced: bool = False, varied: str | None = None
) -> Any:
    """A dataclass field.

    Args:
      default: its default; None where it may be left open, which passes any rule.
      rule: what must hold.
      traced: whether it is a number that the compiled program takes as an argument, so that a
        population may vary it without compiling anew. See `traced_options`.
      varied: how `agent_hparams=varied` draws it; see `sejax.agents.varied`.
    """
    metadata = {"rule": rule, "traced": traced, "varied": varied}
    return dataclasses.field(default=default, metadata=metadata)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """A dataclass whose fields check themselves. `group` is where the command line has them."""

    group: ClassVar[str] = ""

    def __post_init__(self) -> None:
        check(self, self.group)


def check(config: Any, group: str) -> None:
    """Checks all fields of a dataclass that have a rule; makes numbers of NumPy or jax Python's.

    Raises:
      ConfigError: for the first one that does not hold.
    """
    for field in dataclasses.fields(config):
        given = getattr(config, field.name)
        value = errors.as_python(given)
        if value is not given:
            object.__setattr__(config, field.name, value)
        name = f"{group}.{field.name}" if group else field.name
        rule = marks(type(config), field.name).get("rule")
        if rule is not None and not (value is None and field.default is None):
            rule(name, value, field.default)
        errors.require(
            not isinstance(value, float)
            or value == 0
            or not math.isfinite(value)  # a matter of the rule
            or errors.SMALLEST_FLOAT <= abs(value) <= errors.LARGEST_FLOAT,
            name,
            f"be 0 or lie between {errors.SMALLEST_FLOAT:g} and {errors.LARGEST_FLOAT:g} in size",
            "numbers are 32-bit floats",
            value,
            f"{name}={field.default}",
        )


def traced_options(config: Any) -> dict[str, Any]:
    """Values of the fields that are traced, in the order of the dataclass."""
    return {
        field.name: getattr(config, field.name)
        for field in dataclasses.fields(config)
        if marks(type(config), field.name).get("traced")
    }


def marks(cls: type, name: str) -> dict[str, Any]:
    """What `option` says of a field: its own, else that of the class which a subclass overrides.

    So that `warmup_episodes: int = 5` in a subclass changes the default alone.
    """
    found: dict[str, Any] = {}
    for base in reversed(cls.__mro__):
        field = vars(base).get("__dataclass_fields__", {}).get(name)
        found |= dict(field.metadata) if field is not None else {}
    return found


def counts(
    reason: str = "there is nothing to learn from or with otherwise",
    least: int = 1,
    most: int = errors.LARGEST,
) -> Rule:
    """A whole number from `least` to `most`."""
    return lambda name, value, default: errors.whole(
        least, name, value, reason, "null" if default is None else default, most
    )


def not_negative(reason: str = "it is a size") -> Rule:
    """A finite number from 0 on."""

    def rule(name: str, value: Any, default: Any) -> None:
        errors.at_least(0, name, value, reason, default)
        errors.require(value < float("inf"), name, "be finite", reason, value, f"{name}={default}")

    return rule


def finite(reason: str) -> Rule:
    """A finite number, of either sign."""
    return lambda name, value, default: errors.require(
        errors.is_number(value) and abs(value) < float("inf"),
        name,
        "be finite",
        reason,
        value,
        f"{name}={default}",
    )


def positive(reason: str, at_most: float = float("inf")) -> Rule:
    """A number above 0."""
    return lambda name, value, default: errors.positive(name, value, reason, default, at_most)


def fraction() -> Rule:
    """A number in [0, 1]."""
    return lambda name, value, default: errors.fraction(name, value, default)


def shrinks() -> Rule:
    """A factor in (0, 1]."""
    return lambda name, value, default: errors.require(
        errors.is_number(value) and 0 < value <= 1,
        name,
        "lie in (0, 1]",
        "it shrinks each generation",
        value,
        f"{name}={default:g}",
    )


def or_none(rule: Rule) -> Rule:
    """None, or what another rule says; for an option that may be left open, but has a default."""

    def either(name: str, value: Any, default: Any) -> None:
        if value is not None:
            rule(name, value, default)

    return either


def one_of(known: Collection[str]) -> Rule:
    """One of these names."""
    return lambda name, value, default: errors.one_of(name, value, known)
