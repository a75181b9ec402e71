"""Wall-clock of one NES generation of CartPole SEs on all cores: sejax against eager PyTorch.

A generation of the paper (`preset=paper`, 16 members) trains 48 agents and tests each on the real
task. Three sides run it from the same SE, in turn: sejax with one device per core, sejax with one
device, and PyTorch with one process per core (`torch_nes.py`). "start s" is what comes once before:
sejax's compilation, or the start of PyTorch's processes; "incumbent" is the mean test return of the
agents trained on the SE itself.

sejax and PyTorch draw different random numbers, so their trainings stop after different numbers of
steps: next to the plain ratio of wall-clock there is that of wall-clock per agent step (training
steps only), which is what the implementations can be held to. The parallel speed-up is sejax's
throughput with all devices over that with one, both on the same work: their scores must be equal to
the last digit, and the benchmark says whether they are. The speed-up stays below the number of
cores where one device is left with a long training, or other processes take part of a core, and
because two devices of a process take a tenth more CPU time than one for the same work (6.2 s and
6.9, where two processes take as much as one each): XLA's matrix library keeps objects that devices
hand on to each other, through locks and with memory that the other thread has to free.

`--quick` has 2 members and trainings of at most 5 episodes, the same for both sides; tests and the
outer loop then weigh more. It leaves out the parallel speed-up, for which that is too short, and
starts the sides at the same time, which makes "start s" longer.
"""

import argparse
import contextlib
import math
from statistics import mean, median
from typing import Any

import common

QUICK = ["es.population_size=2", "training.max_episodes=5"]
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
    with contextlib.ExitStack() as stack:
        for name in SIDES if not args.quick else (ALL, TORCH):
            side = common.Side(__file__, name, *options, *args.overrides)
            sides[name] = stack.enter_context(side)
            if not args.quick:
                assert side.ready  # one after the other, for the start's own time
        starts = {name: side.ready["start_s"] for name, side in sides.items()}
        request = {"weights": sides[ALL].ready["weights"]}
        samples = common.in_turns(sides, [request] * args.repeats, warm_up=False)
    return compare(samples, starts)


def compare(samples: common.Answers, starts: dict[str, float]) -> dict[str, Any]:
    """Each side's medians, and the ratios between the sides."""
    sides = {name: summarise(samples[name]) | {"start_s": starts[name]} for name in samples}
    ours, torch = sides[ALL], sides[TORCH]
    result = {
        "sides": sides,
        "wall_ratio": torch["wall_s"] / ours["wall_s"],
        "wall_per_step_ratio": torch["wall_us_per_step"] / ours["wall_us_per_step"],
        "cpu_per_step_ratio": torch["cpu_us_per_step"] / ours["cpu_us_per_step"],
    }
    if ONE in sides:
        result["parallel_speedup"] = sides[ONE]["wall_us_per_step"] / ours["wall_us_per_step"]
        result["devices_agree"] = samples[ALL][0]["scores"] == samples[ONE][0]["scores"]
    return result


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
        "incumbent_mean": samples[0]["incumbent_mean"],
    }


def show(result: dict[str, Any]) -> None:
    """Prints the table and the ratios."""
    rows = []
    for name, side in result["sides"].items():
        rows.append([
            TITLES[name], f"{side['wall_s']:.2f}", f"{side['cpu_s']:.2f}",
            f"{side['agent_steps']:,}", f"{side['wall_us_per_step']:.1f}",
            f"{side['cpu_us_per_step']:.1f}", f"{side['incumbent_mean']:.1f}",
            f"{side['start_s']:.1f}",
        ])  # fmt: skip
    columns = ["one generation", "wall s", "CPU s", "agent steps", "wall us/step", "CPU us/step",
               "incumbent", "start s"]  # fmt: skip
    common.print_table("One NES generation, CartPole SE, trainings and tests", columns, rows)
    print(
        f"PyTorch / sejax: wall-clock {result['wall_ratio']:.1f}, wall-clock per agent step "
        f"{result['wall_per_step_ratio']:.1f}, CPU per agent step "
        f"{result['cpu_per_step_ratio']:.1f}."
    )
    if ONE in result["sides"]:
        print(
            f"sejax on all devices / on one, agent steps per second: "
            f"{result['parallel_speedup']:.2f}; equal scores: {result['devices_agree']}."
        )


def sejax_side(args: argparse.Namespace) -> None:
    """One generation as a compiled program, always from the same fresh state."""
    from sejax.runs.runtime import configure_xla

    num_devices = args.cores if args.side == ALL else 1
    configure_xla(num_devices)
    import jax
    import numpy as np

    import sejax
    from sejax.bilevel import make_bilevel
    from sejax.ops.parallel import compiler_options

    bilevel = make_bilevel(**sejax.config(overrides(args)).parts())
    state = jax.jit(bilevel.init)(jax.random.key(args.seed))
    generation = jax.jit(bilevel.generation, compiler_options=compiler_options())
    compiled, start = common.measure(lambda: generation.lower(state).compile())
    weights = jax.tree.map(lambda x: np.asarray(x).tolist(), bilevel.unravel(state.last.weights))

    def handle(request: dict[str, Any]) -> dict[str, Any]:
        (_, info), times = common.measure(lambda: jax.block_until_ready(compiled(state)))
        scores = (info.incumbent_mean, info.population_mean, info.population_max)
        return {
            "steps": int(info.train_steps.sum()),
            "incumbent_mean": info.incumbent_mean.item(),
            "scores": [score.item() for score in scores],
            **times,
        }

    common.serve({"weights": weights, "start_s": start["wall_s"]}, handle)


def torch_side(args: argparse.Namespace) -> None:
    """One generation over a pool of processes, always with the same random numbers."""
    import torch_nes

    import sejax

    settings = torch_nes.Settings.of(sejax.config(overrides(args)))
    pool_context = torch_nes.worker_pool(args.cores, settings)
    pool, start = common.measure(pool_context.__enter__)

    def handle(request: dict[str, Any]) -> dict[str, Any]:
        run = torch_nes.generation
        (_, outcomes), times = common.measure(
            lambda: run(request["weights"], settings, pool, args.seed)
        )
        incumbents = [outcome.score for outcome in outcomes[2 * settings.es.population_size :]]
        finite = [score for score in incumbents if math.isfinite(score)]
        return {
            "steps": sum(outcome.train_steps for outcome in outcomes),
            "incumbent_mean": mean(finite) if finite else math.nan,
            "wall_s": times["wall_s"],
            "cpu_s": times["cpu_s"] + sum(outcome.cpu_s for outcome in outcomes),
        }

    common.serve({"start_s": start["wall_s"]}, handle)
    pool_context.__exit__(None, None, None)


SIDES = {ALL: sejax_side, ONE: sejax_side, TORCH: torch_side}

if __name__ == "__main__":
    main()
