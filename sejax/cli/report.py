"""A page about runs: what they learned, how, with which settings, and how to go on.

The page is one HTML file that holds its figures and loads nothing. What comes from files is text
in it: the template escapes all of it, and nothing that a file names is imported.
"""

import csv
import json
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import yaml
from jinja2 import Environment, FileSystemLoader

from sejax.cli import next_steps, report_figures
from sejax.cli.report_figures import Figure
from sejax.options import ConfigError, shortened, told
from sejax.options.plain import flatten

MOST_ROWS = 60  # generations in a table
COSTS = {
    "agents": "agents trained",
    "train_steps": "their training steps",
    "real_steps": "steps on the real task",
    "cpu_s": "CPU seconds",
    "wall_s": "wall-clock seconds",
}
MISSING = "-"

Row = dict[str, Any]  # of a CSV file: numbers, and names as text


@dataclass(frozen=True, kw_only=True)
class Run:
    """What a page says about a run.

    Attributes:
      path: the folder.
      name: what the page calls it.
      task: the real task.
      title: how it ended.
      facts: what there is to know at first sight.
      config: the configuration by `group.field`.
      environment: machine, devices and versions of the last session; empty before the run ended.
      rows: of `metrics.csv`.
      solved_score: the incumbent mean that solves the task; None if no score does.
      curve: how it learned.
      evaluation: a row for each world and agent that an evaluation beside the run has tested.
      agents: a figure of those; None without an evaluation.
      commands: what can be done next, each with its command.
    """

    path: Path
    name: str
    task: str
    title: str
    facts: dict[str, str]
    config: dict[str, str]
    environment: dict[str, str]
    rows: list[Row]
    solved_score: float | None
    curve: Figure
    evaluation: list[dict[str, str]]
    agents: Figure | None
    commands: list[tuple[str, str]]

    @property
    def thinned(self) -> list[dict[str, str]]:
        """Rows for a table: evenly chosen where there are many, the last one among them."""
        step = -(-len(self.rows) // MOST_ROWS)
        chosen = self.rows[::-1][::step][::-1]
        return [{name: number(value) for name, value in row.items()} for row in chosen]


# --- reading -------------------------------------------------------------------------------------


def read(paths: Sequence[Path]) -> list[Run]:
    """The runs in these folders.

    Raises:
      ConfigError: for one that is none, or whose files cannot be read.
    """
    names = [path.name for path in paths]
    runs = []
    for place, (path, name) in enumerate(zip(paths, names, strict=True)):
        try:
            runs.append(_read(path, name if names.count(name) == 1 else str(path), place))
        except Exception as error:  # files may be damaged in any way
            raise ConfigError(
                f"RUN_DIR must be the folder of a run with a finished generation; got "
                f"{shortened(path)} ({told(error)}). Give the run_dir of a python -m sejax.run.",
                "RUN_DIR",
            ) from error
    return runs


def _read(path: Path, name: str, place: int) -> Run:
    stored = yaml.safe_load((path / "config.yaml").read_text(encoding="utf-8"))
    next_steps.require_run(stored)
    summary = path / "run.json"
    ended = dict(json.loads(summary.read_text(encoding="utf-8"))) if summary.exists() else {}
    rows = _table(path / "metrics.csv")
    if not rows:
        raise ValueError("metrics.csv has no rows")
    evaluated = path / "evaluation.csv"
    agents = _table(evaluated, report_figures.MEASURES) if evaluated.exists() else []
    solved_score = None if ended.get("solved_score") is None else float(ended["solved_score"])
    finished, asked = int(rows[-1]["generation"]) + 1, int(stored["generations"])
    is_over = ended.get("generations") == finished
    better = [row for row in rows if math.isfinite(row["incumbent_mean"])]
    best = max(better, key=lambda row: (row["incumbent_mean"], row["generation"]), default=None)
    incumbent = MISSING if best is None else spread(best["incumbent_mean"], best["incumbent_std"])
    subject = next_steps.title(stored)
    title = _title(is_over, finished, asked, best, solved_score)
    task = str(stored["env"]["name"])
    facts = {
        "task": task,
        "proxy": str(stored["proxy"]["name"]).upper(),
        "agent": ", ".join(next_steps.agent_names(stored)),
        "ended": title,
        "best incumbent": incumbent,
    }
    facts |= {} if best is None else {"in generation (from 0)": number(best["generation"])}
    facts |= {} if solved_score is None else {"solved at": number(solved_score)}
    facts |= {called: number(ended[cost]) for cost, called in COSTS.items() if cost in ended}
    environment = {**_mapping(ended.get("machine")), "devices": ended.get("devices")}
    environment |= _mapping(ended.get("versions"))
    # A run that ends when solved stays so.
    more = None if ended.get("ended") == "solved" else 2 * asked
    groups = _by_world_and_agent(agents)
    evaluation = [_summary(key, group) for key, group in groups.items()]
    return Run(
        path=path,
        name=name,
        task=task,
        title=title,
        facts=facts,
        config={field: text(value) for field, value in flatten(stored).items()},
        environment={k: text(v) for k, v in environment.items() if v is not None},
        rows=rows,
        solved_score=solved_score,
        curve=report_figures.learning_curve(place, name, subject, rows, solved_score, incumbent),
        evaluation=evaluation,
        agents=report_figures.evaluation(place, name, subject, groups, solved_score, evaluation),
        commands=next_steps.of_stored(stored, path, more if is_over else asked),
    )


def _title(
    is_over: bool, finished: int, asked: int, best: Row | None, solved_score: float | None
) -> str:
    if not is_over:
        return f"not ended: {finished} of {asked} generations are there"
    if best is None or solved_score is None:
        return f"ended after {finished} of {asked} generations"
    verdict = "solved" if best["incumbent_mean"] >= solved_score else "not solved"
    return f"{verdict}, after {finished} of {asked} generations"


def _table(path: Path, columns: Sequence[str] = ()) -> list[Row]:
    """The rows of a CSV file, with numbers in these columns, or in all."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file, strict=True))
    return [row | {name: float(row[name]) for name in columns or row} for row in rows]


def _by_world_and_agent(rows: list[Row]) -> dict[tuple[str, str], list[Row]]:
    """Rows of `evaluation.csv`; of a single agent, `agent` is a number."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["world"], row["agent"] if "number" in row else ""), []).append(row)
    return groups


def _summary(key: tuple[str, str], rows: list[Row]) -> dict[str, str]:
    def summed(column: str, digits: int = 1) -> str:
        values = [row[column] for row in rows]
        std = statistics.stdev(values) if len(values) > 1 else math.nan
        return spread(statistics.fmean(values), std, digits)

    world, agent = key
    return {
        "trained on": world,
        **({"agent": agent} if agent else {}),
        "agents": number(len(rows)),
        "return": summed("test_return"),
        "training steps": summed("train_steps", 0),
        "training episodes": summed("train_episodes"),
    }


# --- the page ------------------------------------------------------------------------------------


def page(runs: Sequence[Run]) -> str:
    """The HTML of a report on one run, or a comparison of several."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    one = runs[0]
    title = f"{one.name}: {one.title}" if len(runs) == 1 else f"{len(runs)} runs compared"
    made = environment.get_template("report.html").render(
        title=title,
        runs=runs,
        facts=_side_by_side([run.facts for run in runs]),
        comparison=report_figures.comparison(runs) if len(runs) > 1 else None,
        settings=settings(runs),
        environments=_side_by_side([run.environment for run in runs]),
        version=version("sejax"),
    )
    return made.encode(errors="backslashreplace").decode()  # JSON may hold half a character


def settings(runs: Sequence[Run]) -> list[tuple[str, list[str], bool]]:
    """Each field with its value in every run, and whether these differ; those that do come first.

    Where a run is kept makes no difference.
    """
    table = _side_by_side([run.config for run in runs])
    differing = [
        (name, each, len(set(each)) > 1 and name != "run_dir") for name, each in table.items()
    ]
    return sorted(differing, key=lambda row: not row[2])


def _side_by_side(tables: Sequence[dict[str, str]]) -> dict[str, list[str]]:
    names = dict.fromkeys(name for table in tables for name in table)
    return {name: [table.get(name, MISSING) for table in tables] for name in names}


def text(value: object) -> str:
    """A plain value as configurations have it."""
    if isinstance(value, list):
        return ", ".join(map(text, value))
    words = {None: "null", True: "true", False: "false"}
    return words[value] if isinstance(value, bool | None) else str(value)


def number(value: object) -> str:
    """A number with three decimals at most."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return str(value)
    return f"{value:,.0f}" if value == round(value) else f"{value:,.3f}".rstrip("0").rstrip(".")


def spread(mean: float, std: float, digits: int = 1) -> str:
    """Mean and deviation; one agent has none."""
    return f"{mean:,.{digits}f}" + (f" ± {std:,.{digits}f}" if math.isfinite(std) else "")


def _mapping(value: object) -> Mapping[str, object]:
    return value if isinstance(value, dict) else {}
