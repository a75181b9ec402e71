"""Wall-clock of one NES generation of CartPole SEs on all cores: sejax against eager PyTorch.

A generation of the paper (`preset=paper`, 16 members) trains 48 agents and tests each on the real
task. Three sides run it from the same SE, in turn: sejax with one device per core, sejax with one
device, and PyTorch with one process per core (`torch_nes.py`). Compilation and the start of the
processes are reported apart.

sejax and PyTorch draw different random numbers, so their trainings stop after different numbers of
steps: next to the plain ratio of wall-clock there is that of wall-clock per agent step (training
steps only), which is what the implementations can be held to. The parallel speed-up is sejax's
throughput with all devices over that with one, both on the same work: their scores must be equal to
the last digit, and the benchmark says whether they are. The speed-up stays below the number of
cores where one device is left with a long training, or other processes take part of a core.

`--quick` has 2 members and trainings of at most 10 episodes, the same for all sides; tests and the
outer loop then weigh more.
"""

import argparse
import math
from statistics import median
from typing import Any

import common
from rich.console import Console

QUICK = ["es.population_size=2", "training.max_episodes=10"]
ALL, ONE, TORCH = "sejax", "sejax-one-device", "torch"
TITLES = {ALL: "sejax, all cores", ONE: "sejax, one device", TORCH: "PyTorch, all cores"}


def main() -> None:
    """Runs the benchmark, or one of its sides."""
    args = common.parse_args(__doc__, add_options)
    if args.side:
        SIDES[args.side](args)
        return
    machine = common.machine()
    result = measure_sides(args)
    show(result)
    settings = {"cores": args.cores, "overrides": overrides(args), "repeats": args.repeats}
    common.finish("generation", args, {"machine": machine, "settings": settings, **result})


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this benchmark."""
    parser.add_argument("--cores", type=int, default=len(common.available_cores()))
    parser.add_argument("--repeats", type=int, help="of each side (2 if --quick, else 1)")
    parser.add_argument("overrides", nargs="*", help="of the configuration, after preset=paper")


def overrides(args: argparse.Namespace) -> list[str]:
    """What `sejax.config` gets on every side."""
    return ["preset=paper", f"seed={args.seed}", *(QUICK if args.quick else []), *args.overrides]


def measure_sides(args: argparse.Namespace) -> dict[str, Any]:
    """Runs the generation on each side in turn, and compares."""
    args.repeats = args.repeats or (2 if args.quick else 1)
    options = ["--cores", args.cores, "--seed", args.seed, *(["--quick"] if args.quick else [])]
    sides = {}
    for name in SIDES:
        with Console().status(f"Starting and compiling: {TITLES[name]}"):
            sides[name] = common.Side(__file__, name, *options, *args.overrides)
    weights = sides[ALL].ready["weights"]
    samples: dict[str, list[dict[str, Any]]] = {name: [] for name in sides}
    for _ in range(args.repeats):
        for name, side in sides.items():
            with Console().status(f"One generation: {TITLES[name]}"):
                samples[name].append(side.ask(weights=weights))
    for side in sides.values():
        side.close()
    return compare(samples, {name: side.ready["start"] for name, side in sides.items()})


def compare(
    samples: dict[str, list[dict[str, Any]]], starts: dict[str, dict[str, float]]
) -> dict[str, Any]:
    """Each side's medians, and the ratios between the sides."""
    sides = {name: summarise(samples[name]) | {"start": starts[name]} for name in samples}
    ours, one, torch = sides[ALL], sides[ONE], sides[TORCH]
    return {
        "sides": sides,
        "wall_ratio": torch["wall_s"] / ours["wall_s"],
        "wall_per_step_ratio": torch["wall_us_per_step"] / ours["wall_us_per_step"],
        "cpu_per_step_ratio": torch["cpu_us_per_step"] / ours["cpu_us_per_step"],
        "parallel_speedup": one["wall_us_per_step"] / ours["wall_us_per_step"],
        "devices_agree": samples[ALL][0]["scores"] == samples[ONE][0]["scores"],
    }


def summarise(samples: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians over a side's repetitions. All of them do the same work."""
    steps = samples[0]["steps"]
    wall, cpu = (median(sample[key] for sample in samples) for key in ("wall_s", "cpu_s"))
    return {
        "wall_s": wall,
        "wall_s_all": [sample["wall_s"] for sample in samples],
        "cpu_s": cpu,
        "agent_steps": steps,
        "wall_us_per_step": 1e6 * wall / steps,
        "cpu_us_per_step": 1e6 * cpu / steps,
        "mean_score": samples[0]["mean_score"],
    }


def show(result: dict[str, Any]) -> None:
    """Prints the table and the ratios."""
    rows = []
    for name, side in result["sides"].items():
        start = ", ".join(f"{what} {seconds:.1f}" for what, seconds in side["start"].items())
        rows.append([
            TITLES[name], f"{side['wall_s']:.2f}", f"{side['cpu_s']:.2f}",
            f"{side['agent_steps']:,}", f"{side['wall_us_per_step']:.1f}",
            f"{side['cpu_us_per_step']:.1f}", f"{side['mean_score']:.1f}", start,
        ])  # fmt: skip
    columns = ["one generation", "wall s", "CPU s", "agent steps", "wall us/step", "CPU us/step",
               "mean score", "once, in s"]  # fmt: skip
    common.print_table("One NES generation, CartPole SE, trainings and tests", columns, rows)
    print(
        f"PyTorch / sejax: wall-clock {result['wall_ratio']:.1f}, wall-clock per agent step "
        f"{result['wall_per_step_ratio']:.1f}, CPU per agent step "
        f"{result['cpu_per_step_ratio']:.1f}.\n"
        f"sejax on all devices / on one, agent steps per second: "
        f"{result['parallel_speedup']:.2f}; equal scores: {result['devices_agree']}."
    )


def sejax_side(args: argparse.Namespace) -> None:
    """One generation as a compiled program, always from the same fresh state."""
    from sejax.runtime import configure_xla

    num_devices = args.cores if args.side == ALL else 1
    configure_xla(num_devices)
    import jax
    import numpy as np

    import sejax
    from sejax.bilevel import make_program

    program = make_program(sejax.config(overrides(args)))
    init = jax.jit(program.init)
    keys = jax.random.key(args.seed)[None]
    state = init(keys)
    compiled, start = common.measure(lambda: jax.jit(program.generation).lower(state).compile())
    weights = jax.tree.map(lambda x: np.asarray(x).tolist(), program.unravel(state.incumbent[0]))

    def handle(request: dict[str, Any]) -> dict[str, Any]:
        (_, info), times = common.measure(lambda: jax.block_until_ready(compiled(state)))
        population, incumbent = info.population_mean.item(), info.incumbent_mean.item()
        return {
            "steps": int(info.train_steps_total.item()),
            "mean_score": (2 * population + incumbent) / 3,
            "scores": [population, incumbent, info.population_max.item()],
            **times,
        }

    common.serve({"weights": weights, "start": {"compile": start["wall_s"]}}, handle)


def torch_side(args: argparse.Namespace) -> None:
    """One generation over a pool of processes, always with the same random numbers."""
    import sejax
    import torch_nes

    config = sejax.config(overrides(args))
    pool_context = torch_nes.worker_pool(args.cores)
    pool, start = common.measure(pool_context.__enter__)

    def handle(request: dict[str, Any]) -> dict[str, Any]:
        run = torch_nes.generation
        (_, outcomes), times = common.measure(
            lambda: run(request["weights"], config, pool, args.seed)
        )
        finite = [outcome.score for outcome in outcomes if math.isfinite(outcome.score)]
        return {
            "steps": sum(outcome.train_steps for outcome in outcomes),
            "mean_score": sum(finite) / len(finite),
            "wall_s": times["wall_s"],
            "cpu_s": times["cpu_s"] + sum(outcome.cpu_s for outcome in outcomes),
        }

    common.serve({"start": {"processes": start["wall_s"]}}, handle)
    pool_context.__exit__(None, None, None)


SIDES = {ALL: sejax_side, ONE: sejax_side, TORCH: torch_side}

if __name__ == "__main__":
    main()
