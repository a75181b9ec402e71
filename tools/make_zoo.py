"""Writes docs/zoo.md: a table of what ships with the package.

    python tools/make_zoo.py

What stands above the table is written by hand, in the page itself.
"""

from pathlib import Path

import sejax
from sejax.ops.files import write_text

PAGE = Path(__file__).parents[1] / "docs/zoo.md"


def page() -> str:
    """The text of the page."""
    head = PAGE.read_text(encoding="utf-8").partition("\n\n| name |")[0]
    rows = sorted(map(row, sejax.pretrained()), key=lambda x: x["solved by"] == "none")
    return f"{head}\n\n{table(rows)}\n"


def row(proxy: sejax.PretrainedProxy) -> dict[str, str]:
    """A proxy's row of the table."""
    solved_reward = sejax.load_proxy(proxy.name).task.solved_reward
    # Of an agent with several evaluations the first counts.
    means = {each.agent: each.return_mean for each in reversed(proxy.on_proxy)}
    solved = [name for name in sorted(means) if means[name] >= solved_reward]
    assert proxy.learning
    return {
        "name": f"`{proxy.name}`",
        "solved at": f"{solved_reward:g}",
        "solved by": ", ".join(solved) or "none",
        "not by": ", ".join(sorted(means.keys() - set(solved))),
        "score": spread([each.return_mean for each in proxy.on_proxy], ".1f"),
        "real steps": f"{proxy.learning.real_steps / 1e6:.1f}M",
    }


def spread(values: list[float], spec: str) -> str:
    """The lowest and the highest of some numbers."""
    return " to ".join(dict.fromkeys(format(end, spec) for end in (min(values), max(values))))


def table(rows: list[dict[str, str]]) -> str:
    """A table in Markdown, of rows by the names of their columns."""
    lines = [rows[0].keys(), ["---"] * len(rows[0]), *(row.values() for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    write_text(PAGE, page())
