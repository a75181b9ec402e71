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
`tracker`     `sejax.trackers`        `(run)` a `sejax.cli.trackers.Tracker`
`machines`    `sejax.cli`             `(config, folder, say)`: see `sejax.cli.workers`
============= ======================= ==============================================

A name is one that comes with sejax, one that an installed package offers as an entry point, or
`module:attribute`, which imports the module. Within `only_typed`, as in every command, that is done
only for a `module:attribute` that the user has typed: one that a file holds is refused.
"""

import contextlib
import copy
import dataclasses
import functools
import importlib
import importlib.metadata
import importlib.util
import inspect
import re
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Optional

from sejax import serialize
from sejax.errors import ConfigError, nearest, require, shortened, told, unknown_name


@dataclass(frozen=True)
class Group:
    """A kind of plugin.

    Attributes:
      entry_points: group of entry points where packages offer more of it.
      arguments: what `make` is given, for messages and for functions in a dataclass's place.
      built_in: name to `module:attribute`.
      families: beginning of a name to `module:attribute` of a dataclass with a field `name`.
      base: `module:attribute` of the class that each plugin's dataclass is a subclass of.
    """

    entry_points: str
    arguments: tuple[str, ...]
    built_in: dict[str, str]
    families: dict[str, str] = dataclasses.field(default_factory=dict)
    base: str = "builtins:object"


_EVOSAX = (
    "ars",
    "asebo",
    "cma_anchored_les",
    "cma_es",
    "cr_fm_nes",
    "des",
    "esmc",
    "evotf_es",
    "gradientless_descent",
    "hill_climbing",
    "iamalgam_full",
    "iamalgam_univariate",
    "les",
    "lm_ma_es",
    "ma_es",
    "noise_reuse_es",
    "open_es",
    "persistent_es",
    "pgpe",
    "rm_es",
    "sep_cma_es",
    "simple_es",
    "simulated_annealing",
    "snes",
    "xnes",
)
GROUPS = {
    "env": Group(
        "sejax.envs",
        (),
        {
            "cartpole": "sejax.envs.cartpole:CartPole",
            "cartpole_v1": "sejax.envs.cartpole_v1:CartPoleV1",
            "acrobot": "sejax.envs.acrobot:Acrobot",
            "cliff_walking": "sejax.envs.cliff_walking:CliffWalking",
            "gridworld_2x2": "sejax.envs.gridworld_2x2:GridWorld2x2",
            "mountain_car": "sejax.envs.mountain_car:MountainCar",
            "mountain_car_continuous": "sejax.envs.mountain_car_continuous:MountainCarContinuous",
            "pendulum": "sejax.envs.pendulum:Pendulum",
            "halfcheetah": "sejax.envs.halfcheetah:HalfCheetah",
            "hopper": "sejax.envs.hopper:Hopper",
            "walker2d": "sejax.envs.walker2d:Walker2d",
            "swimmer": "sejax.envs.swimmer:Swimmer",
            "inverted_pendulum": "sejax.envs.inverted_pendulum:InvertedPendulum",
            "ant": "sejax.envs.ant:Ant",
            "reacher": "sejax.envs.reacher:Reacher",
        },
        {"gymnax/": "sejax.envs.gymnax:GymnaxTask"},
    ),
    "agent": Group(
        "sejax.agents",
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
            "boltzmann": "sejax.agents.boltzmann:BoltzmannConfig",
        },
        base="sejax.agents.base:AgentConfig",
    ),
    "exploration": Group(
        "sejax.explorations",
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
        ("task",),
        {
            "se": "sejax.proxies.configs:SyntheticConfig",
            "rn": "sejax.proxies.configs:RewardConfig",
        },
        base="sejax.proxies:ProxyConfig",
    ),
    "objective": Group(
        "sejax.objectives",
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
        ("num_dims",),
        {
            "nes": "sejax.es.nes:NESConfig",
            **dict.fromkeys(_EVOSAX, "sejax.es.evosax:EvosaxConfig"),
        },
    ),
    "tracker": Group(
        "sejax.trackers",
        ("run",),
        {
            "none": "sejax.cli.trackers:NoTracker",
            "tensorboard": "sejax.cli.trackers:TensorBoardConfig",
            "wandb": "sejax.cli.trackers:WandbConfig",
            "trackio": "sejax.cli.trackers:TrackioConfig",
        },
    ),
    "machines": Group(
        "sejax.cli",
        ("config", "folder", "say"),
        {
            "local": "sejax.cli.workers:LocalConfig",
            "ray": "sejax.cli.workers:RayConfig",
        },
    ),
}


# What plugins of a group make.
KINDS = {
    "env": "sejax.envs.base:Task",
    "agent": "sejax.agents.base:Agent",
    "exploration": "sejax.agents.base:Agent",
    "proxy": "sejax.proxies.base:ProxyEnv",
    "objective": "sejax.objectives:Objective",
    "es": "sejax.es.base:Strategy",
    "tracker": "sejax.cli.trackers:Tracker",
    "machines": "contextlib:AbstractContextManager",
}

# What may be imported by its name; None outside of commands, where Python code says it itself.
_TYPED: ContextVar[frozenset[str] | None] = ContextVar("typed", default=None)
_PATH = re.compile(r"(?<![^=\[,+(\s'\"])[\w.]+:[\w.]+(?![^\],+)\s'\"])")


@contextlib.contextmanager
def only_typed(words: Iterable[str]) -> Iterator[None]:
    """Within it, `module:attribute` is imported only if one of these words has it.

    For commands and all that reads files of unknown origin. The outermost one decides: what reads a
    file on behalf of a command allows nothing more.
    """
    if _TYPED.get() is not None:
        yield
        return
    before = _TYPED.set(frozenset(paths_in(words)))
    try:
        yield
    finally:
        _TYPED.reset(before)


def paths_in(words: Iterable[str]) -> list[str]:
    """Each `module:attribute` in words.

    Example:
      >>> paths_in(["env=mine:Room", "agents=[ddqn,mine:A]", "proxy=hf://me/se", "storage=x://a:b@c"])
      ['mine:Room', 'mine:A']
    """
    return [path for word in words for path in _PATH.findall(word)]


def untyped(words: Iterable[str]) -> list[str]:
    """Each `module:attribute` in words that is not imported here, as the user has not typed it."""
    typed = _TYPED.get()
    return [] if typed is None else [path for path in paths_in(words) if path not in typed]


def names(group: str) -> list[str]:
    """The registered names: those that come with sejax, then those of installed packages."""
    return [*GROUPS[group].built_in, *_offered(group)]


def is_registered(group: str, name: str) -> bool:
    """Whether a name is known without importing a module that it names."""
    return name in names(group) or _family(group, name) is not None


def find(group: str, name: str) -> Any:
    """The dataclass that a name stands for.

    Args:
      group: one of `GROUPS`.
      name: see the module. `module:attribute` is imported, if `only_typed` does not forbid it.

    Raises:
      ConfigError: for an unknown name, a module that cannot be imported or that the user has not
        typed, or an attribute that is no plugin.
    """
    kind = GROUPS[group]
    if not isinstance(name, str):
        raise unknown_name(group, shortened(name), names(group))
    if name in kind.built_in:
        return _attribute(kind.built_in[name])
    offered = _offered(group)
    if name in offered:
        try:
            found = offered[name].load()
        except Exception as error:
            raise ConfigError(
                f"{group} must be a plugin that can be imported; {name!r} of "
                f"{offered[name].value} raised {told(error)}."
            ) from error
        return _as_dataclass(group, name, found)
    family = _family(group, name)
    if family is not None:
        return _attribute(family)
    if ":" in name:
        found = _import(group, name)
        _require_maker(group, name, found)
        return _as_dataclass(group, name, found)
    raise unknown_name(group, name, names(group))


def configure(group: str, values: Mapping[str, Any]) -> Any:
    """The configuration that plain values describe: the field `name`, and those of the plugin.

    Raises:
      ConfigError: for an unknown name or field, or a value that cannot be.

    Example:
      >>> configure("agent", {"name": "q_learning", "discount": 0.9}).discount
      0.9
    """
    require(
        isinstance(values, Mapping) and "name" in values,
        group,
        "be a choice with its fields",
        "one is made by name",
        shortened(values),
        f"{group}=NAME",
    )
    name = values["name"]
    cls = find(group, name)
    is_one_of_many = "name" in {field.name for field in dataclasses.fields(cls)}
    fields = values if is_one_of_many else {k: v for k, v in values.items() if k != "name"}
    return serialize.from_plain(cls, fields, group)


def describe(group: str, config: Any) -> dict[str, Any]:
    """Inverse of `configure`."""
    return {"name": name_of(group, config), **serialize.to_plain(config)}


def defaults(group: str, name: str) -> dict[str, Any]:
    """What `describe` gives for a choice with its defaults; "???" for a field without one."""
    cls = find(group, name)
    plain: dict[str, Any] = {"name": name}
    for field in dataclasses.fields(cls):
        if not field.init or field.name == "name":
            continue
        if field.default_factory is not dataclasses.MISSING:
            plain[field.name] = serialize.plain(field.default_factory())
        elif field.default is not dataclasses.MISSING:
            plain[field.name] = serialize.plain(field.default)
        else:
            plain[field.name] = "???"
    return plain


def name_of(group: str, config: Any) -> str:
    """The name by which `find` finds a configuration's class again."""
    if "name" in getattr(type(config), "__dataclass_fields__", {}):
        return str(config.name)
    cls = type(config)
    return _NAMES.get(cls) or _built_in_name(group, cls) or f"{cls.__module__}:{cls.__qualname__}"


def make(group: str, config: Any, *arguments: Any) -> Any:
    """What a configuration configures, built once for equal configurations and arguments.

    Compiled programs are kept by the identity of what they were built from, so that a new instance
    would compile anew.

    Raises:
      ConfigError: if it makes something of another kind, or cannot be made.
    """
    try:
        return _make(group, Same(config), *arguments)
    except TypeError as error:
        if "unhashable" not in str(error):
            raise
        return _checked(group, config, config.make(*arguments))


def require_package(group: str, config: Any, reason: str) -> None:
    """Checks that the package which a plugin names as its `package` is there; imports nothing.

    Raises:
      ConfigError: if it is not.
    """
    package = getattr(config, "package", None)
    if package is not None and importlib.util.find_spec(package) is None:
        name, usual = name_of(group, config), next(iter(GROUPS[group].built_in))
        raise ConfigError(
            f"{group} must be one that is installed, because {reason}; got {name} without the "
            f"package {package}. Install it with pip install 'sejax[{name}]', or set "
            f"{group}={usual}."
        )


class Same:
    """Configurations as a key that is equal if all their fields are, hashable or not.

    What is no dataclass is equal to what it says, by default to itself alone.
    """

    def __init__(self, *configs: Any):
        self.configs = configs  # also keeps alive what the key knows by its address
        self._key = tuple(map(_content, configs))

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and self._key == other._key


def _content(value: Any) -> Any:
    """What makes two values the same, hashable: of dataclasses at any depth class and fields."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        # A flax module that is nobody's part may have no parent.
        return type(value), tuple(
            _content(getattr(value, field.name, None))
            for field in dataclasses.fields(value)
            if field.init
        )
    if isinstance(value, tuple | list):
        return type(value), tuple(map(_content, value))
    if isinstance(value, Mapping):
        return type(value), tuple((repr(name), _content(x)) for name, x in value.items())
    if isinstance(value, bool | int | float | str | None):
        return repr(value)  # by which 1, 1.0 and True are not the same, and nan is
    if isinstance(value, set | frozenset):
        return type(value), frozenset(map(_content, value))
    if hasattr(value, "tolist") and hasattr(value, "dtype") and not isinstance(value, type):
        return type(value), str(value.dtype), repr(value.tolist())  # NumPy's and jax's
    try:
        hash(value)
    except TypeError:
        return type(value), id(value)
    return type(value), value


@functools.cache
def _make(group: str, key: Same, *arguments: Any) -> Any:
    (config,) = key.configs
    return _checked(group, config, config.make(*arguments))


def _checked(group: str, config: Any, made: Any) -> Any:
    """What was made, if it is of the group's kind."""
    kind = _attribute(KINDS[group])
    require(
        isinstance(made, kind),
        group,
        f"make a sejax.{kind.__name__}",
        "that is what is used",
        f"{type(made).__name__} from {name_of(group, config)}",
        f"{group} to a plugin that returns a sejax.{kind.__name__}",
    )
    return made


_NAMES: dict[type, str] = {}  # of classes that were found by another name than their own


def _built_in_name(group: str, cls: type) -> str | None:
    own = f"{cls.__module__}:{cls.__qualname__}"
    return next((name for name, path in GROUPS[group].built_in.items() if path == own), None)


def _family(group: str, name: str) -> str | None:
    matches = [p for start, p in GROUPS[group].families.items() if name.startswith(start)]
    return matches[0] if matches else None


@functools.cache
def _offered(group: str) -> dict[str, Any]:
    """Entry points of installed packages; a name of sejax's own cannot be taken over."""
    points = importlib.metadata.entry_points(group=GROUPS[group].entry_points)
    return {point.name: point for point in points if point.name not in GROUPS[group].built_in}


def _attribute(path: str) -> Any:
    module, _, attribute = path.partition(":")
    return getattr(importlib.import_module(module), attribute)


def _import(group: str, path: str) -> Any:
    """Imports `module:attribute` that a user names."""
    module, _, attribute = path.partition(":")
    require(
        all(part.isidentifier() for part in (*module.split("."), *attribute.split("."))),
        group,
        "be a name or module:attribute",
        "a module is imported by it",
        path,
        f"{group}=my_module:MyClass",
    )
    typed = _TYPED.get()
    require(
        typed is None or path in typed,
        group,
        "be typed on the command line if it is of a module of your own",
        "what a file names is never imported",
        path,
        f"{group}={path}, if you trust that module",
    )
    try:
        found: Any = importlib.import_module(module)
    except Exception as error:
        raise ConfigError(
            f"{group} must name a module that can be imported; importing {shortened(module)!r} for "
            f"{group}={shortened(path)} raised {told(error)}. Run the command in the module's "
            f"folder, or add that folder to PYTHONPATH."
        ) from error
    for part in attribute.split("."):
        if not hasattr(found, part):
            own = {
                name
                for name, value in vars(found).items()
                if callable(value) and getattr(value, "__module__", None) == module
            }
            near = nearest(part, sorted(own))
            raise ConfigError(
                f"{group} must name a class or function of {module}, because that is what makes "
                f"it; got {shortened(part)}, which is not there. There are: "
                f"{', '.join(near) or 'none'}."
                + (f" Did you mean {group}={module}:{near[0]}?" if near else "")
            )
        found = getattr(found, part)
    return found


def _require_maker(group: str, name: str, found: Any) -> None:
    """Checks that a function says that it makes what the group is of; nothing is called.

    Any function of any module could else be called by a command's word.

    Raises:
      ConfigError: if its return annotation does not say so.
    """
    if not (inspect.isfunction(found) or isinstance(found, functools.partial)):
        return  # a class says so by being a dataclass with `make`
    function: Any = getattr(found, "func", found)  # of a partial, what it is one of
    try:
        says = typing.get_type_hints(function).get("return")
    except Exception:  # a name that only type checkers import
        says = getattr(function, "__annotations__", {}).get("return")
    kind = _attribute(KINDS[group])
    said = [typing.get_origin(x) or x for x in (*_of_union(says), says)]
    makes = any(
        issubclass(x, kind)
        if isinstance(x, type)
        else isinstance(x, str) and re.search(rf"\b{kind.__name__}\b", x)
        for x in said
    )
    require(
        makes,
        group,
        f"be a function that says what it makes, -> {kind.__name__}",
        "not any function is called",
        f"{name} -> {says}" if says else f"{name} without",
        f"{group} to a dataclass with make, or annotate the function",
    )


def _of_union(hint: Any) -> tuple[Any, ...]:
    """The parts of `X | None`; empty for what is no union."""
    is_union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    return typing.get_args(hint) if is_union else ()


def _as_dataclass(group: str, name: str, found: Any) -> Any:
    """The dataclass that a plugin is, or that a function stands for."""
    arguments = GROUPS[group].arguments
    if isinstance(found, type) and dataclasses.is_dataclass(found) and hasattr(found, "make"):
        cls: Any = found
    elif inspect.isfunction(found) or isinstance(found, functools.partial):
        cls = _from_function(group, name, found)
    else:
        raise ConfigError(
            f"{group} must name a dataclass with make({', '.join(arguments)}), or a function that "
            f"takes ({', '.join((*arguments, 'option=default, ...'))}), because its fields are the "
            f'options; {name} is {shortened(found)}. See the README, "Adding to it".'
        )
    base = _attribute(GROUPS[group].base)
    require(
        issubclass(cls, base),
        group,
        f"be a subclass of {base.__module__}.{base.__name__}",
        "that says what it fits",
        name,
        f"class {cls.__name__}({base.__name__})",
    )
    if f"{cls.__module__}:{cls.__qualname__}" != name:
        _NAMES[cls] = name
    return cls


@functools.cache
def _from_function(group: str, name: str, function: Callable[..., Any]) -> type:
    """A dataclass whose fields are a function's parameters beyond those that `make` is given."""
    parameters = list(inspect.signature(function).parameters.values())
    arguments = GROUPS[group].arguments
    taken, options = parameters[: len(arguments)], parameters[len(arguments) :]
    bad = [p.name for p in parameters if p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    require(
        len(taken) == len(arguments) and not bad,
        group,
        f"take ({', '.join((*arguments, 'option=default, ...'))})",
        "each option is a field",
        f"{name}{inspect.signature(function)}",
        f"{group} to such a function",
    )
    written = getattr(function, "func", function)  # of a partial, what it is one of
    fields: list[Any] = []
    for parameter in options:
        unknown = parameter.annotation is inspect.Parameter.empty
        kind = Any if unknown else parameter.annotation
        if parameter.default is None:  # which `length: float = None` may be too
            kind = Optional[kind]  # noqa: UP045 (it may be a string)
        fields.append((parameter.name, kind, _field(parameter.default)))

    def make(self: Any, *given: Any) -> Any:
        return function(*given, **{p.name: getattr(self, p.name) for p in options})

    cls = dataclasses.make_dataclass(
        written.__name__,
        fields,
        bases=(_attribute(GROUPS[group].base),),
        namespace={"make": make, "__doc__": written.__doc__},
        frozen=True,
        kw_only=True,
    )
    cls.__module__ = written.__module__
    return cls


def _field(default: Any) -> Any:
    """The field of a parameter with this default."""
    if default is inspect.Parameter.empty:
        return dataclasses.field()
    if type(default).__hash__ is None:  # a list: each configuration has one of its own
        return dataclasses.field(default_factory=lambda: copy.deepcopy(default))
    return dataclasses.field(default=default)
