"""What can be done with a run: the commands that go on with it."""

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sejax.options import as_text


def evaluate_words(
    proxy: Path | str, env_name: str, kind: str, agents: Sequence[str], has_real_steps: bool
) -> list[str]:
    """The overrides with which `sejax.evaluate` judges a proxy.

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


def of_stored(
    stored: Mapping[str, Any], path: Path, generations: int | None
) -> list[tuple[str, str]]:
    """What can be done with a stored run, each with its command.

    Args:
      stored: the run's configuration as `config.yaml` has it; nothing that it names is imported.
      path: the run directory.
      generations: that it may go on to; None if it is over.
    """
    env, kind = str(stored["env"]["name"]), str(stored["proxy"]["name"])
    words = evaluate_words(path, env, kind, agent_names(stored), kind == "rn")
    about = "Train fresh agents on it, and on the real task beside them"
    steps = [(about, _command("sejax.evaluate", words))]
    if ":" not in env + kind:
        load = f"env, params = sejax.load({json.dumps(str(path))})"
        steps.append(("Use it as a gymnax environment", load))
    # What is not sejax's own must be typed: a file names no module.
    chosen = [x["name"] for x in stored.values() if isinstance(x, Mapping) and "name" in x]
    if generations is not None and not any(":" in str(x) for x in (*chosen, *agent_names(stored))):
        folder = as_text(str(path))
        words = [f"preset={as_text(str(path / 'config.yaml'))}", f"run_dir={folder}"]
        again = _command("sejax.run", [*words, f"generations={generations}"])
        steps.append((f"Go on, to generation {generations:,}", again))
    return steps


def require_run(stored: Mapping[str, Any]) -> None:
    """Checks that a stored configuration names what `of_stored` says.

    Raises:
      LookupError, TypeError, AttributeError, ValueError: if it does not.
    """
    for group in ("env", "proxy"):
        str(stored[group]["name"])
    agent_names(stored)
    int(stored["generations"])


def title(stored: Mapping[str, Any]) -> str:
    """What a picture of a stored run is of: task, proxy and agents."""
    proxy = str(stored["proxy"]["name"]).upper()
    return f"{stored['env']['name']}, {proxy}, {' + '.join(agent_names(stored))}"


def agent_names(stored: Mapping[str, Any]) -> list[str]:
    """The agents of a stored run, by the names of their choices."""
    several = stored.get("agents") or {}
    members = [each for each in several.values() if isinstance(each, dict)]
    return [str(each["name"]) for each in members or [stored["agent"]]]


def _command(module: str, words: Sequence[str]) -> str:
    return shlex.join(["python", "-m", module, *words])
