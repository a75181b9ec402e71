"""CPU time of one agent step in a CartPole SE on one core: sejax against eager PyTorch.

Both sides train DDQN agents with the paper's hyperparameters (`preset=paper`) on the same fresh SE
and are kept to the same core; they take turns, so that a disturbance meets both. Two kinds of step
are measured: with learning (act, step the SE, store, sample a batch, one update) and without
(`agent.warmup_episodes` out of reach). Training never stops early, and a fresh SE hardly ever ends
an episode, so that every training is `--episodes` times 200 steps. Compilation and a first training
are not counted.

CPU time, unlike wall-clock, excludes what other processes take, but a busy machine still slows both
sides down (caches, clock rate). The ratio of a pair is what to quote: PyTorch's time over sejax's.
"""

import argparse
import os
from statistics import median
from typing import Any

import common
from rich.progress import track

OVERRIDES = ["preset=paper", "training.stop_rule=never"]
KINDS = {True: "with learning", False: "without learning"}


def main() -> None:
    """Runs the benchmark, or one of its sides."""
    args = common.parse_args(__doc__, add_options)
    if args.side:
        os.sched_setaffinity(0, {args.core})
        SIDES[args.side](args)
        return
    machine = common.machine()
    samples = measure_pairs(args)
    result = summarise(samples)
    show(result)
    settings = {"episodes": args.episodes, "pairs": args.pairs, "core": args.core}
    common.finish("inner_step", args, {"machine": machine, "settings": settings, **result})


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this benchmark."""
    parser.add_argument("--episodes", type=int, default=10, help="in a training, of 200 steps each")
    parser.add_argument("--pairs", type=int, help="repetitions (5 if --quick, else 15)")
    parser.add_argument("--core", type=int, default=common.available_cores()[-1])


def measure_pairs(args: argparse.Namespace) -> list[dict[str, Any]]:
    """One sample for each pair and kind of step: microseconds per step of both sides."""
    pairs = args.pairs or (5 if args.quick else 15)
    args.pairs = pairs
    options = ("--episodes", args.episodes, "--core", args.core, "--seed", args.seed)
    samples = []
    with (
        common.Side(__file__, "sejax", *options) as sejax_side,
        common.Side(__file__, "torch", *options) as torch_side,
    ):
        weights = sejax_side.ready["weights"]
        for pair in track(range(-1, pairs), "Measuring", transient=True):
            for learning in KINDS:
                request = {"learning": learning, "seed": args.seed + pair + 1, "weights": weights}
                times = {side.name: side.ask(**request) for side in (sejax_side, torch_side)}
                if pair >= 0:  # the one before warms up
                    samples.append({"learning": learning, **times})
    return samples


def summarise(samples: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians and ranges of both sides' times and of the ratios within the pairs."""
    result: dict[str, Any] = {}
    for learning, kind in KINDS.items():
        chosen = [sample for sample in samples if sample["learning"] == learning]
        times = {
            side: [1e6 * sample[side]["cpu_s"] / sample[side]["steps"] for sample in chosen]
            for side in SIDES
        }
        ratios = [b / a for a, b in zip(times["sejax"], times["torch"], strict=True)]
        result[kind.replace(" ", "_")] = {
            "sejax_us": common.spread(times["sejax"]),
            "torch_us": common.spread(times["torch"]),
            "ratio": common.spread(ratios),
            "ratios": [round(ratio, 2) for ratio in ratios],
        }
    result["share_of_core"] = median(
        sample[side]["cpu_s"] / sample[side]["wall_s"] for sample in samples for side in SIDES
    )
    return result


def show(result: dict[str, Any]) -> None:
    """Prints the table."""
    rows = [
        [kind, *(common.show_spread(result[kind.replace(" ", "_")][column])
                 for column in ("sejax_us", "torch_us", "ratio"))]
        for kind in KINDS.values()
    ]  # fmt: skip
    common.print_table(
        "CPU microseconds per agent step on one core, median (min to max)",
        ["step", "sejax", "PyTorch", "PyTorch / sejax"],
        rows,
    )
    print(f"Share of the core that these processes got: {result['share_of_core']:.0%}")


def sejax_side(args: argparse.Namespace) -> None:
    """Measures the trainer alone, compiled for one device."""
    from sejax.cli.runtime import configure_xla

    configure_xla(1)
    import jax
    import numpy as np

    import sejax
    from sejax.ops.parallel import compiler_options

    trainings = {}
    for learning in KINDS:
        parts = sejax.config(overrides(args.episodes, learning)).parts()
        env = parts["proxy"]
        train = sejax.make_trainer(parts["agent"], env, parts["training"])
        trainings[learning] = jax.jit(train, compiler_options=compiler_options())
    weights = env.init_weights(jax.random.key(args.seed))

    def handle(request: dict[str, Any]) -> dict[str, Any]:
        train, key = trainings[request["learning"]], jax.random.key(request["seed"])
        params = env.params(weights)
        result, times = common.measure(lambda: jax.block_until_ready(train(key, params)))
        return {"steps": int(result.train_steps), **times}

    plain = jax.tree.map(lambda x: np.asarray(x).tolist(), weights)
    common.serve({"weights": plain}, handle)


def torch_side(args: argparse.Namespace) -> None:
    """Measures the PyTorch reference with one thread."""
    import torch
    import torch_reference as reference

    import sejax

    torch.set_num_threads(1)

    def handle(request: dict[str, Any]) -> dict[str, Any]:
        config = sejax.config(overrides(args.episodes, request["learning"]))
        env = reference.SyntheticEnv(request["weights"], config.proxy)
        result, times = common.measure(
            lambda: reference.train(env, config.agent, config.training, request["seed"])
        )
        return {"steps": result.train_steps, **times}

    common.serve({}, handle)


def overrides(episodes: int, learning: bool) -> list[str]:
    """The configuration in which every step learns, or none does."""
    warmup_episodes = 0 if learning else episodes
    return [
        *OVERRIDES,
        f"training.max_episodes={episodes}",
        f"agent.warmup_episodes={warmup_episodes}",
    ]


SIDES = {"sejax": sejax_side, "torch": torch_side}

if __name__ == "__main__":
    main()
