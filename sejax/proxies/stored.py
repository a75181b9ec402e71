"""What a proxy's file holds, read without JAX: tensors, and a header of plain values.

`sejax.proxies.files` makes environments of it for JAX, `sejax.gym` one for Gymnasium.
"""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open

from sejax.errors import LARGEST, ConfigError, require, shortened, unknown_name
from sejax.ops.checksummed import DamagedError, unpack
from sejax.proxies import hub

FORMAT_VERSION = 2
PRETRAINED_DIR = Path(__file__).parents[1] / "pretrained"
KEY = "sejax"  # of the metadata's entry


def read_config(source: str | Path, option: str = "source") -> dict[str, Any]:
    """What the proxies of a file were learned with, nested plain values.

    Raises:
      ConfigError: if there is no such file, or it is damaged or of another format.
    """
    return read(find(source, option), option)[1]["config"]


def find(source: str | Path, option: str = "source", also: Sequence[str] = ()) -> Path:
    """The file that a run directory, a path, a shipped name or an address on the Hub stands for.

    Args:
      source: as of `load`.
      option: what messages call it.
      also: names beside the shipped ones, for messages.

    Raises:
      ConfigError: if there is none, or it cannot be fetched.
    """
    if hub.is_address(source):
        return hub.fetch(str(source), option)
    text = shortened(source)
    try:
        path = Path(source)
        is_dir, is_file = path.is_dir(), path.is_file()
    except (OSError, ValueError, TypeError) as error:
        raise ConfigError(
            f"{option} must be a path; got {text} ({type(error).__name__})."
        ) from None
    if is_dir:
        path = path / "proxy.safetensors"
        is_run = (path.parent / "config.yaml").exists()
        require(
            path.exists(),
            option,
            "be a run directory with a proxy.safetensors",
            "the run has not finished a generation yet"
            if is_run
            else "this is a folder of another sort",
            str(path.parent),
            f"{option} to a file, or finish the run first"
            if is_run
            else f"{option} to a run directory or a file",
        )
        return path
    if is_file:
        return path
    if path.suffix or len(path.parts) != 1:
        raise ConfigError(
            f"{option} must be a run directory, a safetensors file or a shipped name, because "
            f"weights are read from it; got {text}, which does not exist. Shipped names: "
            f"{', '.join(pretrained_names())}."
        )
    shipped = PRETRAINED_DIR / f"{source}.safetensors"
    if shipped.is_file():
        return shipped
    raise unknown_name(option, str(source), [*pretrained_names(), *also])


def pretrained_names() -> list[str]:
    """Names of the proxies that ship with the package."""
    return sorted(path.stem for path in PRETRAINED_DIR.glob("*.safetensors"))


def learned_agents(config: Mapping[str, Any]) -> dict[str, Any]:
    """Plain values of the agents, one or several families, that a configuration is of, by key."""
    families = config.get("agents")
    if not isinstance(families, Mapping):
        agent = config.get("agent")
        return {str(agent.get("name")) if isinstance(agent, Mapping) else "": agent}
    return {
        key: {name: x for name, x in values.items() if name != "weight"}
        for key, values in families.items()
        if isinstance(values, Mapping)
    }


def read(path: Path, option: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Tensors and header of a file, checked against its digest and brought to this format."""
    try:
        with safe_open(path, framework="np") as file:
            metadata = dict(file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError) as error:
        raise _damaged(path, option, str(error)) from error
    try:
        stored = json.loads(metadata.get(KEY) or metadata["sejax_set"])
        version = stored["format_version"]
        is_known = type(version) is int and version in (1, FORMAT_VERSION)
        if is_known and version == 1:
            stored = _from_version_1(stored, is_set=KEY not in metadata)
        if is_known:
            check_header(stored)
    except (
        LookupError,
        ValueError,
        TypeError,
        AttributeError,
        ArithmeticError,
        RecursionError,
    ) as error:
        raise ConfigError(
            f"{option} must be a file that sejax has written, because the network is rebuilt from "
            f"its metadata; {path} has none that is valid ({type(error).__name__}: "
            f"{shortened(error)}). Learn it again."
        ) from error
    require(
        is_known,
        option,
        f"be of format {FORMAT_VERSION} or 1",
        "this version of sejax reads no other",
        f"{shortened(version)} in {path}",
        f"{option} to a file of this version",
    )
    if version == FORMAT_VERSION:
        try:
            tensors, _ = unpack(path.read_bytes(), KEY)
        except DamagedError as error:
            raise _damaged(path, option, str(error)) from error
    return tensors, stored


def _damaged(path: Path, option: str, how: str) -> ConfigError:
    return ConfigError(
        f"{option} must be a whole safetensors file, because weights are read from it; got {path}, "
        f"which is damaged ({shortened(how)}). The command that wrote it writes it anew from its "
        f"checkpoint."
    )


def check_header(header: dict[str, Any]) -> None:
    """Checks the metadata of a file.

    Raises:
      LookupError, ValueError or TypeError: for metadata of another shape.
    """
    config = header["config"]
    if not all(isinstance(config[group], Mapping) for group in ("env", "proxy")):
        raise ValueError("no task or proxy")
    if not isinstance(header["task"], str) or not isinstance(header["is_set"], bool):
        raise ValueError("no name of a task, or nothing that says whether it is a set")
    records = header["proxies"]
    if not records or not all(isinstance(record, Mapping) for record in records):
        raise ValueError("no records")
    for record in records:
        float(record.get("score", 0)), int(record.get("seed", 0)), int(record.get("generation", 0))
    header["discount"] = float(header["discount"])
    if not 0 <= header["discount"] <= 1:
        raise ValueError("a discount outside of [0, 1]")
    if "interface" in header:  # which older files lack
        _check_interface(header["interface"])


def _check_interface(interface: Any) -> None:
    """Raises an error for what is no `Task.interface`."""
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
        raise ValueError("a space or step limit that is no whole number above 0")


def _from_version_1(stored: Any, is_set: bool) -> dict[str, Any]:
    """A header of version 1, which had two kinds of files and no digest, as this one has it."""
    config = _upgraded(stored["config"])
    names = ("score", "generation", "seed")
    if is_set:
        columns = [stored[f"{name}s"] for name in names]
        records = [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]
    else:
        records = [{k: v for k, v in stored.items() if k not in ("format_version", "config")}]
    agent = config.get("agent") or {}
    return {
        "format_version": FORMAT_VERSION,
        "task": config["env"]["name"],
        "config": config,
        "discount": agent.get("discount", 1.0),
        "is_set": is_set,
        "proxies": records,
    }


def _upgraded(config: Any) -> dict[str, Any]:
    """A configuration of version 1, in which choices had the fields of all of their kind."""
    config = dict(config)
    config["env"] = {k: v for k, v in config["env"].items() if v is not None}
    config.setdefault("exploration", {"name": "none"})
    objective = dict(config.get("objective") or {"name": "max_reward"})
    if objective["name"] != "reward_threshold":
        objective.pop("unsolved_weight", None)
    return config | {"objective": objective}
