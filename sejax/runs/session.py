"""The driver of a run: chunks of generations, each saved before the next one starts."""

import contextlib
import dataclasses
import json
import platform
import signal
import threading
import time
from collections.abc import Iterator
from importlib.metadata import version
from typing import Any

import jax
import numpy as np

from sejax.bilevel import Bilevel, LearnState
from sejax.ops.files import write_text
from sejax.proxies.io import save
from sejax.runs import plots, runtime
from sejax.runs.chunks import Chunks
from sejax.runs.config import LearnConfig
from sejax.runs.progress import RunProgress
from sejax.runs.run_directory import RunDirectory
from sejax.runs.trackers import FinishedGeneration, GuardedTracker, TrackedRun
from sejax.scoring import GenerationInfo

DRAW_EVERY_S = 30.0
PACKAGES = ("flax", "optax", "evosax", "gymnax", "numpy")


def run(
    config: LearnConfig, directory: RunDirectory, chunks: Chunks, report: RunProgress | None = None
) -> dict[str, Any]:
    """Runs Algorithm 1, or the rest of it, in chunks of `checkpoint_every` generations.

    Args:
      config: the configuration.
      directory: its folder.
      chunks: the generations of this configuration.
      report: prints each generation; None: nothing is printed.

    Returns:
      The content of `run.json`. `ended` is solved, by `stop_when_solved` alone; finished, all
      generations, whatever the score; or diverged: no search mean had a finite score, and there is
      no proxy. If all agents diverge, the run stops.

    Raises:
      ConfigError: if another version wrote the folder's state.
      OSError: if a file cannot be written; everything saved before is whole.
    """
    report = report or RunProgress(config, is_quiet=True)
    bilevel = chunks.bilevel
    # What the clocks lack of the seconds of all sessions.
    earlier_wall_s = float(directory.last("wall_s")) - time.monotonic()
    earlier_cpu_s = directory.cpu_s - time.process_time() - chunks.cpu_s
    state = _begin(config.seed, directory, chunks, report)
    drawn = time.monotonic()
    num_trainings = bilevel.evaluate.num_trainings  # of a generation
    folder = directory.folder.resolve()
    start = len(directory.rows)
    about = TrackedRun(folder=folder, id=directory.id, generation=start, config=directory.settings)
    with contextlib.closing(GuardedTracker(config.tracker, about, report.say)) as tracker:
        while not state.solved and (first := len(directory.rows)) < config.generations:
            if first and all(float(x["num_nonfinite"]) == num_trainings for x in directory.rows):
                break  # every agent of every generation has diverged
            (directory.folder / "run.json").unlink(missing_ok=True)  # of fewer generations
            length = min(config.checkpoint_every, config.generations - first)
            state, info = _advance(chunks, state, length, report)
            with interrupts_held():
                on_host, info = jax.device_get((state, info))
                wall_s = earlier_wall_s + time.monotonic()
                cpu_s = earlier_cpu_s + time.process_time() + chunks.cpu_s
                rows = directory.save(on_host, info, wall_s, cpu_s)
                save_proxies(directory, bilevel, on_host, first)
            for generation in _finished(rows, info):
                report.on_generation(generation)
                tracker.on_generation(generation)
            if time.monotonic() - drawn > DRAW_EVERY_S:
                draw(config, directory, bilevel)
                drawn = time.monotonic()
        draw(config, directory, bilevel)
    return _summary(directory, bilevel, state)


def _begin(seed: int, directory: RunDirectory, chunks: Chunks, report: RunProgress) -> LearnState:
    """The folder's state, whose proxies are written again; a new state if there is none."""
    state = chunks.init(jax.random.key(seed))
    restored = directory.restore(state)
    if restored is not None:
        report.say(f"Resuming at generation {len(directory.rows)} of {directory.folder}.")
        here, there = runtime.versions(), directory.versions
        if there != here:
            report.say(f"It was made with {there}; here are {here}. Numbers may move.")
        # `stop_when_solved` may have changed.
        solved = jax.numpy.bool_(chunks.bilevel.ends_run(restored.best.score))
        state = dataclasses.replace(restored, solved=solved)
        save_proxies(directory, chunks.bilevel, jax.device_get(state), 0)
    # A copy has its own buffers, which can be donated.
    return jax.tree.map(lambda x: x.copy(), state)


def _advance(
    chunks: Chunks, state: LearnState, length: int, report: RunProgress
) -> tuple[LearnState, GenerationInfo]:
    """Runs `length` generations, and returns when they are computed."""
    if length not in chunks.compiled:
        report.status("compiling")
        chunks.compile(length)
        report.status("computing")
    state, info = chunks.advance(state, length)
    pending: Any = state.generation
    while not pending.is_ready():  # only Python code hears Ctrl-C
        time.sleep(0.02)
    return state, info


@contextlib.contextmanager
def interrupts_held() -> Iterator[None]:
    """Holds Ctrl-C and SIGTERM back until the end of the block.

    The block writes files. jax's caches also call back from weak references in it, where Python
    prints an exception and drops it: the run would go on.
    """
    is_main = threading.current_thread() is threading.main_thread()  # others get no signals
    heard: list[int] = []
    handlers = {
        number: signal.signal(number, lambda number, frame: heard.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
        if is_main and callable(signal.getsignal(number))
    }
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if heard:
        signal.raise_signal(heard[0])


def save_proxies(directory: RunDirectory, bilevel: Bilevel, state: LearnState, first: int) -> None:
    """Writes the best proxy, if it is new, and the last one; none before a finite score.

    If the search mean is not finite, the previous file stays.

    Args:
      directory: the run's directory.
      bilevel: the functions of Algorithm 1.
      state: the state after the last saved generation, on the host.
      first: the first generation without a written proxy.

    Raises:
      OSError: if a file cannot be written.
    """
    if state.best.generation < 0:
        return
    agent = bilevel.layout.mixture.agents[0]
    names = bilevel.layout.mixture.names
    discount: Any = agent.discount(agent.hparams)  # `save` takes an array of one number too
    # A proxy does not depend on the tracker, nor on the machines.
    config = {k: v for k, v in directory.settings.items() if k not in ("tracker", "machines")}
    for name, scored in {"proxy": state.best, "proxy_last": state.last}.items():
        path = directory.folder / f"{name}.safetensors"
        generation = int(scored.generation)
        if (generation < first and path.exists()) or not np.isfinite(scored.weights).all():
            continue
        record = {"score": float(scored.score), "generation": generation, "seed": config["seed"]}
        if len(names) > 1:
            record["scores"] = dict(zip(names, map(float, scored.by_agent), strict=True))
        save(path, bilevel.proxy, bilevel.unravel(scored.weights), config, discount, **record)


def _summary(directory: RunDirectory, bilevel: Bilevel, state: LearnState) -> dict[str, Any]:
    """Writes `run.json`, unless the same is there, and returns its content."""
    file = directory.folder / "run.json"
    num_trainings = bilevel.evaluate.num_trainings  # of a generation
    is_measured = state.best.generation >= 0
    means = [float(x["train_steps_mean"]) for x in directory.rows]
    counts = {
        "ended": "solved" if state.solved else "finished" if is_measured else "diverged",
        "best_score": float(state.best.score) if is_measured else None,
        "solved_score": bilevel.solved_score,
        "generations": len(directory.rows),
        "agents": len(directory.rows) * num_trainings,
        "train_steps": sum(round(mean * num_trainings) for mean in means),
        "real_steps": int(directory.last("env_steps_total")),
    }
    with contextlib.suppress(OSError, ValueError, TypeError):  # none, or damaged
        stored: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        if stored | counts == stored:
            return stored  # which names the machine that computed it
    versions = runtime.versions() | {package: version(package) for package in PACKAGES}
    summary = counts | {
        "wall_s": round(float(directory.last("wall_s")), 1),
        "cpu_s": round(directory.cpu_s, 1),
        "devices": [str(device) for device in jax.devices()],
        "machine": f"{platform.platform()}, {runtime.available_cores()} cores",
        "versions": {"python": platform.python_version()} | versions,
    }
    write_text(file, json.dumps(summary, indent=2) + "\n")
    return summary


def draw(config: LearnConfig, directory: RunDirectory, bilevel: Bilevel) -> None:
    """Draws the learning curve of the rows so far."""
    path = directory.folder / "learning_curve.png"
    title = ", ".join(map(config.name, ("env", "proxy", "agent")))
    plots.learning_curve(directory.rows, bilevel.solved_score, path, title)


def _finished(rows: list[dict[str, str]], info: GenerationInfo) -> Iterator[FinishedGeneration]:
    """A chunk's generations for the callbacks, made from its rows and its info on the host."""
    for i, row in enumerate(rows):
        scores = np.asarray(info.population_scores[i])
        yield FinishedGeneration(
            generation=int(row["generation"]),
            values={k: float(v) for k, v in row.items() if k not in ("generation", "seed")},
            scores=scores[np.isfinite(scores)],
            train_steps=int(info.train_steps[i].sum(dtype=np.int64)),
        )
