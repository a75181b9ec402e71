"""What can be done with a run: the command that goes on with it."""

from collections.abc import Sequence
from pathlib import Path


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
