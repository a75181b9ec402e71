"""What it costs that a program varies the hyperparameters, against the drawn agents one by one.

Trains DDQN agents with drawn learning rate, batch size, hidden size and depth in a CartPole SE, on
one core: once with the one program that can train all of them, and once each with a program that is
compiled for exactly the drawn sizes. Compilation is not counted in the times. Quoted is the ratio
of the summed CPU times; each draw's ratio is in the table.
"""

import argparse
import os
import time
from typing import Any

import common

OVERRIDES = ["training.stop_rule=never", "agent.warmup_episodes=0"]


def main() -> None:
    """Runs the benchmark, or its side."""
    args = common.parse_args(__doc__, add_options)
    if args.side:
        os.sched_setaffinity(0, {args.core})
        serve(args)
        return
    draws = args.draws or (3 if args.quick else 16)
    options = {name: getattr(args, name) for name in ("steps", "core", "seed")}
    options["agent_size"] = args.agent_size or (32 if args.quick else 128)
    options["agent_layers"] = 1 if args.quick else 2
    with common.sides_of(__file__, ["sejax"], **options) as sides:
        compile_s = sides["sejax"].ready["compile_s"]
        requests = [{"number": number} for number in range(draws)]
        samples = common.in_turns(sides, requests, warm_up=False)["sejax"]
    ratio = sum(s["varied_s"] for s in samples) / sum(s["alone_s"] for s in samples)
    show(samples, ratio, compile_s)
    common.finish("varied_hparams", args,
                  {"ratio": ratio, "compile_s": compile_s, "samples": samples})  # fmt: skip


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this benchmark."""
    parser.add_argument("--draws", type=int, help="agents (3 if --quick, else 16)")
    parser.add_argument("--steps", type=int, default=2000, help="of each training")
    parser.add_argument("--agent-size", type=int, help="hidden and batch size that ranges surround "
                        "(32 if --quick, else 128)")  # fmt: skip
    parser.add_argument("--agent-layers", type=int, default=2, help="that ranges surround")
    common.add_core(parser)


def serve(args: argparse.Namespace) -> None:
    """Compiles the program that varies, then measures each draw both ways."""
    from sejax.cli.runtime import configure_xla

    configure_xla(1)
    import dataclasses

    import jax

    import sejax

    size = args.agent_size
    config = sejax.config([
        *OVERRIDES, "agent_hparams=varied", f"agent.hidden_size={size}", f"agent.batch_size={size}",
        f"agent.num_layers={args.agent_layers}", f"training.max_steps={args.steps}",
        f"training.max_episodes={args.steps}",
    ])  # fmt: skip
    parts = config.parts()
    task, env, varied = parts["task"], parts["proxy"], parts["agent"]
    params = env.params(env.init_weights(jax.random.key(args.seed)))

    def make_run(agent: sejax.Agent) -> Any:
        train = sejax.make_trainer(agent, env, config.training)
        return lambda key, hparams: train(key, params, hparams).train_steps

    def train_varied(key: Any, drawn: Any) -> Any:
        runs = [make_run(agent) for agent in varied.varied.agents]
        return jax.lax.switch(drawn.variant, runs, key, drawn.hparams)

    key = jax.random.key(args.seed)
    started = time.time()
    program = jax.jit(train_varied).lower(key, varied.varied.draw(key)).compile()
    compile_s = time.time() - started

    def handle(request: dict[str, Any]) -> dict[str, Any]:
        key = jax.random.fold_in(jax.random.key(args.seed), request["number"])
        drawn = varied.varied.draw(key)
        plain = {name: float(x) for name, x in drawn.values.items()}
        sizes = {name: round(x) for name, x in plain.items() if name != "learning_rate"}
        changes: dict[str, Any] = {**sizes, "learning_rate": plain["learning_rate"]}
        agent = sejax.make_agent(dataclasses.replace(config.agent, **changes), task)
        alone = jax.jit(agent.fresh(make_run)).lower(key).compile()
        jax.block_until_ready((program(key, drawn), alone(key)))

        def cpu_s(run: Any, *inputs: Any) -> float:
            return common.measure(lambda: jax.block_until_ready(run(*inputs)))[1]["cpu_s"]

        return {**plain, "varied_s": cpu_s(program, key, drawn), "alone_s": cpu_s(alone, key)}

    common.serve({"compile_s": compile_s}, handle)


def show(samples: list[dict[str, Any]], ratio: float, compile_s: float) -> None:
    """Prints the table."""
    rows = [
        [f"{s['batch_size']:.0f}", f"{s['hidden_size']:.0f}", f"{s['num_layers']:.0f}",
         f"{s['varied_s']:.2f}", f"{s['alone_s']:.2f}", f"{s['varied_s'] / s['alone_s']:.2f}"]
        for s in samples
    ]  # fmt: skip
    columns = ["batch", "hidden", "layers", "varying program, CPU s", "alone, CPU s", "ratio"]
    common.print_table("Trainings with drawn hyperparameters, one core", columns, rows)
    print(f"Summed: {ratio:.2f}. The program that varies compiled in {compile_s:.0f} s.")


if __name__ == "__main__":
    main()
