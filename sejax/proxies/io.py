"""Proxies from and to files: `save`, `load`, and what is known of a stored proxy."""

import functools
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NoReturn, overload

import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from jaxtyping import PyTree

from sejax import envs, options
from sejax.agents import Agent, AgentConfig, make_agent
from sejax.envs import Task, TaskSpec
from sejax.envs.environment import Environment
from sejax.ops import checksummed
from sejax.ops.files import write_bytes
from sejax.options import ConfigError, as_python, registry, require, require_known, shortened, told
from sejax.options.plain import from_plain, to_plain
from sejax.proxies import ProxyConfig, ProxyEnv, header
from sejax.proxies.header import Header, Stored, check_tensors
from sejax.training import TrainingConfig


@dataclass(frozen=True, kw_only=True, eq=False)
class _Loaded:
    """What is common to a stored proxy and a set of them.

    Attributes:
      env: the SE or RN, a gymnax environment.
      config: configuration that it was learned with, nested plain values.
      discount: gamma of the agent that it was learned with.
      path: the file.
    """

    env: ProxyEnv
    config: dict[str, Any] = field(repr=False)
    discount: float
    path: Path

    @property
    def task(self) -> Task:
        """The real task; only its spaces if it cannot be made here and an SE needs no more."""
        return self.env.task

    def learned_with(self, group: str) -> Any:
        """A part of the configuration that it was learned with, such as `es`.

        For its agents see `learned_agents`, for its training `sejax.training_of`.

        Raises:
          ConfigError: for an unknown part, and if the file lacks the part, or names one that is not
            registered, because a file's names are never imported.

        Example:
          >>> load_proxy("cliff_walking-rn").learned_with("es").population_size
          16
        """
        require_known("group", group, registry.GROUPS.keys() - {"agent"})
        return header.configured(group, self.config.get(group), self.path.name)

    def learned_agents(self) -> dict[str, Any]:
        """The agent that it was learned with, or the mixture of agents, by their keys.

        Raises:
          ConfigError: as `learned_with`.

        Example:
          >>> list(load_proxy("cliff_walking-rn").learned_agents())
          ['q_learning']
        """
        agents = self.config["agents"]
        return {x: header.configured("agent", agents[x], self.path.name) for x in agents}


@dataclass(frozen=True, kw_only=True, eq=False)
class Proxy(_Loaded):
    """A stored proxy.

    Attributes:
      env: the SE or RN, a gymnax environment whose `default_params` are the params.
      params: its `EnvParams`: the weights, and the discount of the agent it was learned with.
      record: what is known of it, such as `score`, `generation` and `seed`.
      config: configuration that it was learned with, nested plain values.
      discount: gamma of the agent that it was learned with.
      path: the file.
    """

    params: Any = field(repr=False)
    record: dict[str, Any] = field(repr=False)

    @property
    def fingerprint(self) -> str:
        """Eight hexadecimal digits that tell its weights from others."""
        return fingerprint(self.params.weights)


def fingerprint(weights: PyTree) -> str:
    """Eight hexadecimal digits that tell nested weights from others."""
    flat = flatten_dict(weights, sep="/")
    content = b"".join(np.ascontiguousarray(flat[name]).tobytes() for name in sorted(flat))
    return hashlib.sha256(content).hexdigest()[:8]


@dataclass(frozen=True, kw_only=True, eq=False)
class ProxySet(_Loaded):
    """Proxies that share a configuration, and hence every compiled program.

    `proxies[i]` is a `Proxy`; a slice, indices or a mask give a smaller set, as with NumPy.

    Attributes:
      env: the SE or RN that they share; its `default_params` are random.
      weights: leaves `[proxy, ...]`, NumPy float32. To `vmap` over the proxies:
        `vmap(lambda w: f(env.params(w, discount)))(weights)`.
      records: what is known of each proxy: `score` (incumbent mean for which it was chosen),
        `generation` (in which it was measured) and `seed` (of its run).
      config: configuration that they were learned with, nested plain values, with the first seed.
      discount: gamma of the agent that they were learned with.
      path: the file.
    """

    weights: PyTree = field(repr=False)
    records: tuple[dict[str, Any], ...] = field(repr=False)

    def __len__(self) -> int:
        return len(self.records)

    @overload
    def __getitem__(self, index: int) -> Proxy: ...
    @overload
    def __getitem__(self, index: slice | Sequence[int] | np.ndarray) -> "ProxySet": ...
    def __getitem__(self, index: int | slice | Sequence[int] | np.ndarray) -> "Proxy | ProxySet":
        numbers = np.arange(len(self))[index]
        weights = jax.tree.map(lambda leaf: leaf[numbers], self.weights)
        if numbers.ndim:
            records = tuple(self.records[number] for number in numbers)
            return replace(self, weights=weights, records=records)
        params = self.env.params(jax.tree.map(jax.numpy.asarray, weights), self.discount)
        shared = {x.name: getattr(self, x.name) for x in fields(_Loaded)}
        shared["env"] = self.env.with_default_params(params, self.config)
        return Proxy(params=params, record=self.records[numbers], **shared)

    @property
    def scores(self) -> np.ndarray:
        """`[proxy]` float64; nan where a score is not known."""
        return np.array([record.get("score") for record in self.records], float)

    @property
    def seeds(self) -> np.ndarray:
        """`[proxy]` int; -1 where a seed is not known."""
        return np.array([record.get("seed", -1) for record in self.records])

    def ranked(self, count: int, worst: bool = False) -> "ProxySet":
        """The `count` best proxies, best first, or the worst; proxies without a score come last."""
        scores = np.nan_to_num(self.scores, nan=np.inf if worst else -np.inf)
        order = np.argsort(scores, kind="stable")
        order = order if worst else order[::-1]
        return self[order[:count]]


def _stored_env(proxy: ProxyEnv | Proxy | ProxySet) -> tuple[ProxyEnv, Mapping[str, Any]]:
    """The environment of a stored proxy, and the configuration that it was learned with."""
    if isinstance(proxy, _Loaded):
        return proxy.env, proxy.config
    if isinstance(proxy, ProxyEnv) and proxy.learned_config is not None:
        return proxy, proxy.learned_config
    fix = "Set env, params = sejax.load(source)."
    raise ConfigError("proxy", "must be a stored one", got=type(proxy).__name__, fix=fix)


def agent_of(proxy: ProxyEnv | Proxy | ProxySet, name: str | None = None) -> Agent:
    """A fresh agent like those that a stored proxy was learned with, and its exploration.

    Args:
      proxy: the environment of `sejax.load`, or what `load_proxy` and `load_set` return.
      name: of one of several agents; None for the first, by the alphabet.

    Raises:
      ConfigError: for a proxy that is not stored, or was not learned with such an agent.

    Example:
      >>> env, params = load("cartpole")  # learned with ddqn, ppo and td3_discrete
      >>> agent_of(env, "ppo").spec.learns_from
      0
    """
    env, config = _stored_env(proxy)
    stored = config["agents"]
    require(stored, "proxy", "must have been learned with an agent", fix="Use sejax.make_agent.")
    name = next(iter(stored)) if name is None else name
    require_known("name", name, stored)
    agent = header.configured("agent", stored[name], env.name)
    explored = config.get("exploration", {"name": "none"})
    exploration = header.configured("exploration", explored, env.name)
    return make_agent(agent, env.task, exploration, config.get("agent_hparams") == "varied")


def training_of(
    proxy: ProxyEnv | Proxy | ProxySet, agent: AgentConfig | None = None
) -> TrainingConfig:
    """How long agents trained on a stored proxy when it was learned.

    Another agent may begin to learn later than all agents that the proxy was learned with. Ten long
    initial episodes, or a rollout of PPO, could use up a step budget. So the budget grows by the
    additional wait. The number of episodes grows as much, because an episode may have one step.

    Args:
      proxy: the environment of `sejax.load`, or what `load_proxy` and `load_set` return.
      agent: configuration of another agent that is to train on it. None for the training as it was.

    Raises:
      ConfigError: for a proxy that is not stored, or whose file has no training.

    Example:
      >>> training_of(load_proxy("cartpole")).stop_rule
      'never'
    """
    env, config = _stored_env(proxy)
    stored: Any = config.get("training")
    rule = f"must be given for {shortened(env.name)}, whose file does not tell it; got none"
    require(isinstance(stored, Mapping), "training", rule, use="sejax.TrainingConfig(...)")
    training = from_plain(TrainingConfig, stored, "training")
    agents = config["agents"].values()
    limits = (env.max_steps, env.task.max_steps)
    if agent is None or training.max_steps is None or to_plain(agent, "agent") in agents:
        return training
    registry.require_part("agent", AgentConfig, agent, "Pass an object, such as sejax.PPOConfig().")
    registered = [x for x in agents if header.is_known("agent", x)]
    learned = [header.configured("agent", x, env.name) for x in registered]
    wait = max((x.steps_before_learning(*limits) for x in learned), default=0)
    longer = max(0, agent.steps_before_learning(*limits) - wait)
    max_episodes = training.max_episodes + longer
    return replace(training, max_steps=training.max_steps + longer, max_episodes=max_episodes)


# --- writing --------------------------------------------------------------------------------------


def save(
    path: str | Path,
    env: ProxyEnv,
    weights: PyTree,
    config: Mapping[str, Any] | None = None,
    discount: float | None = None,
    **record: Any,
) -> None:
    """Writes a proxy atomically.

    Args:
      path: the file, `*.safetensors`; its folder is made if there is none.
      env: the proxy.
      weights: in the form of its `init_weights`; kept as float32.
      config: configuration that it was learned with, nested plain values. Those of the task and
        the proxy are taken from `env`.
      discount: gamma of the agent that it was learned with, which a potential-based RN needs; 1 if
        it is not given.
      **record: plain values to keep with it, such as `score`, `generation` and `seed`.

    Raises:
      ConfigError: for weights that are not the proxy's or not finite, a potential-based RN without
        a discount, or a configuration or record that `load` would refuse. An older file stays.
      OSError: if it cannot be written; an older file stays as it was.

    Example:
      >>> import tempfile
      >>> env, params = load("cartpole")
      >>> path = Path(tempfile.mkdtemp(), "mine.safetensors")
      >>> save(path, env, params.weights, score=195.0)
      >>> load_proxy(path).record
      {'score': 195.0}
    """
    save_set(path, env, [weights], [record], config, discount, is_set=False)


def save_set(
    path: str | Path,
    env: ProxyEnv,
    weights: Sequence[PyTree],
    records: Sequence[Mapping[str, Any]],
    config: Mapping[str, Any] | None = None,
    discount: float | None = None,
    is_set: bool = True,
) -> None:
    """Writes a set of proxies atomically; arguments as in `save`, with a record for each.

    With `is_set=False` the file holds a single proxy, as `save` writes it.

    Raises:
      ConfigError: as `save`.
      OSError: if it cannot be written; an older file stays as it was.
    """
    require(isinstance(env, ProxyEnv), "env", "must be a proxy's. Write save(path, env, weights).")
    require(records, "records", "must have one for each proxy; got none.")
    rule = "must be given for a potential-based RN; got None. Set discount=params.discount."
    require(discount is not None or not env.config.needs_discount, "discount", rule)
    gamma = 1.0 if discount is None else discount
    gamma = options.checked(gamma, options.Fraction, "discount", 1.0)
    try:
        stacked = jax.tree.map(lambda *x: np.stack(x).astype(np.float32), *weights)
        tensors = flatten_dict(stacked, sep="/")
    except (ValueError, TypeError, AssertionError) as error:
        rule = "must be numbers in the form of init_weights, the same for each proxy"
        raise ConfigError("weights", rule, got=told(error), use="params.weights") from error
    _require_weights("weights", tensors, env, len(records), "params.weights")
    if not is_set:
        tensors = {name: x[0] for name, x in tensors.items()}
    # A name that is not registered, as the registered one may make another task.
    origin = env.task.origin or {"name": f"{env.task.name}{header.BY_HAND}"}
    # `run_dir` would be a path of this machine.
    parts = {"proxy": to_plain(env.config, "proxy"), "env": origin, "run_dir": None}
    try:
        config = dict(config or {})
        if "training" in config:  # whose fields may be left out
            parts["training"] = to_plain(from_plain(TrainingConfig, config["training"], "training"))
        stored = Header(
            format_version=header.FORMAT_VERSION,
            task=env.task.name,
            interface=env.task.interface,
            config={**config, **parts},
            discount=gamma,
            is_set=is_set,
            proxies=[{name: as_python(x) for name, x in record.items()} for record in records],
        )
        data = checksummed.pack(tensors, header.KIND, vars(stored))
        checksummed.unpack(data, header.KIND)  # raises if `load` will
    except (LookupError, ValueError, TypeError, AttributeError, RecursionError) as error:
        rule = "must be plain values that sejax.load takes, with numbers for score and seed"
        use = "sejax.config(...).plain()"
        raise ConfigError("config", f"and record {rule}", got=told(error), use=use) from error
    write_bytes(Path(path).expanduser(), data)


def _require_weights(
    field: str, tensors: Mapping[str, np.ndarray], env: ProxyEnv, count: int, fix: str
) -> None:
    """Checks the tensors of `count` proxies, by `network/layer/parameter`."""
    weights = jax.eval_shape(env.init_weights, jax.random.key(0))
    shapes = {name: (count, *x.shape) for name, x in flatten_dict(weights, sep="/").items()}
    check_tensors(field, tensors, shapes, fix)


# --- reading --------------------------------------------------------------------------------------


def load(
    source: str | Path, task: Task | None = None, proxy: ProxyConfig | None = None
) -> tuple[ProxyEnv, Any]:
    """Loads a proxy as a gymnax environment and its params (the weights).

    The discount of a potential-based RN is that of the agent it was learned with. For an agent with
    another discount take `params.replace(discount=...)`; `make_trainer` does so by itself.

    Args:
      source: a run directory, a safetensors file, the name of a proxy that ships with the package
        (`sejax.pretrained()`), or one on the Hugging Face Hub: `hf://USER/REPO`.
      task: the real task; needed if no registered name makes it, because a file's names are never
        imported. An SE with initial states of its own needs neither the task nor the task's
        package: its file has the spaces, but no solved score. Only resetting or stepping the real
        task then fails.
      proxy: the proxy's configuration; needed for a kind of proxy of your own.

    Returns:
      The environment, and its params. The environment's `default_params` are the same params, for
      wrappers that leave them out.

    Raises:
      ConfigError: if there is no such proxy, the file is damaged or of another format, it holds
        several, its task or kind is not known, or the task given differs from the file's in its
        spaces or, for an SE, in its step limit.

    Example:
      >>> env, params = load("cartpole")
      >>> obs, state = env.reset(jax.random.key(0), params)
      >>> obs.shape
      (4,)
    """
    loaded = load_proxy(source, task, proxy)
    return loaded.env, loaded.params


def load_proxy(
    source: str | Path,
    task: Task | None = None,
    proxy: ProxyConfig | None = None,
    option: str = "source",
) -> Proxy:
    """As `load`, with the real task, the configuration and the record.

    Args:
      source: as in `load`.
      task: as in `load`.
      proxy: as in `load`.
      option: name of `source` in messages.
    """
    return load_set(source, task, proxy, option, single=True)[0]


def load_set(
    source: str | Path,
    task: Task | None = None,
    proxy: ProxyConfig | None = None,
    option: str = "source",
    kind: str | None = None,
    single: bool = False,
) -> ProxySet:
    """Loads a set of proxies; a single stored one is a set of one.

    Args:
      source: a file of `save_set`, or whatever `load` takes.
      task: as in `load`.
      proxy: as in `load`.
      option: name of `source` in messages.
      kind: kind that the proxies must have, such as "se"; None for any.
      single: whether the file must hold one proxy.

    Raises:
      ConfigError: as `load`, or if its proxies are of another kind.

    Example:
      >>> rns = load_set("cliff_walking-rn")  # or a file in results/reward_networks
      >>> len(rns), rns[0].params.discount
      (1, 0.8)
    """
    if kind is not None and ":" not in str(kind):  # of no module
        require_known("kind", kind, registry.names("proxy"))
    stored = header.read(source, option, () if kind is None else (kind,), single)
    env = _env_of(stored, task, proxy, option)
    path, tensors, learned = stored
    tensors = tensors if learned.is_set else {name: x[None] for name, x in tensors.items()}
    _require_weights(option, tensors, env, len(learned.proxies), "a file that sejax has written")
    return ProxySet(
        env=env,
        weights=unflatten_dict(tensors, sep="/"),
        records=tuple(learned.proxies),
        config=learned.config,
        discount=learned.discount,
        path=path,
    )


def _env_of(stored: Stored, task: Task | None, proxy: ProxyConfig | None, option: str) -> ProxyEnv:
    """The environment that a file's header describes; task and configuration may be given."""
    is_task = isinstance(task, Task | None)
    require(is_task, "task", "must be a sejax.Task", got=task, fix="See sejax.envs.make.")
    learned = stored.header
    where = stored.path.name
    proxy = proxy or header.configured("proxy", learned.config["proxy"], where)
    real = task
    if real is None:
        try:
            real = envs.make_from(header.configured("env", learned.config["env"], where))
        except ConfigError as error:
            if proxy.needs_task:
                raise
            spec = json.dumps([learned.interface, learned.config["env"]], sort_keys=True)
            real = _absent_task(learned.task, spec, str(error))
    got = f"{shortened(learned.task, 30)} in {where}"
    require(learned.task == real.name, option, f"must be of the task {real.name}", got=got)
    if task is not None:
        limit = {"max_steps": task.max_steps} if proxy.has_real_dynamics else {}
        spaces = shortened(learned.interface, 90)
        got = shortened(task.interface, 90)
        rule = f"must have spaces and step limit of {shortened(where, 40)}, {spaces}; got {got}."
        require(learned.interface | limit == task.interface, "task", rule)
    return registry.make("proxy", proxy, real)


# --- a task that cannot be made here --------------------------------------------------------------


class AbsentEnv(Environment):
    """The spaces of a task that cannot be made here, for an SE that needs no more of it.

    Such an SE can be loaded without the package that its task needs, or on a device that the task
    does not run on. `reset_env` and `step_env` raise the reason as a `ConfigError`.
    """

    def __init__(self, spec: TaskSpec, reason: str):
        super().__init__(spec)
        self._reason = reason

    def reset_env(self, *_: Any, **__: Any) -> NoReturn:
        raise ConfigError("task", f"cannot run here: {self._reason}")

    step_env = reset_env


@functools.cache
def _absent_task(name: str, plain_spec: str, reason: str) -> Task:
    """A task that is known only from a proxy's file; built once.

    Args:
      name: of the task.
      plain_spec: its interface and its configuration, as JSON.
      reason: why the task itself cannot be made.
    """
    interface, origin = json.loads(plain_spec)
    spec = TaskSpec.of_interface(interface)
    task = Task(name=name, env=AbsentEnv(spec, reason), max_steps=spec.max_steps)
    vars(task)["origin"] = origin
    return task


# --- gymnax ---------------------------------------------------------------------------------------


def register_gymnax() -> list[str]:
    """Registers the shipped proxies with gymnax as `sejax/<name>`; may be called repeatedly.

    Returns:
      The ids, for `gymnax.make`. The environment's `default_params` are the learned weights.
    """
    from gymnax import registration  # imports all of gymnax's environments, which takes a second

    paths = {f"sejax/{name}": path for name, path in header.pretrained_files().items()}
    for env_id in paths.keys() - set(registration.registered_envs):
        registration.register(env_id, lambda path=paths[env_id]: load(path)[0])
    return list(paths)
