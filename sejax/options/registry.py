"""Names to objects: the only place where a name becomes code.

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
`machines`    `sejax.machines`        `(config, say)`: see `sejax.runs.workers`
============= ======================= ==============================================

A name is one that comes with sejax, one that an installed package offers as an entry point, or
`module:attribute`, which imports the module. What reads a file says which of these may be imported
(`imports`): those that the user has typed, or none.

A configuration is written as plain values (`describe`) and read back (`configure`); what a value
may be is in `sejax.options.plain`.
"""

import dataclasses
import functools
import importlib
import importlib.metadata
import importlib.util
import inspect
import operator
import re
import typing
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from sejax.options import (
    ConfigError,
    Options,
    listed,
    nearest,
    place_of,
    require,
    shortened,
    told,
    unknown_name,
)
from sejax.options.plain import fields_of, from_plain, require_typed, to_plain


@dataclass(frozen=True)
class Group:
    """A kind of plugin.

    Attributes:
      entry_points: group of entry points where packages offer more of it.
      makes: `module:attribute` of the class of what `make` returns.
      arguments: what `make` is given, for messages and for functions in a dataclass's place.
      built_in: name to `module:attribute`.
      prefixes: beginning of a name to `module:attribute` of a dataclass with a field `name`.
      base: `module:attribute` of the class that each plugin's dataclass is a subclass of.
    """

    entry_points: str
    makes: str
    arguments: tuple[str, ...]
    built_in: dict[str, str]
    prefixes: dict[str, str] = dataclasses.field(default_factory=dict)
    base: str = "builtins:object"


_EVOSAX = ("cma_es", "cr_fm_nes", "open_es", "pgpe", "sep_cma_es", "snes", "xnes")
GROUPS = {
    "env": Group(
        "sejax.envs",
        "sejax.envs.base:Task",
        (),
        {
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
        {"gymnax/": "sejax.envs.gymnax:GymnaxTask", "stoa/": "sejax.envs.gymnax:GymnaxTask"},
    ),
    "agent": Group(
        "sejax.agents",
        "sejax.agents.base:Agent",
        ("task",),
        {
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
        base="sejax.agents.base:AgentConfig",
    ),
    "exploration": Group(
        "sejax.explorations",
        "sejax.agents.base:Agent",
        ("agent", "task"),
        {
            "none": "sejax.agents.base:NoExploration",
            "icm": "sejax.agents.exploration:ICMConfig",
            "count_based": "sejax.agents.exploration:CountBasedConfig",
        },
        base="sejax.agents.base:ExplorationConfig",
    ),
    "proxy": Group(
        "sejax.proxies",
        "sejax.proxies.base:ProxyEnv",
        ("task",),
        {
            "se": "sejax.proxies.synthetic:SyntheticConfig",
            "rn": "sejax.proxies.reward:RewardConfig",
        },
        base="sejax.proxies:ProxyConfig",
    ),
    "objective": Group(
        "sejax.objectives",
        "sejax.objectives:Objective",
        ("task",),
        {
            "max_reward": "sejax.objectives:MaxReward",
            "reward_threshold": "sejax.objectives:RewardThreshold",
            "auc": "sejax.objectives:AUC",
            "auc_sum": "sejax.objectives:AUCSum",
        },
    ),
    "es": Group(
        "sejax.strategies",
        "sejax.es.base:Strategy",
        ("num_dims",),
        {
            "nes": "sejax.es.nes:NESConfig",
            **dict.fromkeys(_EVOSAX, "sejax.es.evosax:EvosaxConfig"),
        },
    ),
    "tracker": Group(
        "sejax.trackers",
        "sejax.runs.trackers:Tracker",
        ("run",),
        {
            "none": "sejax.runs.trackers:NoTracker",
            "tensorboard": "sejax.runs.trackers:TensorBoardConfig",
            "wandb": "sejax.runs.trackers:WandbConfig",
        },
    ),
    "machines": Group(
        "sejax.machines",
        "contextlib:AbstractContextManager",
        ("config", "say"),
        {
            "local": "sejax.runs.workers:LocalConfig",
            "ray": "sejax.runs.workers:RayConfig",
        },
    ),
}


_PATH = re.compile(r"(?<![^=\[,+(\s'\"])[\w.]+:[\w.]+(?![^\],+)\s'\"])")


def paths_in(words: Iterable[str]) -> list[str]:
    """Each `module:attribute` in words.

    Example:
      >>> paths_in(["env=mine:Room", "agents=[ddqn,mine:A]", "proxy=hf://me/se", "storage=x://a:b@c"])
      ['mine:Room', 'mine:A']
    """
    return [path for word in words for path in _PATH.findall(word)]


# --- names ---------------------------------------------------------------------------------------


def names(group: str) -> list[str]:
    """The registered names: those that come with sejax, then those of installed packages."""
    return [*GROUPS[group].built_in, *_offered(group)]


def is_registered(group: str, name: str) -> bool:
    """Whether a name is known without importing a module that it names."""
    return name in names(group) or _by_prefix(group, name) is not None


def find(group: str, name: object, imports: Collection[str] | None = None) -> Any:
    """The dataclass that a name stands for.

    Args:
      group: one of `GROUPS`.
      name: see the module.
      imports: each `module:attribute` that may be imported; None: any.

    Raises:
      ConfigError: for an unknown name, a module that cannot or may not be imported, or an
        attribute that is no plugin.
    """
    kind = GROUPS[group]
    if not isinstance(name, str):
        raise unknown_name(group, name, names(group))
    built_in = kind.built_in.get(name) or _by_prefix(group, name)
    if built_in is not None:
        return _attribute(built_in)
    if name in _offered(group):
        return _as_dataclass(group, name, imported(group, _offered(group)[name]))
    if ":" not in name:
        is_path = "." in name and name.replace(".", "_").isidentifier()
        meant = [":".join(name.rsplit(".", 1))] if is_path else []
        raise unknown_name(group, name, [*names(group), *meant])
    require_path(group, name)
    require_typed(group, name, imports)
    return _as_dataclass(group, name, imported(group, name))


def name_of(group: str, config: object) -> str:
    """The name by which `find` finds a configuration's class again."""
    cls = type(config)
    own = f"{cls.__module__}:{cls.__qualname__}"
    if _is_one_of_many(cls):
        return str(config.name)  # type: ignore[attr-defined]
    built_in = (name for name, path in GROUPS[group].built_in.items() if path == own)
    return _NAMES.get(cls) or next(built_in, own)


def configure(
    group: str,
    values: Mapping[str, Any],
    imports: Collection[str] | None = None,
) -> Any:
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
    require(
        isinstance(values, Mapping) and "name" in values,
        group,
        f"must be a choice with its fields; got {shortened(values)}. Set {group}=NAME.",
    )
    cls = find(group, values["name"], imports)
    fields = {k: v for k, v in values.items() if k != "name" or _is_one_of_many(cls)}
    try:
        return from_plain(cls, fields, group, imports)
    except ConfigError as error:
        raise _of_another(group, error) or error from None


def _of_another(group: str, error: ConfigError) -> ConfigError | None:
    """The error of a field that this choice has not, but another one that comes with sejax."""
    field = error.field.removeprefix(f"{group}.")
    others = [x for x in GROUPS[group].built_in if field in fields_of(find(group, x))]
    if not others or "is no field" not in str(error):
        return None
    return ConfigError(f"{error.field} is a field of {group}={others[0]}. Set that.", error.field)


def describe(group: str, config: object) -> dict[str, Any]:
    """Inverse of `configure`."""
    return {"name": name_of(group, config), **to_plain(config)}


# --- objects -------------------------------------------------------------------------------------


def make(group: str, config: Any, *arguments: Any) -> Any:
    """What a configuration configures, built once for equal configurations and arguments.

    Compiled programs are cached by the identity of what they were built from, so that a new
    instance would compile again. A configuration that cannot be hashed is equal to itself alone.

    Raises:
      ConfigError: if it makes something of another kind, or cannot be made.
    """
    key = (group, config if is_hashable(config) else id(config), *arguments)
    if key not in _MADE:
        made, kind = config.make(*arguments), _attribute(GROUPS[group].makes)
        require(
            isinstance(made, kind),
            group,
            f"must make a sejax.{kind.__name__}; got {type(made).__name__} from "
            f"{shortened(name_of(group, config))}. Set {group} to a plugin that returns one.",
        )
        _MADE[key] = config, made  # with config, its id stays its own
    return _MADE[key][1]


def is_hashable(config: object) -> bool:
    """Whether a configuration serves as a key: a frozen dataclass of hashable values does."""
    try:
        hash(config)
    except TypeError:
        return False
    return True


def require_package(group: str, config: Any) -> None:
    """Checks that the package which a plugin names as its `package` is there; imports nothing.

    Raises:
      ConfigError: if it is not.
    """
    package, name = getattr(config, "package", None), name_of(group, config)
    require(
        package is None or importlib.util.find_spec(package) is not None,
        group,
        f"must be one that is installed; got {name} without the package {package}. Install it with "
        f"pip install 'sejax[{name}]', or set {group}={next(iter(GROUPS[group].built_in))}.",
    )


_MADE: dict[tuple[Any, ...], tuple[Any, Any]] = {}
_NAMES: dict[type, str] = {}  # of classes that were found by another name than their own


# --- plugins of others ---------------------------------------------------------------------------


def _by_prefix(group: str, name: str) -> str | None:
    prefixes = GROUPS[group].prefixes.items()
    return next((path for start, path in prefixes if name.startswith(start)), None)


def _is_one_of_many(cls: type) -> bool:
    """Whether a class has a family of names, so that the name is one of its fields."""
    return dataclasses.is_dataclass(cls) and "name" in {x.name for x in dataclasses.fields(cls)}


@functools.cache
def _offered(group: str) -> dict[str, str]:
    """Entry points of installed packages; a name of sejax's own cannot be taken over."""
    points = importlib.metadata.entry_points(group=GROUPS[group].entry_points)
    return {x.name: x.value for x in points if x.name not in GROUPS[group].built_in}


def _attribute(path: str) -> Any:
    module, _, attribute = path.partition(":")
    return getattr(importlib.import_module(module), attribute)


def require_path(field: str, path: str) -> None:
    """Checks that a text is of the form `module:attribute`.

    Raises:
      ConfigError: if it is not.
    """
    module, _, attribute = path.partition(":")
    parts = [*module.split("."), *attribute.split(".")]
    own = module.removesuffix(".py").replace("/", ".").strip(".")
    fix = f"{own}:{attribute}" if own.replace(".", "_").isidentifier() else "my_module:MyClass"
    require(
        all(map(str.isidentifier, parts)) and not module.endswith(".py"),
        field,
        f"must be a name or module:attribute; got {shortened(path, 60)}. Set "
        f"{field}={shortened(fix, 60)}.",
    )


def imported(field: str, path: str) -> Any:
    """What `module:attribute` names, which is imported.

    Raises:
      ConfigError: if the module cannot be imported, or has nothing of this name.
    """
    module, _, attribute = path.partition(":")
    try:
        found = importlib.import_module(module)
    except Exception as error:
        fix = "" if place_of(error) else " Is its folder in PYTHONPATH?"
        raise ConfigError(
            f"{field} must name a module that can be imported; {shortened(path, 40)} raised "
            f"{told(error)}.{fix}",
            field,
        ) from error
    try:
        return operator.attrgetter(attribute)(found)
    except AttributeError as error:
        known = [(k, x) for k, x in vars(found).items() if inspect.isfunction(x) or _makes(x)]
        own = [k for k, x in known if x.__module__ == module]
        near = nearest(attribute, own)
        fix = f" Did you mean {field}={module}:{near[0]}?" if near else ""
        raise ConfigError(
            f"{field} must name a class or function of {shortened(module, 40)}; got "
            f"{shortened(attribute, 40)}. There are: {listed(near, 60)}.{fix}",
            field,
        ) from error


def _makes(found: object) -> bool:
    """Whether it is a dataclass with `make`."""
    return isinstance(found, type) and dataclasses.is_dataclass(found) and hasattr(found, "make")


def _as_dataclass(group: str, name: str, found: Any) -> Any:
    """The dataclass that a plugin is, or that a function stands for."""
    arguments = GROUPS[group].arguments
    if _makes(found):
        cls: Any = found
    else:
        require(
            inspect.isfunction(found) or isinstance(found, functools.partial),
            group,
            f"must name a dataclass with make({', '.join(arguments)}), or a function; got "
            f"{shortened(name)}, which is {shortened(found)}. See docs/howto/own_pieces.md.",
        )
        cls = _from_function(group, name, found)
    base = _attribute(GROUPS[group].base)
    require(
        issubclass(cls, base),
        group,
        f"must be a subclass of {base.__module__}.{base.__name__}; got {shortened(name)}. Set "
        f"class {cls.__name__}({base.__name__}).",
    )
    if f"{cls.__module__}:{cls.__qualname__}" != name:
        _NAMES[cls] = name
    return cls


@functools.cache
def _from_function(group: str, name: str, function: Callable[..., Any]) -> type:
    """A dataclass whose fields are a function's parameters beyond those that `make` is given."""
    written: Any = getattr(function, "func", function)  # of a partial, what it is one of
    arguments = GROUPS[group].arguments
    parameters = list(inspect.signature(function).parameters.values())
    is_open = any(p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD) for p in parameters)
    require(
        len(parameters) >= len(arguments) and not is_open,
        group,
        f"must take ({', '.join((*arguments, 'option=default, ...'))}), each option a field; got "
        f"{shortened(f'{name}{inspect.signature(function)}')}. Set {group} to such a function.",
    )
    options = parameters[len(arguments) :]
    lists = {p.name for p in options if isinstance(p.default, list)}

    def make(self: object, *given: object) -> Any:
        values = {p.name: getattr(self, p.name) for p in options}
        return function(*given, **{k: list(v) if k in lists else v for k, v in values.items()})

    base = _attribute(GROUPS[group].base)
    cls = dataclasses.make_dataclass(
        written.__name__,
        [_as_field(parameter) for parameter in options],
        bases=(base if issubclass(base, Options) else Options,),
        namespace={"make": make, "__doc__": written.__doc__},
        frozen=True,
        kw_only=True,
    )
    cls.__module__ = written.__module__
    return cls


def _as_field(parameter: inspect.Parameter) -> tuple[str, Any, Any]:
    """A parameter as name, type and field of a dataclass."""
    default, empty = parameter.default, inspect.Parameter.empty
    kind = Any if parameter.annotation is empty else parameter.annotation
    if default is empty:
        return parameter.name, kind, dataclasses.field()
    if default is None:  # which `length: float = None` may be too
        kind = typing.Optional[kind]  # noqa: UP045 (it may be a string)
    if isinstance(default, list):  # a tuple is hashable, so that what it configures is built once
        default = tuple(default)
        kind = tuple[(*typing.get_args(kind), Any)[0], ...]  # type: ignore[misc]
    return parameter.name, kind, dataclasses.field(default=default)
