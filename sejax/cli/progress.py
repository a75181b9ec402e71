"""Live lines of progress on a terminal, and the last words of `sejax.run`."""

import time
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from sejax import registry
from sejax.cli import next_steps, presets
from sejax.cli.build import LearnConfig
from sejax.cli.families import families_of

DRAW_EVERY_S = 30.0


class Tally:
    """One live line on a terminal: how many are done of all, and the time left; nothing elsewhere.

    Example:
      >>> with Tally(20, "agents on the proxy") as tally:
      ...     tally.add(5)
      >>> tally.is_live
      False
    """

    def __init__(self, total: int, things: str, console: Console | None = None):
        console = console or Console(highlight=False, markup=False)
        self.is_live = console.is_terminal
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


class RunProgress:
    """One live line on a terminal; one line for each generation elsewhere."""

    def __init__(self, config: LearnConfig):
        self._config = config
        self._console = Console(highlight=False, markup=False)
        self._live = self._console.is_terminal
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("generation {task.completed}/{task.total}"),
            BarColumn(bar_width=16),
            TextColumn("{task.description}"),
            TextColumn("left"),
            TimeRemainingColumn(elapsed_when_finished=False),
            console=self._console,
            disable=not self._live,
        )
        self._task = self._progress.add_task("", total=config.generations)
        self._last = self._drawn = time.time()

    def __enter__(self) -> "RunProgress":
        self._progress.start()
        pair = self._config.name("env"), self._config.name("proxy")
        if not presets.is_tuned(*pair):
            self.print(
                f"There are no tuned settings for env={pair[0]} with proxy={pair[1]}: these are "
                f"general ones, not tuned (docs/defaults.md)."
            )
        return self

    def __exit__(self, *_: Any) -> None:
        self._progress.stop()

    def stop(self) -> None:
        self._progress.stop()

    def say(self, text: str) -> None:
        """Shows what is being done before the first generation."""
        self._progress.update(self._task, description=text)

    def print(self, text: str) -> None:
        """Prints a line that stays."""
        self._console.print(text, soft_wrap=True)

    def compiled(self) -> None:
        self.say("first generation")
        self._last = time.time()

    def update(self, generation: int, info: Any) -> None:
        """Shows the last generation of a chunk, whose info has leaves `[generation, ...]`."""
        now = time.time()
        last = max(np.flatnonzero(info.active), default=-1)
        steps_per_s = np.sum(info.train_steps, dtype=np.int64) / max(now - self._last, 1e-9)
        self._last = now
        text = (
            f"incumbent {info.incumbent_mean[last]:.1f} ± {info.incumbent_std[last]:.1f}"
            f"{self._of_agents(info.by_agent.incumbent_mean[last])}, "
            f"best {info.best_so_far[last]:.1f}, "
            f"{info.train_steps_mean[last]:,.0f} steps an agent, {steps_per_s:,.0f} steps/s"
        )
        num_nonfinite = int(np.sum(info.num_nonfinite))
        if num_nonfinite:
            text += f", {num_nonfinite} diverged"
        self._progress.update(self._task, completed=generation, description=text)
        if not self._live:
            self.print(f"generation {generation}/{self._config.generations}: {text}")

    def _of_agents(self, means: np.ndarray) -> str:
        """The incumbent's score with each agent of a mixture."""
        each = [
            f"{family.key} {mean:.1f}"
            for family, mean in zip(families_of(self._config), means, strict=True)
        ]
        return f" ({', '.join(each)})" if len(each) > 1 else ""

    def time_to_draw(self) -> bool:
        """Whether the picture is old enough to be drawn again."""
        if time.time() - self._drawn < DRAW_EVERY_S:
            return False
        self._drawn = time.time()
        return True

    def finish(self, directory: Any, program: Any, best: float, ended: str) -> None:
        """Says how it ended, where everything is, and what to do next."""
        self.stop()
        verdict = f"best incumbent score {best:.1f}"
        if program.objective.meaning:
            verdict += f": {program.objective.meaning}"
        if program.solved_score is not None:
            solved = "solved" if best >= program.solved_score else "not solved"
            verdict = (
                f"{solved}: best incumbent mean {best:.1f}, solved at {program.solved_score:g}"
            )
        path, config = directory.path, self._config
        agents = [registry.name_of("agent", each.agent) for each in families_of(config)]
        words = next_steps.evaluate_words(
            path, config.name("env"), config.name("proxy"), agents, program.proxy.is_real
        )
        title = "learned" if ended == "finished" else ended
        self._console.rule(f"{program.task.name}: {title}", align="left")
        self.print(
            f"{verdict}\n\n"
            f"  {path}/proxy.safetensors    the best proxy\n"
            f"  {path}/learning_curve.png   how it was learned\n"
            f"  {path}/metrics.csv          a row for each generation\n\n"
            f"Train fresh agents on it, and on the real task beside them:\n"
            f"  python -m sejax.evaluate {' '.join(words)}\n"
            f"Use it as a gymnax environment:\n"
            f'  env, params = sejax.load("{path}"{self._own_arguments()})'
        )

    def _own_arguments(self) -> str:
        """What `sejax.load` must be given beside the proxy."""
        task = ", task=my_task" if ":" in self._config.name("env") else ""
        return task + (", proxy=my_proxy_config" if ":" in self._config.name("proxy") else "")
