"""Writes docs/zoo.md: a table of the proxies that ship with the package, and the card of each.

    python tools/make_zoo.py

What stands above the table is written by hand, in the page itself.
"""

import re
from collections.abc import Mapping
from pathlib import Path

import pandas as pd

import sejax
from sejax.ops.files import write_text
from sejax.proxies.zoo import table

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "zoo.md"


def page() -> str:
    """The text of the page."""
    proxies = sejax.pretrained()
    tested = verdicts()
    rows = [row(proxy, tested) for proxy in proxies]
    head = PAGE.read_text(encoding="utf-8").partition("\n\n| name |")[0]
    return "\n\n".join([head, table(rows), *map(section, proxies)])


def verdicts() -> dict[str, str]:
    """What the myopia test says of each shipped SE that it was made on, by its name.

    Not of a proxy that was learned anew since.
    """
    names = {f"{proxy.name} (shipped)": proxy.name for proxy in sejax.pretrained()}
    said = {}
    for folder in ROOT.glob("results/se_myopia/*"):
        rows = pd.read_csv(folder / "rows.csv.xz", low_memory=False)
        lines = (folder / "table.md").read_text(encoding="utf-8").splitlines()
        cells = [line.strip("| ").split(" | ") for line in lines]
        verdicts = {line[0]: line[-1] for line in cells}
        tested = rows[rows["set"].isin(names)].drop_duplicates(["set", "group"])
        for key, fingerprint in zip(tested["set"], tested["group"], strict=True):
            if sejax.load_proxy(names[key]).fingerprint == fingerprint:
                said[names[key]] = verdicts[key]
    return said


def row(proxy: sejax.PretrainedProxy, verdicts: Mapping[str, str]) -> dict[str, str]:
    """A proxy's row of the table."""
    name, kind, *others = proxy.row.items()
    linked = {"name": f"[{proxy.name}](#{proxy.name})"}
    teaches_by = "policy" if proxy.is_distilled else verdicts.get(proxy.name, "")
    return dict([name, kind, ("teaches by", teaches_by), *others]) | linked


def section(proxy: sejax.PretrainedProxy) -> str:
    """What a card says of this proxy alone: its facts, what it teaches and how it was learned."""
    card = proxy.card
    facts = re.findall(r"^\| field .*?(?=\n\n|\Z)", card, re.DOTALL | re.MULTILINE)
    taught = re.findall(r"^Fresh agents.*?(?=\n\n## )", card, re.DOTALL | re.MULTILINE)
    command = re.findall(r"(?<=## How it was learned\n\n).*", card)
    tables = [text.partition("\n\n")[2] for text in taught]
    return "\n\n".join(
        [f"## {proxy.name}", *facts, *tables, *(f"Learned by:\n\n{x}" for x in command)]
    )


if __name__ == "__main__":
    write_text(PAGE, page())
    print(f"{PAGE} has {len(sejax.pretrained())} proxies.")
