"""Proxies as files: safetensors with all that is needed to rebuild the network.

A file holds one proxy or a set of proxies that share a configuration; a set's tensors have a
leading axis over its proxies. The metadata is plain data under one key: the format version, the
configuration, the agents' discount, of each proxy its score, generation and seed, and a digest of
all of it. Nothing in a file is executed, resolved or imported when it is read.
"""

import dataclasses
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from sejax import envs, registry
from sejax.envs import absent
from sejax.envs.absent import require_present
from sejax.envs.base import Task
from sejax.errors import ConfigError, require, shortened, told
from sejax.ops.files import write_bytes
from sejax.ops.sealed import seal
from sejax.proxies.base import ProxyEnv
from sejax.proxies.stored import (
    FORMAT_VERSION,
    KEY,
    PRETRAINED_DIR,
    check_header,
    find,
    learned_agents,
    pretrained_names,
    read,
    read_config,
)
from sejax.serialize import from_plain
from sejax.training import TrainingConfig, budget_for

__all__ = [
    "FORMAT_VERSION",
    "PRETRAINED_DIR",
    "Proxy",
    "ProxySet",
    "find",
    "load",
    "load_proxy",
    "load_set",
    "pretrained_names",
    "read_config",
    "register_gymnax",
    "save",
    "save_set",
]


@dataclass(frozen=True, kw_only=True)
class Proxy:
    """A stored proxy.

    Attributes:
      env: the SE or RN, a gymnax environment whose `default_params` are the params.
      params: its `EnvParams`: the weights, and the discount of the agent it was learned with.
      record: what is known of it: `score`, `generation` and `seed`, where they are.
      config: what it was learned with, nested plain values.
      discount: of the agent that it was learned with.
      path: the file.
    """

    env: ProxyEnv
    params: Any
    record: dict[str, Any]
    config: dict[str, Any]
    discount: float
    path: Path

    @property
    def task(self) -> Task:
        """The real task.

        Raises:
          ConfigError: if it cannot be had here, and the file told what the proxy needs of it.
        """
        return require_present(self.env.task)

    def learned_with(self, group: str) -> Any:
        """A part of the configuration that it was learned with, such as `agent` or `training`.

        Raises:
          ConfigError: if nobody knows, or it is of somebody's own: a file's names are not imported.

        Example:
          >>> load_proxy("cliff_walking-rn").learned_with("agent").discount
          0.8
        """
        stored = self.config.get(group)
        if group == "training" and isinstance(stored, Mapping):
            return from_plain(TrainingConfig, stored, group)
        return self._configured(group, stored)

    def learned_agents(self) -> dict[str, Any]:
        """The agents that it was learned with, one or several families, by their keys.

        Raises:
          ConfigError: as `learned_with`.

        Example:
          >>> list(load_proxy("cliff_walking-rn").learned_agents())
          ['q_learning']
        """
        stored = learned_agents(self.config)
        return {key: self._configured("agent", values) for key, values in stored.items()}

    def training_for(self, agent: Any) -> TrainingConfig:
        """How long an agent trains on it: as those that it was learned with (`budget_for`).

        Raises:
          ConfigError: as `learned_with`.
        """
        known = [
            registry.configure("agent", values)
            for values in learned_agents(self.config).values()
            if _is_registered("agent", values)
        ]
        limit = self.env.task.max_steps
        return budget_for(self.learned_with("training"), agent, known, self.env.max_steps, limit)

    def _configured(self, group: str, stored: Any) -> Any:
        where = f"{group} that {self.path.name} was learned with"
        if not isinstance(stored, Mapping):
            raise ConfigError(f"The {where} must be in the file; it is not. Give one of your own.")
        if not _is_registered(group, stored):
            raise ConfigError(
                f"The {where} must be a registered one, because what a file names is never "
                f"imported; it is {shortened(stored.get('name'))!r}. Give {group}= yourself."
            )
        return registry.configure(group, stored)


@dataclass(frozen=True, kw_only=True)
class ProxySet:
    """Proxies that share a configuration, and hence every compiled program.

    Attributes:
      env: the SE or RN, whose weights are what differs; its `default_params` are random ones.
      weights: leaves `[size, ...]`, NumPy float32.
      records: of each what is known of it: `score` (incumbent mean that it was chosen for),
        `generation` (that measured it) and `seed` (of its run).
      config: that they were learned with, nested plain values; its seed is the first run's.
      discount: of the agent that they were learned with.
      path: the file.
    """

    env: ProxyEnv
    weights: Any
    records: tuple[dict[str, Any], ...]
    config: dict[str, Any]
    discount: float
    path: Path

    @property
    def task(self) -> Task:
        """The real task.

        Raises:
          ConfigError: if it cannot be had here, and the file told what the proxy needs of it.
        """
        return require_present(self.env.task)

    @property
    def size(self) -> int:
        return len(self.records)

    def __len__(self) -> int:
        return self.size

    @property
    def scores(self) -> np.ndarray:
        """`[size]` float64; nan where there is none."""
        return np.array([record.get("score") for record in self.records], float)

    @property
    def seeds(self) -> np.ndarray:
        """`[size]`; -1 where there is none."""
        return np.array([record.get("seed", -1) for record in self.records])

    @property
    def params(self) -> Any:
        """All proxies as one `EnvParams`; only `weights` has the leading axis.

        To `vmap` over them: `vmap(lambda w: f(env.params(w, discount)))(weights)`.
        """
        return self.env.params(self.weights, self.discount)

    def one(self, index: int) -> Any:
        """`EnvParams` of one of them, as `sejax.load` gives them."""
        weights = jax.tree.map(lambda x: jax.numpy.asarray(x[index]), self.weights)
        return self.env.params(weights, self.discount)

    def learned_with(self, group: str) -> Any:
        """As `Proxy.learned_with`, for all of them."""
        return self.proxy(0).learned_with(group)

    def proxy(self, index: int) -> Proxy:
        """One of them; its `env` is a copy that has its params as default ones."""
        params = self.one(index)
        return Proxy(
            env=self.env.with_default_params(params),
            params=params,
            record=self.records[index],
            config=self.config,
            discount=self.discount,
            path=self.path,
        )

    def fingerprint(self, index: int) -> str:
        """Eight letters that tell one's weights from another's."""
        flat = flatten_dict(self.weights, sep="/")
        content = b"".join(
            np.ascontiguousarray(flat[name][index]).tobytes() for name in sorted(flat)
        )
        return hashlib.sha256(content).hexdigest()[:8]

    def first(self, count: int | None) -> "ProxySet":
        """The first ones of the set: those of the first runs, whatever their score."""
        return self.select(range(self.size)[:count])

    def solved(self) -> "ProxySet":
        """Those whose score, a mean return, reached the task's threshold."""
        return self.select(np.flatnonzero(self.scores >= self.task.solved_reward))

    def ranked(self, count: int, worst: bool = False) -> "ProxySet":
        """Those with the highest scores, the best first; or the lowest, the worst first."""
        order = np.argsort(self.scores, kind="stable")
        return self.select((order if worst else order[::-1])[:count])

    def select(self, indices: Sequence[int] | np.ndarray) -> "ProxySet":
        """Those at these places, in this order."""
        places = np.asarray(indices, int)
        return dataclasses.replace(
            self,
            weights=jax.tree.map(lambda x: x[places], self.weights),
            records=tuple(self.records[i] for i in places),
        )


# --- writing -------------------------------------------------------------------------------------


def save(
    path: str | Path,
    env: ProxyEnv,
    weights: Any,
    config: Mapping[str, Any] | None = None,
    discount: float | None = None,
    **record: Any,
) -> None:
    """Writes a proxy atomically.

    Args:
      path: the file, `*.safetensors`.
      env: the proxy.
      weights: as from its `init_weights`; kept as float32.
      config: what it was learned with, nested plain values; task and kind of proxy are added.
      discount: of the agent that it was learned with, which a potential-based RN pays with and
        cannot do without; 1 where none is given.
      **record: plain values to keep with it, such as `score`, `generation` and `seed`.

    Raises:
      ConfigError: for weights that are not the proxy's or not finite, a potential-based RN without
        a discount, or a configuration or record that `load` would not take. An older file stays.
      OSError: if it cannot be written; an older file stays as it was.

    Example:
      >>> import tempfile
      >>> env, params = load("cartpole")
      >>> path = Path(tempfile.mkdtemp(), "mine.safetensors")
      >>> save(path, env, params.weights, score=195.0)
      >>> load_proxy(path).record
      {'score': 195.0}
    """
    _write(Path(path), env, _tensors_of(env, weights), config, discount, [record], is_set=False)


def save_set(
    path: str | Path,
    env: ProxyEnv,
    weights: Sequence[Any],
    records: Sequence[Mapping[str, Any]],
    config: Mapping[str, Any] | None = None,
    discount: float | None = None,
) -> None:
    """Writes a set of proxies atomically; arguments as of `save`, with a record for each.

    Raises:
      ConfigError: as `save`, or if there are not as many records as proxies.
      OSError: if it cannot be written; an older file stays as it was.
    """
    require(
        len(weights) == len(records) > 0,
        "records",
        "be one for each proxy",
        "they say which is which",
        f"{len(records)} for {len(weights)}",
        "records=[{}] * len(weights)",
    )
    each = [_tensors_of(env, one) for one in weights]
    tensors = {name: np.stack([one[name] for one in each]) for name in each[0]}
    _write(Path(path), env, tensors, config, discount, records, is_set=True)


def _tensors_of(env: ProxyEnv, weights: Any) -> dict[str, np.ndarray]:
    """The weights of one proxy by `network/layer/parameter`, checked."""
    require(
        isinstance(weights, Mapping),
        "weights",
        "be nested dictionaries as env.init_weights returns",
        "they are kept by their names",
        type(weights).__name__,
        "weights to params.weights",
    )
    tensors = {
        name: np.asarray(x, np.float32) for name, x in flatten_dict(weights, sep="/").items()
    }
    wanted = {name: x.shape for name, x in _shapes_of(env).items()}
    there = {name: x.shape for name, x in tensors.items()}
    require(
        there == wanted,
        "weights",
        f"have the shapes {shortened(wanted)}",
        f"they are those of {env.name}",
        there,
        "weights to those of this env",
    )
    odd = [name for name, x in tensors.items() if not np.isfinite(x).all()]
    require(
        not odd,
        "weights",
        "be finite",
        "no agent could train on others",
        f"others in {', '.join(odd)}",
        "weights to ones that were scored",
    )
    return tensors


def _write(
    path: Path,
    env: ProxyEnv,
    tensors: dict[str, np.ndarray],
    config: Mapping[str, Any] | None,
    discount: float | None,
    records: Sequence[Mapping[str, Any]],
    is_set: bool,
) -> None:
    require(
        discount is not None or not env.config.needs_discount,
        "discount",
        "be given for a potential-based reward network",
        "its reward is made with it",
        discount,
        "discount=params.discount, that of the agent",
    )
    require(
        isinstance(config, Mapping | None),
        "config",
        "be nested plain values",
        "they are kept beside the weights",
        type(config).__name__,
        "config=sejax.config(...).plain()",
    )
    known = {
        "env": env.task.origin or {"name": env.task.name},
        "proxy": registry.describe("proxy", env.config),
    }
    header: dict[str, Any] = {
        "format_version": FORMAT_VERSION,
        "task": env.task.name,
        "interface": env.task.interface,
        "config": known | dict(config or {}) | {"run_dir": None},  # no path of a machine
        "discount": 1.0 if discount is None else float(discount),
        "is_set": is_set,
        "proxies": [{name: _plain(x) for name, x in record.items()} for record in records],
    }
    try:
        check_header(header)
        sealed = seal(tensors, KEY, header)
    except (LookupError, ValueError, TypeError) as error:
        raise ConfigError(
            f"config, discount and record must be plain values that sejax.load takes, because they "
            f"are kept beside the weights; got {told(error)}. Give score, generation and seed as "
            f"numbers, and config as sejax.config(...).plain() has it."
        ) from error
    write_bytes(path, sealed)


def _plain(value: Any) -> Any:
    """A number for an array of one, such as a result's score."""
    return value.item() if hasattr(value, "dtype") and np.ndim(value) == 0 else value


# --- reading -------------------------------------------------------------------------------------


def load(source: str | Path, task: Task | None = None, proxy: Any = None) -> tuple[ProxyEnv, Any]:
    """Loads a proxy as a gymnax environment and its params (the weights).

    The discount of a potential-based RN is that of the agent it was learned with. For another one
    take `params.replace(discount=...)`; `make_trainer` does so by itself.

    Args:
      source: a run directory, a safetensors file, the name of a proxy that ships with the package
        (`pretrained_names()`), or one on the Hugging Face Hub: `hf://user/repo`.
      task: of the proxy; needed if it is none that a registered name makes, as a file's names are
        never imported. An SE whose initial states are not the real task's can do without, or
        without the package that its task needs: what agents see is in the file, and only what would
        reset or step the real task fails.
      proxy: its configuration; needed likewise for a kind of proxy of your own.

    Returns:
      The environment, whose `default_params` are the same params, for wrappers that leave them out.

    Raises:
      ConfigError: if there is no such proxy, the file is damaged or of another format, it holds
        several, its task or kind is not known, or the task given is not the file's: its spaces are
        others, or for an SE its step limit.

    Example:
      >>> env, params = load("cartpole")
      >>> obs, state = env.reset(jax.random.key(0), params)
      >>> obs.shape
      (4,)
    """
    loaded = load_proxy(source, task, proxy)
    return loaded.env, loaded.params


def load_proxy(
    source: str | Path, task: Task | None = None, proxy: Any = None, option: str = "source"
) -> Proxy:
    """As `load`, with the real task, the configuration and the record.

    Args:
      source: as of `load`.
      task: likewise.
      proxy: likewise.
      option: what messages call `source`.
    """
    proxies = load_set(source, task, proxy, option)
    require(
        proxies.size == 1,
        option,
        "be a single proxy",
        "an agent trains in one world",
        f"{proxies.path}, a set of {proxies.size}",
        f"{option} to a run directory; sejax.load_set reads sets",
    )
    return proxies.proxy(0)


def load_set(
    source: str | Path,
    task: Task | None = None,
    proxy: Any = None,
    option: str = "source",
    kind: str | None = None,
) -> ProxySet:
    """Loads a set of proxies; a single stored one is a set of one.

    Args:
      source: a file of `save_set`, or whatever `load` takes.
      task: as of `load`.
      proxy: likewise.
      option: what messages call `source`.
      kind: "se" or "rn", which the proxies must be; None for any.

    Raises:
      ConfigError: as `load`, or if its proxies are of another kind.

    Example:
      >>> rns = load_set("cliff_walking-rn")  # or a file in results/reward_networks
      >>> env, params = rns.env, rns.one(0)
      >>> rns.size, params.discount
      (1, 0.8)
    """
    path = find(source, option)
    tensors, header = read(path, option)
    config = header["config"]
    name = config["proxy"].get("name")
    require(
        kind in (None, name),
        option,
        f"hold proxies learned with proxy={kind}",
        "these are what is studied",
        f"proxy={name}",
        f"{option} to a file of those",
    )
    env = _env_of(path, header, task, proxy, option)
    if not header["is_set"]:
        tensors = {name: x[None] for name, x in tensors.items()}
    _check_tensors(path, option, env, tensors, len(header["proxies"]))
    weights = unflatten_dict({tuple(name.split("/")): x for name, x in tensors.items()})
    return ProxySet(
        env=env,
        weights=weights,
        records=tuple(header["proxies"]),
        config=config,
        discount=header["discount"],
        path=path,
    )


def _env_of(
    path: Path, header: dict[str, Any], task: Task | None, proxy: Any, option: str
) -> ProxyEnv:
    """The environment that a file's metadata describes."""
    config = header["config"]
    if proxy is None:
        proxy = _registered("proxy", "proxy", "proxy_kind", path, config, option)
    given = task is not None
    if task is None:
        try:
            task = envs.make_from(_registered("env", "task", "env", path, config, option))
        except ConfigError as error:
            if "interface" not in header or proxy.needs_task:
                raise
            task = absent.make(header["task"], header["interface"], config["env"], str(error))
    require(
        header["task"] == task.name,
        option,
        f"be a proxy of {task.name}",
        "that is the task given",
        f"one of {shortened(header['task'])} in {path}",
        f"{option} to a proxy of {task.name}, or another task",
    )
    if given and "interface" in header:
        _require_same(header["interface"], task.interface, proxy, path)
    return registry.make("proxy", proxy, task)


def _require_same(
    learned: Mapping[str, Any], given: Mapping[str, Any], proxy: Any, path: Path
) -> None:
    """Checks that a task given is that of the proxy, as far as the proxy depends on it.

    An RN is for the same dynamics with another step limit too, and an SE in the task's raw units
    does not know the bounds of observations.
    """
    with_bounds = {"observation": proxy.sees_bounds, "action": True}
    for what, wanted in learned.items():
        there = given[what]
        if what in with_bounds:
            same = _is_same_space(wanted, there, with_bounds[what])
        else:
            same = there == wanted or proxy.has_real_dynamics
        require(
            same,
            "task",
            f"have the {what} of the task that the proxy was learned for, {shortened(wanted)}",
            f"{path} is a proxy of that one",
            there,
            f"task to a sejax.Task with that {what}",
        )


def _is_same_space(one: Mapping[str, Any], other: Mapping[str, Any], with_bounds: bool) -> bool:
    """Whether two spaces of `Task.interface` are the same, but for rounding."""
    if "n" in one or "n" in other:
        return one == other
    if len(one["low"]) != len(other["low"]):
        return False
    ends = [(a, b) for end in ("low", "high") for a, b in zip(one[end], other[end], strict=True)]
    return not with_bounds or all(
        a == b if a is None or b is None else math.isclose(a, b, rel_tol=1e-5, abs_tol=1e-8)
        for a, b in ends
    )


def _registered(
    group: str, argument: str, word: str, path: Path, config: Mapping[str, Any], option: str
) -> Any:
    """The configuration of a group, if its name is one that sejax or a package has registered."""
    name = shortened(config[group].get("name"))
    if not _is_registered(group, config[group]):
        named = name if ":" in name else f"my_module:function, one that makes {name},"
        raise ConfigError(
            f"{option} must be a proxy of a registered {group} if no {argument} is given, because "
            f"what a file names is never imported; {path} is one of {name!r}. Give it: "
            f"sejax.load(path, {argument}=...), or {word}={named} on the command line."
        )
    return registry.configure(group, config[group])


def _is_registered(group: str, stored: Any) -> bool:
    """Whether plain values name what sejax or a package has registered."""
    return isinstance(stored, Mapping) and registry.is_registered(group, str(stored.get("name")))


def _check_tensors(
    path: Path, option: str, env: ProxyEnv, tensors: dict[str, np.ndarray], count: int
) -> None:
    wanted = {name: ("float32", (count, *x.shape)) for name, x in _shapes_of(env).items()}
    there = {name: (str(x.dtype), x.shape) for name, x in tensors.items()}
    finite = there == wanted and all(np.isfinite(x).all() for x in tensors.values())
    if not finite:
        what = "numbers that are not finite" if there == wanted else shortened(there)
        raise ConfigError(
            f"{option} must hold the tensors of the network in its metadata, because they are its "
            f"weights; {path} has {what} in place of {shortened(wanted)}. Learn it again."
        )


def _shapes_of(env: ProxyEnv) -> dict[str, Any]:
    """Shape and dtype of each of a proxy's weights."""
    return flatten_dict(jax.eval_shape(env.init_weights, jax.random.key(0)), sep="/")


# --- gymnax --------------------------------------------------------------------------------------


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
    """Makes a shipped proxy."""

    name: str

    def __call__(self) -> Any:
        return load(self.name)[0]
