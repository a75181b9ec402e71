"""What a proxy's file holds, read without JAX: tensors, and a header of plain values.

A file is in the safetensors format, with a checksum. It holds one proxy, or a set of proxies that
share a configuration, whose tensors then have a leading axis over them. Nothing that a file says is
executed, resolved or imported when it is read. `sejax.proxies.io` makes environments of it for JAX,
`sejax.gym` some for Gymnasium.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sejax.ops.checksummed import DamagedError, pack, unpack
from sejax.options import LARGEST, ConfigError, registry, require, shortened, unknown_name
from sejax.options.plain import from_plain
from sejax.proxies import hub

FORMAT_VERSION = 2
PRETRAINED_DIR = Path(__file__).parents[1] / "pretrained"
_KEY = "sejax"  # of the metadata's entry


@dataclass(frozen=True, kw_only=True)
class Header:
    """Metadata of a file, all of it plain values.

    Attributes:
      format_version: version of the format, of which this module reads one.
      task: name of the real task.
      interface: the task's spaces and step limit, see `sejax.Task.interface`.
      config: configuration that the proxies were learned with; at least `env` and `proxy`.
      discount: gamma of the agent that they were learned with, in [0, 1].
      is_set: whether the tensors have a leading axis over several proxies.
      proxies: a record of each proxy, such as its score, generation and seed.

    Raises:
      ValueError, LookupError or TypeError: for values that cannot be those of a file.
    """

    format_version: int
    task: str
    interface: dict[str, Any]
    config: dict[str, Any]
    discount: float
    is_set: bool
    proxies: list[dict[str, Any]]

    def __post_init__(self) -> None:
        if self.format_version != FORMAT_VERSION:
            raise ValueError(f"format {self.format_version} in place of {FORMAT_VERSION}")
        if not all(isinstance(self.config[group], Mapping) for group in ("env", "proxy")):
            raise ValueError("no task or proxy")
        if not self.proxies or not all(isinstance(record, Mapping) for record in self.proxies):
            raise ValueError("no records")
        for record in self.proxies:
            for name in ("score", "generation", "seed"):
                float(record.get(name, 0))
        if not 0 <= self.discount <= 1:
            raise ValueError("a discount outside of [0, 1]")
        _check_interface(self.interface)

    @property
    def kind(self) -> str:
        """Name of the proxy's configuration: se, rn, or one of a package or module."""
        return str(self.config["proxy"].get("name"))

    @property
    def task_kind(self) -> str:
        """Name of the task's configuration."""
        return str(self.config["env"].get("name"))

    @property
    def agents(self) -> dict[str, Any]:
        """Plain values of the agents that the proxies were learned with, by their keys."""
        return agents_of(self.config)

    def with_tensors(self, tensors: dict[str, np.ndarray]) -> bytes:
        """The content of a file with this header.

        Args:
          tensors: float32 arrays by `network/layer/parameter`.

        Raises:
          TypeError or ValueError: if the header's values are not plain.
        """
        return pack(tensors, _KEY, vars(self))


def agents_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """Plain values of a configuration's agent, or of its mixture of agents, by their keys."""
    mixture = config.get("agents")
    if not isinstance(mixture, Mapping):
        agent = config.get("agent")
        return {str(agent.get("name")) if isinstance(agent, Mapping) else "": agent}
    return {
        key: {name: x for name, x in values.items() if name != "weight"}
        for key, values in mixture.items()
        if isinstance(values, Mapping)
    }


def is_registered(group: str, stored: Any) -> bool:
    """Whether plain values name what sejax or an installed package has registered."""
    return isinstance(stored, Mapping) and registry.is_registered(group, str(stored.get("name")))


def _check_interface(interface: Mapping[str, Any]) -> None:
    """Raises an error for plain values that are not `Task.interface`."""
    counts = [interface["max_steps"]]
    for space in (interface["observation"], interface["action"]):
        if "n" in space:
            counts.append(space["n"])
            continue
        low, high = space["low"], space["high"]
        are_numbers = all(x is None or math.isfinite(x) for x in (*low, *high))
        if not (are_numbers and len(low) == len(high) > 0):
            raise ValueError("a space of vectors without bounds")
        if any(None not in pair and pair[0] > pair[1] for pair in zip(low, high, strict=True)):
            raise ValueError("a space whose bounds are in the wrong order")
    if not all(type(count) is int and 0 < count <= LARGEST for count in counts):
        raise ValueError("a space or step limit that is not a whole number above 0")


# --- where a file is ------------------------------------------------------------------------------


def pretrained_names() -> list[str]:
    """Names of the proxies that ship with the package."""
    return sorted(path.stem for path in PRETRAINED_DIR.glob("*.safetensors"))


def find(source: str | Path, option: str = "source", also: Sequence[str] = ()) -> Path:
    """The file that a run directory, a path, a shipped name or an address on the Hub stands for.

    Args:
      source: as of `sejax.load`.
      option: name of the argument, for messages.
      also: names beside the shipped ones, for messages.

    Raises:
      ConfigError: if there is none, or it cannot be fetched.
    """
    if hub.is_address(source):
        return hub.fetch(str(source), option)
    text = shortened(source, 120)
    try:
        path = Path(source)
        is_dir, is_file = path.is_dir(), path.is_file()
    except (OSError, ValueError, TypeError) as error:
        raise ConfigError(
            f"{option} must be a path or a name; got {text} ({type(error).__name__}).", option
        ) from None
    if is_dir:
        stored = path / hub.FILE
        is_run = (path / "config.yaml").exists()
        require(
            stored.exists(),
            option,
            f"must be a run directory with a {hub.FILE}, because "
            f"{'the run has not finished a generation yet' if is_run else 'it is no run'}; "
            f"got {shortened(text)}. Set {option} to a run directory or a file.",
        )
        return stored
    if is_file:
        return path
    if path.suffix or len(path.parts) != 1:
        raise ConfigError(
            f"{option} must be a run directory, a safetensors file, a shipped name or an address "
            f"hf://USER/REPO; got {text}, which does not exist.",
            option,
        )
    shipped = PRETRAINED_DIR / f"{source}.safetensors"
    if shipped.is_file():
        return shipped
    raise unknown_name(option, shortened(source, 80), [*pretrained_names(), *also])


# --- reading and writing --------------------------------------------------------------------------


def read(
    source: str | Path, option: str = "source", kinds: Sequence[str] = ()
) -> tuple[dict[str, np.ndarray], Header]:
    """Tensors and header of a file, whose checksum is verified.

    Args:
      source: as of `find`.
      option: name of the argument, for messages.
      kinds: kinds of proxies, one of which it must hold; empty for any.

    Raises:
      ConfigError: if there is no such file, it is damaged, too large or of another format, or it
        holds proxies of another kind.
    """
    path = find(source, option)
    try:
        size = path.stat().st_size
        if size > hub.MAX_BYTES:
            raise DamagedError(f"it has {size:,} bytes, and the largest proxies have fewer")
        tensors, stored = unpack(path.read_bytes(), _KEY)
        header = from_plain(Header, stored, "header")
    except (OSError, LookupError, ValueError, TypeError, ArithmeticError) as error:
        raise ConfigError(
            f"{option} must be a proxy's file as sejax writes it; got {shortened(path, 80)}, which "
            f"is damaged or of another format ({shortened(error, 60)}). The run writes it again.",
            option,
        ) from error
    require(
        not kinds or header.kind in kinds,
        option,
        f"must be a proxy of the kind {shortened(' or '.join(map(str, kinds)), 40)}, because "
        f"others are not read here; got proxy={shortened(header.kind, 40)} in "
        f"{shortened(path, 80)}. Set {option} to such a proxy.",
    )
    return tensors, header


def read_single(
    source: str | Path, kinds: Sequence[str] = ()
) -> tuple[dict[str, np.ndarray], Header]:
    """As `read`, of a file that must hold one proxy.

    Raises:
      ConfigError: as `read`, or if it holds a set.
    """
    tensors, header = read(source, kinds=kinds)
    require_single(len(header.proxies), source)
    return tensors, header


def require_single(count: int, source: Any, option: str = "source") -> None:
    """Checks that a file holds one proxy.

    Raises:
      ConfigError: if it holds a set.
    """
    require(
        count == 1,
        option,
        f"must be a single proxy, because an agent trains in one environment; got a set of {count} "
        f"in {shortened(source, 80)}. Set {option} to a run directory; sejax.load_set reads sets.",
    )


def read_config(source: str | Path, option: str = "source") -> dict[str, Any]:
    """The configuration that the proxies of a file were learned with, nested plain values.

    Raises:
      ConfigError: as `read`.
    """
    return read(source, option)[1].config


def check_tensors(
    field: str,
    tensors: Mapping[str, np.ndarray],
    shapes: Mapping[str, tuple[int, ...]],
    fix: str,
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
    there = {name: x.shape for name, x in tensors.items()}
    odd = [
        f"numbers that are not finite float32 in {name}"
        for name, x in tensors.items()
        if x.dtype != np.float32 or not np.isfinite(x).all()
    ]
    require(
        there == shapes and not odd,
        field,
        f"must hold finite float32 tensors of the shapes {shortened(shapes, 60)}, because the "
        "proxy's configuration describes such networks; got "
        f"{shortened(shortened(odd[0] if odd and there == shapes else there, 60))}. Set {field} to "
        f"{fix}.",
    )
