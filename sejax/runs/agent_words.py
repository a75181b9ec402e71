"""The notations of agents: how they stand in words, and in trees of plain values.

======================================= =======================================================
words                                   tree
======================================= =======================================================
`agent=ddqn`, `agents=[ddqn,ppo]`       `{"agents": {"ddqn": {"name": "ddqn"}, ...}}`
`agents.big=ddqn agents.big.tau=0.1`    `{"agents": {"big": {"name": "ddqn", "tau": "0.1"}}}`
`agent.tau=0.1`, of an only agent       `{"agent": {"tau": "0.1"}}`, until its key is known; then
                                        `{"agents": {"ddqn": {"tau": "0.1"}}}` (`settled`)
======================================= =======================================================

Messages and `--help` name an only agent's fields as in the last row (`as_typed`).
"""

import re
from collections.abc import Collection, Mapping
from typing import Any, TypeAlias

from sejax.options import ConfigError, registry, require, shortened
from sejax.options.plain import defaults_of, flatten, merge, split, unquoted

Tree: TypeAlias = dict[str, Any]  # nested plain values
WORDS = {"agent", "agents"}  # that choose all agents
# `agents.KEY`; the two names that it leaves out are fields that a mixture had in older versions.
BY_KEY = re.compile(r"agents\.(?!(aggregate|compared_by)$)[^.]+")


def chosen(values: Mapping[str, Any]) -> Tree:
    """The agents that `agent=ddqn` or `agents=[ddqn,ppo]` choose, by key.

    Raises:
      ConfigError: if both words are there, or one names an agent twice or none.
    """
    known: list[str] = []
    for word in [word for word in values if word in WORDS]:
        text = str(values[word])
        is_list = text.startswith("[") and text.endswith("]")
        names = [unquoted(x) for x in split(text[1:-1] if is_list else text)]
        several = ",".join(dict.fromkeys(filter(None, [*known, *names]))) or "ddqn,ppo"
        is_clear = all(names) and not known and len({*names}) == len(names)
        fix = f"Set agents=[{shortened(several)}]."
        require(is_clear, word, "must name each agent once", got=values[word], fix=fix)
        known = names
    return {registry.key_of(name): {"name": name} for name in known}


def names_of(agents: Mapping[str, Any]) -> dict[str, str]:
    """The names of the chosen agents by their keys."""
    named = {key: x for key, x in agents.items() if isinstance(x, Mapping) and "name" in x}
    return {key: str(x["name"]) for key, x in named.items()}


def without_replaced(file: Tree, typed: Tree, is_whole: bool) -> Tree:
    """The tree of a file without the agents, and their weights, that typed choices replace.

    Args:
      file: the file's tree.
      typed: the words' tree.
      is_whole: whether words choose all agents; `agents.KEY=ppo` chooses one.
    """
    named = file["agents"]
    if len(named) == 1:
        file["agents"] = named = {key: merge(x, file.pop("agent", {})) for key, x in named.items()}
    if names := names_of(typed["agents"]):
        keys = names.keys() if is_whole else named.keys() | names.keys()
        others = {k for k, x in names_of(named).items() if names.get(k, x) != x}
        file["agents"] = {key: x for key, x in named.items() if key in keys - others}
        mixture = dict(file.pop("mixture", {}))
        weights = {key: x for key, x in mixture.pop("weights", {}).items() if key in keys}
        if len(keys) > 1:
            file |= {"mixture": mixture | {"weights": weights}} if mixture or weights else {}
            file.pop("agent", None)
    return file


def settled(tree: Tree, names: Mapping[str, str]) -> Tree:
    """The tree with the fields of `agent` under the only agent's key.

    Args:
      tree: of words, or of a file.
      names: names of the chosen agents by key.

    Raises:
      ConfigError: if there are such fields, and several agents.
    """
    fields, key = tree.get("agent", {}), next(iter(names))
    for field, value in flatten(fields).items() if len(names) > 1 else ():
        classes = {key: registry.find("agent", name) for key, name in names.items()}
        having = [key for key, x in classes.items() if field.split(".")[0] in defaults_of(x)]
        fix = f"Set agents.{(having or [key])[0]}.{field:.40}={shortened(value, 40)}."
        raise ConfigError(f"agent.{field:.40}", "must be one agent's", got=value, fix=fix)
    others = {name: x for name, x in tree.items() if name != "agent"}
    return others | {"agents": merge(tree["agents"], {key: fields})}


def as_typed(name: str, keys: Collection[str]) -> str:
    """A field's name as a user types it, with agents of these keys.

    Example:
      >>> as_typed("agents.ddqn.tau", ["ddqn"]), as_typed("agents.ddqn.tau", ["ddqn", "ppo"])
      ('agent.tau', 'agents.ddqn.tau')
    """
    prefix = f"agents.{next(iter(keys), '')}"
    is_only = len(keys) == 1 and f"{name}.".startswith(f"{prefix}.")
    return "agent" + name.removeprefix(prefix) if is_only else name
