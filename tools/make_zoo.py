"""Writes docs/zoo.md: a table of the proxies that ship with the package, and the card of each.

python tools/make_zoo.py
"""

import re
from pathlib import Path

import sejax
from sejax.ops.files import write_text
from sejax.proxies.zoo import PretrainedProxy, spread

PAGE = Path(__file__).parents[1] / "docs" / "zoo.md"

HEAD = """\
# The zoo

Proxies that ship with the package. `sejax.load("cartpole")` loads one as a gymnax environment,
`sejax.gym.make("cartpole")` a synthetic environment (`se`) for Gymnasium. `sejax.pretrained()`
lists them with all that stands here. `python tools/make_zoo.py` makes this page of their files;
`python tools/ship_proxy.py --help` says how one gets into the package.

*Return* and *steps* are from the lowest to the highest of the kinds of agents that were trained on
the proxy and tested on the real task: the mean return there, and how long an agent trained.

| name | kind | task | learned with | tested with | return | steps | CPU seconds | real steps | kB |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
"""


def page() -> str:
    """The text of the page."""
    proxies = sejax.pretrained()
    cards = [re.sub(r"^#", "##", proxy.card, flags=re.MULTILINE) for proxy in proxies]
    return HEAD + "\n".join(map(row, proxies)) + "\n\n" + "\n\n".join(cards) + "\n"


def row(proxy: PretrainedProxy) -> str:
    """A line of the table."""
    tested = dict.fromkeys(each.agent for each in proxy.on_proxy)
    cells = (
        f"[{proxy.name}](#{proxy.name})", proxy.kind, proxy.task, ", ".join(proxy.agents),
        ", ".join(tested), spread([each.return_mean for each in proxy.on_proxy], ".1f"),
        spread([each.train_steps for each in proxy.on_proxy], ",.0f"),
        f"{proxy.learning.cpu_s:,.0f}" if proxy.learning else "",
        f"{proxy.learning.real_steps:,}" if proxy.learning else "", f"{proxy.size_kb:.1f}",
    )  # fmt: skip
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    write_text(PAGE, page())
    print(f"{PAGE} has {len(sejax.pretrained())} proxies.")
