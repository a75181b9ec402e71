"""Names to objects: where the name of a plugin becomes code.

Everything that a configuration chooses by name is a *plugin* of a group: a dataclass whose fields
are its options and whose `make` builds the object, or a function that builds it, whose keyword
parameters are then its options.

============= ======================= ==============================================
group         entry points            `make(...)` gives
============= ======================= ==============================================
`env`         `sejax.envs`            `()` a `sejax.Task`
`agent`       `sejax.agents`          `(task)` a `sejax.Agent`
`exploration` `sejax.explorations`    `(agent, task)` a `sejax.Agent`
`proxy`       `sejax.proxies`         `(task)` a `sejax.ProxyEnv`
`objective`   `sejax.objectives`      `(task)` a `sejax.Objective`
`es`          `sejax.strategies`      `(num_dims)` a `sejax.Strategy`
`tracker`     `sejax.trackers`        `(run)` a `sejax.runs.trackers.Tracker`
`machines`    `sejax.machines`        `(config)`: see `sejax.runs.workers`
============= ======================= ==============================================

A name is one that comes with sejax, one that an installed package offers as an entry point, or
`module:attribute`, which imports the module. What reads a file says which of these may be imported
(`imports`): those that the user has typed, or none.

A configuration is written as plain values (`describe`) and read back (`configure`); what a value
may be is in `sejax.options.plain`.
"""

import copy
import dataclasses
import functools
import importlib
import importlib.metadata
import importlib.util
import inspect
import operator
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from sejax.options import ConfigError, Options, place_of, require, shortened, told, unknown_name
from sejax.options.plain import fields_of, from_plain, require_typed, to_plain

if TYPE_CHECKING:
    from sejax.options.parts import Makes

T = TypeVar("T")


class Group(NamedTuple):
    """A kind of plugin.

    Attributes:
      entry_points: group of entry points where packages offer more of it.
      makes: `module:attribute` of the class of what `make` returns.
      arguments: what `make` is given, for messages and for functions in a dataclass's place.
      base: `module:attribute` of the class that each plugin's dataclass is a subclass of.
    """

    entry_points: str
    makes: str
    arguments: tuple[str, ...]
    base: str = "builtins:object"


GROUPS = {
    "env": Group("sejax.envs", "sejax.envs.base:Task", ()),
    "agent": Group("sejax.agents", "sejax.agents:Agent", ("task",), "sejax.agents:AgentConfig"),
    "exploration": Group(
        "sejax.explorations",
        "sejax.agents:Agent",
        ("agent", "task"),
        "sejax.agents:ExplorationConfig",
    ),
    "proxy": Group(
        "sejax.proxies", "sejax.proxies:ProxyEnv", ("task",), "sejax.proxies:ProxyConfig"
    ),
    "objective": Group("sejax.objectives", "sejax.objectives:Objective", ("task",)),
    "es": Group("sejax.strategies", "sejax.es.base:Strategy", ("num_dims",)),
    "tracker": Group("sejax.trackers", "sejax.runs.trackers:Tracker", ("run",)),
    "machines": Group("sejax.machines", "contextlib:AbstractContextManager", ("config",)),
}
_EVOSAX = ("cma_es", "cr_fm_nes", "open_es", "pgpe", "sep_cma_es", "snes", "xnes")
# Names that come with sejax.
BUILT_IN = {
    "env": {
        "cartpole": "sejax.envs.classic:CartPole",
        "cartpole_v1": "sejax.envs.classic:CartPoleV1",
        "acrobot": "sejax.envs.classic:Acrobot",
        "cliff_walking": "sejax.envs.gridworld:CliffWalking",
        "gridworld_2x2": "sejax.envs.gridworld:GridWorld2x2",
        "mountain_car": "sejax.envs.classic:MountainCar",
        "mountain_car_continuous": "sejax.envs.classic:MountainCarContinuous",
        "pendulum": "sejax.envs.classic:Pendulum",
        "halfcheetah": "sejax.envs.mujoco.tasks:HalfCheetah",
        "hopper": "sejax.envs.mujoco.tasks:Hopper",
        "walker2d": "sejax.envs.mujoco.tasks:Walker2d",
        "swimmer": "sejax.envs.mujoco.tasks:Swimmer",
        "inverted_pendulum": "sejax.envs.mujoco.tasks:InvertedPendulum",
        "ant": "sejax.envs.mujoco.tasks:Ant",
        "reacher": "sejax.envs.mujoco.tasks:Reacher",
    },
    "agent": {
        "ddqn": "sejax.agents.dqn:DDQNConfig",
        "dueling_ddqn": "sejax.agents.dqn:DuelingDDQNConfig",
        "dqn": "sejax.agents.dqn:DQNConfig",
        "td3": "sejax.agents.td3:TD3Config",
        "td3_discrete": "sejax.agents.td3:DiscreteTD3Config",
        "ppo": "sejax.agents.ppo:PPOConfig",
        "sac": "sejax.agents.sac:SACConfig",
        "q_learning": "sejax.agents.tabular:QLearningConfig",
        "sarsa": "sejax.agents.tabular:SARSAConfig",
    },
    "exploration": {
        "none": "sejax.agents.base:NoExploration",
        "icm": "sejax.agents.exploration:ICMConfig",
        "count_based": "sejax.agents.exploration:CountBasedConfig",
    },
    "proxy": {
        "se": "sejax.proxies.synthetic:SyntheticConfig",
        "rn": "sejax.proxies.reward:RewardConfig",
    },
    "objective": {
        "max_reward": "sejax.objectives:MaxReward",
        "reward_threshold": "sejax.objectives:RewardThreshold",
        "auc": "sejax.objectives:AUC",
        "auc_sum": "sejax.objectives:AUCSum",
    },
    "es": {
        "nes": "sejax.es.nes:NESConfig",
        **dict.fromkeys(_EVOSAX, "sejax.es.evosax:EvosaxConfig"),
    },
    "tracker": {
        "none": "sejax.runs.trackers:NoTracker",
        "tensorboard": "sejax.runs.trackers:TensorBoardConfig",
    },
    "machines": {"local": "sejax.runs.workers:LocalConfig", "ray": "sejax.runs.workers:RayConfig"},
}
# Beginnings of a task's name: a dataclass with a field `name`.
PREFIXES = {"gymnax/": "sejax.envs.gymnax:GymnaxTask", "stoa/": "sejax.envs.gymnax:GymnaxTask"}


# --- names ---------------------------------------------------------------------------------------


def names(group: str) -> list[str]:
    """The registered names: those that come with sejax, then those of installed packages."""
    return [*BUILT_IN[group], *_offered(group)]


def is_registered(group: str, name: str) -> bool:
    """Whether a name is known without importing a module that it names."""
    return _path_of(group, name) is not None


def find(group: str, name: str, imports: Collection[str] | None = None) -> Any:
    """The dataclass that a name stands for.

    Args:
      group: one of `GROUPS`.
      name: see the module.
      imports: each `module:attribute` that may be imported; None: any.

    Raises:
      ConfigError: for an unknown name, a module that cannot or may not be imported, or an
        attribute that is no plugin.
    """
    if name in BUILT_IN[group]:
        return _attribute(BUILT_IN[group][name])
    path = _path_of(group, name)
    if path is None and ":" in name:
        path = name
        require_typed(group, path, imports)
    if path is None:
        raise unknown_name(group, name, [*names(group), *_meant(name)])
    cls = _as_dataclass(group, name, imported(group, path))
    if f"{cls.__module__}:{cls.__qualname__}" != name:
        _NAMES[cls] = name
    return cls


def name_of(group: str, config: "Makes[Any]") -> str:
    """The name by which `find` finds a configuration's class again."""
    cls = type(config)
    if _is_one_of_many(cls):
        return str(config.name)  # type: ignore[attr-defined]
    path = f"{cls.__module__}:{cls.__qualname__}"
    built_in = {path: name for name, path in BUILT_IN[group].items()}
    return _NAMES.get(cls) or built_in.get(path, path)


def paths_in(words: Iterable[str]) -> list[str]:
    """Each `module:attribute` in words.

    Example:
      >>> paths_in(["env=mine:Room", "agents=[ddqn,mine:A]", "proxy=hf://me/se", "storage=x://a:b@c"])
      ['mine:Room', 'mine:A']
    """
    path = r"(?<![^=\[,+(\s'\"])[\w.]+:[\w.]+(?![^\],+)\s'\"])"
    return [match for word in words for match in re.findall(path, word)]


_NAMES: dict[type, str] = {}  # of classes that were found by another name than their path


@functools.cache
def _offered(group: str) -> dict[str, str]:
    """Entry points of installed packages; a name of sejax's own cannot be taken over."""
    points = importlib.metadata.entry_points(group=GROUPS[group].entry_points)
    return {x.name: x.value for x in points if x.name not in BUILT_IN[group]}


def _path_of(group: str, name: str) -> str | None:
    """The `module:attribute` that a registered name stands for."""
    prefixes = PREFIXES if group == "env" else {}
    by_prefix = (path for start, path in prefixes.items() if name.startswith(start))
    return (BUILT_IN[group] | _offered(group)).get(name) or next(by_prefix, None)


def _is_one_of_many(cls: type) -> bool:
    """Whether a class has a family of names, so that the name is one of its fields."""
    return dataclasses.is_dataclass(cls) and "name" in fields_of(cls)


# --- configurations ------------------------------------------------------------------------------


def configure(group: str, values: Mapping[str, Any], imports: Collection[str] | None = None) -> Any:
    """The configuration that plain values describe: the field `name`, and those of the plugin.

    Args:
      group: one of `GROUPS`.
      values: by the names of the fields.
      imports: each `module:attribute` that may be imported; None: any.

    Raises:
      ConfigError: for an unknown name or field, or a value that cannot be.

    Example:
      >>> configure("agent", {"name": "q_learning", "discount": 0.9}).discount
      0.9
    """
    is_choice = isinstance(values, Mapping) and isinstance(values.get("name"), str)
    message = f"must be a choice with its fields; got {shortened(values)}. Set {group}=NAME."
    require(is_choice, group, message)
    cls = find(group, values["name"], imports)
    fields = {k: v for k, v in values.items() if k != "name" or _is_one_of_many(cls)}
    known = fields_of(cls)
    for field in [name for name in fields if name not in known]:
        others = [x for x in BUILT_IN[group] if field in fields_of(find(group, x))]
        message = f"is a field of {group}={', '.join(others)}. Set one of them."
        require(not others, f"{group}.{field}", message)
    return from_plain(cls, fields, group, imports)


def describe(group: str, config: "Makes[Any]") -> dict[str, Any]:
    """Inverse of `configure`."""
    return {"name": name_of(group, config), **to_plain(config)}


def make(group: str, config: "Makes[T]", *arguments: Any) -> T:
    """What a configuration configures, built once for equal configurations and arguments.

    Compiled programs are cached by the identity of what they were built from, so that a new
    instance would compile again. A configuration that cannot be hashed is equal to itself alone.

    Raises:
      ConfigError: if it makes something of another kind, or cannot be made.
    """
    key = (group, config if is_hashable(config) else id(config), *arguments)
    if key in _PARTS:
        part: T = _PARTS[key][1]
    else:
        part, cls = config.make(*arguments), _attribute(GROUPS[group].makes)
        name = shortened(name_of(group, config))
        message = f"must make a sejax.{cls.__name__}; got {type(part).__name__} from {name}."
        require(isinstance(part, cls), group, message)
        _PARTS[key] = config, part  # with config, its id stays its own
    return part


_PARTS: dict[tuple[Any, ...], tuple[Any, Any]] = {}


def is_hashable(config: object) -> bool:
    """Whether a configuration serves as a key: a frozen dataclass of hashable values does."""
    try:
        hash(config)
    except TypeError:
        return False
    return True


def require_package(group: str, config: "Makes[Any]") -> None:
    """Checks that the package which a plugin names as its `package` is there; imports nothing.

    Raises:
      ConfigError: if it is not.
    """
    package, name = getattr(config, "package", None), name_of(group, config)
    is_there = package is None or importlib.util.find_spec(package) is not None
    message = f"must be installed; got {name} without the package {package}. Install it with pip"
    require(is_there, group, f"{message} install 'sejax[{name}]'.")


# --- plugins -------------------------------------------------------------------------------------


def _attribute(path: str) -> Any:
    module, _, attribute = path.partition(":")
    return operator.attrgetter(attribute)(importlib.import_module(module))


def require_path(field: str, path: str) -> None:
    """Checks that a text is of the form `module:attribute`.

    Raises:
      ConfigError: if it is not.
    """
    module, _, attribute = path.partition(":")
    is_path = all(map(str.isidentifier, [*module.split("."), *attribute.split(".")]))
    got, fix = (shortened(x, 60) for x in (path, *_meant(path), "my_module:MyClass")[:2])
    message = f"must be a name or module:attribute; got {got}. Set {field}={fix}."
    require(is_path and not module.endswith(".py"), field, message)


def _meant(text: str) -> list[str]:
    """The `module:attribute` that a dotted name or the path of a file may stand for."""
    match = re.fullmatch(r"([\w./]*?\w)(?:\.py)?[:.](\w+)", text)
    return [f"{match[1].strip('./').replace('/', '.')}:{match[2]}"] if match else []


def imported(field: str, path: str) -> Any:
    """What `module:attribute` names, which is imported.

    Raises:
      ConfigError: if it is not of this form, the module cannot be imported, or has nothing of this
        name.
    """
    require_path(field, path)
    try:
        return _attribute(path)
    except Exception as error:
        hint = "" if place_of(error) else " Is its folder in PYTHONPATH?"
        got = shortened(path, 60)
        message = f"{field} must name what can be imported; {got} raised {told(error)}.{hint}"
        raise ConfigError(message, field) from error


def _as_dataclass(group: str, name: str, plugin: Any) -> Any:
    """The dataclass that a plugin is, or that a function stands for."""
    base, arguments = _attribute(GROUPS[group].base), GROUPS[group].arguments
    if inspect.isfunction(plugin):
        return _from_function(group, name, plugin)
    is_config = dataclasses.is_dataclass(plugin) and hasattr(plugin, "make")
    is_fit = isinstance(plugin, type) and is_config and issubclass(plugin, base)
    must = f"must name a function, or a dataclass with make({', '.join(arguments)}) that derives"
    must += f" from {base.__module__}.{base.__name__}; got {shortened(name)}, which is"
    require(is_fit, group, f"{must} {shortened(plugin)}.")
    return plugin


@functools.cache
def _from_function(group: str, name: str, function: Callable[..., Any]) -> type:
    """A dataclass whose fields are a function's parameters beyond those that `make` is given."""
    arguments, signature = GROUPS[group].arguments, inspect.signature(function)
    parameters = list(signature.parameters.values())
    is_open = any(p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD) for p in parameters)
    must = f"must take ({', '.join((*arguments, 'option=default, ...'))}), each option a field; got"
    is_fit = len(parameters) >= len(arguments) and not is_open
    require(is_fit, group, f"{must} {shortened(f'{name}{signature}')}.")
    options = parameters[len(arguments) :]

    def make(self: object, *parts: object) -> Any:
        return function(*parts, **{p.name: getattr(self, p.name) for p in options})

    fields = []
    for p in options:
        field: Any = dataclasses.field() if p.default is p.empty else p.default
        if not is_hashable(p.default):  # such as a list
            field = dataclasses.field(default_factory=functools.partial(copy.copy, p.default))
        fields.append((p.name, Any if p.annotation is p.empty else p.annotation, field))
    base = _attribute(GROUPS[group].base)
    bases = (base if issubclass(base, Options) else Options,)
    namespace = {"make": make, "__doc__": function.__doc__, "__module__": function.__module__}
    return dataclasses.make_dataclass(
        function.__name__, fields, bases=bases, namespace=namespace, frozen=True, kw_only=True
    )
