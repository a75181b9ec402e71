"""What can be done with a run: the commands that go on with it."""

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sejax.cli import config as configuration
from sejax.options import ConfigError, as_text, registry
from sejax.options.registry import flatten


def evaluate_words(
    proxy: Any, env_name: str, kind: str, agents: Sequence[str], has_real_steps: bool
) -> list[str]:
    """What `sejax.evaluate` must be told.

    Args:
      proxy: a run directory.
      env_name: the task's.
      kind: the proxy's name.
      agents: names of those that it was learned with.
      has_real_steps: whether the proxy keeps the real dynamics.
    """
    words = [f"proxy={proxy}"]
    words += [f"env={env_name}"] if ":" in env_name else []
    words += [f"proxy_kind={kind}"] if ":" in kind else []
    # An RN is judged with the agent that it was learned with; an SE is meant for the paper's.
    if has_real_steps and not any(":" in name for name in agents):
        words.append("agent_hparams=as_learned")
    elif len(agents) > 1:
        words.append(f"agents=[{','.join(agents)}]")
    elif list(agents) != ["ddqn"]:
        words.append(f"agent={agents[0]}")
    return [*words, "num_agents=20"]


def of_stored(stored: dict[str, Any], path: Path, generations: int | None) -> list[tuple[str, str]]:
    """What can be done with a stored run, each with its command.

    Args:
      stored: the run's configuration as `config.yaml` has it; nothing that it names is imported.
      path: the run directory.
      generations: that it may go on to; None if it is over.
    """
    kind = str(stored["proxy"]["name"])
    words = evaluate_words(
        path, str(stored["env"]["name"]), kind, agent_names(stored), kind == "rn"
    )
    steps = [
        (
            "Train fresh agents on it, and on the real task beside them",
            _command("sejax.evaluate", words),
        )
    ]
    if not any(":" in name for name in (kind, str(stored["env"]["name"]))):
        steps.append(
            ("Use it as a gymnax environment", f"env, params = sejax.load({json.dumps(str(path))})")
        )
    changes = {"run_dir": str(path), "generations": generations}
    again = run_words(stored | changes) if generations is not None else None
    if again is not None:
        steps.append((f"Go on, to generation {generations:,}", _command("sejax.run", again)))
    return steps


def require_run(stored: dict[str, Any]) -> None:
    """Checks that a stored configuration names what `of_stored` says.

    Raises:
      LookupError, TypeError, AttributeError, ValueError: if it does not.
    """
    for group in ("env", "proxy"):
        str(stored[group]["name"])
    agent_names(stored)
    int(stored["generations"])


def agent_names(stored: dict[str, Any]) -> list[str]:
    """The agents of a stored run, by the names of their choices."""
    several = stored.get("agents") or {}
    families = [each for each in several.values() if isinstance(each, dict)]
    return [str(each["name"]) for each in families or [stored["agent"]]]


def run_words(stored: dict[str, Any]) -> list[str] | None:
    """The words after `python -m sejax.run` that compose a configuration; None if none are known.

    That is so for what is not sejax's own: to know its fields, it would have to be imported.
    """
    several = agent_names(stored) if stored.get("agents") else []
    groups = [x for x in configuration.LearnConfig.groups if x != "agent" or not several]
    names = {group: str(stored.get(group, {}).get("name", "none")) for group in groups}
    named = [*names.items(), *(("agent", name) for name in several)]
    is_known = all(registry.is_registered(group, name) for group, name in named)
    if (
        not is_known or stored.get("preset") not in configuration.preset_names()
    ):  # a run stores no file's name
        return None
    chosen = [f"{group}={names[group]}" for group in ("env", "proxy")]
    chosen += [f"preset={stored['preset']}"] if stored.get("preset") != "best" else []
    chosen += [f"agents=[{','.join(several)}]"] if several else []
    try:
        usual = configuration.plain(configuration.config(chosen))
        others = [
            f"{group}={name}"
            for group, name in names.items()
            if (usual[group] or {}).get("name") != name
        ]
        chosen += others
        usual = flatten(configuration.plain(configuration.config(chosen)) if others else usual)
        asked = flatten(stored)
        words = chosen + [
            f"{name}={as_text(value)}"
            for name, value in asked.items()
            if name in usual and usual[name] != value
        ]
        composed = flatten(configuration.plain(configuration.config(words)))
    except (ConfigError, LookupError, TypeError, AttributeError):
        return None
    return words if all(composed.get(name) == value for name, value in asked.items()) else None


def _command(module: str, words: Sequence[str]) -> str:
    return shlex.join(["python", "-m", module, *words])
