"""From the words that a user types to trees of plain values; the notations of agents.

A word is `group=choice`, `group.field=value` or `field=value`. `texts_of` splits words into names
and texts; `trees_of` makes a tree of them, and of the file that `preset=FILE.yaml` names.
`command_config` lays this tree over the layers below it. Names are checked later, when the tree
becomes dataclasses. Agents have notations of their own:

======================================= =======================================================
words                                   tree
======================================= =======================================================
`agent=ddqn`, `agents=[ddqn,ppo]`       `{"agents": {"ddqn": {"name": "ddqn"}, ...}}`
`agents.big=ddqn agents.big.tau=0.1`    `{"agents": {"big": {"name": "ddqn", "tau": "0.1"}}}`
`agent.tau=0.1`, of all agents          `{"agent": {"tau": "0.1"}}`, until their keys are known;
                                        then `{"agents": {"ddqn": {"tau": "0.1"}}}` (`by_agent`)
======================================= =======================================================

Messages and `--help` name an only agent's fields as `agent.tau` (`typed_name`).
"""

import itertools
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import yaml

from sejax.options import ConfigError, old, registry, require, shortened
from sejax.options.plain import flatten, merge, split, unquoted, with_home

Tree: TypeAlias = dict[str, Any]  # nested plain values
NAME = re.compile(r"[A-Za-z_][\w.-]*")  # a field's name
# A choice may stand beside its fields, as in config.yaml.
CHOICES = {f"{group}.name": group for group in registry.GROUPS}
# First parts of fields' names that have dots.
DOTTED = {*registry.GROUPS, "agents", "mixture", "training", "real_training"}
CHOOSE_ALL = {"agent", "agents"}  # words that choose all agents
# `agents.KEY`; the two names that it leaves out are fields that a mixture had in older versions.
BY_KEY = re.compile(r"agents\.(?!(aggregate|compared_by)$)[^.]+")
# What reading a file of YAML may raise.
UNREADABLE = (OSError, yaml.YAMLError, ValueError, TypeError, AttributeError, RecursionError)


def texts_of(overrides: Sequence[str]) -> dict[str, str]:
    """Splits any command's words into names and texts; of words with one name the last counts.

    Raises:
      ConfigError: for a word that is not of the form NAME=TEXT, or has several values.

    Example:
      >>> texts_of(["env=acrobot", "agents=[ddqn,ppo]"])
      {'env': 'acrobot', 'agents': '[ddqn,ppo]'}
    """
    is_list = isinstance(overrides, list | tuple) and all(isinstance(x, str) for x in overrides)
    require(is_list, "overrides", "must be a list of text", got=overrides, use='["env=cartpole"]')
    texts = {}
    for override in overrides:
        name, equals, text = override.partition("=")
        if not (equals and NAME.fullmatch(name)):
            field, _, after = name.strip("-. ").partition(" ")
            if not NAME.fullmatch(field):  # such as a path with spaces
                field, after = name.strip("-. "), ""
            field = shortened(field or "NAME")
            is_choice = any(registry.is_registered(group, field) for group in registry.GROUPS)
            is_name = field.isascii() and field.isidentifier() and not is_choice
            is_field = name.startswith("-") or field.partition(".")[0] in DOTTED or is_name
            value = f"{field}={shortened((after or text).strip()) or 'VALUE'}"
            fix = f"Write {value if is_field else f'env={field} or proxy={field}'}."
            raise ConfigError("an override", "must read FIELD=VALUE", got=override, fix=fix)
        first, *others = split(text)
        is_open = text.startswith("[") and not text.endswith("]")
        if others or is_open:
            use = shortened(f"{text.rstrip(',')}]" if is_open else first)
            rule = "must be one value; a list stands in brackets, without spaces"
            raise ConfigError(name, rule, got=text, use=use)
        texts[CHOICES.get(name, name)] = text
    return texts


def trees_of(overrides: Sequence[str], groups: Collection[str]) -> tuple[Tree, Tree]:
    """The tree of the file that `preset=FILE.yaml` names, empty without one; the tree of the words.

    Args:
      overrides: as typed after a command.
      groups: groups of plugins whose choices are fields of the command.

    Raises:
      ConfigError: as `texts_of`, and for a file that cannot be read.

    Example:
      >>> trees_of(["agent=ddqn", "es.noise_std=0.1"], ["es"])
      ({'agents': {}}, {'agents': {'ddqn': {'name': 'ddqn'}}, 'es': {'noise_std': '0.1'}})
    """
    texts: Tree = {name: unquoted(text) for name, text in texts_of(overrides).items()}
    if not texts.get("preset", "").endswith((".yaml", ".yml")):
        return {"agents": {}}, _tree(texts, groups)
    path = Path(with_home(texts.pop("preset")))
    typed = _tree(texts, groups)
    try:
        values = flatten(read_yaml(path))
        file = _tree({CHOICES.get(name, name): x for name, x in values.items()}, groups)
        drop_other_choices(file, typed, groups)
        return drop_replaced(file, typed, is_whole=bool(CHOOSE_ALL & texts.keys())), typed
    except ConfigError:  # it is readable
        raise
    except UNREADABLE as error:
        rule = f"must be a name or a YAML file; got {shortened(path, 40)} ({shortened(error)})"
        raise ConfigError("preset", rule, use="best") from error


def read_yaml(path: Path) -> Any:
    """The values of a file of YAML.

    Raises:
      OSError, ValueError, yaml.YAMLError: if it cannot be read, its values have many levels, or
        its aliases stand for values with aliases. A few lines of these can make billions of values;
        other aliases are as long as the file.
    """
    text = path.read_text(encoding="utf-8")
    anchors: list[bool] = []  # of the open collections
    for event in yaml.parse(text):
        if len(anchors) > 50:  # the time to read them grows with the square of their number
            raise ValueError("its values have more than 50 levels")
        if isinstance(event, yaml.CollectionStartEvent):
            anchors.append(event.anchor is not None)
        elif isinstance(event, yaml.CollectionEndEvent):
            anchors.pop()
        elif isinstance(event, yaml.AliasEvent) and any(anchors):
            raise ValueError("it has aliases within what has an anchor")
    return yaml.safe_load(text)


def _tree(values: Mapping[str, Any], groups: Collection[str]) -> Tree:
    """Values by their names in words as a tree: `env=acrobot` is `env.name=acrobot`."""
    tree: Tree = {"agents": chosen_agents(values)}
    for name in [name for name in values if name not in CHOOSE_ALL]:
        path = f"{name}.name" if name in groups or BY_KEY.fullmatch(name) else name
        value = values[name]
        for part in reversed(path.split(".")):
            value = {part: value}
        tree = merge(tree, value)
    return old.upgraded(tree)


def drop_other_choices(below: Tree, typed: Tree, groups: Iterable[str]) -> None:
    """Removes the fields of each choice that a typed one replaces."""
    for group in groups:
        name = typed.get(group, {}).get("name")
        if name is not None and below.get(group, {}).get("name", name) != name:
            del below[group]


def expand(overrides: Sequence[str]) -> list[list[str]]:
    """The words of each run of a sweep: commas outside of brackets separate values.

    Example:
      >>> expand(["env=acrobot", "seed=0,1"])
      [['env=acrobot', 'seed=0'], ['env=acrobot', 'seed=1']]
    """
    pairs = (override.partition("=") for override in overrides)
    values = [[f"{name}{equals}{value}" for value in split(text)] for name, equals, text in pairs]
    return [list(of_run) for of_run in itertools.product(*values)]


# --- agents ---------------------------------------------------------------------------------------


def chosen_agents(values: Mapping[str, Any]) -> Tree:
    """The agents that `agent=ddqn` or `agents=[ddqn,ppo]` choose, by key.

    Raises:
      ConfigError: if both words are there, or one names an agent twice or none.
    """
    known: list[str] = []
    for word in [word for word in values if word in CHOOSE_ALL and values[word] is not None]:
        text = str(values[word])
        is_list = text.startswith("[") and text.endswith("]")
        names = [unquoted(x) for x in split(text[1:-1] if is_list else text)]
        is_clear = all(names) and not known and len({*names}) == len(names)
        every = ",".join(dict.fromkeys(filter(None, [*known, *names])))
        fix = f"Set agents=[{every or 'ddqn'}] alone."
        require(is_clear, word, "must name each agent once, in one word", got=text, fix=fix)
        known = names
    return {registry.key_of(name): {"name": name} for name in known}


def agent_names(agents: Mapping[str, Any]) -> dict[str, str]:
    """The names of the chosen agents by their keys."""
    return {k: str(x["name"]) for k, x in agents.items() if isinstance(x, Mapping) and "name" in x}


def drop_replaced(file: Tree, typed: Tree, is_whole: bool) -> Tree:
    """The tree of a file without the agents, and their weights, that typed choices replace.

    Args:
      file: the file's tree.
      typed: the words' tree.
      is_whole: whether words choose all agents; `agents.KEY=ppo` chooses one.
    """
    typed_names = agent_names(typed["agents"])
    if not typed_names:
        return file
    if file["agents"]:
        file = by_agent(file, file["agents"])  # the file's `agent.FIELD` are of its own agents
    agents = file["agents"]
    keys = typed_names.keys() if is_whole else agents.keys() | typed_names.keys()
    replaced = {k for k, name in agent_names(agents).items() if typed_names.get(k, name) != name}
    file["agents"] = {key: x for key, x in agents.items() if key in keys - replaced}
    mixture = file.pop("mixture", {})
    if mixture and len(keys) > 1:
        weights = {key: x for key, x in mixture.get("weights", {}).items() if key in keys}
        file["mixture"] = {**mixture, "weights": weights}
    return file


def by_agent(tree: Tree, keys: Iterable[str]) -> Tree:
    """The tree with the fields of `agent` under each agent's key, below the agent's own fields.

    Args:
      tree: of words, or of a file.
      keys: of the chosen agents.

    Example:
      >>> by_agent({"agents": {"ddqn": {"tau": "1"}}, "agent": {"tau": "0.1"}}, ["ddqn", "td3"])
      {'agents': {'ddqn': {'tau': '1'}, 'td3': {'tau': '0.1'}}}
    """
    others = {name: x for name, x in tree.items() if name != "agent"}
    return others | {"agents": merge(dict.fromkeys(keys, tree.get("agent", {})), tree["agents"])}


def typed_name(name: str, keys: Collection[str]) -> str:
    """A field's name as a user types it, with agents of these keys.

    Example:
      >>> typed_name("agents.ddqn.tau", ["ddqn"]), typed_name("agents.ddqn.tau", ["ddqn", "ppo"])
      ('agent.tau', 'agents.ddqn.tau')
    """
    prefix = f"agents.{next(iter(keys), '')}"
    is_only = len(keys) == 1 and f"{name}.".startswith(f"{prefix}.")
    return "agent" + name.removeprefix(prefix) if is_only else name
