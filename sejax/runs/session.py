"""The driver of a run: blocks of generations, each saved before the next one starts."""

import contextlib
import dataclasses
import platform
import signal
import threading
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version
from typing import Any

import jax
import numpy as np
from jax import Array

from sejax.bilevel import Bilevel, LearnState, make_bilevel
from sejax.objectives import GenerationInfo
from sejax.ops.parallel import compiler_options
from sejax.proxies.io import save
from sejax.runs import next_steps, plots, runtime
from sejax.runs.config import LearnConfig
from sejax.runs.run_directory import RunDirectory
from sejax.runs.trackers import FinishedGeneration, GuardedTracker, Reporter, TrackedRun

DRAW_EVERY_S = 30.0
PACKAGES = ("sejax", "jax", "jaxlib", "flax", "optax", "evosax", "gymnax", "numpy")


class Chunks:
    """The generations of a learner in chunks, each length compiled once, ahead of time.

    `jax.jit` would compile again whenever the placement of the state differs: new, restored, or as
    the chunk before returned it.

    Attributes:
      learner: the functions of Algorithm 1.
      cpu_s: CPU seconds of other processes than this one.
    """

    cpu_s = 0.0

    def __init__(self, learner: Bilevel):
        self.learner = learner
        self.init: Callable[[Array], LearnState] = jax.jit(learner.init)  # before generation 0
        self._compiled: dict[int, Any] = {}  # by the length

    def is_ready(self, length: int) -> bool:
        """Whether a chunk of this length has been compiled."""
        return length in self._compiled

    def compile(self, length: int) -> None:
        """Compiles a chunk of this length."""

        def chunk(state: LearnState) -> tuple[LearnState, GenerationInfo]:
            step = self.learner.generation
            return jax.lax.scan(lambda state, _: step(state), state, length=length)

        state = jax.eval_shape(self.init, jax.random.key(0))
        jitted = jax.jit(chunk, donate_argnums=0, compiler_options=compiler_options())
        self._compiled[length] = jitted.lower(state).compile()

    def advance(self, state: LearnState, length: int) -> tuple[LearnState, GenerationInfo]:
        """Runs `length` generations; the buffers of the state are donated.

        Returns:
          The state, and an info with leaves `[length, ...]`.
        """
        if not self.is_ready(length):
            self.compile(length)
        state, info = self._compiled[length](state)
        return state, info


def make_chunks(config: LearnConfig) -> Chunks:
    """The generations of a configuration, for all runs that differ from it in the seed."""
    return Chunks(make_bilevel(**config.parts()))


def run(
    config: LearnConfig,
    directory: RunDirectory,
    chunks: Chunks,
    report: Reporter | None = None,
) -> str:
    """Runs Algorithm 1, or what is left of it, in chunks of `checkpoint_every` generations.

    Args:
      config: the configuration.
      directory: its folder.
      chunks: the generations of this configuration.
      report: hears how it goes on.

    Returns:
      How it ended: finished, solved, or diverged: a run of whose agents none has ended with finite
      numbers stops, and has no proxy.

    Raises:
      ConfigError: if the folder's state is that of another version.
      OSError: if a file cannot be written; everything saved before is whole.
    """
    report = report or Reporter()
    learner, clock = chunks.learner, _Clock(directory, chunks)
    proxies = _Proxies(config, directory, learner)
    state = chunks.init(jax.random.key(config.seed))
    restored = directory.restore(state)
    if restored is not None:
        # `stop_when_solved` may have changed.
        solved = jax.numpy.bool_(learner.is_solved(restored.best_score))
        state = dataclasses.replace(restored, solved=solved)
        report.say(f"Going on at generation {directory.finished_generations} of {directory.path}.")
        here = runtime.versions()
        if directory.versions != here:
            report.say(f"It was made with {directory.versions}; here are {here}. Numbers may move.")
        proxies.save(jax.device_get(state))
    state = jax.tree.map(lambda x: x.copy(), state)  # own buffers, so that they can be donated
    tracked = TrackedRun(
        folder=directory.path.resolve(),
        id=directory.id,
        generation=directory.finished_generations,
        config=directory.config,
    )
    tracker = GuardedTracker(config.tracker, tracked, report.say)
    drawn = time.monotonic()
    with contextlib.closing(tracker):
        while directory.finished_generations < config.generations and not state.solved:
            if _all_diverged(directory, learner):
                break
            left = config.generations - directory.finished_generations
            length = min(config.checkpoint_every, left)
            if not chunks.is_ready(length):
                report.status("compiling")
                chunks.compile(length)
                report.status("first generation")
            state, info = chunks.advance(state, length)
            pending: Any = state.generation
            while not pending.is_ready():  # Ctrl-C is heard in Python alone
                time.sleep(0.02)
            with interrupts_held():
                saved, info = jax.device_get((state, info))
                rows = directory.save(saved, info, clock.wall_s(), clock.cpu_s())
                proxies.save(saved)
                for generation in _finished(rows, info):
                    report.on_generation(generation)
                    tracker.on_generation(generation)
            if time.monotonic() - drawn > DRAW_EVERY_S:
                draw(directory, learner)
                drawn = time.monotonic()
        draw(directory, learner)
    diverged = _all_diverged(directory, learner)
    ended = "solved" if state.solved else "diverged" if diverged else "finished"
    agents = learner.strategy.num_evaluations  # of a generation
    steps_of_agents = sum(float(row["train_steps_mean"]) for row in directory.rows)
    directory.write_summary(
        ended=ended,
        best_score=float(state.best_score),
        generations=directory.finished_generations,
        solved_score=learner.solved_score,
        wall_s=round(clock.wall_s(), 1),
        cpu_s=round(clock.cpu_s(), 1),
        agents=directory.finished_generations * agents,
        train_steps=round(steps_of_agents * agents),
        real_steps=directory.real_steps,
        devices=[str(device) for device in jax.devices()],
        machine=runtime.machine(),
        versions={"python": platform.python_version()} | {x: version(x) for x in PACKAGES},
    )
    return ended


def _all_diverged(directory: RunDirectory, learner: Bilevel) -> bool:
    """Whether there are generations, and every agent of each met a number that is not finite."""
    agents = learner.strategy.num_evaluations
    rows = directory.rows
    return bool(rows) and all(float(row["num_nonfinite"]) == agents for row in rows)


@contextlib.contextmanager
def interrupts_held() -> Iterator[None]:
    """Ctrl-C and SIGTERM are heard at the end of the block.

    Within, files are being written, and jax's caches call back from weak references, where Python
    prints an exception and forgets it: the run would go on.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    handlers = {number: handler for number, handler in handlers.items() if callable(handler)}
    heard: list[int] = []
    for number in handlers:
        signal.signal(number, lambda number, frame: heard.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if heard:
        signal.raise_signal(heard[0])


class _Clock:
    """Seconds of all sessions of a run; no change of the machine's time moves them."""

    def __init__(self, directory: RunDirectory, chunks: Chunks):
        self._chunks = chunks
        self._wall_s = directory.wall_s - time.monotonic()
        self._cpu_s = directory.cpu_s - time.process_time() - chunks.cpu_s

    def wall_s(self) -> float:
        return self._wall_s + time.monotonic()

    def cpu_s(self) -> float:
        return self._cpu_s + time.process_time() + self._chunks.cpu_s


class _Proxies:
    """The proxy files of a run."""

    def __init__(self, config: LearnConfig, directory: RunDirectory, learner: Bilevel):
        self._directory, self._learner, self._seed = directory, learner, config.seed
        # What was learned does not depend on the tracker, nor on where it was computed.
        plain = directory.config.items()
        self._plain = {k: v for k, v in plain if k not in ("tracker", "machines")}
        agent = learner.mixture.agents[0]
        discount = agent.discount(agent.hparams)
        self._discount = None if discount is None else float(discount)
        self._best: int | None = None  # the generation of the best proxy that is on the disk

    def save(self, state: LearnState) -> None:
        """Writes the best proxy, if it is new, and the last one; none if all agents diverged.

        Raises:
          OSError: if a file cannot be written.
        """
        if _all_diverged(self._directory, self._learner):
            return
        if self._best != state.best_generation:
            best = state.best, state.best_score, state.best_scores, state.best_generation
            self._save("proxy", *best)
            self._best = int(state.best_generation)
        last = state.incumbent, state.incumbent_score, state.incumbent_scores
        self._save("proxy_last", *last, state.generation - 1)

    def _save(self, name: str, flat: Array, score: Array, scores: Array, generation: Array) -> None:
        if not np.isfinite(flat).all():  # the mean has diverged; the file before it stays
            return
        names = self._learner.mixture.names
        by_agent = dict(zip(names, map(float, scores), strict=True))
        save(
            self._directory.path / f"{name}.safetensors",
            self._learner.proxy,
            self._learner.unravel(flat),
            self._plain,
            self._discount,
            score=float(score),
            generation=int(generation),
            seed=self._seed,
            **({"scores": by_agent} if len(names) > 1 else {}),
        )


def draw(directory: RunDirectory, learner: Bilevel) -> None:
    """Draws the learning curve of the rows so far."""
    if directory.rows:
        path = directory.path / "learning_curve.png"
        title = next_steps.title(directory.config)
        plots.learning_curve(directory.rows, learner.solved_score, path, title)


def _finished(rows: list[dict[str, str]], info: GenerationInfo) -> Iterator[FinishedGeneration]:
    """The generations of a chunk for the callbacks, of its rows and its info on the host."""
    for i, row in enumerate(rows):
        scores = np.asarray(info.population_scores[i])
        yield FinishedGeneration(
            generation=int(row["generation"]),
            values={k: float(v) for k, v in row.items() if k not in ("generation", "seed")},
            scores=scores[np.isfinite(scores)],
            train_steps=int(info.train_steps[i].sum(dtype=np.int64)),
        )
