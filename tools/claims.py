"""Checks the numbers of the documents against the stored rows that they come from.

    python -m tools.claims          # make claims: fails for a number that is not what the rows give
    python -m tools.claims write    # makes the tables of results/ again, and writes the documents
    python -m tools.claims list     # each claim, with its count and the commit of its rows

`docs/claims.yaml` has an entry for each number, and says what an entry looks like.
"""

import functools
import io
import re
import string
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

import sejax
from experiments.common.shards import read_rows
from experiments.common.statistics import difference_interval, mean_interval
from sejax.ops.files import write_text
from sejax.proxies import zoo
from tools import remake

ROOT = Path(__file__).parents[1]
NUMBER = r"[-+]?\d[\d,]*(?:\.\d+)?%?"
TABLE = re.compile(r"(<!-- table: (.+?) -->\n).*?(<!-- end -->)", re.DOTALL)
# What no number is looked for in: generated tables, comments, code, mathematics, addresses.
HIDDEN = re.compile(
    r"<!--.*?-->|^ *(`{3,}).*?^ *\1|`[^`]*`|\$\$.*?\$\$|\$[^$\n]*\$|\]\([^)]*\)|https?://\S+"
    r"|^:[^\n]*",  # directives and their options
    re.DOTALL | re.MULTILINE,
)
# Numbers of headings, of lists and of years, and those in names.
NAMES = re.compile(
    r"^#+ [\d.]+|^\d+\. |\b(?:Python|Apache|[Ff]igures?|[Tt]ables?|[Ss]ections?|[Ss]eeds?) \d[\d.]*"
    r"|\((?:[^()]*, )?(?:19|20)\d\d\)|\bet al\.,? (?:[A-Z]+ )?(?:19|20)\d\d",
    re.MULTILINE,
)
UNCLAIMED = re.compile(rf"(?<![\w.-])(?<!\w[-/]){NUMBER}")
FUNCTIONS = {"len": len, "min": min, "max": max, "sum": sum, "round": round, "abs": abs}
FUNCTIONS |= {each.__name__: each for each in (mean_interval, difference_interval)}


class WrongError(ValueError):
    """A claim or table that its rows do not give."""


@dataclass(frozen=True)
class Claims:
    """The entries of `docs/claims.yaml`, and the documents of the project in a folder."""

    root: Path
    entries: Mapping[str, Any]

    @classmethod
    def read(cls, root: Path) -> "Claims":
        return cls(root, yaml.safe_load((root / "docs/claims.yaml").read_text(encoding="utf-8")))

    # --- what the rows give ----------------------------------------------------------------------

    @functools.cached_property
    def remade(self) -> list[remake.Remade]:
        """The tables of `results/`, and the numbers behind them."""
        return remake.remake(self.root)

    @functools.cached_property
    def summaries(self) -> dict[Path, str]:
        """The numbers behind each table, by the file that they would be."""
        return {
            each.path.with_name(each.path.name.replace("table.md", "summary.csv")): each.summary
            for each in self.remade
        }

    def frame(self, rows: str) -> Any:
        """Stored rows: a table, what a JSON file holds, shipped proxies' evaluations, settings."""
        if rows.startswith("settings "):
            return sejax.config(rows.split()[1:])
        if rows == "pretrained":
            return pd.DataFrame(
                [
                    vars(proxy) | (vars(proxy.learning) if proxy.learning else {}) | vars(each)
                    for proxy in zoo.pretrained()
                    for each in proxy.evaluations
                ]
            )
        if "*" in rows:
            found = sorted(self.root.glob(rows))
            return pd.concat([read_rows(path).assign(folder=path.parent.name) for path in found])
        rows, _, variant = rows.partition("#")
        path = self.root.resolve() / rows
        if path.name.endswith("summary.csv") and path in self.summaries:
            return pd.read_csv(io.StringIO(self.summaries[path]))
        if not path.exists():
            raise WrongError(f"there are no rows {rows}")
        if path.suffix == ".json":
            return yaml.safe_load(path.read_text())
        found = read_rows(path)
        return found[found["variant"] == variant] if variant else found

    def selected(self, entry: Mapping[str, Any]) -> dict[str, Any]:
        """The frames of an entry by name; one file is `rows`."""
        names = entry["rows"] if isinstance(entry["rows"], dict) else {"rows": entry["rows"]}
        frames = {name: self.frame(rows) for name, rows in names.items()}
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
        """A table in Markdown: that of an experiment, or of an entry."""
        if name.startswith("results/"):
            text = (self.root / name).read_text(encoding="utf-8")
            return [line for line in text.splitlines() if line.startswith("|")]
        if name not in self.entries.get("tables", {}):
            raise WrongError("it has no entry")
        table = self.entries["tables"][name]
        made = [table["head"], " | ".join("---" for _ in table["head"].split("|"))]
        for line in table["lines"]:
            if "values" in line or "rows" not in line:
                each: Any = [self.values(line) if "rows" in line else {}]
            else:
                each = self.selected(line)["rows"].to_dict("records")
            made += [without_nan(line["cells"].format_map(row)) for row in each]
        return [re.sub(" +", " ", f"| {line} |") for line in made]

    # --- what the documents say ------------------------------------------------------------------

    def documents(self) -> dict[str, str]:
        """The text of each document, by its path."""
        paths = [*self.root.glob("*.md"), *(self.root / "docs").rglob("*.md")]
        named = {str(path.relative_to(self.root)): path for path in sorted(paths)}
        return {
            name: path.read_text(encoding="utf-8")
            for name, path in named.items()
            if "_build" not in name and name not in self.entries.get("generated", ())
        }

    def with_tables(self, text: str) -> str:
        """A document whose tables are what the rows give."""
        return TABLE.sub(
            lambda found: "\n".join([found[1], *self.lines(found[2]), "", found[3]]), text
        )

    def pattern(self, entry: Mapping[str, Any], names: Mapping[str, Any]) -> re.Pattern[str]:
        """An entry's text with any numbers in place of its own, over any line breaks."""
        parts = []
        for literal, field, spec, _ in string.Formatter().parse(entry["text"]):
            parts.append(r"\s+".join(map(re.escape, re.split(r"\s+", literal))))
            if field is not None:
                said = format_field(field, spec, names)
                is_number = re.fullmatch(NUMBER, said)
                parts.append(f"({NUMBER})" if is_number else f"({re.escape(said)})")
        return re.compile("".join(parts))

    def said(self, entry: Mapping[str, Any], names: Mapping[str, Any]) -> list[str]:
        """The entry's numbers as the rows give them, in the order of its text."""
        fields = string.Formatter().parse(entry["text"])
        return [format_field(field, spec, names) for _, field, spec, _ in fields if field]

    # --- the check -------------------------------------------------------------------------------

    def check(self) -> Iterator[str]:
        """What is wrong, a message each."""
        yield from remake.check(self.root, self.remade)
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
                pattern, said = self.pattern(entry, names), self.said(entry, names)
                entry["count"].format_map(names)
            except Exception as error:  # whatever an expression raises
                yield f"{key}: {error!r}"
                continue
            covering.append(pattern)
            where = [(name, x) for name, text in documents.items() for x in pattern.finditer(text)]
            if not where:
                yield f"{key}: no document has its text"
            for name, found in where:
                if list(found.groups()) != said:
                    yield f"{name}: {key} says {list(found.groups())}, its rows give {said}"
        stated = {
            phrase: re.compile(r"\s+".join(map(re.escape, phrase.split())))
            for phrase in self.entries.get("stated", {})
        }
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
        tables = self.entries.get("tables", {}).items()
        for key, table in ((key, table) for key, table in tables if "source" not in table):
            texts[key] = "\n".join([table["head"], *(line["cells"] for line in table["lines"])])
        return {key: re.sub(r"\{.*?\}", "_", text) for key, text in texts.items()}

    def write(self) -> None:
        """Puts what the rows give into the tables of `results/` and all documents."""
        remake.write(self.remade)
        claims = [(entry, self.values(entry)) for entry in self.entries.get("claims", {}).values()]
        for name, text in self.documents().items():
            new = self.with_tables(text)
            for entry, names in claims:
                put = functools.partial(replaced, said=self.said(entry, names))
                new = self.pattern(entry, names).sub(put, new)
            if new != text:
                write_text(self.root / name, new)
                print(f"{name} is written.")

    def list(self) -> None:
        """Prints each claim with its count, and the commit and date of its rows."""
        for key, entry in self.entries.get("claims", {}).items():
            names = self.values(entry)
            rows = entry["rows"]
            files = list(rows.values()) if isinstance(rows, dict) else [rows]
            print(f"{key}: {entry['text'].format_map(names)} ({entry['count'].format_map(names)})")
            for file in files:
                print(f"    {file}, {entry.get('made') or self.made(file)}")

    def made(self, rows: str) -> str:
        """Commit and date at which rows were made: the older of those of rows and of settings.

        Rows are written again when columns move, settings when their format does.
        """
        rows = rows.partition("#")[0].replace("summary.csv", "rows.csv.xz")
        paths = [{"pretrained": "sejax/pretrained"}.get(rows, rows)]
        paths += [str(path) for path in (self.root / rows).parent.glob("settings.json*")]
        git = ["git", "-C", str(self.root), "log", "-1", "--format=%ct %h %cs", "--"]
        found = [
            subprocess.run([*git, path], capture_output=True, text=True).stdout.strip()
            for path in paths
        ]
        return min(filter(None, found), default="").partition(" ")[2]


def format_field(field: str, spec: str | None, names: Mapping[str, Any]) -> str:
    """A placeholder's text."""
    return f"{{{field}:{spec or ''}}}".format_map(names)


def without_nan(text: str) -> str:
    """Cells without the intervals that too few values leave unknown."""
    return re.sub(r" \[nan, nan\]|\bnan%?", "", text)


def replaced(found: re.Match[str], said: list[str]) -> str:
    """The text that was found, with these groups."""
    parts, start = [], found.start()
    for group, text in enumerate(said, 1):
        parts += [found.string[start : found.start(group)], text]
        start = found.end(group)
    return "".join([*parts, found.string[start : found.end()]])


def unclaimed(name: str, text: str, covering: Iterable[re.Pattern[str]]) -> Iterator[str]:
    """The numbers of a text that are in no generated table, claim or stated phrase."""
    for pattern in (*covering, TABLE, HIDDEN, NAMES):
        text = pattern.sub(lambda x: re.sub(r"\S", " ", x[0]), text)
    for found in UNCLAIMED.finditer(text):
        line = text.count("\n", 0, found.start()) + 1
        yield f"{name}:{line}: {found[0]} has no entry in docs/claims.yaml"


def main() -> None:
    """The command."""
    claims = Claims.read(ROOT)
    if "list" in sys.argv[1:]:
        claims.list()
    elif "write" in sys.argv[1:]:
        claims.write()
    wrong = list(claims.check())
    print("\n".join([*wrong, f"docs/claims.yaml: {len(wrong)} wrong"]))
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
