"""Sets of learned proxies of one task in one file: what the experiments write and read.

The tensors are those of one proxy with a leading axis over the proxies, in safetensors. The
metadata holds the format version, the configuration that all were learned with, and of each proxy
its score, generation and seed. Nothing in it is executed when it is read.
"""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
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
from sejax.errors import ConfigError, require
from sejax.files import atomic_path
from sejax.proxies import io as proxy_io
from sejax.proxies.registry import ProxyEnv, ProxyParams, make_proxy, params_as_learned

FORMAT_VERSION = 1


@dataclass(frozen=True, kw_only=True)
class ProxySet:
    """Proxies that share a configuration, and hence every compiled program.

    Attributes:
      env: the SE or RN; its weights are what differs.
      weights: leaves `[size, ...]`, NumPy float32.
      scores: `[size]` incumbent mean that each was chosen for.
      generations: `[size]` outer iteration that measured it.
      seeds: `[size]` seed of the run that it came from.
      config: that they were learned with; its seed is the first run's.
      path: the file.
    """

    env: ProxyEnv
    weights: Any
    scores: np.ndarray
    generations: np.ndarray
    seeds: np.ndarray
    config: LearnConfig
    path: Path

    @property
    def task(self) -> envs.Task:
        return self.env.task

    @property
    def size(self) -> int:
        return len(self.scores)

    @property
    def params(self) -> ProxyParams:
        """All proxies as one `EnvParams`; only `weights` has the leading axis."""
        return params_as_learned(self.env, self.weights, self.config)

    def one(self, index: int) -> ProxyParams:
        """`EnvParams` of one of them, as `sejax.load` gives them."""
        weights = jax.tree.map(lambda x: x[index], self.weights)
        return params_as_learned(self.env, weights, self.config)

    def fingerprint(self, index: int) -> str:
        """Eight letters that tell one's weights from another's."""
        flat = flatten_dict(self.one(index).weights, sep="/")
        content = b"".join(np.ascontiguousarray(flat[name]).tobytes() for name in sorted(flat))
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
            scores=self.scores[places],
            generations=self.generations[places],
            seeds=self.seeds[places],
        )


def save_set(
    path: str | Path,
    config: LearnConfig,
    weights: Sequence[Any],
    scores: Sequence[float],
    generations: Sequence[int],
    seeds: Sequence[int],
) -> None:
    """Writes a set atomically.

    Args:
      path: the file, `*.safetensors`.
      config: the configuration that all were learned with.
      weights: of each proxy, as from its `init_weights`.
      scores: of each, its incumbent mean.
      generations: of each, the outer iteration that measured it.
      seeds: of each, its run's seed.

    Raises:
      OSError: if it cannot be written; an older file stays as it was.
    """
    header = {
        "format_version": FORMAT_VERSION,
        "config": to_dict(config) | {"run_dir": None},  # no path of the machine that made it
        "scores": [float(x) for x in scores],
        "generations": [int(x) for x in generations],
        "seeds": [int(x) for x in seeds],
    }
    flat = [flatten_dict(one, sep="/") for one in weights]
    tensors = {name: np.stack([np.asarray(one[name], np.float32) for one in flat])
               for name in flat[0]}  # fmt: skip
    with atomic_path(Path(path)) as temporary:
        save_file(tensors, temporary, metadata={"sejax_set": json.dumps(header)})


def load_set(source: str | Path, option: str = "source", kind: str | None = None) -> ProxySet:
    """Loads a set of proxies; a single stored one is a set of one.

    Args:
      source: a file of `save_set`, or whatever `sejax.load` takes.
      option: named in error messages.
      kind: "se" or "rn", which the proxies must be; None for either.

    Raises:
      ConfigError: if there is no such file, it is damaged or of another format, or its proxies are
        of another kind.

    Example:
      >>> rns = load_set("cliff_walking-rn")  # or a file in results/reward_networks
      >>> env, params = rns.env, rns.one(0)
      >>> rns.size, params.discount
      (1, 0.8)
    """
    if not Path(source).is_file():
        return _set_of_one(source, option, kind)
    path = Path(source)
    try:
        with safe_open(path, framework="np") as file:
            header = dict(file.metadata() or {})
            if "sejax_set" not in header:
                return _set_of_one(path, option, kind)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        stored = json.loads(header["sejax_set"])
        config = from_dict(stored["config"])
        columns = [np.asarray(stored[name]) for name in ("scores", "generations", "seeds")]
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise ConfigError(
            f"{option} must be a whole file of proxies that sejax has written, because weights are "
            f"read from it; got {path}, which is damaged ({error}). Run the experiment again that "
            f"wrote it."
        ) from error
    require(stored.get("format_version") == FORMAT_VERSION, option,
            f"be of format {FORMAT_VERSION}", "this version of sejax reads no other",
            stored.get("format_version"), f"{option} to a file of this version")  # fmt: skip
    env = _proxy_of(config, option, kind)
    _check_shapes(path, option, env, tensors, [len(column) for column in columns])
    weights = unflatten_dict({tuple(name.split("/")): x for name, x in tensors.items()})
    scores, generations, seeds = columns
    return ProxySet(env=env, weights=weights, scores=scores, generations=generations, seeds=seeds,
                 config=config, path=path)  # fmt: skip


def _proxy_of(config: LearnConfig, option: str, kind: str | None) -> ProxyEnv:
    require(kind in (None, config.proxy.name), option, f"hold proxies learned with proxy={kind}",
            "these are what is studied", f"proxy={config.proxy.name}",
            f"{option} to a file of those")  # fmt: skip
    return make_proxy(config.env.make(), config.proxy)


def _set_of_one(source: str | Path, option: str, kind: str | None) -> ProxySet:
    proxy = proxy_io.load_proxy(source)
    stored = proxy.metadata
    return ProxySet(
        env=_proxy_of(proxy.config, option, kind),
        weights=jax.tree.map(lambda x: np.asarray(x)[None], proxy.params.weights),
        scores=np.array([stored.get("score", np.nan)]),
        generations=np.array([stored.get("generation", -1)]),
        seeds=np.array([stored.get("seed", -1)]),
        config=proxy.config,
        path=proxy.path,
    )


def _check_shapes(
    path: Path, option: str, env: ProxyEnv, tensors: dict[str, np.ndarray], counts: list[int]
) -> None:
    expected = flatten_dict(jax.eval_shape(env.init_weights, jax.random.key(0)), sep="/")
    wanted = {name: (counts[0], *x.shape) for name, x in expected.items()}
    shapes = {name: x.shape for name, x in tensors.items()}
    if shapes != wanted or len(set(counts)) > 1 or counts[0] < 1:
        raise ConfigError(
            f"{option} must hold the tensors of the network in its metadata for each proxy, as "
            f"they are its weights; {path} has {shapes} in place of {wanted}, and {counts} "
            f"scores, generations and seeds. Run the experiment again that wrote it."
        )
