"""Words of a command line: values as words, and the words that a preset file stands for."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, QuotedString
from hydra.errors import HydraException

from sejax import registry
from sejax.cli import presets
from sejax.errors import ConfigError, require, shortened
from sejax.serialize import flatten

ENDING = ".yaml"  # of a preset that is a file
# Fields whose value may be a module's: those of choices.
IMPORTING = {*registry.GROUPS, "agents", "name", "proxy_kind"}
FIELD = re.compile(r"(?!hydra\b)[A-Za-z_][\w.-]*")  # Hydra's own are no settings


def word(value: Any) -> str:
    """A value as Hydra's grammar reads it: text in quotes where it is more than a word."""
    if isinstance(value, list):
        return f"[{','.join(map(word, value))}]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if not isinstance(value, str) or re.fullmatch(r"[\w./+-]+", value, re.ASCII):
        return str(value)
    escaped = value.replace("'", "\\'")
    return f"'{escaped}'"


def without_files(words: Sequence[str]) -> list[str]:
    """Words with those that a file stands for in the place of `preset=FILE.yaml`.

    A file maps choices and fields to values, by their full names or nested; `preset: paper` among
    them names what it builds on. A word beside it goes over the file's of the same name.

    Raises:
      ConfigError: for a file that cannot be read, holds something else, or names a module.
    """
    files = {text: path for text in words if (path := _file_of(text)) is not None}
    given = {_name(text) for text in words if text not in files}
    return [
        each
        for text in words
        for each in (_words_of(files[text], given) if text in files else [text])
    ]


def file_text(words: Iterable[str]) -> str:
    """The preset file that stands for words.

    Example:
      >>> print(file_text(["env=acrobot", "es.noise_std=0.1"]), end="")
      env: acrobot
      es.noise_std: 0.1
    """
    return str(yaml.safe_dump({_name(text): _value(text) for text in words}, sort_keys=False))


def _name(text: str) -> str:
    return text.partition("=")[0].lstrip("+")


def _value(text: str) -> Any:
    """What a word sets, as plain values; a `Sweep` if it is one."""
    return _plain(OverridesParser.create().parse_override(text).value())


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(x) for x in value]
    return value.text if isinstance(value, QuotedString) else value


def _file_of(text: str) -> Path | None:
    """The file that a word takes as a preset; None if it takes none."""
    if not text.startswith("preset=") or ENDING not in text:
        return None
    try:
        value = _value(text)
    except HydraException:
        return None  # Hydra will say what it cannot read
    require(
        not isinstance(value, ChoiceSweep),
        "preset",
        "be one, if it is a file",
        "its words are read before those of a sweep",
        text.partition("=")[2],
        "preset=FILE.yaml",
    )
    return Path(value) if isinstance(value, str) and value.endswith(ENDING) else None


def _words_of(path: Path, given: set[str]) -> list[str]:
    """The words that a file stands for, but for those of these names."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"preset must be one of {', '.join(presets.names())}, or a YAML file; got {path} "
            f"({shortened(' '.join(str(error).split()))}). Set preset=best."
        ) from error
    require(
        content and isinstance(content, dict),
        "preset",
        "be a file that maps fields to values",
        "they are set",
        f"{path} with {shortened(content)}",
        "preset=best, or write `es.noise_std: 0.1` there",
    )
    values = flatten(content)
    odd = [name for name in values if not FIELD.fullmatch(name)]
    require(
        not odd,
        "preset",
        "be a file of choices and fields",
        "nothing else is a setting",
        f"{', '.join(odd)} in {path}",
        "preset=best, or remove them there",
    )
    base = str(values.get("preset", ""))
    require(
        not base.endswith(ENDING),
        "preset",
        "be the name of one within a file",
        "files do not build on others",
        f"{base} in {path}",
        "`preset: best` there",
    )
    found = [f"{name}={word(value)}" for name, value in values.items() if name not in given]
    foreign = [
        text
        for text in found
        if _name(text).rpartition(".")[2] in IMPORTING and registry.paths_in([text])
    ]
    require(
        not foreign,
        "preset",
        "name no module",
        "only what you type is imported",
        f"{', '.join(foreign)} in {path}",
        "these words on the command line too, if you trust the module",
    )
    return found
