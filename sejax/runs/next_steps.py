"""What can be done with a run: the command that goes on with it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sejax.proxies.header import agents_of


def evaluate_words(proxy: Path | str, env_name: str, kind: str, agents: Sequence[str]) -> list[str]:
    """The overrides with which `sejax.evaluate` judges a proxy.

    Args:
      proxy: a run directory.
      env_name: the task's.
      kind: the proxy's name.
      agents: names of those that it was learned with.
    """
    words = [f"proxy={proxy}"]
    words += [f"env={env_name}"] if ":" in env_name else []
    words += [f"proxy_kind={kind}"] if ":" in kind else []
    if any(":" in name for name in agents):  # which are imported only if they are named
        words.append(f"agents=[{','.join(agents)}]" if len(agents) > 1 else f"agent={agents[0]}")
    return [*words, "num_agents=20"]


def title(stored: Mapping[str, Any]) -> str:
    """What a picture of a stored run is of: task, proxy and agents."""
    proxy = str(stored["proxy"]["name"]).upper()
    return f"{stored['env']['name']}, {proxy}, {' + '.join(agent_names(stored))}"


def agent_names(stored: Mapping[str, Any]) -> list[str]:
    """The agents of a stored run, by the names of their choices."""
    return [str(values["name"]) for values in agents_of(stored).values()]
