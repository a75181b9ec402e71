"""Generations of a run whose trainings are done elsewhere."""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sejax.bilevel import Program
from sejax.machines.handout import HandOut, Share
from sejax.machines.ledger import Ledger
from sejax.machines.scorer import Work
from sejax.objectives import Outcome
from sejax.ops.parallel import compiler_options

CAPACITY = 16  # trials in a share at most: on a CPU core they follow one another


class RemoteChunks:
    """In the place of `sejax.cli.session.Chunks`: a generation's trainings are handed out.

    The strategy and its state stay here. A generation gives the numbers of `Program.generation` to
    the last bit, where the workers' CPUs are of this one's kind.
    """

    def __init__(self, program: Program, hand_out: HandOut, ledger: Ledger | None = None):
        self.program = program
        self.cpu_s = 0.0  # of the workers, for trainings that counted
        self._hand_out, self._ledger = hand_out, ledger
        # One program asks and tells, and runs twice in a generation: XLA fuses what is told with
        # what was asked, so that two would round candidates otherwise than `Program.generation`.
        self._compiled: dict[int, Any] = {}  # by the number of seeds
        self._shapes: dict[int, Outcome] = {}  # of a generation's outcome, likewise

    def __enter__(self) -> "RemoteChunks":
        return self

    def __exit__(self, *_: Any) -> None:
        self._hand_out.close()

    def init(self, keys: Any) -> Any:
        """The state before the first generation, for keys `[seed]`."""
        return jax.jit(self.program.init)(keys)

    def is_ready(self, num_seeds: int, length: int) -> bool:
        """Whether this process has compiled its part for so many seeds."""
        return num_seeds in self._compiled

    def compile(self, num_seeds: int, length: int) -> None:
        """Compiles this process's part, and waits for a worker that has compiled its own.

        Raises:
          ConfigError: if none gets ready.
        """
        program = self.program
        self._hand_out.start()  # workers compile meanwhile

        def generation(state: Any, outcome: Outcome) -> tuple[Any, ...]:
            asked = program.ask(state)
            trials = jax.random.key_data(asked.keys), asked.candidates, program.eval_steps(state)
            return program.tell(state, asked, outcome), trials

        keys = jax.random.split(jax.random.key(0), num_seeds)
        state = jax.eval_shape(program.init, keys)
        self._shapes[num_seeds] = self._outcome_shapes(num_seeds, state)
        jitted = jax.jit(generation, compiler_options=compiler_options())
        self._compiled[num_seeds] = jitted.lower(state, self._shapes[num_seeds]).compile()
        self._hand_out.get_ready()

    def advance(self, state: Any, length: int) -> tuple[Any, Any]:
        """Runs `length` generations.

        Returns:
          The state, and an info with leaves `[length, seed]`.

        Raises:
          ConfigError: if no worker gets ready.
          FailedError: if a training fails everywhere.
          OSError: if `machines.csv` cannot be written.
        """
        num_seeds = state.generation.shape[0]
        if not self.is_ready(num_seeds, length):
            self.compile(num_seeds, length)
        infos = []
        for _ in range(length):
            outcome = self._outcome(num_seeds, state)
            (state, info), _ = self._compiled[num_seeds](state, outcome)
            infos.append(info)
        return state, jax.tree.map(lambda *each: jnp.stack(each), *infos)

    def _outcome(self, num_seeds: int, state: Any) -> Outcome:
        """What comes of a generation's trials, leaves `[seed, trials, ...]`."""
        shapes = self._shapes[num_seeds]
        nothing = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)
        _, trials = self._compiled[num_seeds](state, nothing)
        keys, candidates, eval_steps = jax.device_get(trials)
        active = ~np.asarray(state.finished)
        num_trials = keys.shape[1]

        def work_of(share: Share) -> Work:
            seeds, trials = np.divmod(share.places, num_trials)
            return Work(
                share.family,
                keys[seeds, trials],
                candidates[seeds, trials],
                active[seeds],
                None if eval_steps is None else eval_steps[seeds],
            )

        def problem_of(share: Share, scored: Any) -> str | None:
            return problem(scored, shapes, len(share.places))

        seeds = np.arange(num_seeds)[:, None] * num_trials
        families = [
            (seeds + np.flatnonzero(self.program.family_of_trial == family)).reshape(-1)
            for family in range(self.program.families.size)
        ]
        started = time.perf_counter()
        outcomes, done = self._hand_out.score(families, work_of, problem_of)
        wall_s = time.perf_counter() - started
        self.cpu_s += sum(each.cpu_s for each in done.values())
        if self._ledger is not None:
            about = {worker: self._hand_out.about(worker) for worker in done}
            self._ledger.write(int(state.generation.max()), wall_s, about, done)
        merged = {
            name: np.zeros((num_seeds * num_trials, *x.shape[2:]), x.dtype)
            for name, x in vars(shapes).items()
        }
        for share, outcome in outcomes:
            for name, x in outcome.items():
                merged[name][share.places] = x
        leaves: dict[str, Any] = {
            name: x.reshape(num_seeds, num_trials, *x.shape[1:]) for name, x in merged.items()
        }
        return Outcome(**leaves)

    def _outcome_shapes(self, num_seeds: int, state: Any) -> Outcome:
        """Shapes and types of a generation's outcome, of those of its state."""
        program = self.program
        num_trials = len(program.family_of_trial)
        keys = jax.random.split(jax.random.key(0), 1)
        eval_steps = jax.eval_shape(program.eval_steps, state)
        one: Outcome = jax.eval_shape(
            program.share_of(0),
            keys,
            jnp.zeros((1, program.num_dims)),
            jnp.ones(1, bool),
            eval_steps and jax.ShapeDtypeStruct((1,), eval_steps.dtype),
        )
        return jax.tree.map(
            lambda x: jax.ShapeDtypeStruct((num_seeds, num_trials, *x.shape[1:]), x.dtype), one
        )


def problem(scored: Any, shapes: Outcome, num_trials: int) -> str | None:
    """What is wrong with what a worker says of a share, if anything is.

    Args:
      scored: from the worker.
      shapes: of a generation's outcome, `[seed, trials, ...]`.
      num_trials: in the share.
    """
    outcome = getattr(scored, "outcome", None)
    wanted = {name: ((num_trials, *x.shape[2:]), x.dtype) for name, x in vars(shapes).items()}
    if not isinstance(outcome, dict) or outcome.keys() != wanted.keys():
        return "it sent no outcome"
    for name, (shape, dtype) in wanted.items():
        x = outcome[name]
        if not isinstance(x, np.ndarray) or x.shape != shape or x.dtype != dtype:
            return f"it sent {name} of another shape or type"
    for name in ("train_steps", "train_episodes", "real_steps"):
        if (outcome[name] < 0).any():
            return f"it sent negative {name}"
    sound = ~outcome["nonfinite"]
    if not np.isfinite(outcome["test_returns"][sound]).all():
        return "it sent returns that are not finite of agents that did not diverge"
    return None
