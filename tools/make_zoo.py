"""Writes docs/zoo.md: a table of what ships with the package.

    python tools/make_zoo.py

What stands above the table is written by hand, in the page itself.
"""

from pathlib import Path

import sejax
from sejax.ops.files import write_text
from sejax.proxies.zoo import table

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "zoo.md"


def page() -> str:
    """The text of the page."""
    head = PAGE.read_text(encoding="utf-8").partition("\n\n| name |")[0]
    return f"{head}\n\n{table([row(proxy) for proxy in sejax.pretrained()])}\n"


def row(proxy: sejax.PretrainedProxy) -> dict[str, str]:
    """A proxy's row of the table."""
    solved_reward = sejax.load_proxy(proxy.name).task.solved_reward
    means: dict[str, float] = {}
    for evaluation in proxy.on_proxy:
        means.setdefault(evaluation.agent, evaluation.return_mean)
    solving = [agent for agent, mean in means.items() if mean >= solved_reward]
    return {
        "name": f"`{proxy.name}`",
        "learned with": proxy.row["learned with"],
        "solved by": ", ".join(solving) or "none",
        "not by": ", ".join(agent for agent in means if agent not in solving),
        "score": proxy.row["return"],
        "steps": proxy.row["steps"],
        "real steps": proxy.row["real steps"],
    }


if __name__ == "__main__":
    write_text(PAGE, page())
    print(f"{PAGE} has {len(sejax.pretrained())} proxies.")
