"""Proxies as files: safetensors with all that is needed to rebuild the network.

The file's metadata holds the format version, the configuration of the run, the score, the
generation and the seed. Nothing in it is executed when it is read.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from sejax import envs
from sejax.configs import LearnConfig, from_dict, to_dict
from sejax.errors import ConfigError, require, unknown_name
from sejax.files import atomic_path
from sejax.proxies.registry import ProxyEnv, ProxyParams, make_proxy, params_as_learned

FORMAT_VERSION = 1
PRETRAINED_DIR = Path(__file__).parents[1] / "pretrained"


@dataclass(frozen=True, kw_only=True)
class Proxy:
    """A stored proxy: its environment, its weights as `EnvParams`, and where it came from."""

    env: ProxyEnv
    params: ProxyParams
    config: LearnConfig
    metadata: dict[str, Any]
    path: Path

    @property
    def task(self) -> envs.Task:
        return self.env.task


def save(path: str | Path, config: LearnConfig, weights: Any, **metadata: Any) -> None:
    """Writes a proxy atomically.

    Args:
      path: the file, `*.safetensors`.
      config: the configuration it was learned with.
      weights: as from `init_weights` of the proxy.
      **metadata: plain values to keep with it, such as score, generation and seed.

    Raises:
      OSError: if it cannot be written; an older file stays as it was.
    """
    header = {"format_version": FORMAT_VERSION, **metadata}
    header["config"] = to_dict(config) | {"run_dir": None}  # no path of the machine that made it
    tensors = {name: np.asarray(x) for name, x in flatten_dict(weights, sep="/").items()}
    with atomic_path(Path(path)) as temporary:
        # One entry: safetensors writes several in random order.
        save_file(tensors, temporary, metadata={"sejax": json.dumps(header)})


def load(source: str | Path) -> tuple[ProxyEnv, ProxyParams]:
    """Loads a proxy as a gymnax environment and its params (the weights).

    The discount of a potential-based RN is that of the agent it was learned with. For another one
    take `params.replace(discount=...)`; `make_trainer` does so by itself.

    Args:
      source: a run directory, a safetensors file, or the name of a proxy that ships with the
        package (`pretrained_names()`).

    Raises:
      ConfigError: if there is no such proxy, or the file is damaged or of another format.

    Example:
      >>> env, params = load("cartpole")
      >>> obs, state = env.reset(jax.random.key(0), params)
      >>> obs.shape
      (4,)
    """
    proxy = load_proxy(source)
    return proxy.env, proxy.params


def load_proxy(source: str | Path) -> Proxy:
    """As `load`, with the real task, the configuration and the metadata."""
    path = find(source)
    tensors, header = _read(path)
    require("sejax_set" not in header, "proxy", "be a single proxy", "an agent trains in one world",
            f"{path}, a set of several", "proxy to a run directory; in Python "
            "sejax.load_set reads sets")  # fmt: skip
    try:
        metadata = json.loads(header["sejax"])
        config = from_dict(metadata.pop("config"))
    except (KeyError, ValueError) as error:
        raise ConfigError(
            f"proxy must be a file that sejax has written, because the network is rebuilt from its "
            f"metadata; {path} has none that is valid ({error}). Learn it again with sejax.run."
        ) from error
    require(metadata["format_version"] == FORMAT_VERSION, "proxy",
            f"be of format {FORMAT_VERSION}", "this version of sejax reads no other",
            metadata["format_version"], "proxy to a file of this version")  # fmt: skip
    env = make_proxy(config.env.make(), config.proxy)
    weights = unflatten_dict({tuple(name.split("/")): x for name, x in tensors.items()})
    _check_shapes(path, env, weights)
    return Proxy(
        env=env,
        params=params_as_learned(env, jax.tree.map(jax.numpy.asarray, weights), config),
        config=config,
        metadata=metadata,
        path=path,
    )


def find(source: str | Path) -> Path:
    """The file that a run directory, a path or a shipped name stands for."""
    path = Path(source)
    if path.is_dir():
        path = path / "proxy.safetensors"
        require(path.exists(), "proxy", "be a run directory with a proxy.safetensors",
                "the run has not finished a generation yet", str(path.parent),
                "proxy=FILE, or finish the run first")  # fmt: skip
        return path
    if path.is_file():
        return path
    shipped = PRETRAINED_DIR / f"{source}.safetensors"
    if shipped.is_file():
        return shipped
    if path.suffix or len(path.parts) > 1:
        raise ConfigError(
            f"proxy must be a run directory, a safetensors file or a shipped name, because weights "
            f"are read from it; got {source}, which does not exist. Shipped names: "
            f"{', '.join(pretrained_names())}."
        )
    raise unknown_name("proxy", str(source), [*pretrained_names(), "real"])


def pretrained_names() -> list[str]:
    """Names of the proxies that ship with the package."""
    return sorted(path.stem for path in PRETRAINED_DIR.glob("*.safetensors"))


def register_gymnax() -> list[str]:
    """Registers the shipped proxies with gymnax as `sejax/<name>`; may be called repeatedly.

    Returns:
      The ids, for `gymnax.make`. The environment's `default_params` are the learned weights.
    """
    import gymnax
    from gymnax.registration import registered_envs

    ids = [f"sejax/{name}" for name in pretrained_names()]
    for env_id in ids:
        if env_id not in registered_envs:
            gymnax.register(env_id, _Factory(env_id.removeprefix("sejax/")))
    return ids


@dataclass(frozen=True)
class _Factory:
    """Makes a shipped proxy whose default params are its weights."""

    name: str

    def __call__(self) -> ProxyEnv:
        env, params = load(self.name)
        return env.with_default_params(params)


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    try:
        with safe_open(path, framework="np") as file:
            header = dict(file.metadata() or {})
            return {name: file.get_tensor(name) for name in file.keys()}, header  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise ConfigError(
            f"proxy must be a whole safetensors file, because weights are read from it; got "
            f"{path}, which is damaged ({error}). Use proxy_last.safetensors of the same run, "
            f"or run sejax.run on the directory again."
        ) from error


def _check_shapes(path: Path, env: ProxyEnv, weights: Any) -> None:
    expected = jax.eval_shape(env.init_weights, jax.random.key(0))
    shapes = {k: x.shape for k, x in flatten_dict(weights, sep="/").items()}
    wanted = {k: x.shape for k, x in flatten_dict(expected, sep="/").items()}
    if shapes != wanted:
        raise ConfigError(
            f"proxy must hold the tensors of the network in its metadata, because they are its "
            f"weights; {path} has {shapes} in place of {wanted}. Learn it again with sejax.run."
        )
