"""What a proxy's file holds: tensors of NumPy, and a header of plain values.

A file is in the safetensors format, with a checksum. It holds one proxy, or a set of proxies that
share a configuration. The tensors of a set have a leading axis over its proxies. Reading a file
executes, resolves and imports nothing that the file names. `sejax.proxies.io` makes environments
for JAX from it, and `sejax.gym` makes environments for Gymnasium.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sejax.envs.spec import Box, Space, TaskSpec
from sejax.ops import checksummed
from sejax.options import LARGEST, ConfigError, old, registry, require, shortened, unknown_name
from sejax.options.plain import configure, from_plain, require_typed, with_home
from sejax.proxies import hub

FORMAT_VERSION = 2
PRETRAINED_DIR = Path(__file__).parents[1] / "pretrained"
# A caller must give the parts that no file can name: by group, the argument of `sejax.load` and the
# word of a command.
GIVEN = {"env": ("task", "env"), "proxy": ("proxy", "proxy_kind")}
BY_HAND = ", made by hand"  # ends the name of a task that no name makes again
KIND = "sejax"  # name of the metadata's entry


@dataclass(frozen=True, kw_only=True)
class Header:
    """Metadata of a file, all of it plain values.

    Attributes:
      format_version: version of the format; this module reads only one.
      task: name of the real task.
      interface: the task's spaces and step limit, see `sejax.Task.interface`.
      config: configuration that the proxies were learned with, in today's form; at least `env` and
        `proxy`.
      discount: gamma of the agent that they were learned with, in [0, 1].
      is_set: whether the tensors have a leading axis over several proxies.
      proxies: a record of each proxy, such as its score, generation and seed.

    Raises:
      ValueError, LookupError, TypeError, ArithmeticError or AttributeError: for values that no file
        has.
    """

    format_version: int
    task: str
    interface: dict[str, Any]
    config: dict[str, Any]
    discount: float
    is_set: bool
    proxies: list[dict[str, Any]]

    def __post_init__(self) -> None:
        config = old.upgraded(self.config)
        object.__setattr__(self, "config", config)
        explored = config.get("exploration", {"name": "none"})
        parts = [config["env"], config["proxy"], *config["agents"].values(), explored]
        are_named = all(isinstance(part.get("name"), str) for part in parts)
        if self.format_version != FORMAT_VERSION or not (self.proxies and are_named):
            raise ValueError(f"format {self.format_version}, or a part that is missing")
        numbers = [self.discount]
        for record in self.proxies:
            numbers += [record[name] for name in ("score", "generation", "seed") if name in record]
            numbers += dict(record.get("scores", {})).values()
        are_numbers = all(type(x) in (int, float) for x in numbers) and 0 <= self.discount <= 1
        np.array(numbers, float)  # OverflowError for one that is too large
        spec = self.spec
        sizes = [spec.max_steps, _size_of(spec.observation), _size_of(spec.action)]
        are_counts = all(type(size) is int and 0 < size <= LARGEST for size in sizes)
        with np.errstate(over="ignore"):  # `spec` changes nan, and bounds beyond single precision
            is_same = spec.interface == self.interface
        if not (are_numbers and are_counts and is_same):
            raise ValueError("a number, a space or a step limit that no proxy has")

    @property
    def spec(self) -> TaskSpec:
        """The task's spaces and step limit."""
        return TaskSpec.of_interface(self.interface)

    @property
    def kind(self) -> str:
        """Name of the proxy's configuration: se, rn, or one of a package or module."""
        return str(self.config["proxy"].get("name"))


class Stored(NamedTuple):
    """What a file holds.

    Attributes:
      path: the file.
      tensors: by `network/layer/parameter`; kernels `[out, in]`, biases `[out]`.
      header: its metadata.
    """

    path: Path
    tensors: dict[str, np.ndarray]
    header: Header


def _size_of(space: Space) -> int:
    """The size of a space; 0 if a lower bound exceeds the upper one."""
    bounds = zip(space.low, space.high, strict=True) if isinstance(space, Box) else ()
    return space.size if all(low <= high for low, high in bounds) else 0


def is_known(group: str, stored: object) -> bool:
    """Whether plain values name what sejax or an installed package has registered."""
    return isinstance(stored, Mapping) and registry.is_registered(group, str(stored.get("name")))


def configured(group: str, values: object, where: str) -> Any:
    """The configuration of a group that a file holds as plain values.

    Args:
      group: such as `agent`.
      values: of the file.
      where: the file, for messages.

    Raises:
      ConfigError: if there are no values, their name is not registered, or one does not fit.
    """
    if is_known(group, values):
        require_typed({group: values})
        try:
            return configure(group, values)
        except ConfigError as error:
            error.rule += f" in {shortened(where, 40)}" if error.details else ""
            raise
    name = values.get("name") if isinstance(values, Mapping) else "none"
    argument, word = GIVEN.get(group, (group, group))
    rule = f"must be given for {shortened(where, 40)}, as code that a file names is never imported"
    is_path = ":" in str(name) and not str(name).startswith("__main__:")  # a script's own
    text = shortened(name, 80) if is_path else "MODULE:NAME"
    fix = f"If you trust it, set {word}={text} in a command, or {argument}=... in Python."
    raise ConfigError(argument, rule, got=shortened(name, 40), fix=fix)


# --- where a file is ------------------------------------------------------------------------------


def pretrained_files() -> dict[str, Path]:
    """The proxies that ship with the package, by name. Agents can train on each of them."""
    return dict(sorted((path.stem, path) for path in PRETRAINED_DIR.glob("*.safetensors")))


def find(source: str | Path, option: str = "source") -> Path:
    """The file that a run directory, a path, a shipped name or an address on the Hub stands for.

    Args:
      source: as in `sejax.load`.
      option: name of the argument, for messages.

    Raises:
      ConfigError: if there is none, or it cannot be fetched.
    """
    name = str(source)
    if name.startswith(hub.SCHEME):
        return hub.fetch(name, option)
    path = with_home(name)
    file = os.path.join(path, hub.FILE) if os.path.isdir(path) else path
    if os.path.isfile(file):
        return Path(file)
    shipped = pretrained_files()
    if name in shipped:
        return shipped[name]
    if os.path.isdir(path) or "." in path or os.path.basename(path) != path:
        rule = f"must be a file, a run's folder with its {hub.FILE}, a name or hf://USER/REPO"
        raise ConfigError(option, f"{rule}; got {shortened(name)}, where there is none.")
    raise unknown_name(option, name, shipped)


# --- reading and writing --------------------------------------------------------------------------


def read(
    source: str | Path, option: str = "source", kinds: Sequence[str] = (), single: bool = False
) -> Stored:
    """Tensors and header of a file, whose checksum is verified.

    Args:
      source: as in `find`.
      option: name of the argument, for messages.
      kinds: allowed kinds of proxies; empty for any.
      single: whether the file must hold one proxy.

    Raises:
      ConfigError: if there is no such file, it is damaged or of another format, or it holds a set
        or proxies of another kind.
    """
    path = find(source, option)
    where = shortened(path, 60)
    try:
        tensors, plain = checksummed.read(path, KIND)
        header = from_plain(Header, plain, "header")
    except (OSError, LookupError, AttributeError, ValueError, TypeError, ArithmeticError) as error:
        rule = f"must be whole, as sejax wrote it; got {where} ({shortened(error, 60)})."
        raise ConfigError(option, rule) from error
    is_allowed = not kinds or header.kind in kinds
    got = f"{shortened(header.kind, 20)} in {where}"
    require(is_allowed, option, f"must have proxy={' or '.join(map(str, kinds))}", got=got)
    is_one = len(header.proxies) == 1 or not single
    require(is_one, option, f"must be a single proxy. sejax.load_set reads the set {where}.")
    if single and header.is_set:  # a set of one
        tensors = {name: x[0] if x.shape[:1] == (1,) else x for name, x in tensors.items()}
        header = replace(header, is_set=False)
    return Stored(path, tensors, header)


def check_tensors(
    field: str, tensors: Mapping[str, np.ndarray], shapes: Mapping[str, Any], fix: str
) -> None:
    """Checks that tensors are those of the networks that a configuration describes.

    Args:
      field: name of the argument, for messages.
      tensors: arrays by `network/layer/parameter`.
      shapes: shapes of the networks' parameters.
      fix: what to set the argument to, for messages.

    Raises:
      ConfigError: for other names, shapes or types, or numbers that are not finite.
    """
    got = {name: x.shape for name, x in tensors.items()}
    require(got == shapes, field, f"must have the shapes {shortened(shapes)}", got=got, use=fix)
    are_numbers = all(x.dtype == np.float32 and np.isfinite(x).all() for x in tensors.values())
    require(are_numbers, field, "must hold finite float32 numbers", use=fix)
