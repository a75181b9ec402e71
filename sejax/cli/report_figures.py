"""Figures of reports: SVG that stands in the page, and takes its colour of text from there."""

import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import matplotlib as mpl
import matplotlib.pyplot as plt
from markupsafe import Markup

from sejax.cli import plots

if TYPE_CHECKING:  # which imports this
    from sejax.cli.report import Run

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
MEASURES = ("test_return", "train_steps", "train_episodes")  # of an evaluation, in its figure

Rows = Sequence[Mapping[str, Any]]


class Figure(NamedTuple):
    """A figure of a page."""

    svg: Markup
    about: str  # for who does not see it


def learning_curve(
    place: int, name: str, title: str, rows: Rows, solved_score: float | None, best: str
) -> Figure:
    """How a run learned; `place` is its number on the page."""
    return Figure(
        _svg(lambda path: plots.learning_curve(rows, solved_score, path, title), f"curve{place}"),
        f"Learning curve of {name}: scores of incumbent and population, and agents' training "
        f"steps, over {len(rows)} generations; best incumbent {best}.",
    )


def evaluation(
    place: int,
    name: str,
    title: str,
    groups: Mapping[tuple[str, str], Rows],
    solved_score: float | None,
    summaries: Sequence[Mapping[str, str]],
) -> Figure | None:
    """What fresh agents reached on a run's proxy and beside it, where they were trained."""
    if not groups:
        return None
    tables = {
        (_label(world), _label(agent)): {name: [row[name] for row in rows] for name in MEASURES}
        for (world, agent), rows in groups.items()
    }
    about = "; ".join(
        f"trained on {row['trained on']} {row.get('agent', '')}: return {row['return']}, "
        f"{row['training steps']} training steps"
        for row in summaries
    )
    return Figure(
        _svg(
            lambda path: plots.evaluation(tables, solved_score, path, title), f"evaluation{place}"
        ),
        f"Fresh agents of {name} on the real task. {about}.",
    )


def comparison(runs: "Sequence[Run]") -> Figure:
    """The incumbents of several runs, a panel for each task."""
    tasks = list(dict.fromkeys(run.task for run in runs))

    def draw(path: Path) -> None:
        size = (6, 0.6 + 3.4 * len(tasks))
        figure, axes = plt.subplots(
            len(tasks), 1, figsize=size, squeeze=False, layout="constrained"
        )
        for axis, task in zip(axes[:, 0], tasks, strict=True):
            for i, run in enumerate(runs):
                if run.task == task:
                    axis.plot(
                        [row["generation"] for row in run.rows],
                        [row["incumbent_mean"] for row in run.rows],
                        color=COLORS[i % len(COLORS)],
                        lw=1.8,
                        marker=MARKERS[i % len(MARKERS)],
                        ms=4,
                        markevery=max(1, len(run.rows) // 12),
                        label=_label(run.name),
                    )
            for score in {x.solved_score for x in runs if x.task == task} - {None}:
                label = f"solved ({score:g})"
                axis.axhline(score, color=plots.SOLVED, ls="--", lw=1.2, label=label)
            axis.set(title=_label(task), xlabel="generation", ylabel="incumbent mean")
            axis.xaxis.get_major_locator().set_params(integer=True)
            axis.legend(frameon=False, fontsize=8)
        figure.savefig(path)
        plt.close(figure)

    each = (f"{x.name} on {x.task}: best incumbent {x.facts['best incumbent']}" for x in runs)
    return Figure(_svg(draw, "comparison"), f"Incumbent means by generation. {'; '.join(each)}.")


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


def _label(name: str) -> str:
    """A name as matplotlib shows it: one that begins with an underscore it would leave out."""
    return re.sub("^_", "\u2009_", name)
