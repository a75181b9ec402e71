"""`python -m sejax.run`: learn a proxy for a task.

Running the same command on an existing run directory goes on where it stopped.
"""

import platform
import sys
import time
from typing import Any

import hydra
from omegaconf import DictConfig

from sejax import commands
from sejax.configs import LearnConfig, from_hydra


@hydra.main(config_path="conf/run", config_name="run", version_base="1.3")
@commands.task
def main(cfg: DictConfig) -> float:
    """Learns a proxy as configured and returns the best incumbent mean (for Hydra's sweepers)."""
    config = from_hydra(cfg)
    from sejax.runtime import configure_xla

    if "jax" not in sys.modules:  # a sweep's second job finds it running
        configure_xla(config.devices)
    return learn(config)


def learn(config: LearnConfig) -> float:
    """Runs the bilevel loop in chunks of `checkpoint_every` generations, saving after each.

    Every chunk is the same executable, with the state donated. Ctrl-C leaves at once, with exit
    code 130: what is finished has been saved.

    Returns:
      The best incumbent mean of all seeds.

    Raises:
      ConfigError: if the run directory cannot be used.
      OSError: if a file cannot be written; everything saved before is whole.
    """
    from sejax.progress import RunProgress
    from sejax.run_directory import RunDirectory

    directory = RunDirectory.open(config)  # before jax is imported: a refusal must be quick
    with RunProgress(config) as progress:
        try:
            return _learn_in(directory, progress)
        except KeyboardInterrupt:
            progress.stop()
            done = max((int(row["generation"]) + 1 for row in directory.rows), default=0)
            print(f"Interrupted. {done} generations are saved in {directory.path}; the same "
                  f"command goes on from there.")  # fmt: skip
            commands.leave(commands.INTERRUPTED)


def _learn_in(directory: Any, progress: Any) -> float:
    started, cpu_started = time.time(), time.process_time()
    progress.say("importing jax and the task")
    import jax

    from sejax import checkpoints
    from sejax.bilevel import make_program
    from sejax.runtime import enable_compilation_cache

    enable_compilation_cache()
    config = directory.config
    program = make_program(config)
    keys = jax.numpy.stack([jax.random.key(config.seed + i) for i in range(config.num_seeds)])
    state = jax.jit(program.init)(keys)
    state, generation, problems = checkpoints.restore_newest(directory.checkpoints, state)
    for problem in problems:
        progress.print(problem)
    if generation:
        progress.print(f"Going on at generation {generation} of {directory.path}.")
    directory.go_on_from(generation)

    wall_before = float(directory.rows[-1]["wall_s"]) if directory.rows else 0.0
    progress.say("compiling")
    compiled: dict[int, Any] = {}
    state = jax.tree.map(lambda x: x.copy(), state)  # own buffers, so that they can be donated
    ended = "finished"
    while generation < config.generations and not bool(state.finished.all()):
        length = min(config.checkpoint_every, config.generations - generation)
        if length not in compiled:
            compiled[length] = _compile_chunk(program, state, length)
            progress.compiled()
        state, info = compiled[length](state)
        _wait(state)
        generation += length
        host_state, info = jax.device_get((state, info))
        wall_s = wall_before + time.time() - started
        with commands.interrupts_held():
            directory.add_rows(info, wall_s)
            directory.save_proxies(program, host_state)
            checkpoints.save(directory.checkpoints, generation, state)
        progress.update(generation, info)
        if progress.time_to_draw():
            _draw(directory, program)
    if bool(state.finished.all()):
        ended = "solved"
    _draw(directory, program)
    best = float(state.best_score.max())
    directory.write_summary(
        ended=ended,
        best_score=best,
        generations=generation,
        wall_s=round(wall_before + time.time() - started, 1),
        cpu_s_of_last_session=round(time.process_time() - cpu_started, 1),
        devices=[str(device) for device in jax.devices()],
        versions=_versions(),
    )
    progress.finish(directory, program, best, ended)
    return best


def _compile_chunk(program: Any, state: Any, length: int) -> Any:
    import jax

    def chunk(state: Any) -> Any:
        return jax.lax.scan(lambda state, _: program.generation(state), state, length=length)

    return jax.jit(chunk, donate_argnums=0).lower(state).compile()


def _wait(state: Any) -> None:
    """Waits for the devices in Python, so that Ctrl-C is heard while they work."""
    while not state.generation.is_ready():
        time.sleep(0.02)


def _draw(directory: Any, program: Any) -> None:
    from sejax import plots

    if directory.rows:
        plots.learning_curve(
            directory.rows, program.solved_score, directory.path / "learning_curve.png"
        )


def _versions() -> dict[str, str]:
    from importlib.metadata import version

    packages = ("sejax", "jax", "jaxlib", "flax", "optax", "evosax", "gymnax", "numpy")
    return {"python": platform.python_version(), **{name: version(name) for name in packages}}


if __name__ == "__main__":
    commands.start(main)
