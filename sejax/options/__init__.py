"""Options: the fields of a configuration, their checks, and the errors that bad input raises.

A configuration is a frozen dataclass that can make what it configures. Each of its fields is
written once: name, type, default, and the rule that a value must obey. What the docstring says of
a field under `Attributes:` is the text of `--help`.

Every message has one form: the field, what must hold, why, what came, and how to fix it.

Example:
  >>> @dataclasses.dataclass(frozen=True, kw_only=True)
  ... class Config(Options):
  ...     '''An agent.
  ...
  ...     Attributes:
  ...       batch_size: transitions of an update.
  ...     '''
  ...
  ...     group: ClassVar[str] = "agent"
  ...     batch_size: int = option(128, counts())
  >>> Config(batch_size=0)
  Traceback (most recent call last):
  sejax.options.ConfigError: agent.batch_size must be a whole number from 1 to 2147483647, because \
there is nothing to learn from or with otherwise; got 0. Set agent.batch_size=128.
"""

import contextlib
import dataclasses
import functools
import inspect
import os
import re
import sysconfig
import textwrap
import traceback
import types
import typing
from collections import ChainMap
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from difflib import SequenceMatcher
from pathlib import Path
from typing import Any, ClassVar, TypeGuard, TypeVar

ACTIVATIONS = ("tanh", "fast_tanh", "relu", "leaky_relu", "prelu")  # of `sejax.ops.networks`
MOVES = "the agent would not move"  # otherwise: why learning rates are above 0
NOTHING = "there is nothing to learn from or with otherwise"
MOST_MEMBERS = 100_000  # of a population, each with the weights of a proxy
MOST_LAYERS = 100  # layers and blocks of a network are traced one by one
LARGEST = 2**31 - 1  # steps, episodes and sizes are counted in 32 bits
MOST, LEAST = 1e30, 1e-30  # of numbers that programs compute with in 32 bits

T = TypeVar("T")
Rule = Callable[[str, T, T | None], None]  # (name, value, default) -> None, or raises ConfigError


# --- errors --------------------------------------------------------------------------------------


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


@contextlib.contextmanager
def errors_of(group: str, where: str) -> Iterator[None]:
    """Errors about a group in here name the place where it stands, as `agents.ddqn` for `agent`."""
    try:
        yield
    except ConfigError as error:
        if group in ("", where):
            raise
        message = re.sub(rf"\b{group}(?=\.\w| must )", where, str(error))
        raise ConfigError(message, re.sub(rf"^{group}\b", where, error.field)) from None


def require(holds: object, field: str, message: str) -> None:
    """Raises `ConfigError` unless `holds`.

    Args:
      holds: what must be so.
      field: the field at fault.
      message: follows the field: what must hold, `; got` what came, and how to fix it.
    """
    if not holds:
        raise ConfigError(f"{field} {message}", field)


def unknown_name(field: str, got: str, known: Iterable[str]) -> ConfigError:
    """Error for an unknown choice; lists known ones, nearest first, and names the override."""
    ranked = nearest(got, known)
    message = f"{field} must be one of {listed(ranked)}; got {shortened(got)!r}."
    return ConfigError(f"{message} Did you mean {field}={ranked[0]}?", field)


def nearest(got: str, known: Iterable[str]) -> list[str]:
    """The known names, the most similar first."""
    text = got[:200].lower()  # comparing takes time that grows with the square of the length
    return sorted(known, key=lambda name: -SequenceMatcher(None, text, name.lower()).ratio())


def listed(names: Collection[str], most: int = 120) -> str:
    """Names with commas between, as many as fit into `most` characters."""
    text, more = ", ".join(names) or "none", " and more"
    return textwrap.shorten(text, most, placeholder=more, break_on_hyphens=False)


def shortened(value: object, length: int = 80) -> str:
    """A value as text that leaves room for the rest of a message."""
    text = str(value).replace("\n", "\\n")
    return text if len(text) <= length else f"{text[:length]}... ({len(text)} characters)"


def told(error: BaseException) -> str:
    """An error of other code on one line: its kind, its message, its place in a user's file."""
    line, text = place_of(error), shortened(" ".join(str(error).split()), 120)
    classes = [cls.__name__ for cls in type(error).__mro__]
    # jax's errors of a value that is not known while tracing; their texts tell of jax's inside.
    if any(name.startswith(("ConcretizationType", "NonConcrete", "Tracer")) for name in classes):
        text = "Python code needs the value of a traced array; use jnp.where, or jax.numpy"
    return f"{classes[0]}: {text}{f' ({line})' if line else ''}"


def place_of(error: BaseException) -> str:
    """File, line and source of the innermost frame in a user's own file; empty without one.

    Python's library, installed packages and sejax are not the user's own.
    """
    frames = traceback.extract_tb(error.__traceback__)
    users = [frame for frame in frames if not frame.filename.startswith(("<", *_LIBRARIES))]
    if not users:
        return ""
    path = Path(users[-1].filename)
    with contextlib.suppress(OSError, ValueError):  # it is elsewhere
        path = path.relative_to(Path.cwd())
    return f"{path}:{users[-1].lineno}: {shortened(users[-1].line, 60)}"


_LIBRARIES = (
    *(f"{sysconfig.get_path(x)}{os.sep}" for x in ("stdlib", "platstdlib", "purelib", "platlib")),
    f"{Path(__file__).parents[1]}{os.sep}",
)


# --- fields --------------------------------------------------------------------------------------


def option(
    default: Any = dataclasses.MISSING,
    rule: Rule[T] | None = None,
    *,
    traced: bool = False,
    varied: str | None = None,
    names_code: bool = False,
) -> Any:
    """A dataclass field.

    Args:
      default: its default; without one it must be given.
      rule: what must hold; None passes it where that is the default or `... | None` the type.
      traced: whether it is a number that the compiled program takes as an argument, so that a
        population may vary it without compiling anew. See `traced_options`.
      varied: how `agent_hparams=varied` draws it; see `sejax.agents.varied`.
      names_code: whether its text may be a `module:attribute`, which no file may name.
    """
    metadata = {"rule": rule, "traced": traced, "varied": varied, "names_code": names_code}
    return dataclasses.field(default=default, metadata=metadata)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """A dataclass whose fields check themselves.

    `group` is where the command line has them.
    """

    group: ClassVar[str] = ""

    def __post_init__(self) -> None:
        """Checks all fields that have a rule.

        Numbers of NumPy and jax become Python's, and whole numbers floats where the default is one,
        so that equal configurations are the same program.

        Raises:
          ConfigError: for the first one that does not hold.
        """
        for field in dataclasses.fields(self):
            value = as_python(getattr(self, field.name))
            if type(field.default) is float and type(value) is int and abs(value) < LARGEST:
                value = float(value)
            object.__setattr__(self, field.name, value)
            rule = marks(type(self), field.name).get("rule")
            may_be_none = field.default is None or types.NoneType in typing.get_args(field.type)
            if rule is not None and not (value is None and may_be_none):
                rule(f"{self.group}.{field.name}".lstrip("."), value, field.default)


def traced_options(config: Options) -> dict[str, Any]:
    """Values of the fields that are traced, in the order of the dataclass."""
    names = [field.name for field in dataclasses.fields(config)]
    return {x: getattr(config, x) for x in names if marks(type(config), x).get("traced")}


def marks(cls: type, name: str) -> dict[str, Any]:
    """The metadata of a field: its own, else that of the class which a subclass overrides.

    So that `warmup_episodes: int = 5` in a subclass changes the default alone.
    """
    fields = (vars(base).get("__dataclass_fields__", {}).get(name) for base in cls.__mro__)
    return dict(ChainMap(*(dict(field.metadata) for field in fields if field is not None)))


def field_lines(
    values: Mapping[str, Any], classes: Iterable[tuple[str, type]], sources: Mapping[str, str]
) -> str:
    """Lines of `--help`: each field with its value, its text, and where its value comes from.

    Args:
      values: plain values by the fields' names.
      classes: groups of fields, each with a class whose docstring has their texts.
      sources: what stands behind a field's text, such as the layer that its value is from.
    """
    of_groups = ((group, help_texts(cls).items()) for group, cls in classes)
    texts = {f"{group}.{name}".lstrip("."): x for group, of_cls in of_groups for name, x in of_cls}
    lines = []
    for name, value in values.items():
        about = f"  # {texts[name]}" if name in texts else ""
        line = f"  {name}={as_text(value)}{about}{sources.get(name, '')}"
        lines.append(textwrap.fill(line, 98, subsequent_indent=" " * 6, break_long_words=False))
    return "\n".join(lines)


def help_texts(cls: type) -> dict[str, str]:
    """What the docstrings of a class and its bases say of its attributes, by their names."""
    texts: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        rest = inspect.cleandoc(base.__doc__ or "").partition("Attributes:\n")[2]
        section = re.split(r"\n\n(?=\S)", rest)[0]
        entries = re.findall(r"^  (\w+): (.*(?:\n    .*)*)", section, re.MULTILINE)
        texts |= {name: " ".join(text.split()) for name, text in entries}
    return texts


def is_number(value: object) -> TypeGuard[float]:
    """Whether it is an int or a float, which a bool is not here; see `as_python`."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def as_python(value: Any) -> Any:
    """A number or bool of NumPy or jax as Python's; all else, traced ones too, as it is."""
    if getattr(value, "shape", None) != () or not hasattr(value, "item"):
        return value
    try:
        return value.item()
    except (TypeError, NotImplementedError):  # a traced one has no value yet, a key has none
        return value


# --- rules ---------------------------------------------------------------------------------------


def as_text(value: object) -> str:
    """A value as the command line takes it.

    Example:
      >>> as_text([None, True, 0.5, "ddqn", "a b, c"])
      "[null,true,0.5,ddqn,'a b, c']"
    """
    if isinstance(value, list | tuple):
        return f"[{','.join(map(as_text, value))}]"
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    text = str(value)
    return f"'{text}'" if any(character in text for character in ",[]'\" ") else text


def between(
    low: float, high: float, reason: str, must: str = "", is_whole: bool = False
) -> Rule[float]:
    """A number from `low` to `high`, and a whole one with `is_whole`."""
    must = must or f"lie between {low:g} and {high:g}"

    def apply(name: str, value: float, default: float | None) -> None:
        is_within = is_number(value) and low <= value <= high
        if not is_within or (is_whole and value != value // 1):
            got, fix = shortened(value), f"{name}={as_text(default)}"
            raise ConfigError(f"{name} must {must}, because {reason}; got {got}. Set {fix}.", name)

    return apply


def counts(reason: str = NOTHING, least: int = 1, most: int = LARGEST) -> Rule[float]:
    """A whole number from `least` to `most`."""
    return between(least, most, reason, f"be a whole number from {least} to {most}", is_whole=True)


def not_negative(reason: str = "it is a size") -> Rule[float]:
    """A finite number from 0 on."""
    return between(0, MOST, reason)


def positive(reason: str, at_most: float = MOST) -> Rule[float]:
    """A finite number above 0 with which programs can compute in 32 bits."""
    return between(LEAST, at_most, reason)


#: `finite(reason)` is a finite number, of either sign.
finite = functools.partial(between, -MOST, MOST)
#: `fraction()` is a number in [0, 1].
fraction = functools.partial(between, 0, 1, "it is a fraction")
#: `shrinks()` is a factor in (0, 1].
shrinks = functools.partial(between, LEAST, 1, "it shrinks each generation", "lie in (0, 1]")
#: `seed()` is a seed that `jax.random.key` takes as it is.
seed = functools.partial(between, 0, LARGEST, "it is a 32-bit number", "lie in [0, 2**31)")


def one_of(known: Collection[str]) -> Rule[str]:
    """One of these names."""

    def apply(name: str, value: str, default: str | None) -> None:
        if value not in known:
            raise unknown_name(name, str(value), known)

    return apply


def each_of(known: Collection[str]) -> Rule[Iterable[str]]:
    """A list of these names."""

    def apply(name: str, values: Iterable[str], default: Iterable[str] | None) -> None:
        for value in values:
            one_of(known)(name, value, None)

    return apply
