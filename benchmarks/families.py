"""What a generation of several families of agents costs, against the parts that it is made of.

Learns CartPole SEs on one core: a program whose members take turns among the families, and one for
each family alone, with as many agents in all. They take turns; compilation and a first generation
are not counted. The parts of a generation of three families are a third of each one's own: quoted
is the ratio of its CPU time to their sum, the median over rounds.
"""

import argparse
import os
from statistics import median
from typing import Any

import common


def main() -> None:
    """Runs the benchmark, or its side."""
    args = common.parse_args(__doc__, add_options)
    if args.side:
        os.sched_setaffinity(0, {args.core})
        serve(args)
        return
    args.rounds = args.rounds or (3 if args.quick else 7)
    args.members = args.members or (3 if args.quick else 63)
    options = ("--families", args.families, "--members", args.members, "--steps", args.steps,
               "--core", args.core, "--seed", args.seed)  # fmt: skip
    with common.Side(__file__, "sejax", *options) as side:
        rounds = [side.ask(round=i) for i in range(args.rounds)]
    names = args.families.split(",")
    ratios = [row["together"] * len(names) / sum(row[name] for name in names) for row in rounds]
    together = median(row["together"] for row in rounds)
    shown = common.show_spread(common.spread(ratios), 2)
    print(f"A generation of {args.families} takes {together:.2f} CPU s, {shown} of its parts.")
    common.finish("families", args, {"ratio": median(ratios), "ratios": ratios, "rounds": rounds})


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this benchmark."""
    parser.add_argument("--families", default="ddqn,ppo,td3_discrete", help="agents")
    parser.add_argument("--rounds", type=int, help="generations (3 if --quick, else 7)")
    parser.add_argument("--members", type=int, help="perturbations, which each have two signs (3 "
                        "if --quick, else 63)")  # fmt: skip
    parser.add_argument("--steps", type=int, default=2000, help="of each training")
    parser.add_argument("--core", type=int, default=common.available_cores()[-1])


def serve(args: argparse.Namespace) -> None:
    """Compiles all programs, then measures a generation of each."""
    from sejax.cli.runtime import configure_xla

    configure_xla(1)
    import jax

    import sejax
    from sejax.cli import session

    names = args.families.split(",")
    words = ["env=cartpole", f"training.max_steps={args.steps}",
             f"training.max_episodes={args.steps}", f"seed={args.seed}",
             f"es.population_size={args.members}"]  # fmt: skip
    # As many agents on the incumbent in each program as divide evenly.
    words.append(f"es.num_incumbent_evals={2 * len(names)}")
    chosen = {"together": f"agents=[{args.families}]", **{x: f"agent={x}" for x in names}}
    programs: dict[str, Any] = {}
    for name, word in chosen.items():
        chunks = session.make_chunks(sejax.config([*words, word]))
        state = jax.jit(chunks.learner.init)(jax.random.split(jax.random.key(args.seed), 1))
        programs[name] = [chunks, jax.block_until_ready(chunks.advance(state, 1)[0])]

    def measure(request: dict[str, Any]) -> dict[str, Any]:
        seconds = {}
        for name, program in programs.items():
            chunks, state = program

            def generation(chunks: Any = chunks, state: Any = state) -> Any:
                return jax.block_until_ready(chunks.advance(state, 1))[0]

            program[1], times = common.measure(generation)
            seconds[name] = times["cpu_s"]
        return seconds

    common.serve({}, measure)


if __name__ == "__main__":
    main()
