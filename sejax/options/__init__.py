"""Options: the fields of a configuration, their checks, and the errors that bad input raises.

A configuration is a frozen dataclass that can make an object. Each of its fields is written once:
name, type with its bounds, default. Pydantic checks and converts its value. The docstring's texts
under `Attributes:` are the texts of `--help`.

Every message has one form: the field, the rule, the value, and how to fix it.

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
  ...     batch_size: Count = 128
  >>> Config(batch_size=0)
  Traceback (most recent call last):
  sejax.options.ConfigError: agent.batch_size must be at least 1; got 0. Set agent.batch_size=128.
"""

import contextlib
import dataclasses
import functools
import importlib.util
import os
import sysconfig
import textwrap
import traceback
import typing
from collections import ChainMap
from collections.abc import Collection, Iterable, Iterator, Mapping
from difflib import SequenceMatcher
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypedDict, Unpack

from pydantic import ConfigDict, Field, InstanceOf, TypeAdapter, ValidationError

LARGEST = 2**31 - 1  # steps, episodes and sizes are counted in 32 bits
MOST, LEAST = 1e30, 1e-30  # of numbers in programs, which compute in 32 bits


# --- errors --------------------------------------------------------------------------------------


class Details(TypedDict, total=False):
    """What follows a rule in a message.

    Attributes:
      got: the value, which the message shortens.
      use: a value that holds, for `Set FIELD=VALUE.`
      fix: another sentence that says how to fix it.
    """

    got: object
    use: object
    fix: str


class ConfigError(ValueError):
    """Input that cannot work. Commands print its message and exit with status 2.

    Attributes:
      field: the field or group at fault, such as `agent.batch_size`; empty if there is none.
      rule: what the field must be; without details the whole message, to its full stop.
      details: texts of `Details`.
    """

    def __init__(self, field: str, rule: str, **details: Unpack[Details]):
        super().__init__(field, rule)  # by which it is made again in another process
        self.field = field
        self.rule = rule
        self.details = {name: shortened(x) if name == "got" else x for name, x in details.items()}

    def __str__(self) -> str:
        message = f"{self.field} {self.rule}".lstrip()
        details = self.details
        if not details:
            return message
        message += f"; got {details['got']}" if "got" in details else ""
        fix = f"Set {self.field}={details['use']}." if "use" in details else details.get("fix", "")
        return f"{message}. {fix}".rstrip()


class FailedError(RuntimeError):
    """A computation that cannot go on. Commands print its message and exit with status 1."""


@contextlib.contextmanager
def errors_of(group: str, where: str) -> Iterator[None]:
    """Errors in the block say `where` in place of `group`, as `agents.ddqn` for `agent`."""
    try:
        yield
    except ConfigError as error:
        if error.field.partition(".")[0] == group:
            error.field = where + error.field.removeprefix(group)
        raise


def require(holds: object, field: str, message: str, **details: Unpack[Details]) -> None:
    """Raises `ConfigError` unless `holds`.

    Args:
      holds: what must be true.
      field: the field at fault.
      message: see `ConfigError.rule`.
      **details: `got`, the value; and `use`, a value that holds, or `fix`. See `Details`.

    Example:
      >>> require(0 % 2, "es.population_size", "must be odd", got=0, use=1)
      Traceback (most recent call last):
      sejax.options.ConfigError: es.population_size must be odd; got 0. Set es.population_size=1.
    """
    if not holds:
        raise ConfigError(field, message, **details)


def require_package(field: str, package: str, extra: str) -> None:
    """Raises `ConfigError` unless a package is installed that comes with an extra of sejax."""
    message = f"needs the package {package}. Run pip install '.[{extra}]' in sejax's folder."
    require(importlib.util.find_spec(package), field, message)


def unknown_name(field: str, got: str, known: Iterable[str]) -> ConfigError:
    """The error for an unknown choice; it lists known names, nearest first, and an override."""
    ranked = nearest(got, known)
    return ConfigError(field, f"must be one of {listed(ranked)}", got=repr(got), use=ranked[0])


def nearest(got: str, known: Iterable[str]) -> list[str]:
    """The known names, the most similar first."""
    text = got[:200].lower()  # comparing takes time that grows with the square of the length
    return sorted(known, key=lambda name: -SequenceMatcher(None, text, name.lower()).ratio())


def listed(names: Collection[str]) -> str:
    """Names with commas between, as many as fit into 120 characters."""
    text = ", ".join(names) or "none"
    return textwrap.shorten(text, 120, placeholder=" and more", break_on_hyphens=False)


def shortened(value: object, length: int = 80) -> str:
    """A value as text that leaves room for the rest of a message."""
    text = escaped(str(value))
    return text if len(text) <= length else f"{text[:length]}... ({len(text)} characters)"


def escaped(text: str) -> str:
    """A text on one line, its line breaks and control characters written out."""
    return "".join(x if x.isprintable() else repr(x)[1:-1] for x in text)


@contextlib.contextmanager
def foreign_code(field: str, rule: str) -> Iterator[None]:
    """Turns what code of others raises in the block into a `ConfigError` that tells it.

    A `ConfigError` passes as it is.

    Args:
      field: the field at fault.
      rule: what the code must do, and its name, after which the message says "raised ...".
    """
    try:
        yield
    except ConfigError:
        raise
    except Exception as error:  # of any kind
        raise ConfigError(field, f"{rule} raised {told(error)}.") from error


def told(error: BaseException) -> str:
    """An error of other code on one line: its kind, its message, its place in a user's file."""
    line = place_of(error)
    text = shortened(" ".join(str(error).split()), 120)
    classes = [cls.__name__ for cls in type(error).__mro__]
    # jax's errors for a value that is unknown while tracing; their texts describe jax's internals.
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
    with contextlib.suppress(OSError, ValueError):  # the file is outside of the current folder
        path = path.relative_to(Path.cwd())
    return f"{path}:{users[-1].lineno}: {shortened(users[-1].line, 60)}"


_LIBRARIES = (
    *(f"{sysconfig.get_path(x)}{os.sep}" for x in ("stdlib", "platstdlib", "purelib", "platlib")),
    f"{Path(__file__).parents[1]}{os.sep}",
)


# --- fields --------------------------------------------------------------------------------------


# A whole number from 1.
Count = Annotated[int, Field(ge=1, le=LARGEST)]
# A whole number from 0.
WholeNumber = Annotated[int, Field(ge=0, le=LARGEST)]
# A number of layers, which are traced one by one.
Depth = Annotated[int, Field(ge=1, le=100)]
# A number above 0.
Positive = Annotated[float, Field(ge=LEAST, le=MOST)]
# A finite number from 0.
NonNegative = Annotated[float, Field(ge=0, le=MOST)]
# A finite number, of either sign.
Finite = Annotated[float, Field(ge=-MOST, le=MOST)]
# A number in [0, 1].
Fraction = Annotated[float, Field(ge=0, le=1)]
# A factor in (0, 1] by which something shrinks each generation.
Decay = Annotated[float, Field(ge=LEAST, le=1)]
# A name of `sejax.ops.networks`.
Activation = Literal["tanh", "fast_tanh", "relu", "leaky_relu", "prelu"]


def option(default: Any, *, traced: bool = False, varied: str | None = None) -> Any:
    """A dataclass field with marks.

    Args:
      default: its default.
      traced: whether it may be traced: a number that a compiled program can take as an argument, as
        with `agent_hparams=varied`. Otherwise, and by default, it is a constant of the program.
      varied: how `agent_hparams=varied` draws it: `triple`, from a third of it to three times;
        `one_more_or_less`; or `tenth_to_one`, from 0.1 to 1. None for never.
    """
    return dataclasses.field(default=default, metadata={"traced": traced, "varied": varied})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """A dataclass whose fields are checked by their types, such as `Count`.

    `group` is the first part of the fields' names on the command line.
    """

    group: ClassVar[str] = ""

    def __post_init__(self) -> None:
        """Checks and converts all fields.

        Numbers of NumPy and jax become Python's, so that equal configurations give one program.

        Raises:
          ConfigError: for the first value that does not fit its field's type.
        """
        hints = hints_of(type(self), self.group)
        for field in dataclasses.fields(self):
            name = f"{self.group}.{field.name}".lstrip(".")
            value = checked(getattr(self, field.name), hints[field.name], name, field.default)
            object.__setattr__(self, field.name, value)


def hints_of(cls: type, where: str) -> dict[str, Any]:
    """The types of a dataclass's fields, with their bounds.

    Raises:
      ConfigError: for a type that is not known where the class is defined.
    """
    try:
        return typing.get_type_hints(cls, include_extras=True)
    except NameError as error:
        raise ConfigError(where, f"must have fields of known types: {error}.") from error


def checked(value: Any, hint: Any, name: str, default: Any) -> Any:
    """A value that pydantic has converted to its field's type.

    Args:
      value: any value.
      hint: the type.
      name: the field's name, for messages.
      default: the field's default; if it is None, None fits.

    Raises:
      ConfigError: if it does not fit.
    """
    got = as_python(value)
    if got is None and default is None:
        return None
    try:
        converted = _adapter(hint).validate_python(got)
    except ValidationError as error:
        problem = error.errors()[0]
        if typing.get_origin(hint) is Literal:
            raise unknown_name(name, str(got), typing.get_args(hint)) from None
        if isinstance(got, Mapping):
            raise ConfigError(name, "must have no fields", got=got, fix="Leave them out.") from None
        if problem["type"] == "dict_type":
            use = f"{name}.KEY=VALUE"
            raise ConfigError(name, "must be values by key", got=got, fix=f"Set {use}.") from None
        if problem["type"] == "tuple_type" and not str(got).startswith("["):
            use = f"[{shortened(got, 20)}]"
            raise ConfigError(name, "must be a list in brackets", got=repr(got), use=use) from None
        rule = problem["msg"].partition(", unable")[0]
        is_rule = rule.startswith("Input should")
        rule = rule.replace("Input should", "must") if is_rule else f"must fit its type: {rule}"
        for bound, words in (("ge", "at least"), ("le", "at most")):
            if bound in problem.get("ctx", {}):
                rule = f"must be {words} {problem['ctx'][bound]}"
    else:
        if isinstance(got, bool) == isinstance(converted, bool):  # bools are numbers in Python
            return converted
        rule = f"must be {'' if isinstance(converted, bool) else 'no '}true or false"
    is_open = default is dataclasses.MISSING or dataclasses.is_dataclass(default)
    use = "VALUE" if is_open else as_text(default)
    raise ConfigError(name, rule, got=repr(got), use=use)


@functools.cache
def _adapter(hint: Any) -> TypeAdapter[Any]:
    if dataclasses.is_dataclass(hint):  # which pydantic would make of a dictionary
        return TypeAdapter(InstanceOf[hint])
    return TypeAdapter(hint, config=ConfigDict(arbitrary_types_allowed=True))


def require_known(field: str, value: object, known: Collection[str]) -> None:
    """Raises `ConfigError` unless the value is one of these names."""
    if value not in known:
        raise unknown_name(field, str(value), known)


def marks(cls: type, name: str) -> dict[str, Any]:
    """The metadata of a field; a subclass that gives a default without `option` inherits them."""
    fields = (vars(base).get("__dataclass_fields__", {}).get(name) for base in cls.__mro__)
    return dict(ChainMap(*(dict(field.metadata) for field in fields if field is not None)))


def as_python(value: Any) -> Any:
    """A number or bool of NumPy or jax as Python's, a path as text; others stay as they are."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    try:
        return value.item() if getattr(value, "shape", None) == () else value
    except (AttributeError, TypeError, NotImplementedError):  # a traced array, a shape, or a key
        return value


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
    quote = '"' if "'" in text else "'"
    return f"{quote}{text}{quote}" if any(character in text for character in ",[]'\" ") else text
