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

A configuration is written as plain values (`describe`) and read back (`configure`). A value is
taken as its field's type means it (`1` for a float, a list for a tuple, the text of an override for
a number) and never guessed: nothing in it is resolved, imported or executed.
"""

import contextlib
import dataclasses
import functools
import importlib
import importlib.metadata
import importlib.util
import inspect
import re
import types
import typing
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

from sejax.options import (
    ConfigError,
    Options,
    as_text,
    listed,
    nearest,
    require,
    shortened,
    told,
    unknown_name,
)

# Fields that had another name in files of older versions.
RENAMED = {
    "init_episodes": "warmup_episodes",
    "target_update_rate": "tau",
    "lanes": "num_parallel",
    "first_test_steps": "first_eval_steps",
}
_MISSING = dataclasses.MISSING


@dataclass(frozen=True)
class Group:
    """A kind of plugin.

    Attributes:
      entry_points: group of entry points where packages offer more of it.
      makes: `module:attribute` of the class of what `make` returns.
      arguments: what `make` is given, for messages and for functions in a dataclass's place.
      built_in: name to `module:attribute`.
      families: beginning of a name to `module:attribute` of a dataclass with a field `name`.
      base: `module:attribute` of the class that each plugin's dataclass is a subclass of.
    """

    entry_points: str
    makes: str
    arguments: tuple[str, ...]
    built_in: dict[str, str]
    families: dict[str, str] = dataclasses.field(default_factory=dict)
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
        {"gymnax/": "sejax.envs.gymnax:GymnaxTask"},
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
            "boltzmann": "sejax.agents.boltzmann:BoltzmannConfig",
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
            "se": "sejax.proxies.configs:SyntheticConfig",
            "rn": "sejax.proxies.configs:RewardConfig",
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
        "sejax.cli.trackers:Tracker",
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
        "contextlib:AbstractContextManager",
        ("config", "folder", "say"),
        {
            "local": "sejax.cli.workers:LocalConfig",
            "ray": "sejax.cli.workers:RayConfig",
        },
    ),
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
        raise unknown_name(group, name, names(group))
    if name in kind.built_in:
        return _attribute(kind.built_in[name])
    if name in _offered(group):
        return _as_dataclass(group, name, _load(group, _offered(group)[name]))
    family = _family(group, name)
    if family is not None:
        return _attribute(family)
    if ":" in name:
        found = _import(group, name)
        _require_maker(group, name, found)
        return _as_dataclass(group, name, found)
    raise unknown_name(group, name, names(group))


# --- plain values --------------------------------------------------------------------------------


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
        f"must be a choice with its fields, because one is made by name; got {shortened(values)}. "
        f"Set {group}=NAME.",
    )
    cls = find(group, values["name"])
    is_one_of_many = "name" in {field.name for field in dataclasses.fields(cls)}
    fields = values if is_one_of_many else {k: v for k, v in values.items() if k != "name"}
    return from_plain(cls, fields, group)


def describe(group: str, config: Any) -> dict[str, Any]:
    """Inverse of `configure`."""
    return {"name": name_of(group, config), **to_plain(config)}


def defaults(group: str, name: str) -> dict[str, Any]:
    """What `describe` gives for a choice with its defaults; "???" for a field without one."""
    plain_values: dict[str, Any] = {"name": name}
    for field in dataclasses.fields(find(group, name)):
        if field.init and field.name != "name":
            plain_values[field.name] = "???" if _is_needed(field) else plain(_default(field))
    return plain_values


def name_of(group: str, config: Any) -> str:
    """The name by which `find` finds a configuration's class again."""
    if "name" in getattr(type(config), "__dataclass_fields__", {}):
        return str(config.name)
    cls = type(config)
    own = f"{cls.__module__}:{cls.__qualname__}"
    built_in = (name for name, path in GROUPS[group].built_in.items() if path == own)
    return _NAMES.get(cls) or next(built_in, own)


def to_plain(config: Any) -> dict[str, Any]:
    """The fields of a dataclass as plain values: numbers, words, None, lists and dictionaries."""
    fields = [field.name for field in dataclasses.fields(config) if field.init]
    return {name: plain(getattr(config, name)) for name in fields}


def plain(value: Any) -> Any:
    """One value as `to_plain` has it."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return to_plain(value)
    if isinstance(value, tuple | list):
        return [plain(x) for x in value]
    if isinstance(value, Mapping):
        return {str(key): plain(x) for key, x in value.items()}
    is_array = hasattr(value, "tolist") and not isinstance(value, type)  # NumPy's and jax's
    return value.tolist() if is_array else value


def from_plain(cls: Any, values: Mapping[str, Any], where: str) -> Any:
    """Inverse of `to_plain`.

    Args:
      cls: a dataclass.
      values: by the names of its fields, today's or those of `RENAMED`; those left out have their
        defaults.
      where: what messages call it, as `agent` in `agent.batch_size`; may be empty.

    Raises:
      ConfigError: for a field that is not there, is missing, or has a value of another type.
    """
    fields = {field.name: field for field in dataclasses.fields(cls) if field.init}
    try:
        hints = typing.get_type_hints(cls)
    except NameError as error:
        raise ConfigError(
            f"{where or cls.__name__} must have fields of known types, because values are read by "
            f"them; got {cls.__name__}, where {error}. Import it where the class is defined.",
            where,
        ) from error
    read = {}
    for stored, value in values.items():
        name = stored if stored in fields else RENAMED.get(stored, stored)
        if name not in fields:
            raise unknown_field(_join(where, name), [_join(where, field) for field in fields])
        full = _join(where, name)
        read[name] = _converted(value, hints[name], full, _default(fields[name]))
    for name in fields.keys() - read.keys():
        full = _join(where, name)
        is_there = not _is_needed(fields[name])
        require(
            is_there, full, f"must be given, because it has no default; got none. Set {full}=VALUE."
        )
    return cls(**read)


def unknown_field(field: str, known: Collection[str]) -> ConfigError:
    """Error for a field that is not there, with the nearest of those that are."""
    field, last = shortened(field, 40), field.rpartition(".")[2]
    ranked = [name for name in known if name.rpartition(".")[2] == last] or nearest(field, known)
    fix = f"Did you mean {ranked[0]}? " if ranked else ""
    return ConfigError(
        f"{field} must be a field, because nothing else is read; got one that is not there. "
        f"{fix}Fields: {listed(ranked)}.",
        field,
    )


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as `{"group.field": value}`."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def differences(
    there: Mapping[str, Any], here: Mapping[str, Any], free: Collection[str] = (), most: int = 10
) -> str:
    """The fields in which two nested settings differ, for a message; empty if in none.

    Args:
      there: settings that were stored.
      here: those that are asked for.
      free: groups and fields of the first level that may differ.
      most: fields that are named.

    Example:
      >>> differences({"es": {"noise_std": 0.1}, "seed": 0}, {"es": {"noise_std": 0.2}, "seed": 0})
      'es.noise_std (0.1 there, 0.2 here)'
    """
    old, asked = flatten(there), flatten(here)
    differing = [
        f"{name} ({shortened(old.get(name), 60)} there, {shortened(asked.get(name), 60)} here)"
        for name in sorted(old.keys() | asked.keys())
        if name.partition(".")[0] not in free
        # In the second way nan is nan.
        and old.get(name) != asked.get(name)
        and repr(old.get(name)) != repr(asked.get(name))
    ]
    more = f" and {len(differing) - most} more" if len(differing) > most else ""
    return ", ".join(differing[:most]) + more


def split(text: str, separator: str = ",") -> list[str]:
    """The parts of a text between separators that are outside of brackets and quotes.

    Example:
      >>> split("0.1,[1,2],'a,b'")
      ['0.1', '[1,2]', "'a,b'"]
    """
    parts, depth, quote = [""], 0, ""
    for character in text:
        if quote:
            quote = "" if character == quote else quote
        elif character in "'\"" and not parts[-1].strip():
            quote = character
        depth += (character in "[(" and not quote) - (character in "])" and not quote)
        if character == separator and depth <= 0 and not quote:
            parts.append("")
        else:
            parts[-1] += character
    return [part.strip() for part in parts] if len(parts) > 1 else parts


def unquoted(text: str) -> str:
    """A text without the quotes around it."""
    is_quoted = len(text) > 1 and text[0] == text[-1] and text[0] in "'\""
    return text[1:-1] if is_quoted else text


def parsed(text: str) -> Any:
    """What the text of an override says by itself: null, true, a number, a list, or the text.

    Example:
      >>> parsed("[1e-3,2,true,ddqn]")
      [0.001, 2, True, 'ddqn']
    """
    if text in _CONSTANTS:
        return _CONSTANTS[text]
    if text[:1] == "[" and text[-1:] == "]":
        return [parsed(part) for part in split(text[1:-1])] if text[1:-1].strip() else []
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return unquoted(text)


_CONSTANTS = {"null": None, "true": True, "True": True, "false": False, "False": False}
_TYPES = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
_NO = object()  # what a value of another type is converted to


def _converted(value: Any, hint: Any, name: str, default: Any) -> Any:
    """A value as its field's type, or an error that says which that is."""
    if hint is Any:
        return parsed(value) if isinstance(value, str) else value
    kinds = typing.get_args(hint) if _is_union(hint) else (hint,)
    if type(None) in kinds and (value is None or value == "null"):
        return None
    kinds = tuple(kind for kind in kinds if kind is not type(None))
    if type(value) in kinds and not isinstance(value, str):
        return value
    for kind in kinds[:-1]:
        try:
            return _as(kind, value, name, default)
        except ConfigError:
            continue
    return _as(kinds[-1], value, name, default)


def _as(kind: Any, value: Any, name: str, default: Any) -> Any:
    origin, arguments = typing.get_origin(kind) or kind, typing.get_args(kind)
    fix = f"{name}={'VALUE' if default is _MISSING else as_text(plain(default))}"
    if origin is typing.Literal:
        read = parsed(value) if isinstance(value, str) and value not in arguments else value
        if read not in arguments:
            raise unknown_name(name, value, map(str, arguments))
        return read
    if origin in (tuple, list):
        items = parsed(value) if isinstance(value, str) else value
        require(
            isinstance(items, list | tuple),
            name,
            f"must be a list, because it is several; got {shortened(value)}. Set {fix}.",
        )
        if isinstance(value, str):  # each is read by its own type
            items = split(value[1:-1]) if items else []
        return origin(_elements(items, origin, arguments, name, default))
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        if isinstance(value, kind):
            return value
        first = next(iter(dataclasses.fields(kind))).name
        is_nested = isinstance(value, Mapping)
        require(
            is_nested,
            name,
            f"must have fields, because it is several; got {shortened(value)}. Set "
            f"{name}.{first}=VALUE.",
        )
        return from_plain(kind, value, name)
    if kind not in _TYPES:
        return value
    read = _scalar(value, kind)
    require(
        read is not _NO,
        name,
        f"must be {_TYPES[kind]}, because that is its type; got {shortened(repr(value))}. Set "
        f"{fix}.",
    )
    return read


def _elements(items: Any, origin: Any, kinds: tuple[Any, ...], name: str, default: Any) -> Any:
    """The elements of a list or tuple, each as its type."""
    if origin is tuple and kinds and kinds[-1] is not Ellipsis:
        must, fix = f"have {len(kinds)} values", f"{name}={as_text(plain(default))}"
        require(
            len(items) == len(kinds),
            name,
            f"must {must}, because that is its type; got {shortened(items)}. Set {fix}.",
        )
    else:
        kinds = (kinds[0] if kinds else Any,) * len(items)
    return (_converted(x, kind, name, default) for x, kind in zip(items, kinds, strict=True))


def _scalar(value: Any, kind: type) -> Any:
    """A value as a bool, int, float or str; `_NO` if it is none."""
    if kind is str:
        is_name = type(value) in (int, float)  # a name of digits, as of a folder
        return value if isinstance(value, str) else str(value) if is_name else _NO
    if isinstance(value, str):
        value = parsed(value)
    if kind is float and type(value) is int and abs(value) < 2**1000:
        return float(value)
    if kind is int and type(value) is float and value.is_integer() and abs(value) < 2**53:
        return int(value)
    return value if type(value) is kind else _NO


def _is_union(hint: Any) -> bool:
    return typing.get_origin(hint) in (types.UnionType, typing.Union)


def _is_needed(field: Any) -> bool:
    return _default(field) is _MISSING


def _default(field: Any) -> Any:
    has_factory = field.default_factory is not _MISSING
    return field.default_factory() if has_factory else field.default


def _join(where: str, name: str) -> str:
    return f"{where}.{shortened(name)}" if where else shortened(name)


# --- objects -------------------------------------------------------------------------------------


def make(group: str, config: Any, *arguments: Any) -> Any:
    """What a configuration configures, built once for equal configurations and arguments.

    Compiled programs are cached by the identity of what they were built from, so that a new
    instance would compile again. A configuration that cannot be hashed is equal to itself alone.

    Raises:
      ConfigError: if it makes something of another kind, or cannot be made.
    """
    if is_hashable(config):
        return _made_once(group, config, *arguments)
    key = (group, id(config), *arguments)
    if key not in _MADE:
        _MADE[key] = config, _made(group, config, *arguments)  # with config, its id stays its own
    return _MADE[key][1]


def is_hashable(config: Any) -> bool:
    """Whether a configuration serves as a key: a frozen dataclass of hashable values does."""
    try:
        hash(config)
    except TypeError:
        return False
    return True


def _made(group: str, config: Any, *arguments: Any) -> Any:
    made = config.make(*arguments)
    kind = _attribute(GROUPS[group].makes)
    require(
        isinstance(made, kind),
        group,
        f"must make a sejax.{kind.__name__}, because that is what is used; got "
        f"{type(made).__name__} from {name_of(group, config)}. Set {group} to a plugin that "
        f"returns a sejax.{kind.__name__}.",
    )
    return made


_made_once = functools.cache(_made)
_MADE: dict[tuple[Any, ...], tuple[Any, Any]] = {}


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
            f"{group}={usual}.",
            group,
        )


_NAMES: dict[type, str] = {}  # of classes that were found by another name than their own


def _family(group: str, name: str) -> str | None:
    matches = [p for start, p in GROUPS[group].families.items() if name.startswith(start)]
    return matches[0] if matches else None


@functools.cache
def _offered(group: str) -> dict[str, Any]:
    """Entry points of installed packages; a name of sejax's own cannot be taken over."""
    points = importlib.metadata.entry_points(group=GROUPS[group].entry_points)
    return {point.name: point for point in points if point.name not in GROUPS[group].built_in}


def _load(group: str, point: Any) -> Any:
    try:
        return point.load()
    except Exception as error:
        raise ConfigError(
            f"{group} must be a plugin that can be imported; {point.name!r} of {point.value} "
            f"raised {told(error)}. Mend or remove that package.",
            group,
        ) from error


def _attribute(path: str) -> Any:
    module, _, attribute = path.partition(":")
    return getattr(importlib.import_module(module), attribute)


def _import(group: str, path: str) -> Any:
    """Imports `module:attribute` that a user names."""
    module, _, attribute = path.partition(":")
    require(
        all(part.isidentifier() for part in (*module.split("."), *attribute.split("."))),
        group,
        "must be a name or module:attribute, because a module is imported by it; got "
        f"{shortened(path)}. Set {group}=my_module:MyClass.",
    )
    typed = _TYPED.get()
    require(
        typed is None or path in typed,
        group,
        "must be typed on the command line if it is of a module of your own, because what a file "
        f"names is never imported; got {shortened(path)}. Set {group}={path}, if you trust that "
        "module.",
    )
    try:
        found: Any = importlib.import_module(module)
    except Exception as error:
        raise ConfigError(
            f"{group} must name a module that can be imported; {shortened(path)} raised "
            f"{told(error)}. Run the command in the module's folder, or add that folder to "
            f"PYTHONPATH.",
            group,
        ) from error
    for part in attribute.split("."):
        if not hasattr(found, part):
            own = {
                name
                for name, value in vars(found).items()
                if callable(value) and getattr(value, "__module__", None) == module
            }
            near = nearest(part, own)
            fix = f" Did you mean {group}={module}:{near[0]}?" if near else ""
            raise ConfigError(
                f"{group} must name a class or function of {module}; got {shortened(part)}. "
                f"There are: {listed(near)}.{fix}",
                group,
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
    kind = _attribute(GROUPS[group].makes)
    said = [
        typing.get_origin(x) or x
        for x in (*(typing.get_args(says) if _is_union(says) else ()), says)
    ]
    makes = any(
        issubclass(x, kind)
        if isinstance(x, type)
        else isinstance(x, str) and re.search(rf"\b{kind.__name__}\b", x)
        for x in said
    )
    require(
        makes,
        group,
        f"must be a function that says what it makes, -> {kind.__name__}, because not any function "
        f"is called; got {shortened(name)} {f'-> {says}' if says else 'without'}. Set {group} to a "
        f"dataclass with make, or annotate the function.",
    )


def _as_dataclass(group: str, name: str, found: Any) -> Any:
    """The dataclass that a plugin is, or that a function stands for."""
    arguments = GROUPS[group].arguments
    if isinstance(found, type) and dataclasses.is_dataclass(found) and hasattr(found, "make"):
        cls: Any = found
    elif inspect.isfunction(found) or isinstance(found, functools.partial):
        cls = _from_function(group, name, found)
    else:
        raise ConfigError(
            f"{group} must name a dataclass with make({', '.join(arguments)}), or a function of "
            f"({', '.join((*arguments, 'option=default, ...'))}); {name} is {shortened(found)}. "
            f"See docs/howto/own_pieces.md.",
            group,
        )
    base = _attribute(GROUPS[group].base)
    require(
        issubclass(cls, base),
        group,
        f"must be a subclass of {base.__module__}.{base.__name__}, because that says what it fits; "
        f"got {shortened(name)}. Set class {cls.__name__}({base.__name__}).",
    )
    if f"{cls.__module__}:{cls.__qualname__}" != name:
        _NAMES[cls] = name
    return cls


@functools.cache
def _from_function(group: str, name: str, function: Callable[..., Any]) -> type:
    """A dataclass whose fields are a function's parameters beyond those that `make` is given."""
    parameters = list(inspect.signature(function).parameters.values())
    arguments = GROUPS[group].arguments
    options = parameters[len(arguments) :]
    is_open = any(p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD) for p in parameters)
    require(
        len(parameters) >= len(arguments) and not is_open,
        group,
        f"must take ({', '.join((*arguments, 'option=default, ...'))}), because each option is a "
        f"field; got {name}{inspect.signature(function)}. Set {group} to such a function.",
    )

    def make(self: Any, *given: Any) -> Any:
        values = {p.name: getattr(self, p.name) for p in options}
        as_lists = [p.name for p in options if isinstance(p.default, list)]
        return function(*given, **values | {name: list(values[name]) for name in as_lists})

    written = getattr(function, "func", function)  # of a partial, what it is one of
    base = _attribute(GROUPS[group].base)
    cls = dataclasses.make_dataclass(
        written.__name__,
        [_as_field(parameter) for parameter in options],
        bases=(Options if GROUPS[group].base == "builtins:object" else base,),
        namespace={"make": make, "__doc__": written.__doc__},
        frozen=True,
        kw_only=True,
    )
    cls.__module__ = written.__module__
    return cls


def _as_field(parameter: inspect.Parameter) -> tuple[str, Any, Any]:
    """A parameter as name, type and field of a dataclass."""
    unknown = parameter.annotation is inspect.Parameter.empty
    kind = Any if unknown else parameter.annotation
    default = parameter.default
    if default is None:  # which `length: float = None` may be too
        kind = typing.Optional[kind]  # noqa: UP045 (it may be a string)
    if default is inspect.Parameter.empty:
        return parameter.name, kind, dataclasses.field()
    if isinstance(default, list):  # a tuple is hashable, so that what it configures is built once
        default = tuple(default)
        kinds = typing.get_args(kind)
        kind = tuple[(kinds[0] if kinds else Any), ...]  # type: ignore[misc]
    return parameter.name, kind, dataclasses.field(default=default)
