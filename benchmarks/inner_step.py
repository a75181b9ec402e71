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
from typing import Any

import common

OVERRIDES = ["preset=paper", "training.stop_rule=never"]
KINDS = {True: "with learning", False: "without learning"}


def main() -> None:
    """Runs the benchmark, or one of its sides."""
    args = common.parse_args(__doc__, add_options)
    if args.side:
        os.sched_setaffinity(0, {args.core})
        SIDES[args.side](args)
        return
    args.pairs = args.pairs or (5 if args.quick else 15)
    machine = common.machine()
    answers = measure_pairs(args)
    rows = {kind: common.compare_with_torch(mine) for kind, mine in answers.items()}
    share = common.share_of_core([*answers.values()])
    common.show_comparison("", "step", rows, share)
    settings = {"episodes": args.episodes, "pairs": args.pairs, "core": args.core}
    result = {kind.replace(" ", "_"): row for kind, row in rows.items()} | {"share_of_core": share}
    common.finish("inner_step", args, {"machine": machine, "settings": settings, **result})


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this benchmark."""
    parser.add_argument("--episodes", type=int, default=10, help="in a training, of 200 steps each")
    parser.add_argument("--pairs", type=int, help="repetitions (5 if --quick, else 15)")
    common.add_core(parser)


def measure_pairs(args: argparse.Namespace) -> dict[str, common.Answers]:
    """What both sides answer about each kind of step; the two kinds take turns."""
    options = {"episodes": args.episodes, "core": args.core, "seed": args.seed}
    answers: dict[str, common.Answers] = {}
    with common.sides_of(__file__, common.PAIR, **options) as sides:
        weights = sides["sejax"].ready["weights"]
        requests = [
            {"learning": learning, "seed": args.seed + pair, "weights": weights}
            for pair in range(args.pairs + 1)  # the first one warms up
            for learning in KINDS
        ]
        every = common.in_turns(sides, requests, warm_up=False)
    for place, kind in enumerate(KINDS.values()):
        answers[kind] = {
            name: mine[len(KINDS) + place :: len(KINDS)] for name, mine in every.items()
        }
    return answers


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
