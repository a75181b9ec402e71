"""Live lines of progress on a terminal, and the last words of `sejax.run`."""

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from sejax.options import registry
from sejax.runs import next_steps, preset_files
from sejax.runs.config import LearnConfig
from sejax.runs.trackers import FinishedGeneration, Reporter

if TYPE_CHECKING:  # the first line is shown before jax is imported
    from sejax.bilevel import Bilevel
    from sejax.runs.run_directory import RunDirectory


class Tally:
    """One live line on a terminal: how many are done of all, and the time left.

    Elsewhere one line says what is being done.

    Example:
      >>> with Tally(20, "agents on the proxy") as tally:
      ...     tally.add(5)
      training 20 agents on the proxy ...
    """

    def __init__(self, total: int, things: str, console: Console | None = None):
        console = console or Console(highlight=False, markup=False)
        self.is_live = console.is_terminal
        if not self.is_live:
            print(f"training {total:,} {things} ...", flush=True)
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.completed:,.0f}/{task.total:,.0f} {task.description}"),
            BarColumn(bar_width=16),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
            disable=not self.is_live,
            transient=True,
        )
        self._task = self._progress.add_task(things, total=total)
        self._total = total

    def __enter__(self) -> "Tally":
        self._progress.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self._progress.stop()

    def add(self, count: int = 1) -> None:
        """Counts what is done, from any thread; there are no more than all."""
        self._progress.update(self._task, advance=count)
        if self._progress.tasks[0].completed > self._total:
            self._progress.update(self._task, completed=self._total)


class RunProgress(Reporter):
    """One live line on a terminal; one line for each generation elsewhere."""

    def __init__(self, config: LearnConfig):
        self._config = config
        self._console = Console(highlight=False, markup=False)
        self._live = self._console.is_terminal
        self._progress = Progress(
            SpinnerColumn(),
            BarColumn(bar_width=16),
            TextColumn("{task.description}"),
            TextColumn("left"),
            TimeRemainingColumn(elapsed_when_finished=False),
            console=self._console,
            disable=not self._live,
        )
        self._task = self._progress.add_task("", total=config.generations)
        self._started, self._steps = time.monotonic(), 0

    def __enter__(self) -> "RunProgress":
        self._progress.start()
        pair = self._config.name("env"), self._config.name("proxy")
        if not preset_files.is_tuned(*pair):
            self.say(
                f"There are no tuned settings for env={pair[0]} with proxy={pair[1]}: these are "
                f"general ones, not tuned (docs/defaults.md)."
            )
        return self

    def __exit__(self, *_: Any) -> None:
        self.stop()

    def stop(self) -> None:
        self._progress.stop()

    def status(self, text: str) -> None:
        """Shows what is being done before the first generation."""
        self._progress.update(self._task, description=text)
        self._started = time.monotonic()
        if not self._live:
            self.say(f"{text} ...")

    def say(self, text: str) -> None:
        """Prints a line that stays."""
        self._console.print(text, soft_wrap=True)

    def on_generation(self, info: FinishedGeneration) -> None:
        """Shows the numbers of a generation; steps per second are the session's so far."""
        self._steps += info.train_steps
        steps_per_s = self._steps / max(time.monotonic() - self._started, 1e-9)
        values = info.values
        text = (
            f"generation {info.generation}/{self._config.generations - 1}: "  # from 0, as in files
            f"incumbent {self._score(values['incumbent_mean'])} ± "
            f"{self._score(values['incumbent_std'])}{self._of_agents(values)}, "
            f"best {self._score(values['best_so_far'])}, "
            f"{values['train_steps_mean']:,.0f} steps an agent, {steps_per_s:,.0f} steps/s"
        )
        if values["num_nonfinite"]:
            text += f", {values['num_nonfinite']:.0f} diverged"
        self._progress.update(self._task, completed=info.generation + 1, description=text)
        if not self._live:
            self.say(text)

    def _score(self, score: float) -> str:
        return f"{score:.1f}"

    def _of_agents(self, values: Mapping[str, float]) -> str:
        """The incumbent's mean for each of several agents."""
        keys = self._config.scored_agents
        each = [
            f"{key} {self._score(values[f'incumbent_mean_{key}'])}" for key in keys if len(keys) > 1
        ]
        return f" ({', '.join(each)})" if each else ""

    def finish(
        self, directory: "RunDirectory", learner: "Bilevel", best: float, ended: str
    ) -> None:
        """Says how it ended, where everything is, and what to do next."""
        self.stop()
        title, verdict = "learned", f"best incumbent score {self._score(best)}"
        if learner.scoring.objective.meaning:
            verdict += f": {learner.scoring.objective.meaning}"
        if learner.solved_score is not None:
            solved = "solved" if best >= learner.solved_score else "not solved"
            title = "solved" if solved == "solved" else title
            verdict = (
                f"{solved}: best incumbent mean {best:.1f}, solved at {learner.solved_score:g}"
            )
        path, config = directory.path, self._config
        agents = [registry.name_of("agent", each) for each in config.agents.values()]
        words = next_steps.evaluate_words(path, config.name("env"), config.name("proxy"), agents)
        self._console.rule(f"{learner.proxy.task.name}: {title}", align="left")
        self.say(
            f"{verdict}\n\n"
            f"  {path}/proxy.safetensors    the best proxy\n"
            f"  {path}/learning_curve.png   how it was learned\n"
            f"  {path}/metrics.csv          a row for each generation\n\n"
            "Train fresh agents on it, and on the real task beside them:\n"
            f"  python -m sejax.evaluate {' '.join(words)}\n"
            f"Use it as a gymnax environment:\n"
            f'  env, params = sejax.load("{path}"{self._own_arguments()})'
        )

    def _own_arguments(self) -> str:
        """What `sejax.load` must be given beside the proxy: what no file's name is imported for."""
        env, proxy = registry.describe("env", self._config.env), self._config.name("proxy")
        fields = ", ".join(f"{name}={value!r}" for name, value in env.items())
        task = f", task=sejax.envs.make({fields})" if ":" in env["name"] else ""
        return task + (f', proxy=sejax.config(["proxy={proxy}"]).proxy' if ":" in proxy else "")
