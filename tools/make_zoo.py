"""Writes docs/zoo.md: a table of the proxies that ship with the package, and the card of each.

python tools/make_zoo.py
"""

import re
from pathlib import Path

import sejax
from sejax.ops.files import write_text
from sejax.proxies.zoo import table

PAGE = Path(__file__).parents[1] / "docs" / "zoo.md"

HEAD = """\
# The zoo

Proxies that ship with the package. `sejax.load("cartpole")` loads one as a gymnax environment,
`sejax.gym.make("cartpole")` a synthetic environment (`se`) for Gymnasium. `sejax.pretrained()`
lists them with all that stands here. `python tools/make_zoo.py` makes this page of their files;
`python tools/ship_proxy.py --help` says how one gets into the package.

*Return* and *steps* are from the lowest to the highest of the kinds of agents that were trained on
the proxy and tested on the real task: the mean return there, and how long an agent trained.

"""


def page() -> str:
    """The text of the page."""
    proxies = sejax.pretrained()
    rows = [proxy.row | {"name": f"[{proxy.name}](#{proxy.name})"} for proxy in proxies]
    cards = [re.sub(r"^#", "##", proxy.card, flags=re.MULTILINE) for proxy in proxies]
    return HEAD + "\n\n".join([table(rows), *cards]) + "\n"


if __name__ == "__main__":
    write_text(PAGE, page())
    print(f"{PAGE} has {len(sejax.pretrained())} proxies.")
