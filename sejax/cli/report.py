"""A page about runs: what they learned, how, with which settings, and how to go on.

The page is one HTML file that holds its figures and loads nothing. What comes from files is text
in it: the template escapes all of it, and nothing that a file names is imported.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from sejax.cli import next_steps
from sejax.cli.run_directory import COLUMNS
from sejax.options import ConfigError, told
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


@dataclass(frozen=True, kw_only=True)
class Run:
    """What a run directory holds.

    Attributes:
      path: the folder.
      name: what the page calls it.
      stored: the configuration, plain values in nested mappings.
      rows: of `metrics.csv`.
      ended: `run.json`; empty for a run that has not ended.
      agents: `evaluation.csv`, if there is one.
    """

    path: Path
    name: str
    stored: dict[str, Any]
    rows: pd.DataFrame
    ended: dict[str, Any]
    agents: pd.DataFrame | None

    @cached_property
    def config(self) -> dict[str, Any]:
        """The configuration as `{"group.field": value}`."""
        return flatten(self.stored)

    @property
    def task(self) -> str:
        return str(self.config.get("env.name"))

    @property
    def generations(self) -> int:
        """Generations that are finished."""
        return int(self.rows["generation"].max()) + 1 if len(self.rows) else 0

    @property
    def has_ended(self) -> bool:
        return self.ended.get("generations") == self.generations

    @property
    def solved_score(self) -> float | None:
        """The incumbent mean that solves the task, if a score does and the run says so."""
        score = self.ended.get("solved_score")
        return float(score) if isinstance(score, int | float) else None

    @property
    def best_row(self) -> Any:
        """The last row with the best incumbent, whose proxy is kept; None if none survived."""
        scores = self.rows["incumbent_mean"].dropna()
        return self.rows.loc[scores[scores == scores.max()].index[-1]] if len(scores) else None

    @property
    def how_it_ended(self) -> str:
        asked = self.config.get("generations")
        if not self.has_ended:
            return f"not ended: {self.generations} of {asked} generations are there"
        best, solved = self.best_row, self.solved_score
        if solved is None or best is None:
            return f"ended after {self.generations} of {asked} generations"
        verdict = "solved" if best["incumbent_mean"] >= solved else "not solved"
        return f"{verdict}, after {self.generations} of {asked} generations"

    @property
    def facts(self) -> dict[str, str]:
        """What there is to know at first sight, by what it is called."""
        best = self.best_row
        facts = {
            "task": self.task,
            "proxy": str(self.config.get("proxy.name")).upper(),
            "agent": ", ".join(next_steps.agent_names(self.stored)),
            "ended": self.how_it_ended,
            "seeds": number(self.rows["seed"].nunique()),
            "best incumbent": MISSING,
        }
        if best is not None:
            facts["best incumbent"] = spread(best["incumbent_mean"], best["incumbent_std"])
            facts["in generation (from 0)"] = number(best["generation"])
        if self.solved_score is not None:
            facts["solved at"] = number(self.solved_score)
        return facts | {
            called: number(self.ended[name]) for name, called in COSTS.items() if name in self.ended
        }

    @property
    def environment(self) -> dict[str, str]:
        """Machine, devices and versions, as the run's last session had them."""
        parts = {
            **{k: v for k, v in _mapping(self.ended.get("machine")).items()},
            "devices": self.ended.get("devices"),
            **_mapping(self.ended.get("versions")),
        }
        return {name: text(value) for name, value in parts.items() if value is not None}

    @property
    def evaluation(self) -> list[dict[str, str]]:
        """A row for each world and agent that an evaluation beside the run has tested."""
        if self.agents is None:
            return []
        by = ["world", "agent"] if "number" in self.agents else ["world"]
        return [
            {
                "trained on": str(key[0]),
                **({"agent": str(key[1])} if len(by) > 1 else {}),
                "agents": number(len(mine)),
                "return": spread(mine["test_return"].mean(), mine["test_return"].std()),
                "training steps": spread(mine["train_steps"].mean(), mine["train_steps"].std(), 0),
                "training episodes": spread(
                    mine["train_episodes"].mean(), mine["train_episodes"].std()
                ),
            }
            for key, mine in self.agents.groupby(by, sort=False)
        ]

    @property
    def thinned(self) -> list[dict[str, str]]:
        """Rows for a table: evenly chosen where there are many, the last one among them."""
        step = math.ceil(len(self.rows) / MOST_ROWS) or 1
        chosen = self.rows.iloc[::-1].iloc[::step].iloc[::-1]
        return [
            {name: number(value) for name, value in row.items()}
            for row in chosen.to_dict("records")
        ]

    @cached_property
    def commands(self) -> list[tuple[str, str]]:
        """What can be done next, each with its command; a run that ends when solved stays so."""
        generations = int(self.stored["generations"])
        more: int | None = 2 * generations if self.has_ended else generations
        if self.has_ended and self.ended.get("ended") == "solved":
            more = None
        return next_steps.of_stored(self.stored, self.path, more)


# --- reading -------------------------------------------------------------------------------------


def read(paths: Sequence[Path]) -> list[Run]:
    """The runs in these folders.

    Raises:
      ConfigError: for one that is none, or whose files cannot be read.
    """
    names = [path.resolve().name for path in paths]
    return [
        _read(path, name if names.count(name) == 1 else str(path))
        for path, name in zip(paths, names, strict=True)
    ]


def _read(path: Path, name: str) -> Run:
    try:
        stored = yaml.safe_load((path / "config.yaml").read_text(encoding="utf-8"))
        rows = pd.read_csv(path / "metrics.csv")
        ended = path / "run.json"
        agents = path / "evaluation.csv"
        next_steps.require_run(stored)
        run = Run(
            path=path,
            name=name,
            stored=dict(stored),
            rows=_complete(rows, COLUMNS),
            ended=dict(json.loads(ended.read_text(encoding="utf-8"))) if ended.exists() else {},
            agents=_complete(pd.read_csv(agents), AGENT_COLUMNS) if agents.exists() else None,
        )
    except (
        OSError,
        ValueError,
        TypeError,
        LookupError,
        AttributeError,
        RecursionError,
        yaml.YAMLError,
    ) as error:
        raise ConfigError(
            f"RUN_DIR must be the folder of a run that has finished a generation, because the "
            f"report is made of its files; got {path} ({told(error)}). Give the run_dir of a "
            f"`python -m sejax.run`."
        ) from error
    return run


AGENT_COLUMNS = ("test_return", "train_steps", "train_episodes")  # those that hold numbers


def _complete(table: pd.DataFrame, columns: Sequence[str]) -> pd.DataFrame:
    """The table with numbers in these columns; a row that is being written is left out."""
    table = table.dropna(subset=[columns[-1]])
    return table.assign(**{name: table[name].astype(float) for name in columns})


# --- the page ------------------------------------------------------------------------------------


def page(runs: Sequence[Run]) -> str:
    """The HTML of a report on one run, or a comparison of several."""
    from importlib.metadata import version

    from jinja2 import Environment, FileSystemLoader

    from sejax.cli import report_figures

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    one = runs[0]
    title = f"{one.name}: {one.how_it_ended}" if len(runs) == 1 else f"{len(runs)} runs compared"
    return environment.get_template("report.html").render(
        title=title,
        runs=runs,
        facts=_side_by_side([run.facts for run in runs]),
        curves=report_figures.curves(runs),
        comparison=report_figures.comparison(runs),
        evaluations=report_figures.evaluations(runs),
        settings=settings(runs),
        environments=_side_by_side([run.environment for run in runs]),
        version=version("sejax"),
    )


def settings(runs: Sequence[Run]) -> list[tuple[str, list[str], bool]]:
    """Each field with its value in every run, and whether these differ; those that do come first.

    Where a run is kept makes no difference.
    """
    table = _side_by_side([{k: text(v) for k, v in run.config.items()} for run in runs])
    differing = [
        (name, each, len(set(each)) > 1 and name != "run_dir") for name, each in table.items()
    ]
    return sorted(differing, key=lambda row: not row[2])


def _side_by_side(tables: Sequence[dict[str, str]]) -> dict[str, list[str]]:
    names = dict.fromkeys(name for table in tables for name in table)
    return {name: [table.get(name, MISSING) for table in tables] for name in names}


def text(value: Any) -> str:
    """A plain value as configurations have it."""
    if isinstance(value, list):
        return ", ".join(map(text, value))
    return (
        {None: "null", True: "true", False: "false"}[value]
        if isinstance(value, bool | None)
        else str(value)
    )


def number(value: Any) -> str:
    """A number with three decimals at most."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return str(value)
    return f"{value:,.0f}" if value == round(value) else f"{value:,.3f}".rstrip("0").rstrip(".")


def spread(mean: float, std: float, digits: int = 1) -> str:
    """Mean and deviation; one agent has none."""
    return f"{mean:,.{digits}f}" + (f" ± {std:,.{digits}f}" if math.isfinite(std) else "")


def _mapping(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
