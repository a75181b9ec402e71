"""Several agents on a command line: `agents=[ddqn,ppo] agents.ddqn.batch_size=32`.

Hydra would take a list as choices of a group, but can look up no settings by it. So the agents
together are one choice of the group `agent`, written `ddqn+ppo`, for which a task's tuned settings
are found as for any other.
"""

import contextlib
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, QuotedString
from hydra.errors import HydraException

from sejax import registry, serialize
from sejax.agents.mixture import FamiliesConfig
from sejax.errors import ConfigError, is_number, require, shortened, unknown_name

JOINT = "+"  # between the agents of a choice, and after a single one
_SHARED = tuple(serialize.to_plain(FamiliesConfig()))
_CHOICE = re.compile(r"agents?=")
_KEY = re.compile(r"\w[\w-]*")


@dataclass(frozen=True, kw_only=True)
class AgentFamily:
    """An agent among others.

    Attributes:
      key: what tables call it.
      field: what the command line and messages call it.
      agent: its configuration.
      weight: its share of a generation's members; with 0 it judges incumbents alone.
    """

    key: str
    field: str
    agent: Any
    weight: float = 1.0


@dataclass(frozen=True, kw_only=True)
class AgentsConfig(FamiliesConfig):
    """Agents that share generations, in the order of their keys whichever way they were named."""

    families: tuple[AgentFamily, ...]


# --- configurations ------------------------------------------------------------------------------


def from_plain(values: Any) -> AgentsConfig | None:
    """The agents that plain values describe; None if there are none.

    Args:
      values: the fields of `FamiliesConfig`, and under each other key an agent's `name`, fields and
        `weight`.

    Raises:
      ConfigError: for an unknown or bad field.
    """
    if not values:
        return None
    require(
        isinstance(values, Mapping),
        "agents",
        "be a list of agents",
        "each is a family",
        shortened(values),
        "agents=[ddqn,ppo]",
    )
    shared = serialize.from_plain(
        FamiliesConfig, {k: v for k, v in values.items() if k in _SHARED}, "agents"
    )
    families = [_family(key, values[key]) for key in sorted(values.keys() - set(_SHARED))]
    require(
        families,
        "agents",
        "hold an agent",
        "proxies are told by what agents learn on them",
        "none",
        "agents=[ddqn,ppo]",
    )
    return AgentsConfig(families=tuple(families), **serialize.to_plain(shared))


def _family(key: str, values: Any) -> AgentFamily:
    field = f"agents.{key}"
    require(
        _KEY.fullmatch(key),
        field,
        "be a word",
        "columns of tables are named by it",
        key,
        "agents=[ddqn,ppo]",
    )
    with named(field):
        require(
            isinstance(values, Mapping),
            "agent",
            "be an agent with its fields",
            "each is a family",
            shortened(values),
            "agent=ddqn",
        )
        fields = dict(values)
        weight = fields.pop("weight", 1.0)
        require(
            is_number(weight) and 0 <= weight <= 1e6,
            "agent.weight",
            "lie in [0, 1e6]",
            "it is a share of the members",
            weight,
            "agent.weight=1",
        )
        agent = registry.configure("agent", fields)
    return AgentFamily(key=key, field=field, agent=agent, weight=float(weight))


def to_plain(agents: AgentsConfig | None) -> dict[str, Any] | None:
    """Inverse of `from_plain`."""
    if agents is None:
        return None
    shared = {name: getattr(agents, name) for name in _SHARED}
    return shared | {
        each.key: {"name": "", "weight": each.weight} | registry.describe("agent", each.agent)
        for each in agents.families
    }


def defaults(agents: AgentsConfig) -> dict[str, Any]:
    """What `to_plain` gives for these agents with their defaults."""
    return serialize.to_plain(FamiliesConfig()) | {
        each.key: {"weight": 1.0}
        | registry.defaults("agent", registry.name_of("agent", each.agent))
        for each in agents.families
    }


def families_of(config: Any) -> tuple[AgentFamily, ...]:
    """The agents of a command's configuration: several, or the one."""
    if config.agents is not None:
        return config.agents.families
    key = registry.name_of("agent", config.agent)
    return (AgentFamily(key=key, field="agent", agent=config.agent),)


@contextlib.contextmanager
def named(field: str) -> Iterator[None]:
    """What is said of `agent` in here is said of a family's field, such as `agents.ddqn`."""
    try:
        yield
    except ConfigError as error:
        if field == "agent":
            raise
        said = re.sub(r"\bagent(?=\.\w| must )", field, str(error))
        at_fault = re.sub(r"^agent\b", field, error.field)
        raise ConfigError(re.sub(r"\bagent=", "agents=", said), at_fault) from error


# --- words ---------------------------------------------------------------------------------------


def in_one_choice(words: Sequence[str]) -> list[str]:
    """Words in which `agents=[ddqn,ppo]`, or `agent=[ddqn,ppo]`, is the choice `agent=ddqn+ppo`.

    Raises:
      ConfigError: for agents that are named twice or together with a single one, and for fields of
        a single one.
    """
    written = [_in_one_choice(word) for word in words]
    choices = {
        word: choice.partition("=")[2]
        for word, choice in zip(words, written, strict=True)
        if choice is not None and _CHOICE.match(choice)
    }
    several = [word for word, choice in choices.items() if JOINT in choice]
    chosen = members(choices[several[0]]) if several else []
    for word in words if several else ():
        name, _, value = word.lstrip("+~").partition("=")
        require(
            name != "agent" or word in several,
            "agent",
            f"be left out with {several[0]}",
            "all agents are named there",
            value,
            f"agents=[{','.join([*chosen, value])}]",
        )
        require(
            not name.startswith("agent."),
            name,
            f"be left out with {several[0]}",
            "each agent has fields of its own",
            value,
            f"agents.{key_of(chosen[0])}{name.removeprefix('agent')}={value}",
        )
    return [choice for choice in written if choice is not None]


def _in_one_choice(word: str) -> str | None:
    """A word, which may choose agents; None for no agents, which chooses nothing."""
    if not _CHOICE.match(word):
        return word
    try:
        override = OverridesParser.create().parse_override(word)
    except HydraException:
        return word  # Hydra will say what it cannot read
    group, value = override.key_or_group, override.value()
    if group == "agents" and (value is None or value == []):
        return None
    values = value.list if isinstance(value, ChoiceSweep) else [value]
    if group == "agent" and not any(isinstance(value, list) for value in values):
        return word
    return f"agent={','.join(_choice_of(group, value) for value in values)}"


def _choice_of(group: str, value: Any) -> str:
    """The choice that a list of agents is; `agent=ddqn` is that of one."""
    text = value.text if isinstance(value, QuotedString) else value
    if group == "agent" and isinstance(text, str):
        return text
    names = [
        x.text if isinstance(x, QuotedString) else x
        for x in (text if isinstance(text, list) else [text])
    ]
    for name in names or [[]]:
        if not isinstance(name, str) or not name:
            raise unknown_name(group, shortened(name), registry.names("agent"))
    names = [part for name in names for part in members(name)]
    twice = [key for key, count in Counter(map(key_of, names)).items() if count > 1]
    require(
        not twice,
        group,
        "name each agent once",
        "each is a family",
        ", ".join(twice),
        f"{group}=[...] with each of them once",
    )
    return JOINT.join(names) if len(names) > 1 else f"{names[0]}{JOINT}"


def members(choice: str) -> list[str]:
    """The agents that a choice of the group `agent` names."""
    return [name for name in choice.split(JOINT) if name] or [choice]


def key_of(name: str) -> str:
    """What an agent's fields and columns are called; of `my_module:MyAgent` `my_module_MyAgent`."""
    return re.sub(r"[^\w-]+", "_", name)


# --- what Hydra is told --------------------------------------------------------------------------


def node(choice: str, shares: bool) -> dict[str, Any]:
    """The fields of several agents, under `agents`.

    Args:
      choice: `ddqn+ppo`.
      shares: whether they share generations, so that there is something to weigh and compare.
    """
    agents: dict[str, Any] = serialize.to_plain(FamiliesConfig()) if shares else {}
    for name in members(choice):
        fields = registry.defaults("agent", name)
        require(
            "weight" not in fields,
            "agents",
            "have no field `weight` of their own",
            "that is their share of the members",
            name,
            f"agent={name}",
        )
        weight = {"name": name, "weight": 1.0} if shares else {}
        agents[key_of(name)] = weight | fields
    return {"agents": agents}


def tuned(
    choice: str, settings: Iterable[tuple[str, str, str, Mapping[str, Any]]]
) -> Iterator[tuple[str, str, str, dict[str, Any]]]:
    """The settings tuned for each of several agents together, as settings of their choice.

    Args:
      choice: `ddqn+ppo`.
      settings: of a task and proxy, from `presets.settings`. What they hold for an agent beside its
        own fields is left out, as all agents share the rest.
    """
    found: dict[str, dict[str, Any]] = {}
    for preset, kind, name, values in settings:
        if kind == "tuned_agent" and name in members(choice):
            found.setdefault(preset, {})[key_of(name)] = values.get("agent", {})
    for preset, agents in found.items():
        yield preset, "tuned_agent", choice, {"agents": agents}


def unknown_field(field: str, choices: Iterable[str]) -> ConfigError | None:
    """What is wrong with `agents.x.y`, if it is not the field's name."""
    chosen = [key_of(name) for choice in choices if JOINT in choice for name in members(choice)]
    key = field.split(".")[1]
    if not chosen:
        return ConfigError(
            f"{field} must come with several agents, because it is about those; got none. "
            f"Set agents=[ddqn,ppo]."
        )
    if "." not in field.partition(".")[2] or key in chosen:
        return None
    return ConfigError(
        f"{field} must be of one of the agents {', '.join(chosen)}, because nothing else is read; "
        f"got {key}. Set agents=[{','.join(chosen)},{key}]."
    )
