"""From names to objects: where the name of a plugin becomes code.

Everything that a configuration chooses by name is a *plugin* of a group. A plugin is a dataclass,
whose fields are its options and whose `make` builds the object. Or it is a function that builds the
object; its keyword parameters are its options.

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
`machines`    `sejax.machines`        `(config)`: see `sejax.runs.chunks`
============= ======================= ==============================================

A name comes with sejax, is an entry point of an installed package, or is `module:attribute`, which
imports the module. Code that reads a file calls `plain.require_typed` first: what a file names is
imported only if the user has typed it too.

`sejax.options.plain` makes configurations of plain values, and writes them.
"""

import copy
import dataclasses
import functools
import importlib.metadata
import inspect
import re
from collections.abc import Callable, Hashable
from pkgutil import resolve_name
from typing import Any, NamedTuple, Protocol, TypeVar, cast, overload, runtime_checkable

from sejax.options import ConfigError, Options, place_of, require, shortened, told, unknown_name

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


@runtime_checkable
class Makes(Protocol[T_co]):
    """A configuration that makes a part, such as an agent for a task."""

    @property
    def make(self) -> Callable[..., T_co]: ...


class Group(NamedTuple):
    """A kind of plugin.

    Attributes:
      entry_points: group of entry points where packages offer more plugins.
      makes: `module:attribute` of the class of the objects that `make` returns.
      arguments: names of `make`'s arguments, for messages and for plugins that are functions.
      base: `module:attribute` of the class that each plugin's dataclass derives from.
    """

    entry_points: str
    makes: str
    arguments: tuple[str, ...]
    base: str = "builtins:object"


GROUPS = {
    "env": Group("sejax.envs", "sejax.envs.base:Task", ()),
    "agent": Group("sejax.agents", "sejax:Agent", ("task",), "sejax.agents:AgentConfig"),
    "exploration": Group(
        "sejax.explorations", "sejax:Agent", ("agent", "task"), "sejax.agents:ExplorationConfig"
    ),
    "proxy": Group("sejax.proxies", "sejax:ProxyEnv", ("task",), "sejax.proxies:ProxyConfig"),
    "objective": Group("sejax.objectives", "sejax.objectives:Objective", ("task",)),
    "es": Group("sejax.strategies", "sejax.es.base:Strategy", ("num_dims",)),
    "tracker": Group("sejax.trackers", "sejax.runs.trackers:Tracker", ("run",)),
    "machines": Group(
        "sejax.machines",
        "contextlib:AbstractContextManager",
        ("config",),
        "sejax.runs.config:MachinesConfig",
    ),
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
    "proxy": {
        "se": "sejax.proxies.synthetic:SyntheticConfig",
        "rn": "sejax.proxies.reward:RewardConfig",
    },
    "exploration": {
        "none": "sejax.agents.base:NoExploration",
        "icm": "sejax.agents.exploration:ICMConfig",
        "count_based": "sejax.agents.exploration:CountBasedConfig",
    },
    "es": {
        "nes": "sejax.es.nes:NESConfig",
        **dict.fromkeys(_EVOSAX, "sejax.es.evosax:EvosaxConfig"),
    },
    "objective": {
        "max_reward": "sejax.objectives:MaxReward",
        "reward_threshold": "sejax.objectives:RewardThreshold",
        "auc": "sejax.objectives:AUC",
        "auc_sum": "sejax.objectives:AUCSum",
    },
    "tracker": {
        "none": "sejax.runs.trackers:NoTracker",
        "tensorboard": "sejax.runs.trackers:TensorBoardConfig",
    },
    "machines": {"local": "sejax.runs.chunks:LocalConfig", "ray": "sejax.runs.ray:RayConfig"},
}
# What is chosen if nothing else makes a choice: a group's first name.
DEFAULTS = {group: {"name": next(iter(known))} for group, known in BUILT_IN.items()}
# Beginnings of names of tasks: a dataclass with a field `name` serves all names that begin so.
PREFIXES = {"gymnax/": "sejax.envs.gymnax:GymnaxTask"}


# --- names ---------------------------------------------------------------------------------------


def names(group: str) -> list[str]:
    """The registered names: first sejax's own, then the names of installed packages."""
    return [*_paths(group)]


def is_registered(group: str, name: str) -> bool:
    """Whether a name comes with sejax or an installed package; a `module:attribute` does not."""
    return _path_of(group, name) is not None


def find(group: str, name: str) -> Any:
    """The dataclass that a name stands for.

    Args:
      group: one of `GROUPS`.
      name: see the module's docstring.

    Raises:
      ConfigError: for an unknown name, a module that cannot be imported, or an attribute that is
        no plugin.
    """
    if name in BUILT_IN[group]:
        return resolve_name(BUILT_IN[group][name])
    path = _path_of(group, name)
    if path is None and ":" not in name:
        raise unknown_name(group, name, [*names(group), *_suggestions(name)])
    plugin = imported(group, path or name)
    if inspect.isfunction(plugin):
        plugin = _from_function(group, name, plugin)
    base = resolve_name(GROUPS[group].base)
    is_class = isinstance(plugin, type) and dataclasses.is_dataclass(plugin)
    is_fit = is_class and issubclass(plugin, base) and _can_make(group, plugin, base)
    rule = f"must name a function, or a dataclass with make({', '.join(GROUPS[group].arguments)})"
    rule += "" if base is object else f" that derives from {base.__module__}.{base.__name__}"
    require(is_fit, group, rule, got=f"{shortened(name, 40)}, which is {plugin}")
    # A registered class may serve several names, and then has such a field.
    is_free = path is not None or "name" not in plugin.__dataclass_fields__
    require(is_free, group, "must have no field `name`, which holds the choice", got=name)
    if f"{plugin.__module__}:{plugin.__qualname__}" != name:
        _NAMES[plugin] = name
    return plugin


def _can_make(group: str, plugin: type, base: type) -> bool:
    """Whether a class has its own `make`, which takes the group's arguments."""
    make = inspect.getattr_static(plugin, "make", None)
    is_own = make is not inspect.getattr_static(base, "make", None)
    is_field = "make" in inspect.getattr_static(plugin, "__dataclass_fields__")
    if is_field or not inspect.isfunction(make):  # such as a static method or a property
        return is_own
    try:  # of what is called: what a decorator wraps may take other arguments
        inspect.signature(make, follow_wrapped=False).bind(None, *GROUPS[group].arguments)
    except TypeError:
        return False
    return is_own


def name_of(group: str, config: object) -> str:
    """The name by which `find` finds a configuration's class again."""
    cls = type(config)
    if "name" in getattr(cls, "__dataclass_fields__", ()):  # the class serves several names
        return str(config.name)  # type: ignore[attr-defined]
    path = f"{cls.__module__}:{cls.__qualname__}"
    built_in = {path: name for name, path in BUILT_IN[group].items()}
    return _NAMES.get(cls) or built_in.get(path, path)


def key_of(name: str) -> str:
    """The key of an agent's name: `my_module_MyAgent` for `my_module:MyAgent`."""
    return re.sub(r"[^\w-]+", "_", name)


_NAMES: dict[type, str] = {}  # names of classes that were found by a name other than their path


@functools.cache
def _paths(group: str) -> dict[str, str]:
    """The `module:attribute` of each registered name; packages cannot replace sejax's own."""
    points = importlib.metadata.entry_points(group=GROUPS[group].entry_points)
    return BUILT_IN[group] | {x.name: x.value for x in points if x.name not in BUILT_IN[group]}


def _path_of(group: str, name: str) -> str | None:
    """The `module:attribute` that a registered name stands for."""
    by_prefix = PREFIXES.get(name[: name.find("/") + 1]) if group == "env" else None
    return _paths(group).get(name, by_prefix)


# --- objects -------------------------------------------------------------------------------------


@overload
def make(group: str, config: Makes[T], *arguments: Any) -> T: ...
@overload
def make(group: str, config: T | Makes[T], *arguments: Any) -> T: ...
def make(group: str, config: T | Makes[T], *arguments: Any) -> T:
    """The object that a configuration makes, built once for equal configurations and arguments.

    Compiled programs are cached by the identity of the objects that they were built from, so a new
    object would compile again. A configuration that cannot be hashed equals only itself.

    Args:
      group: one of `GROUPS`.
      config: the configuration; or the object itself, which is returned.
      *arguments: the arguments of `Makes.make`.

    Raises:
      ConfigError: if `config` is neither, or if it makes an object of another class or none.
    """
    cls = resolve_name(GROUPS[group].makes)
    if isinstance(config, cls | type) or not isinstance(config, Makes):
        return require_part(group, cls, config)
    key = (group, *map(_key, (config, *arguments)))
    if key not in _PARTS:
        part = config.make(*arguments)
        if not isinstance(part, cls):
            got = f"{type(part).__name__} from {name_of(group, config)}"
            raise ConfigError(group, f"must make a sejax.{cls.__name__}", got=got)
        _PARTS[key] = config, arguments, part  # while these are kept, no others get their ids
    return cast(T, _PARTS[key][-1])


_PARTS: dict[tuple[Any, ...], tuple[Any, ...]] = {}


def _key(value: object) -> object:
    """The value, or its id if it cannot be hashed."""
    try:
        hash(value)
    except TypeError:
        return id(value)
    return value


def require_part(group: str, cls: type[T], part: object, fix: str = "") -> T:
    """The part, if it is one of this class.

    Raises:
      ConfigError: for anything else.
    """
    fix = fix or "Pass an object; sejax.config([...]) takes names."
    require(isinstance(part, cls), group, f"must be a sejax.{cls.__name__}", got=part, fix=fix)
    return cast(T, part)


# --- plugins -------------------------------------------------------------------------------------


def require_path(field: str, path: str) -> None:
    """Checks that a text is of the form `module:attribute`.

    Raises:
      ConfigError: if it is not.
    """
    module, _, attribute = path.partition(":")
    is_path = all(map(str.isidentifier, [*module.split("."), *attribute.split(".")]))
    use = shortened((*_suggestions(path), "my_module:MyClass")[0], 60)
    rule = "must be a name or module:attribute"
    require(is_path and not module.endswith(".py"), field, rule, got=path, use=use)


def _suggestions(text: str) -> list[str]:
    """The `module:attribute` that the user may mean by a dotted name or the path of a file."""
    match = re.fullmatch(r"([./]*[^\W\d][\w./]*?)(?:\.py)?[:.]([^\W\d]\w*)", text)
    return [f"{match[1].strip('./').replace('/', '.')}:{match[2]}"] if match else []


def imported(field: str, path: str) -> Any:
    """Imports the module of a `module:attribute`, and returns the attribute.

    Raises:
      ConfigError: if the text is not of this form, or the module cannot be imported or lacks the
        attribute.
    """
    require_path(field, path)
    try:
        return resolve_name(path)
    except Exception as error:
        is_lost = isinstance(error, ModuleNotFoundError) and not place_of(error)
        rule = f"must name what can be imported; {shortened(path, 60)} raised {told(error)}."
        rule += " Is its folder in PYTHONPATH?" if is_lost else ""
        raise ConfigError(field, rule) from error


@functools.cache
def _from_function(group: str, name: str, function: Callable[..., Any]) -> type:
    """A dataclass for a function: its fields are the parameters after the group's arguments."""
    arguments = GROUPS[group].arguments
    signature = inspect.signature(function)
    parameters = list(signature.parameters.values())
    options = parameters[len(arguments) :]
    is_open = any(p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD) for p in parameters)
    rule = f"must take ({', '.join((*arguments, 'option=default, ...'))}), each option a field"
    is_fit = len(parameters) >= len(arguments) and not is_open
    is_fit &= all(p.name not in ("name", "make") for p in options)  # which every choice has
    require(is_fit, group, rule, got=f"{name}{signature}")

    def make(self: object, *parts: object) -> Any:
        return function(*parts, **{p.name: getattr(self, p.name) for p in options})

    fields = []
    for p in options:
        field: Any = dataclasses.field() if p.default is p.empty else p.default
        if not isinstance(p.default, Hashable):  # such as a list
            field = dataclasses.field(default_factory=functools.partial(copy.copy, p.default))
        fields.append((p.name, Any if p.annotation is p.empty else p.annotation, field))
    base = resolve_name(GROUPS[group].base)
    bases = (base if issubclass(base, Options) else Options,)
    of_function = {"__doc__": function.__doc__, "__module__": function.__module__}
    namespace = {"group": group, "make": make, **of_function}
    return dataclasses.make_dataclass(
        function.__name__, fields, bases=bases, namespace=namespace, frozen=True, kw_only=True
    )
