"""Where sejax's time and memory go: the learning step, compilation, and a generation's memory.

1. The inner step with the paper's CartPole hyperparameters on one core: CPU time with and without
   learning, as in `inner_step.py`; their difference is the learning step (sampling, gradient, Adam,
   soft update), and its share of the whole says what is worth tuning.
2. The learning step's FLOP rate against the peak of this core, a 1024-cubed float32 matrix product
   in the same process. Counted are the matrix products alone, for B rows and layers n_l x m_l:

       2 B [ 3 sum_l n_l m_l  (forward: online and target at s', online at s)
           +   sum_l n_l m_l  (gradients of the weights)
           +   sum_{l>1} n_l m_l ]  (gradients of the hidden activations)

   Activations (a third of the time), Adam and sampling count as time but not as FLOP, and products
   this small cannot reach the peak: the share is no measure of what could still be gained.
3. Compilation of one generation (default settings, all cores), cold and then in a fresh process
   from the persistent compilation cache; importing and tracing are the same in both.
4. Peak resident memory of the process that then runs the generation. `--quick` runs it with 2
   members, which changes the time and hardly the memory: each device has one replay buffer.
"""

import argparse
import itertools
import os
import tempfile
from collections.abc import Sequence
from statistics import median
from typing import Any

import common
from inner_step import KINDS, overrides
from rich.console import Console

GEMM_SIZE = 1024
QUICK = ["es.population_size=2"]


def main() -> None:
    """Runs the benchmark, or one of its sides."""
    args = common.parse_args(__doc__, add_options)
    if args.side:
        SIDES[args.side](args)
        return
    machine = common.machine()
    result = {"step": step_profile(args), "compile": compile_profile(args)}
    show(result)
    common.finish("profile_step", args, {"machine": machine, **result})


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this benchmark."""
    parser.add_argument("--episodes", type=int, default=10, help="in a training, of 200 steps each")
    parser.add_argument("--repeats", type=int, help="of each measurement (7 if --quick, else 30)")
    parser.add_argument("--core", type=int, default=common.available_cores()[-1])


def step_profile(args: argparse.Namespace) -> dict[str, float]:
    """Times of the step and the product, and what follows from them."""
    repeats = args.repeats or (7 if args.quick else 30)
    options = ("--episodes", args.episodes, "--core", args.core, "--seed", args.seed)
    with (
        Console().status("Measuring the inner step"),
        common.Side(__file__, "step", *options) as side,
    ):
        samples = [side.ask(seed=args.seed + i) for i in range(repeats)]
        flops = side.ready["flops"]
    times = {key: median(sample[key] for sample in samples) for key in samples[0]}
    learn_us = times["learning_us"] - times["acting_us"]
    peak = 2 * GEMM_SIZE**3 / times["gemm_s"]
    rate = flops / (learn_us * 1e-6)
    return {
        "step_us": times["learning_us"],
        "step_without_learning_us": times["acting_us"],
        "learn_us": learn_us,
        "learning_share": learn_us / times["learning_us"],
        "learn_mflop": flops / 1e6,
        "learn_gflops": rate / 1e9,
        "gemm_gflops": peak / 1e9,
        "share_of_peak": rate / peak,
    }


def compile_profile(args: argparse.Namespace) -> dict[str, Any]:
    """Compilation without and with the persistent cache, and the memory of a generation."""
    options = ["--seed", args.seed, *(["--quick"] if args.quick else [])]
    result = {}
    with tempfile.TemporaryDirectory() as cache_dir:
        env = {"JAX_COMPILATION_CACHE_DIR": cache_dir,
               "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}  # fmt: skip
        for name in ("cold", "cached"):
            with (
                Console().status(f"Compiling a generation: {name}"),
                common.Side(__file__, "generation", *options, env=env) as side,
            ):
                result[name] = side.ready
                if name == "cached":
                    result["generation"] = side.ask()
    return result


def learning_flops(sizes: Sequence[int], batch_size: int) -> int:
    """FLOP of the matrix products in one DDQN update; the formula is in the module's docstring."""
    products = [fan_in * fan_out for fan_in, fan_out in itertools.pairwise(sizes)]
    return 2 * batch_size * (4 * sum(products) + sum(products[1:]))


def show(result: dict[str, Any]) -> None:
    """Prints the tables."""
    step, compiled = result["step"], result["compile"]
    common.print_table(
        "The inner step on one core (CPU time)",
        ["what", "value"],
        [
            ["agent step, us", f"{step['step_us']:.1f}"],
            ["the same without learning, us", f"{step['step_without_learning_us']:.1f}"],
            ["share of learning", f"{step['learning_share']:.0%}"],
            ["learning step, MFLOP in products", f"{step['learn_mflop']:.3f}"],
            ["learning step, GFLOP/s", f"{step['learn_gflops']:.1f}"],
            [f"{GEMM_SIZE}-cubed product, GFLOP/s", f"{step['gemm_gflops']:.1f}"],
            ["share of the peak", f"{step['share_of_peak']:.0%}"],
        ],
    )
    columns = ("import_s", "trace_s", "compile_s", "peak_memory_mib")
    rows = [[f"{name} cache" if name == "cold" else name,
             *(f"{compiled[name][key]:.1f}" for key in columns)]
            for name in ("cold", "cached")]  # fmt: skip
    run = compiled["generation"]
    rows.append([f"then {run['trainings']} trainings", "", "", "", f"{run['peak_memory_mib']:.1f}"])
    common.print_table(
        "A default CartPole generation (wall-clock)",
        ["start of a process", "import s", "trace s", "compile s", "peak memory so far MiB"],
        rows,
    )


def step_side(args: argparse.Namespace) -> None:
    """Measures trainings with and without learning, and the matrix product, on one core."""
    os.sched_setaffinity(0, {args.core})
    from sejax.cli.runtime import configure_xla

    configure_xla(1)
    import jax
    import jax.numpy as jnp

    import sejax

    trainings = []
    for learning in KINDS:
        config = sejax.config(overrides(args.episodes, learning))
        parts = config.parts()
        task, env = parts["task"], parts["proxy"]
        trainings.append(jax.jit(sejax.make_trainer(parts["agent"], env, parts["training"])))
    params = env.params(env.init_weights(jax.random.key(args.seed)))
    multiply = jax.jit(jnp.matmul)
    matrix = jax.random.normal(jax.random.key(args.seed), (GEMM_SIZE, GEMM_SIZE))

    def microseconds_per_step(train: Any, seed: int) -> float:
        key = jax.random.key(seed)
        result, times = common.measure(lambda: jax.block_until_ready(train(key, params)))
        return 1e6 * times["cpu_s"] / int(result.train_steps)

    def handle(request: dict[str, Any]) -> dict[str, Any]:
        learning, acting = (microseconds_per_step(train, request["seed"]) for train in trainings)
        _, times = common.measure(lambda: multiply(matrix, matrix).block_until_ready())
        return {"learning_us": learning, "acting_us": acting, "gemm_s": times["cpu_s"]}

    handle({"seed": args.seed})  # compiles
    hidden = [config.agent.hidden_size] * config.agent.num_layers
    sizes = [task.obs_dim, *hidden, task.num_actions]
    common.serve({"flops": learning_flops(sizes, config.agent.batch_size)}, handle)


def generation_side(args: argparse.Namespace) -> None:
    """Compiles a default generation, says how long it took, and runs it on request."""
    from sejax.cli.runtime import configure_xla

    configure_xla()

    def load() -> Any:
        import sejax
        from sejax.bilevel import make_program

        config = sejax.config([f"seed={args.seed}", *(QUICK if args.quick else [])])
        return make_program(**config.parts())

    program, importing = common.measure(load)
    import jax

    state = jax.jit(program.init)(jax.random.key(args.seed)[None])
    lowered, tracing = common.measure(
        lambda: jax.jit(program.generation, donate_argnums=0).lower(state)
    )
    generation, compiling = common.measure(lowered.compile)

    def handle(request: dict[str, Any]) -> dict[str, Any]:
        nonlocal state
        (state, info), times = common.measure(lambda: jax.block_until_ready(generation(state)))
        return {
            "wall_s": times["wall_s"],
            "trainings": program.strategy.num_evaluations,
            "agent_steps": int(info.train_steps_total.item()),
            "peak_memory_mib": common.peak_memory_mib(),
        }

    ready = {
        "import_s": importing["wall_s"],
        "trace_s": tracing["wall_s"],
        "compile_s": compiling["wall_s"],
        "compile_cpu_s": compiling["cpu_s"],
        "peak_memory_mib": common.peak_memory_mib(),
    }
    common.serve(ready, handle)


SIDES = {"step": step_side, "generation": generation_side}

if __name__ == "__main__":
    main()
