"""Checks the numbers of the documents against the stored rows that they come from.

    python -m tools.claims          # make claims: fails for a number that is not what the rows give
    python -m tools.claims write    # makes the tables of results/ again, and writes the documents

`docs/claims.yaml` has an entry for each number, and says what an entry looks like.
"""

import functools
import io
import re
import string
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from experiments.common.shards import read_rows
from experiments.common.statistics import difference_interval, mean_interval
from experiments.common.tables import steps_text
from sejax.ops.files import write_text
from tools import remake

ROOT = Path(__file__).parents[1]
NUMBER = r"[-+]?\d[\d,]*(?:\.\d+)?%?"
NAN = r" \[nan, nan\]|\bnan%?"  # an interval that too few values leave unknown, or a mean
TABLE = re.compile(r"(<!-- table: (.+?) -->\n).*?(<!-- end -->)", re.DOTALL)
# What no number is looked for in: comments, code, mathematics, addresses, directives and their
# options; numbers of headings, of lists and of years, and those in names.
HIDDEN = re.compile(
    r"<!--.*?-->|^ *(`{3,}).*?^ *\1|`[^`]*`|\$\$.*?\$\$|\$[^$\n]*\$|\]\([^)]*\)|https?://\S+"
    r"|^:[^\n]*|^#+ [\d.]+|^\d+\. "
    r"|\b(?:Python|Apache|[Ff]igures?|[Tt]ables?|[Ss]ections?|[Ss]eeds?) \d[\d.]*"
    r"|\((?:[^()]*, )?(?:19|20)\d\d\)|\bet al\.,? (?:[A-Z]+ )?(?:19|20)\d\d",
    re.DOTALL | re.MULTILINE,
)
UNCLAIMED = re.compile(rf"(?<![\w.-])(?<!\w[-/]){NUMBER}")
FUNCTIONS = {"len": len, "min": min, "max": max, "sum": sum, "round": round, "abs": abs}
FUNCTIONS |= {each.__name__: each for each in (mean_interval, difference_interval, steps_text)}


@dataclass(frozen=True)
class Claims:
    """The entries of `docs/claims.yaml`, and the documents of the project in a folder.

    Attributes:
      frames: stored rows that were read, by what entries call them.
    """

    root: Path
    entries: Mapping[str, Any]
    frames: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def read(cls, root: Path) -> "Claims":
        return cls(root, yaml.safe_load((root / "docs/claims.yaml").read_text(encoding="utf-8")))

    # --- what the rows give ----------------------------------------------------------------------

    @functools.cached_property
    def remade(self) -> list[remake.Remade]:
        """The tables of `results/`, and the numbers behind them."""
        return remake.remake(self.root)

    def frame(self, rows: str) -> Any:
        """Stored rows, which are read once."""
        if rows not in self.frames:
            self.frames[rows] = self.read_frame(rows)
        return self.frames[rows]

    def read_frame(self, rows: str) -> Any:
        """Stored rows: a table, or what a JSON file holds."""
        if "*" in rows:
            found = sorted(self.root.glob(rows))
            return pd.concat([read_rows(path).assign(folder=path.parent.name) for path in found])
        rows, _, variant = rows.partition("#")
        path = self.root / rows
        if path.name.endswith("summary.csv"):
            summaries = {str(each.summary_file): each.summary for each in self.remade}
            return pd.read_csv(io.StringIO(summaries[rows]))
        if path.suffix == ".json":
            return yaml.safe_load(path.read_text())
        found = read_rows(path)
        return found[found["variant"] == variant] if variant else found

    def selected(self, entry: Mapping[str, Any]) -> dict[str, Any]:
        """The frames of an entry by name; one file is `rows`."""
        rows = entry.get("rows", {})
        named = rows if isinstance(rows, dict) else {"rows": rows}
        frames = {name: self.frame(rows) for name, rows in named.items()}
        if "where" in entry:
            frames["rows"] = frames["rows"].query(entry["where"])
        return frames

    def values(self, entry: Mapping[str, Any]) -> dict[str, Any]:
        """The names that an entry's text may have: values, and columns where the row is one."""
        frames = self.selected(entry)
        rows: Any = frames.get("rows")
        one = isinstance(rows, pd.DataFrame) and len(rows) == 1
        names = {**(rows.to_dict("records")[0] if one else {}), **frames}
        for name, expression in entry.get("values", {}).items():
            names[name] = eval(str(expression), {"__builtins__": FUNCTIONS, "np": np} | names)
        return names

    def lines(self, name: str) -> list[str]:
        """A table of an entry, in Markdown."""
        table = self.entries["tables"][name]
        made = [table["head"], " | ".join("---" for _ in table["head"].split("|"))]
        for line in table["lines"]:
            is_one = "values" in line or "rows" not in line
            each = [self.values(line)] if is_one else self.selected(line)["rows"].to_dict("records")
            made += [re.sub(NAN, "", line["cells"].format_map(row)) for row in each]
        return [re.sub(" +", " ", f"| {line} |") for line in made]

    # --- what the documents say ------------------------------------------------------------------

    def documents(self) -> dict[str, str]:
        """The text of each document, by its path."""
        patterns = ("*.md", "docs/**/*.md", "paper/*.md")
        paths = sorted(path for pattern in patterns for path in self.root.glob(pattern))
        texts = {str(x.relative_to(self.root)): x.read_text(encoding="utf-8") for x in paths}
        made = self.entries.get("generated", ())
        return {name: x for name, x in texts.items() if "_build" not in name and name not in made}

    def with_tables(self, text: str) -> str:
        """A document whose tables are what the rows give."""
        return TABLE.sub(lambda x: "\n".join([x[1], *self.lines(x[2]), "", x[3]]), text)

    def text_of(self, entry: Any, names: Mapping[str, Any]) -> tuple[re.Pattern[str], list[str]]:
        """An entry's text with any numbers, over any line breaks, and the numbers of its rows.

        Every second group of the pattern is a number; the others are the text between.
        """
        parts, said = [], []
        for literal, name, spec, _ in string.Formatter().parse(entry["text"]):
            parts.append(f"({loosely(literal)})")
            if name is not None:
                said.append(f"{{{name}:{spec}}}".format_map(names))
                is_number = re.fullmatch(NUMBER, said[-1])
                parts.append(f"({NUMBER})" if is_number else f"({re.escape(said[-1])})")
        return re.compile("".join(parts)), said

    # --- the check -------------------------------------------------------------------------------

    def check(self) -> Iterator[str]:
        """What is wrong, a message each."""
        for made in (made for made in self.remade if made.differs):
            yield f"{made.path.relative_to(self.root.resolve())} is not what its rows give"
        documents, covering = self.documents(), []
        for name, text in documents.items():
            for found in TABLE.finditer(text):
                try:
                    if found[0] != self.with_tables(found[0]):
                        yield f"{name}: the table {found[2]} is not what its rows give"
                except Exception as error:  # whatever an expression raises
                    yield f"{name}: the table {found[2]} cannot be made: {error!r}"
        for key, entry in self.entries.get("claims", {}).items():
            try:
                names = self.values(entry)
                pattern, said = self.text_of(entry, names)
                entry["count"].format_map(names)
            except Exception as error:  # whatever an expression raises
                yield f"{key}: {error!r}"
                continue
            covering.append(pattern)
            where = [(name, x) for name, text in documents.items() for x in pattern.finditer(text)]
            if not where:
                yield f"{key}: no document has its text"
            for name, found in where:
                if list(found.groups()[1::2]) != said:
                    yield f"{name}: {key} says {list(found.groups()[1::2])}, its rows give {said}"
        stated = {x: re.compile(loosely(x)) for x in self.entries.get("stated", {})}
        typed = self.typed()
        for phrase, pattern in stated.items():
            if not any(map(pattern.search, (*documents.values(), *typed.values()))):
                yield f"stated: no document has {phrase!r}"
        for name in self.entries["documents"]:
            yield from unclaimed(name, documents[name], [*covering, *stated.values()])
        for name, text in typed.items():
            yield from unclaimed(name, text, stated.values())

    def typed(self) -> dict[str, str]:
        """What the texts of claims and the cells of tables say beside their placeholders."""
        texts = {key: entry["text"] for key, entry in self.entries.get("claims", {}).items()}
        tables = {k: x for k, x in self.entries.get("tables", {}).items() if "source" not in x}
        for key, table in tables.items():
            texts[key] = "\n".join([table["head"], *(line["cells"] for line in table["lines"])])
        return {key: re.sub(r"\{.*?\}", "_", text) for key, text in texts.items()}

    def write(self) -> None:
        """Puts what the rows give into the tables of `results/` and all documents."""
        for made in (made for made in self.remade if made.differs):
            write_text(made.path, made.table)
            print(f"{made.path} is written.")
        entries = self.entries.get("claims", {}).values()
        claims = [self.text_of(entry, self.values(entry)) for entry in entries]
        for name, text in self.documents().items():
            new = self.with_tables(text)
            for pattern, said in claims:
                new = pattern.sub(functools.partial(replaced, said=said), new)
            if new != text:
                write_text(self.root / name, new)
                print(f"{name} is written.")


def loosely(text: str) -> str:
    """A pattern that finds a text over any line breaks."""
    return r"\s+".join(map(re.escape, re.split(r"\s+", text)))


def replaced(found: re.Match[str], said: list[str]) -> str:
    """The text that was found, with these numbers."""
    texts = list(found.groups())
    texts[1::2] = said
    return "".join(texts)


def unclaimed(name: str, text: str, covering: Iterable[re.Pattern[str]]) -> Iterator[str]:
    """The numbers of a text that are in no generated table, claim or stated phrase."""
    for pattern in (*covering, TABLE, HIDDEN):
        text = pattern.sub(lambda x: re.sub(r"\S", " ", x[0]), text)
    for found in UNCLAIMED.finditer(text):
        line = text.count("\n", 0, found.start()) + 1
        yield f"{name}:{line}: {found[0]} has no entry in docs/claims.yaml"


def main() -> None:
    """The command."""
    claims = Claims.read(ROOT)
    if "write" in sys.argv[1:]:
        claims.write()
    wrong = list(claims.check())
    print("\n".join([*wrong, f"docs/claims.yaml: {len(wrong)} wrong"]))
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
