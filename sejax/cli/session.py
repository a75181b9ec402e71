"""The one driver of a run: chunks of generations, each saved before the next one starts."""

import copy
import platform
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Protocol

import jax
import numpy as np

from sejax import __version__
from sejax.bilevel import Bilevel, make_bilevel
from sejax.cli import build, commands, runtime
from sejax.cli.follower import Follower
from sejax.cli.run_directory import RunDirectory
from sejax.ops.parallel import compiler_options
from sejax.proxies.io import save


class Reporter(Protocol):
    """What a run tells while it goes on; see `sejax.cli.progress`."""

    def say(self, text: str) -> None: ...
    def print(self, text: str) -> None: ...
    def compiled(self) -> None: ...
    def update(self, generation: int, info: Any) -> None: ...
    def time_to_draw(self) -> bool: ...


class Quiet:
    """Tells nothing and draws nothing."""

    def say(self, text: str) -> None:
        pass

    print = say

    def compiled(self) -> None:
        pass

    def update(self, generation: int, info: Any) -> None:
        pass

    def time_to_draw(self) -> bool:
        return False


class Chunks:
    """A learner's generations in chunks of one length, compiled ahead of time.

    `jax.jit` alone would recompile whenever the state's sharding differs: fresh, restored, or
    returned by the previous chunk.

    Args:
      program: the learner. Its generations are what is compiled, unless `make` is given.
      make: `make(*arguments) -> Bilevel`, traced, of a learner whose numbers are arguments of what
        is compiled.
      arguments: pytrees with which `make` gives `program`.

    Attributes:
      cpu_s: CPU seconds of other processes than this one.
    """

    cpu_s = 0.0

    def __init__(
        self,
        program: Bilevel,
        make: Callable[..., Bilevel] | None = None,
        arguments: tuple[Any, ...] = (),
    ):
        self.program = program
        self._make, self._arguments = make or (lambda: program), arguments
        self._init = jax.jit(lambda key, *arguments: self._make(*arguments).init(key))
        self._compiled: dict[int, Any] = {}

    def sharing(self, program: Bilevel, arguments: tuple[Any, ...]) -> "Chunks":
        """The chunks of a learner of other arguments, by the same executables."""
        chunks = copy.copy(self)
        chunks.program, chunks._arguments = program, arguments
        return chunks

    def init(self, key: Any) -> Any:
        """The state before the first generation."""
        return self._init(key, *self._arguments)

    def is_ready(self, length: int) -> bool:
        """Whether such a chunk has been compiled."""
        return length in self._compiled

    def advance(self, state: Any, length: int) -> tuple[Any, Any]:
        """Runs `length` generations; the state's buffers are donated.

        Returns:
          The state, and an info with leaves `[length, ...]`.
        """
        if not self.is_ready(length):
            self.compile(length)
        return self._compiled[length](state, *self._arguments)

    def compile(self, length: int) -> None:
        """Compiles a chunk."""

        def chunk(state: Any, *arguments: Any) -> Any:
            program = self._make(*arguments)
            return jax.lax.scan(lambda state, _: program.generation(state), state, length=length)

        state = jax.eval_shape(self._init, jax.random.key(0), *self._arguments)
        program = jax.jit(chunk, donate_argnums=0, compiler_options=compiler_options())
        self._compiled[length] = program.lower(state, *self._arguments).compile()


def make_chunks(config: build.LearnConfig) -> Chunks:
    """The compiled program of a configuration, which runs that differ in their seeds share."""
    return Chunks(make_bilevel(**config.parts()))


def rows_of(info: Any, real_steps_before: int) -> Any:
    """The info of a chunk as the run directory takes it, leaves `[generation, 1, ...]`.

    Args:
      info: of a chunk, on the host, leaves `[generation, ...]`.
      real_steps_before: steps on the real task of all generations before.
    """
    real_steps = info.real_steps.astype(np.int64).sum(axis=1)
    columns = {name: x for name, x in vars(info).items() if isinstance(x, np.ndarray)}
    columns |= {
        "env_steps_total": real_steps_before + np.cumsum(real_steps * info.active),
        "train_steps_total": info.train_steps.astype(np.int64).sum(axis=1),
        "member_scores": info.population_scores,
    }
    families = SimpleNamespace(**{name: x[:, None] for name, x in vars(info.by_agent).items()})
    return SimpleNamespace(**{name: x[:, None] for name, x in columns.items()}, families=families)


def run(
    config: build.LearnConfig,
    directory: RunDirectory,
    chunks: Chunks,
    report: Reporter | None = None,
) -> str:
    """Runs the bilevel loop, or what is left of it, in chunks of `checkpoint_every` generations.

    Every chunk is the same executable. After each, the metrics, the proxies and a checkpoint are
    written.

    Args:
      config: of the run.
      directory: its folder.
      chunks: of a program of this configuration.
      report: told how it goes; nobody is if not given.

    Returns:
      How it ended: finished or solved.

    Raises:
      ConfigError: if the folder's files do not fit each other.
      OSError: if a file cannot be written; everything saved before is whole.
    """
    report = report or Quiet()
    program = chunks.program
    started, cpu_started = time.time(), time.process_time()
    state = chunks.init(jax.random.key(config.seed))
    state, generation, problems = directory.resume(state)
    for problem in problems:
        report.print(problem)
    proxies = Proxies(config, directory.path, program)
    if generation:
        report.print(f"Going on at generation {generation} of {directory.path}.")
        proxies.save(jax.device_get(state))  # again, as somebody may have damaged them
    wall_before = float(directory.rows[-1]["wall_s"]) if directory.rows else 0.0
    cpu_before = directory.cpu_s

    def cpu_s() -> float:
        return cpu_before + time.process_time() - cpu_started + chunks.cpu_s

    state = jax.tree.map(lambda x: x.copy(), state)  # own buffers, so that they can be donated
    with Follower(config, directory, report) as follower:
        if generation < config.generations and not bool(state.finished):
            follower.open()
        follower.tell()  # what it has missed
        while generation < config.generations and not bool(state.finished):
            length = min(config.checkpoint_every, config.generations - generation)
            if not chunks.is_ready(length):
                report.say("compiling")
                chunks.compile(length)
                report.compiled()
            state, info = chunks.advance(state, length)
            _wait(state)
            generation += length
            host_state, info = jax.device_get((state, info))
            real_steps = int(directory.rows[-1]["env_steps_total"]) if directory.rows else 0
            rows = rows_of(info, real_steps)
            with commands.interrupts_held():
                directory.append(rows, wall_before + time.time() - started)
                proxies.save(host_state)
                directory.commit(generation, state, cpu_s())
            report.update(generation, info)
            with commands.interrupts_held():
                follower.tell(rows)
            if report.time_to_draw():
                draw(directory, program)
        ended = "solved" if bool(state.finished) else "finished"
        draw(directory, program)
    directory.write_summary(
        ended=ended,
        best_score=float(state.best_score),
        generations=directory.finished_generations,  # fewer than advanced, if it was solved
        solved_score=program.solved_score,
        wall_s=round(wall_before + time.time() - started, 1),
        cpu_s=round(cpu_s(), 1),
        **_cost(directory, program.strategy.num_candidates),
        devices=[str(device) for device in jax.devices()],
        machine=runtime.machine(),
        versions=_versions(),
    )
    return ended


class Proxies:
    """The proxy files of a run."""

    def __init__(self, config: build.LearnConfig, folder: Path, program: Bilevel):
        self.config, self.folder, self.program = config, folder, program
        # Who followed the run and where it was computed are no part of what was learned.
        plain = build.to_plain(config)
        self._plain = {k: v for k, v in plain.items() if k not in ("tracker", "machines")}
        agent = program.mixture.agents[0]
        discount = agent.discount(agent.hparams)
        self._discount = None if discount is None else float(discount)

    def save(self, state: Any) -> None:
        """Writes the best proxy and the last one.

        Raises:
          OSError: if a file cannot be written.
        """
        self._save("proxy", state.best, state.best_score, state.best_scores, state.best_generation)
        self._save(
            "proxy_last",
            state.incumbent,
            state.incumbent_score,
            state.incumbent_scores,
            state.generation - 1,
        )

    def _save(self, name: str, flat: Any, score: Any, scores: Any, generation: Any) -> None:
        if not np.isfinite(flat).all():  # a mean that is lost; the file before it stays
            return
        names = self.program.mixture.names
        by_agent = dict(zip(names, map(float, scores), strict=True))
        save(
            self.folder / f"{name}.safetensors",
            self.program.proxy,
            self.program.unravel(flat),
            self._plain,
            self._discount,
            score=float(score),
            generation=int(generation),
            seed=self.config.seed,
            **({"scores": by_agent} if len(names) > 1 else {}),
        )


def draw(directory: RunDirectory, program: Bilevel) -> None:
    """Draws the learning curve of what there is."""
    from sejax.cli import plots

    if directory.rows:
        path = directory.path / "learning_curve.png"
        plots.learning_curve(directory.rows, program.solved_score, path)


def _cost(directory: RunDirectory, num_candidates: int) -> dict[str, int]:
    """What the generations took, in agents and steps."""
    steps_of_agents = sum(float(row["train_steps_mean"]) for row in directory.rows)
    return {
        "agents": len(directory.rows) * num_candidates,
        "train_steps": round(steps_of_agents * num_candidates),
        "real_steps": int(directory.rows[-1]["env_steps_total"]) if directory.rows else 0,
    }


def _wait(state: Any) -> None:
    """Waits for the devices in Python, so that Ctrl-C is heard while they work."""
    while not state.generation.is_ready():
        time.sleep(0.02)


def _versions() -> dict[str, str]:
    from importlib.metadata import version

    packages = ("jax", "jaxlib", "flax", "optax", "evosax", "gymnax", "numpy")
    return {
        "python": platform.python_version(),
        "sejax": __version__,
        **{name: version(name) for name in packages},
    }
