"""The documents' numbers are those of the stored rows: `make claims`."""

import shutil

import pandas as pd
import pytest
import yaml

from tools import claims

DOCUMENT = """# 1. A page of 2026 tests

DDQN takes 41% of the
steps, [paper](https://arxiv.org/abs/2202.02790), `seed=3`, over 16 workers (Ferreira, 2022).

<!-- table: steps -->

| agent | steps |
| --- | --- |
| ddqn | 1,025 |

<!-- end -->
"""
ENTRIES = yaml.safe_load("""
documents: [README.md]
claims:
  share:
    text: "DDQN takes {share:.0%} of the steps"
    rows: results/rows.csv
    values:
      share: rows.steps.iloc[0] / rows.steps.iloc[1]
      agents: rows.agents.max()
    count: "{agents} agents"
tables:
  steps:
    head: agent | steps
    lines:
      - cells: "{kind} | {steps:,} [{low:.0f}, {high:.0f}]"
        rows: results/rows.csv
        where: kind == 'ddqn'
stated:
  over 16 workers: paper, Table 3
  of 2026 tests: the test
""")
TYPED = {"share": ENTRIES["claims"]["share"] | {"text": "DDQN takes 41% of the steps"}}


@pytest.fixture
def project(tmp_path):
    """A project with one document; `check(text, rows, **entries)` says what is wrong with it."""

    def check(text=DOCUMENT, steps=1025, **entries):
        for folder in ("docs", "results"):
            (tmp_path / folder).mkdir(exist_ok=True)
        rows = f"kind,agents,steps,low,high\nddqn,10,{steps},,\nppo,10,2500,,\n"
        (tmp_path / "results/rows.csv").write_text(rows)
        (tmp_path / "README.md").write_text(text)
        (tmp_path / "docs/claims.yaml").write_text(yaml.safe_dump(ENTRIES | entries))
        return list(claims.Claims.read(tmp_path).check())

    return check


def test_documents_that_say_what_the_rows_give_pass(project):
    assert project() == []


@pytest.mark.parametrize(("old", "new", "wrong"), [
    ("41%", "42%", "README.md: share says ['42%'], its rows give ['41%']"),
    ("1,025", "1,026", "README.md: the table steps is not what its rows give"),
    ("16 workers", "17 workers", "README.md:4: 17 has no entry in docs/claims.yaml"),
    ("steps, [", "steps, 5.5 seconds, [", "README.md:4: 5.5 has no entry"),
    ("DDQN takes", "DDQN needs", "share: no document has its text"),
])  # fmt: skip
def test_another_digit_in_a_document_is_found(project, old, new, wrong):
    assert any(message.startswith(wrong) for message in project(DOCUMENT.replace(old, new)))


@pytest.mark.parametrize(("changes", "wrong"), [
    ({"steps": 1125}, "README.md: share says ['41%'], its rows give ['45%']"),
    ({"claims": TYPED}, "share:1: 41% has no entry in docs/claims.yaml"),
    ({"stated": {"in 7 hours": "paper"}}, "stated: no document has 'in 7 hours'"),
])  # fmt: skip
def test_another_row_and_entries_without_a_source_are_found(project, changes, wrong):
    assert wrong in project(**changes)


def test_a_number_typed_into_a_table_needs_a_source(project):
    table = {"head": "paper | steps", "lines": [{"cells": "40 | 2,500"}]}
    entries = {"tables": ENTRIES["tables"] | {"typed": table}}
    wrong = [f"typed:2: {number} has no entry in docs/claims.yaml" for number in ("40", "2,500")]
    assert project(**entries) == wrong
    table["source"] = "paper, Table 2"
    assert project(**entries) == []


def test_numbers_and_tables_are_written(project, tmp_path):
    project(DOCUMENT.replace("41%", "0%").replace("1,025", "0"))
    claims.Claims.read(tmp_path).write()
    assert (tmp_path / "README.md").read_text() == DOCUMENT


@pytest.mark.slow
def test_a_changed_row_of_an_experiment_is_found(tmp_path):
    name = "results/agents"
    shutil.copytree(claims.ROOT / name, tmp_path / name)  # whose table is that of its rows
    path = tmp_path / name / "rows.csv.xz"
    rows = pd.read_csv(path)
    rows["test_return"] += 1
    rows.to_csv(path, index=False)
    assert list(claims.Claims(tmp_path, {"documents": []}).check()) == [
        f"{name}/table.md is not what its rows give"
    ]


@pytest.mark.slow
def test_the_documents_of_this_project_pass():
    """As `make claims`: its tables are made again, which takes most of a minute."""
    assert list(claims.Claims.read(claims.ROOT).check()) == []


def test_results_have_ten_megabytes_at_most():
    files = [path for path in (claims.ROOT / "results").rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= 10e6
