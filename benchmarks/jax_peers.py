"""Time of an agent's step in JAX, CPU time of one core or wall-clock of a GPU: sejax, rejax.

Networks, batches, buffers and numbers of updates are equal: two hidden layers, batches of 64, an
update a step; PPO has one environment, rollouts of 128 steps, 4 minibatches and 10 epochs. Agents
of both train as users of JAX train them: one after the other in `jax.lax.map`, or all at once in
`jax.vmap`. Both are compiled with `sejax.compiler_options()`, kept to one core, and take turns;
compilation is not in the time of a step and stands beside it.

    pip install '.[examples]'
    python benchmarks/jax_peers.py
    python benchmarks/jax_peers.py --worlds task --agents 1024 --modes vmap  # on a GPU
"""

import argparse
import itertools
import os
from pathlib import Path
from typing import Any

import common

ALGORITHMS = {  # the tasks on which each is measured
    "ddqn": ("cartpole",),
    "sac": ("cartpole", "pendulum"),
    "td3": ("pendulum",),
    "ppo": ("cartpole", "pendulum"),
}
WIDTHS = {64: 1024, 256: 256}  # units of a layer -> steps of a training
PPO_STEPS = 128 * 16
SIDES = ("sejax", "rejax")
MODES = ("map", "vmap")
HEAD = ["agent, units, task", "world", "agents", *SIDES, "rejax / sejax", "vmap / map of sejax"]
SES = {"cartpole": "cartpole-episodic", "pendulum": "pendulum"}
GYMNAX_NAMES = {"cartpole": "CartPole-v1", "pendulum": "Pendulum-v1"}


def main() -> None:
    """Runs the benchmark, or one of its sides."""
    args = common.parse_args(__doc__, add_options)
    if args.side:
        os.sched_setaffinity(0, {args.core})
        serve(args.side, args)
        return
    cases = [
        f"{algorithm} {width} {task}"
        for algorithm, tasks in ALGORITHMS.items() for width in WIDTHS for task in tasks
    ]  # fmt: skip
    cases = args.cases or cases[: 1 if args.quick else None]
    machine = common.machine(("jax", "rejax", "sejax"))
    rows = []
    with common.sides_of(__file__, SIDES, core=args.core, seed=args.seed) as sides:
        machine |= sides["sejax"].ready
        choices = itertools.product(cases, args.worlds, args.agents, args.modes)
        for case, world, agents, mode in choices:
            request = {"case": case, "world": world, "agents": agents, "mode": mode}
            answers = common.in_turns(sides, [request] * args.repeats)
            row = request | {
                f"{side}_us": common.spread([x["us"] for x in values])
                for side, values in answers.items()
            }
            seconds = {f"{side}_compile_s": x[0]["compile_s"] for side, x in answers.items()}
            rows.append(row | seconds)
    table = best_of_modes(rows)
    rows_of_table = [
        [x["case"], x["world"], x["agents"], *(f"{x[side]:.1f}" for side in SIDES),
         f"{x['ratio']:.2f}", f"{x['vmap_over_map']:.2f}"] for x in table
    ]  # fmt: skip
    title = f"Microseconds a step on {machine['device']}, the better of map and vmap"
    common.print_table(title, HEAD, rows_of_table)
    if args.out:
        lines = [HEAD, ["---"] * len(HEAD), *rows_of_table]
        text = "".join(f"| {' | '.join(map(str, line))} |\n" for line in lines)
        (args.out / "speed.txt").write_text(text)
        draw(table, args.out / "figure.png", f"one core of an {machine['cpu']}")
    common.finish("jax_peers", args, {"machine": machine, "rows": rows, "table": table})


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this benchmark."""
    parser.add_argument("--cases", nargs="+", metavar="CASE", help="such as 'ddqn 64 cartpole'")
    parser.add_argument("--worlds", nargs="+", choices=("task", "se"), default=["task", "se"])
    parser.add_argument("--agents", nargs="+", type=int, default=[1, 16], help="in a program")
    parser.add_argument("--modes", nargs="+", choices=MODES, default=MODES)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="write table and figure there")
    common.add_core(parser)


def best_of_modes(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """For each case, world and number of agents each side's better time and their ratio."""
    names = ("case", "world", "agents")
    table = []
    for case, modes in itertools.groupby(rows, lambda row: {x: row[x] for x in names}):
        by_mode = {row["mode"]: row for row in modes}
        times = {x: {m: row[f"{x}_us"]["median"] for m, row in by_mode.items()} for x in SIDES}
        best = {side: min(times[side].values()) for side in SIDES}
        vmapped, mapped = (times["sejax"].get(mode, float("nan")) for mode in ("vmap", "map"))
        ratios = {"ratio": best["rejax"] / best["sejax"], "vmap_over_map": vmapped / mapped}
        table.append(case | best | ratios)
    return table


def draw(table: list[dict[str, Any]], path: Path, cpu: str) -> None:
    """Bars of both sides, a group for each case on the task with most agents."""
    import matplotlib.pyplot as plt
    import numpy as np

    most = max(row["agents"] for row in table)
    shown = [row for row in table if row["agents"] == most and row["world"] == table[0]["world"]]
    figure, axes = plt.subplots(figsize=(7, 0.4 * len(shown) + 1.2), layout="constrained")
    for offset, side in ((-0.2, "sejax"), (0.2, "rejax")):
        axes.barh(np.arange(len(shown)) + offset, [row[side] for row in shown], 0.4, label=side)
    axes.set_yticks(range(len(shown)), [row["case"] for row in shown])
    axes.invert_yaxis()
    axes.set(xscale="log", xlabel=f"CPU microseconds a step, {cpu}")
    axes.legend()
    figure.savefig(path)


def serve(side: str, args: argparse.Namespace) -> None:
    """A side: compiles what it is asked for the first time, and trains."""
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"  # the sides share a GPU's memory
    import jax

    import sejax

    device = jax.devices()[0]
    clock = "cpu_s" if device.platform == "cpu" else "wall_s"
    programs: dict[tuple[str, ...], tuple[Any, int, float]] = {}

    def keys(agents: int) -> Any:
        return jax.random.split(jax.random.key(args.seed), agents)

    def compiled(case: str, world: str, agents: int, mode: str) -> tuple[Any, int, float]:
        algorithm, width, task = case.split()
        steps = PPO_STEPS if algorithm == "ppo" else WIDTHS[int(width)]
        train = TRAINERS[side](algorithm, int(width), task, world, steps)
        fn = jax.vmap(train) if mode == "vmap" else lambda keys: jax.lax.map(train, keys)
        lowered = jax.jit(fn, compiler_options=sejax.compiler_options()).lower(keys(agents))
        program, times = common.measure(lowered.compile)
        return program, steps, times["wall_s"]

    def handle(request: dict[str, Any]) -> dict[str, Any]:
        name = tuple(map(str, request.values()))
        if name not in programs:
            programs.clear()
            programs[name] = compiled(**request)
        program, steps, compile_s = programs[name]
        inputs = keys(request["agents"])
        _, times = common.measure(lambda: jax.block_until_ready(program(inputs)))
        return {"us": 1e6 * times[clock] / (steps * request["agents"]), "compile_s": compile_s}

    common.serve({"device": device.device_kind}, handle)


def world_of(task_name: str, world: str) -> tuple[Any, Any, Any]:
    """The task, and the environment with its parameters: the task's own, or the shipped SE's."""
    import sejax

    if world == "task":
        task = sejax.envs.make(task_name)
        return task, task.env, task.params
    env, params = sejax.load(SES[task_name])
    return env.task, env, params


def sejax_trainer(algorithm: str, width: int, task_name: str, world: str, steps: int) -> Any:
    """`key -> trained agent`."""
    import sejax

    task, env, params = world_of(task_name, world)
    network: dict[str, Any] = {"hidden_size": width, "num_layers": 2}
    if algorithm == "ppo":
        rollouts: dict[str, Any] = {"rollout_steps": 128, "num_minibatches": 4, "epochs": 10}
        config: Any = sejax.PPOConfig(**network, **rollouts, activation="tanh")
    else:
        network |= {"batch_size": 64, "buffer_size": steps, "warmup_episodes": 0}
        config = getattr(sejax, f"{algorithm.upper()}Config")(**network, activation="relu")
    agent = sejax.make_agent(config, task)
    training = sejax.TrainingConfig(max_steps=steps, max_episodes=steps, stop_rule="never")
    train = sejax.make_trainer(agent, env, training)
    return lambda key: train(key, params).agent_state


def rejax_trainer(algorithm: str, width: int, task_name: str, world: str, steps: int) -> Any:
    """`key -> parameters of the networks`."""
    import jax.numpy as jnp
    import rejax
    from flax import linen as nn
    from rejax import networks

    from sejax.envs import with_one_done

    if world == "task":
        import gymnax

        env, params = gymnax.make(GYMNAX_NAMES[task_name])
    else:
        _, env, params = world_of(task_name, world)
    common_settings = {
        "env": with_one_done(env), "env_params": params, "total_timesteps": steps,
        "eval_freq": steps, "skip_initial_evaluation": True, "learning_rate": 1e-3, "num_envs": 1,
    }  # fmt: skip
    replay = {"buffer_size": steps, "fill_buffer": 1, "batch_size": 64, "num_epochs": 1}
    layers, layout = (width, width), {"hidden_layer_sizes": (width, width), "activation": nn.relu}
    if algorithm == "ppo":
        agent: Any = rejax.PPO.create(
            **common_settings, num_steps=128, num_minibatches=4, num_epochs=10,
            agent_kwargs={"activation": "tanh", "hidden_layer_sizes": layers},
        )  # fmt: skip
    elif algorithm == "sac":
        agent = rejax.SAC.create(**common_settings, **replay, hidden_layer_sizes=layers)
    elif algorithm == "ddqn":
        q_network = networks.EpsilonGreedyPolicy(networks.DiscreteQNetwork)
        agent = rejax.DQN.create(**common_settings, **replay)
        agent = agent.replace(agent=q_network(action_dim=2, **layout))
    else:
        agent = rejax.TD3.create(**common_settings, **replay)
        bounds = agent.env.action_space(params)
        actor = networks.DeterministicPolicy(1, (bounds.low, bounds.high), **layout)
        agent = agent.replace(actor=actor, critic=networks.QNetwork(**layout))
    agent = agent.replace(eval_callback=lambda *_: jnp.zeros(()))

    def train(key: Any) -> Any:
        state, _ = agent.train(key)
        return {name: x for name, x in vars(state).items() if name.endswith("_ts")}

    return train


TRAINERS = {"sejax": sejax_trainer, "rejax": rejax_trainer}

if __name__ == "__main__":
    main()
