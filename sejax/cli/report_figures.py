"""Figures of reports: SVG that stands in the page, and takes its colour of text from there."""

import re
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from markupsafe import Markup

from sejax.cli import plots

STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "sejax",
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "text.parse_math": False,
    "figure.constrained_layout.h_pad": 0.12,
}
COLORS = (plots.INCUMBENT, plots.POPULATION, *plots.AGENTS)
MARKERS = "osD^vP*X"


class Figure(NamedTuple):
    """A figure of a page."""

    svg: Markup
    about: str  # for who does not see it


def curves(runs: Sequence[Any]) -> list[Figure]:
    """How each run learned."""
    return [_learning_curve(run, f"curve{i}") for i, run in enumerate(runs)]


def comparison(runs: Sequence[Any]) -> Figure | None:
    """The incumbents of several runs, a panel for each task; None of a single run."""
    if len(runs) == 1:
        return None
    tasks = list(dict.fromkeys(run.task for run in runs))
    about = "; ".join(
        f"{run.name} on {run.task}: best incumbent {run.facts['best incumbent']}" for run in runs
    )

    def draw(path: Path) -> None:
        figure, axes = plt.subplots(
            len(tasks), 1, figsize=(6, 0.6 + 3.4 * len(tasks)), squeeze=False, layout="constrained"
        )
        for axis, task in zip(axes[:, 0], tasks, strict=True):
            for i, run in enumerate(runs):
                if run.task == task:
                    means = run.rows.groupby("generation")["incumbent_mean"].mean()
                    axis.plot(
                        means.index,
                        means,
                        color=COLORS[i % len(COLORS)],
                        lw=1.8,
                        marker=MARKERS[i % len(MARKERS)],
                        ms=4,
                        markevery=max(1, len(means) // 12),
                        label=_label(run.name),
                    )
            for score in {x.solved_score for x in runs if x.task == task} - {None}:
                axis.axhline(
                    score, color=plots.SOLVED, ls="--", lw=1.2, label=f"solved ({score:g})"
                )
            axis.set(title=_label(task), xlabel="generation", ylabel="incumbent mean")
            axis.xaxis.get_major_locator().set_params(integer=True)
            axis.legend(frameon=False, fontsize=8)
        figure.savefig(path)
        plt.close(figure)

    return Figure(_svg(draw, "comparison"), f"Incumbent means by generation. {about}.")


def evaluations(runs: Sequence[Any]) -> list[Figure | None]:
    """What fresh agents reached on each run's proxy and beside it, where they were trained."""
    return [_evaluation(run, f"evaluation{i}") for i, run in enumerate(runs)]


def _learning_curve(run: Any, prefix: str) -> Figure:
    best = run.facts["best incumbent"]
    svg = _svg(
        lambda path: plots.learning_curve(run.rows.to_dict("records"), run.solved_score, path),
        prefix,
    )
    return Figure(
        svg,
        f"Learning curve of {run.name}: scores of incumbent and population, and "
        f"agents' training steps, over {run.generations} generations; best incumbent "
        f"{best}.",
    )


def _evaluation(run: Any, prefix: str) -> Figure | None:
    if run.agents is None:
        return None
    by = run.agents["agent"] if "number" in run.agents else pd.Series("", run.agents.index)
    worlds = run.agents["world"].map(_label)
    tables = {key: table for key, table in run.agents.groupby([worlds, by.map(_label)], sort=False)}
    solved = np.nan if run.solved_score is None else run.solved_score
    svg = _svg(lambda path: plots.evaluation(tables, solved, path), prefix)
    about = "; ".join(
        f"trained on {row['trained on']} {row.get('agent', '')}: return {row['return']}, "
        f"{row['training steps']} training steps"
        for row in run.evaluation
    )
    return Figure(svg, f"Fresh agents of {run.name} on the real task. {about}.")


def _svg(draw: Callable[[Path], None], prefix: str) -> Markup:
    """What `draw` writes as SVG, made to stand in a page: its ids begin with the prefix.

    Black becomes the colour of the page's text, which matplotlib has escaped; the width follows the
    page within what can be read.
    """
    with mpl.rc_context(STYLE), tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "figure.svg")
        draw(path)
        svg = path.read_text(encoding="utf-8")
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{prefix}-", svg)
    head, body = svg.split(">", maxsplit=1)
    points = float(head.partition('width="')[2].partition("pt")[0])
    head = re.sub(r' (width|height)="[^"]*"', "", head)
    limits = f"min-width: {0.7 * points:.0f}px; max-width: {1.5 * points:.0f}px"
    body = body.replace("#000000", "currentColor")
    return Markup(f'{head} aria-hidden="true" style="{limits}">{body}')


def _label(name: object) -> str:
    """A name as matplotlib shows it: one that begins with an underscore it would leave out."""
    return re.sub("^_", "\u2009_", str(name))
