"""The command line's words to a configuration, by Hydra.

What can be chosen is not written in YAML: the nodes of a group are made from the dataclasses that
its names stand for (`sejax.registry`), those of a task's tuned settings from one file for each task
and proxy (`sejax.cli.presets`).
"""

import contextlib
import functools
import itertools
import re
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override, QuotedString
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sejax import agents, envs, registry, serialize
from sejax.cli import build, families, presets
from sejax.cli.words import ENDING, without_files
from sejax.errors import ConfigError, nearest, require, shortened, unknown_name
from sejax.proxies import header
from sejax.training import TrainingConfig

CONF_DIR = Path(__file__).parents[1] / "conf"
# As in conf/run.yaml.
_DEFAULT_ENV, _DEFAULT_PROXY, _DEFAULT_AGENT = "cartpole", "se", "ddqn"
_DEFAULT_OBJECTIVE = "max_reward"
_OF_TASK = "of_task"  # as in conf/evaluate.yaml
_GROUPS = tuple(registry.GROUPS)
# Groups that no word may choose.
_INTERNAL = ("base", "tuned", "tuned_agent", "tuned_es", "tuned_objective")
_NAME = re.compile(r"(\w+)\.name")
_CHOICE = re.compile(rf"(?:\+\+?)?({'|'.join(_GROUPS)}|preset)=(.*)", re.DOTALL)


def config(overrides: Sequence[str] = ()) -> build.LearnConfig:
    """Composes and validates a configuration from command-line overrides.

    Args:
      overrides: Hydra overrides as typed after `python -m sejax.run`.

    Raises:
      ConfigError: for an unknown group, choice or field, or a value out of range.

    Example:
      >>> config(["env=acrobot", "generations=7"]).generations
      7
    """
    with registry.only_typed(overrides):
        return learn_config(_compose("run", overrides))


def evaluate_config(overrides: Sequence[str] = ()) -> build.EvaluateConfig:
    """As `config`, for the words after `python -m sejax.evaluate`."""
    with registry.only_typed(overrides):
        return evaluate_config_of(_compose("evaluate", overrides))


def learn_config(cfg: DictConfig) -> build.LearnConfig:
    """The typed and validated configuration of a composed Hydra one."""
    return build.learn_config(to_plain(cfg))


def evaluate_config_of(cfg: DictConfig) -> build.EvaluateConfig:
    """As `learn_config`, for `sejax.evaluate`."""
    return build.evaluate_config(to_plain(cfg))


def to_plain(cfg: DictConfig) -> dict[str, Any]:
    """A composed configuration as plain values, with every interpolation resolved.

    Raises:
      ConfigError: for an interpolation of what is not there.
    """
    try:
        plain: Any = OmegaConf.to_container(cfg, resolve=True)
    except OmegaConfBaseException as error:
        raise ConfigError(_first_line(error)) from error
    plain.pop("hydra", None)
    return plain


def help_text(name: str, overrides: Sequence[str]) -> str:
    """What `--help` prints: what can be chosen, and the configuration that these words compose.

    Not Hydra's own, which lists the settings of presets as choices, and takes seconds to.

    Args:
      name: of the command: run or evaluate.
      overrides: the words after it.

    Raises:
      ConfigError: for words that cannot be composed.
    """
    cfg = _compose(name, overrides, return_hydra_config=True)
    about = cfg.hydra.help
    groups = _GROUPS if name == "run" else build.EVALUATE_GROUPS
    choices = {
        group: [
            *registry.names(group),
            *(f"{start}ID" for start in registry.GROUPS[group].families),
            "module:attribute",
        ]
        for group in groups
    } | ({"preset": [*presets.names(), f"FILE{ENDING}"]} if name == "run" else {})
    listed = "\n".join(
        textwrap.fill(f"  {group}: {', '.join(names)}", 98, subsequent_indent="    ")
        for group, names in choices.items()
    )
    fields = OmegaConf.to_yaml({key: value for key, value in cfg.items() if key != "hydra"})
    return (
        f"{about.header}\n\nChoices (group=choice):\n{listed}\n\n"
        f"Fields, as these words set them (field=value, group.field=value):\n"
        f"{textwrap.indent(fields, '  ')}\n{about.footer}\n"
        f"Also: --cfg job (the configuration as YAML), --multirun (sweeps: seed=0,1,2)."
    )


def hydra_words(words: Sequence[str]) -> list[str]:
    """A command's words as Hydra is told them: preset files read, several agents in one choice.

    Raises:
      ConfigError: for a file or agents that cannot be.
    """
    for before, word in itertools.pairwise(["", *words]):
        is_override = "=" in word or word[:1] in ("-", "~", "") or before.startswith("-")
        require(
            is_override,
            "a word",
            "be FIELD=VALUE",
            "nothing else is read",
            word,
            f"env={word} or proxy={word}, if that is meant",
        )
    return families.in_one_choice(without_files(words))


def _compose(name: str, overrides: Sequence[str], **options: Any) -> DictConfig:
    overrides = hydra_words(overrides)
    try:
        register(name, overrides)
        if GlobalHydra.instance().is_initialized():  # within a command: Hydra knows the folder
            return compose(name, overrides=list(overrides), **options)
        with initialize_config_dir(str(CONF_DIR), version_base="1.3"):
            return compose(name, overrides=list(overrides), **options)
    except (HydraException, OmegaConfBaseException) as error:
        raise translate_hydra_error(error, overrides) from error


# --- what can be chosen --------------------------------------------------------------------------


def register(name: str, overrides: Sequence[str]) -> None:
    """Makes all choices known to Hydra, those in these words that are somebody's own too.

    Args:
      name: of the command: run or evaluate.
      overrides: the words after it, as of `hydra_words`.

    Raises:
      ConfigError: for a choice that is none, or one of somebody's own that cannot be imported.
    """
    groups = _GROUPS if name == "run" else build.EVALUATE_GROUPS
    _require_choices((*groups, "preset") if name == "run" else groups, overrides)
    store = ConfigStore.instance()
    for group in (*_GROUPS, "preset", *_INTERNAL):  # `proxy` is a group of run, a field of evaluate
        store.repo.pop(group, None)
    training = serialize.to_plain(TrainingConfig())
    base = {"training": training}
    if name == "evaluate":
        base["real_training"] = training
    store.store(name="base", node=base)
    chosen = _choices(overrides)
    for group in groups:
        store.repo[group] = dict(_built_in_nodes(group))
        others = dict.fromkeys([*registry.names(group), *chosen.get(group, ())])
        for choice in (name for name in others if name not in registry.GROUPS[group].built_in):
            if group == "agent" and families.JOINT in choice:
                node = families.node(choice, shares=name == "run")
                _store(group, choice, node, package="_global_")
            else:
                _register_choice(group, choice, choice in chosen.get(group, ()), overrides)
    if name == "run":
        _register_presets(chosen)
    else:
        _store("agent", _OF_TASK, registry.defaults("agent", _agent_of_proxy(overrides)))


def _require_choices(groups: tuple[str, ...], overrides: Sequence[str]) -> None:
    """Checks the words that choose: Hydra takes none but a name, and looks for it as a file.

    Raises:
      ConfigError: for a choice that is not known, or is taken away.
    """
    parser = OverridesParser.create()
    for word in overrides:
        try:
            override = parser.parse_override(word)
        except HydraException:
            continue  # Hydra will say what it cannot read
        group = override.key_or_group
        if not group or group in _INTERNAL:
            raise _unknown_field(group, overrides)
        if (named := _NAME.fullmatch(group)) and named[1] in groups:
            # It would choose after the settings that are tuned for the choice were looked up.
            raise ConfigError(
                f"{group} must not be set, because a choice brings more than its name; got "
                f"{shortened(word)}. Set {named[1]}={shortened(word.partition('=')[2])}."
            )
        if group in groups:
            require(
                not override.is_delete(),
                group,
                "be chosen",
                "nothing works without it",
                word,
                f"{group}=NAME",
            )
            for choice in _values(override):
                _require_choice(group, choice)


def _values(override: Override) -> list[Any]:
    """What a word sets, or each value of a sweep that lists them."""
    value = override.value()
    if isinstance(value, ChoiceSweep):
        return [x.text if isinstance(x, QuotedString) else x for x in value.list]
    return [] if override.is_sweep_override() else [value]


def _require_choice(group: str, choice: Any, field: str = "") -> None:
    if group == "agent" and isinstance(choice, str) and families.JOINT in choice:
        for name in families.members(choice):
            _require_choice(group, name, "agents")
        return
    known = presets.names() if group == "preset" else registry.names(group)
    is_own = (
        group != "preset"
        and isinstance(choice, str)
        and (registry.is_registered(group, choice) or ":" in choice)
    )
    if choice not in known and not is_own:
        raise unknown_name(field or group, choice, known)


def _choices(overrides: Iterable[str]) -> dict[str, list[str]]:
    """The choices in the words of a command line, also of sweeps: `env=a,b`."""
    found: dict[str, list[str]] = {}
    for match in filter(None, map(_CHOICE.fullmatch, overrides)):
        values = match[2].removeprefix("choice(").removesuffix(")")
        choices = [value.strip(" '\"") for value in values.split(",")]
        found.setdefault(match[1], []).extend(value for value in choices if value)
    return found


@functools.cache
def _built_in_nodes(group: str) -> dict[str, Any]:
    """Hydra's nodes of what comes with sejax, which are the same whatever the words; by file."""
    repo = ConfigStore.instance().repo
    repo.pop(group, None)
    for choice in registry.GROUPS[group].built_in:
        _register_choice(group, choice, False, ())
    return dict(repo.pop(group))


def _register_choice(group: str, choice: str, is_chosen: bool, overrides: Sequence[str]) -> None:
    """A choice with its fields; of those that packages offer, only if it is chosen."""
    is_own = choice not in registry.GROUPS[group].built_in
    known = registry.is_registered(group, choice) or ":" in choice
    if not known or (is_own and not is_chosen):
        if choice in registry.names(group):
            _store(group, choice, {"name": choice})
        return  # Hydra will say that it does not know it
    node = registry.defaults(group, choice)
    changes: dict[str, str] = {}
    if group == "env":
        agent = _agent_for(choice, is_own, node, overrides)
        changes = {"agent": agent} if agent != _DEFAULT_AGENT else {}
    elif group == "proxy":
        wanted = registry.find(group, choice).default_objective
        changes = {"objective": wanted} if wanted != _DEFAULT_OBJECTIVE else {}
    if changes:  # chooses of another group too, where that is left open
        defaults = [{f"override /{other}": value} for other, value in changes.items()]
        _store(group, choice, {"defaults": defaults, group: node}, package="_global_")
    else:
        _store(group, choice, node)


def _agent_for(choice: str, is_own: bool, node: dict[str, Any], overrides: Sequence[str]) -> str:
    """The agent that learns in a task where the command line names none."""
    states_spec = hasattr(registry.find("env", choice), "spec")
    if not states_spec and (not is_own or "agent" in _choices(overrides)):
        return _DEFAULT_AGENT
    fields: dict[str, Any] = {}
    if not states_spec:  # the task must be made to know: with the fields that are asked for
        given = {word.partition("=")[0]: word.partition("=")[2] for word in overrides}
        fields = {
            name.removeprefix("env."): to_plain(OmegaConf.create({"x": parsed(value)}))["x"]
            for name, value in given.items()
            if name.startswith("env.")
        }
    if "???" in {**node, **fields}.values():
        return _DEFAULT_AGENT  # what is missing is said later
    return agents.default_for(envs.spec_of(registry.configure("env", {**node, **fields})))


def _agent_of_proxy(overrides: Sequence[str]) -> str:
    """The agent that is evaluated on a proxy where the command line names none.

    Raises:
      ConfigError: for a sweep over proxies that want different ones.
    """
    values = _last_values(overrides, ("agent", "agents", "proxy", "env"))
    if "agent" in values or "agents" in values:
        return _DEFAULT_AGENT  # not used
    found = {
        _agent_on(str(proxy), env)
        for proxy in values.get("proxy", [""])
        for env in values.get("env", [None])
    }
    require(
        len(found) == 1,
        "agent",
        "be given",
        "the proxies of this sweep have tasks of different kinds",
        f"none, with {', '.join(sorted(found))} for them",
        "agent=ppo, which suits all with vectors as states",
    )
    return found.pop()


def _last_values(overrides: Sequence[str], names: Sequence[str]) -> dict[str, list[Any]]:
    """What the last word of each name sets: a value, or those of a sweep."""
    found = {}
    parser = OverridesParser.create()
    for word in overrides:
        with contextlib.suppress(HydraException):  # Hydra will say what it cannot read
            override = parser.parse_override(word)
            if override.key_or_group in names:
                found[override.key_or_group] = [
                    x.text if isinstance(x, QuotedString) else x for x in _values(override)
                ]
    return found


def _agent_on(source: str, env: Any) -> str:
    """The agent of one proxy's task; what a file names is not imported."""
    given = {"name": env} if isinstance(env, str) else None
    try:
        if source not in ("", "real"):
            _, stored = header.read(source, "proxy")
            return agents.default_for(envs.TaskSpec.of_interface(stored.interface))
        return agents.default_for(envs.spec_of(registry.configure("env", given or {})))
    except ConfigError:
        return _DEFAULT_AGENT  # what is wrong is said later


def parsed(text: str) -> Any:
    """What YAML reads in a word's value; the text itself if it reads nothing."""
    import yaml

    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return text


def _register_presets(chosen: dict[str, list[str]]) -> None:
    """The tuned settings of the chosen tasks and proxies."""
    for preset in presets.names():
        _store("preset", preset, {"preset": preset}, package="_global_")
    for env in dict.fromkeys([_DEFAULT_ENV, *chosen.get("env", ())]):
        for proxy in dict.fromkeys([_DEFAULT_PROXY, *chosen.get("proxy", ())]):
            settings = list(presets.settings(env, proxy))
            settings += [
                tuned
                for choice in chosen.get("agent", ())
                if families.JOINT in choice
                for tuned in families.tuned(choice, settings)
            ]
            for preset, kind, choice, values in settings:
                name = f"{env}-{proxy}" + (f"-{choice}" if choice else "")
                _store(f"{kind}/{preset}", name, dict(values), package="_global_")


def _store(group: str, name: str, node: dict[str, Any], package: str | None = None) -> None:
    """A node for Hydra; a name with slashes is a path in its group."""
    folder, _, leaf = f"{group}/{name}".rpartition("/")
    ConfigStore.instance().store(group=folder, name=leaf, node=node, package=package or group)


# --- messages ------------------------------------------------------------------------------------


def translate_hydra_error(error: Exception, overrides: Iterable[str] = ()) -> ConfigError:
    """One clear sentence for what Hydra refused; unknown choices get the nearest known ones."""
    text = str(error)
    missing = _between(text, "Could not find '", "'")
    if missing and missing.startswith("tuned/"):
        return _no_preset(missing.removeprefix("tuned/"))
    if missing and "Available options" in text:
        group, _, got = missing.partition("/")
        if group in registry.GROUPS:
            return unknown_name(group, got, registry.names(group))
        if group == "preset":
            return unknown_name(group, got, presets.names())
    key = _between(text, "Could not override '", "'")
    if key:
        return _unknown_field(key, overrides)
    return ConfigError(_first_line(error))


def _no_preset(name: str) -> ConfigError:
    preset, _, pair = name.partition("/")
    env, _, proxy = pair.rpartition("-")
    known = presets.tuned(proxy, preset)
    fix = f"Set preset=best, or env={known[0]}." if known else "Set preset=best."
    tasks = f" ({', '.join(known)} with proxy={proxy})" if known else ""
    return ConfigError(
        f"preset must be one that the paper or a measurement defines for the task{tasks}, because "
        f"it holds that task's numbers; got preset={preset} for {env} with proxy={proxy}. {fix}"
    )


def _unknown_field(key: str, overrides: Iterable[str]) -> ConfigError:
    chosen = _choices(overrides)
    if key.startswith("agents."):
        refusal = families.unknown_field(key, chosen.get("agent", ()))
        if refusal is not None:
            return refusal
    group, known = key.rpartition(".")[0], _known_fields(chosen)
    siblings = [name for name in known if name.rpartition(".")[0] == group]
    if key in siblings:
        return ConfigError(
            f"override must name a field of the chosen {group}, because nothing else is read; "
            f"got {key}, which another choice of {group} has. See --cfg job for its fields."
        )
    in_groups = [name for name in known if name.rpartition(".")[2] == key]
    ranked = in_groups or nearest(key, siblings or known)
    return ConfigError(
        f"override must name a field of the configuration, because nothing else is read; got "
        f"{shortened(key)}. Did you mean {ranked[0]}? Fields there: {', '.join(ranked)}."
    )


def _known_fields(chosen: dict[str, list[str]]) -> list[str]:
    """Every field of every choice, and the plain ones."""
    import dataclasses

    schemas = (build.LearnConfig, build.EvaluateConfig)
    typed = {*registry.GROUPS, *build.TRAININGS, "agents"}
    known = [
        f.name for schema in schemas for f in dataclasses.fields(schema) if f.name not in typed
    ]
    for group in registry.GROUPS:
        for choice in dict.fromkeys([*registry.names(group), *chosen.get(group, ())]):
            try:
                if group == "agent" and families.JOINT in choice:
                    known += serialize.flatten(families.node(choice, shares=True))
                else:
                    known += [f"{group}.{name}" for name in registry.defaults(group, choice)]
            except ConfigError:
                continue
    for training in build.TRAININGS:
        known += [f"{training}.{f.name}" for f in dataclasses.fields(TrainingConfig)]
    return list(dict.fromkeys(known))


def _between(text: str, start: str, end: str) -> str:
    _, found, rest = text.partition(start)
    return rest.partition(end)[0] if found else ""


def _first_line(error: Exception) -> str:
    message = getattr(error, "msg", None) or str(error)
    key = getattr(error, "full_key", None)
    line = shortened((str(message).strip().splitlines() or [type(error).__name__])[0], 400)
    return f"{line.rstrip('.')}{f' in {key}' if key and key not in line else ''}."
