"""What can be done with a run: the command that goes on with it."""

from collections.abc import Sequence
from pathlib import Path


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
