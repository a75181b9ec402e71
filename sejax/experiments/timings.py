"""Seconds for an outer iteration of NES on every task, beside the paper's.

Source: paper, appendix "Computational Complexity for Training Synthetic Environments and Reward
Networks" (table "Approximate timings for one NES outer loop").

The first outer iterations of a run are timed, once compiled: SEs with the paper's settings and with
our default, RNs with our default, which has the paper's agents and sizes. Most of
their agents are far from solving the task and train for as long as they may: later ones are
faster. HalfCheetah is projected from its parts, an environment step and a learning step, as no
iteration of it ends within an hour here.
"""

import argparse
import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sejax.experiments import common
from sejax.runtime import available_cores
from sejax.validation import each_of

NAME = "timings"
PAPER_CORES = 16


class Row(NamedTuple):
    """A cell of the paper's table: `seconds` for one outer iteration."""

    env: str
    proxy: str
    seconds: float


ROWS = {
    "cliff_walking-rn": Row("cliff_walking", "rn", 10),
    "acrobot-se": Row("acrobot", "se", 100),
    "cartpole-se": Row("cartpole", "se", 100),
    "cartpole-rn": Row("cartpole", "rn", 100),
    "mountain_car_continuous-rn": Row("mountain_car_continuous", "rn", 500),
    "halfcheetah-rn": Row("halfcheetah", "rn", 2000),
}
# Agents, episodes and batches that take seconds.
QUICK = ["es.population_size=2", "es.num_incumbent_evals=2", "training.max_episodes=4",
         "agent.init_episodes=1"]  # fmt: skip
SETTINGS = {"paper": "the paper's", "best": "our default"}


def main() -> None:
    """Runs the experiment as the command line says."""
    common.run_command(NAME, __doc__, add_options, run)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this experiment."""
    parser.add_argument("--rows", nargs="+", default=list(ROWS), metavar="ROW",
                        help=", ".join(ROWS))  # fmt: skip
    parser.add_argument("--generations", type=int, default=2, help="outer iterations to time; 2")


def run(args: argparse.Namespace) -> pd.DataFrame:
    """Times what is missing, writes everything and returns the table.

    Raises:
      ConfigError: for an unknown row, or an output folder of other settings.
    """
    each_of("--rows", args.rows, ROWS)
    common.require_counts(args, "generations")
    pieces = common.Pieces(args.out / "pieces")
    cores = args.devices or available_cores()
    tables = []
    for name in args.rows:
        row = ROWS[name]
        presets = ("paper", "best") if row.proxy == "se" else ("best",)
        for preset in presets:
            settings = {"row": name, "preset": preset, "quick": args.quick, "cores": cores,
                        "generations": args.generations, "seed": args.seed}  # fmt: skip
            measure = project_halfcheetah if row.env == "halfcheetah" else time_generations
            table = pieces.compute(
                f"{name}-{preset}-{cores}", settings,
                functools.partial(measure, args, row, preset),
            )  # fmt: skip
            tables.append(table.assign(row=name, preset=preset, cores=cores))
            print(f"{name}, {preset}: {table['seconds'].iloc[0]:,.1f} s", flush=True)
    return report(args, pd.concat(tables, ignore_index=True))


def config_of(args: argparse.Namespace, row: Row, preset: str) -> Any:
    """The configuration that is timed."""
    import sejax

    overrides = [f"env={row.env}", f"proxy={row.proxy}", f"preset={preset}"]
    if row.proxy == "rn":  # the paper does not say which variant; this one needs two potentials
        overrides.append("proxy.variant=additive_potential")
    if args.quick:
        overrides += [word for word in QUICK
                      if row.env != "cliff_walking" or "init_episodes" not in word]  # fmt: skip
    return dataclasses.replace(sejax.config(overrides), devices=args.devices, seed=args.seed)


def time_generations(args: argparse.Namespace, row: Row, preset: str) -> pd.DataFrame:
    """Mean wall-clock of the first outer iterations, compiled before."""
    import jax

    from sejax.bilevel import make_program
    from sejax.experiments.proxy_runs import make_step

    program = make_program(config_of(args, row, preset))
    step = make_step(program)
    state = jax.jit(program.init)(jax.random.key(args.seed)[None])
    warm_up, _ = step(jax.tree.map(lambda x: x.copy(), state.replace(finished=~state.finished)))
    jax.block_until_ready(warm_up)  # compiled, and run with nothing to do
    wall, cpu, steps = [], [], []
    for _ in range(args.generations):
        started, cpu_started = time.perf_counter(), time.process_time()
        state, info = jax.block_until_ready(step(state))
        wall.append(time.perf_counter() - started)
        cpu.append(time.process_time() - cpu_started)
        steps.append(int(info.train_steps_total[0]))
    return pd.DataFrame([{
        "seconds": np.mean(wall), "cpu_seconds": np.mean(cpu), "agents": program.num_candidates,
        "train_steps": np.mean(steps), "how": "measured",
    }])  # fmt: skip


def project_halfcheetah(args: argparse.Namespace, row: Row, preset: str) -> pd.DataFrame:
    """What an iteration would take if no agent solved the task, from the cost of its parts.

    Each agent makes `max_episodes` training and as many test episodes, and learns once for each
    training step after its initial episodes.
    """
    import jax

    from sejax.agents.registry import make_agent
    from sejax.agents.replay import Transition
    from sejax.bilevel import make_program
    from sejax.proxies.reward import make_reward

    config = config_of(args, row, preset)
    task = config.env.make()
    env = make_reward(task, config.proxy)
    agent = make_agent(config.agent, task, config.exploration)
    params = env.params(env.init_weights(jax.random.key(0)), config.agent.discount)
    num_steps = 200 if args.quick else 2000

    def environment_steps(key: Any) -> Any:
        def step(state: Any, key: Any) -> Any:
            action = jax.random.uniform(key, (task.action_dim,), minval=-1.0)
            _, state, reward, _, _ = env.step_env(key, state, action, params)
            return state, reward

        _, state = env.reset_env(key, params)
        return jax.lax.scan(step, state, jax.random.split(key, num_steps))[1].sum()

    def learning_steps(key: Any) -> Any:
        state = agent.init(key, agent.hparams)
        size = config.agent.batch_size
        batch = Transition(
            jax.random.normal(key, (task.obs_dim, size)),
            jax.random.uniform(key, (task.action_dim, size), minval=-1.0),
            jax.random.normal(key, (size,)), jax.numpy.ones(size),
            jax.random.normal(key, (task.obs_dim, size)),
        )  # fmt: skip

        def step(state: Any, key: Any) -> Any:
            return agent.update(key, state, batch), None

        state, _ = jax.lax.scan(step, state, jax.random.split(key, num_steps))
        return jax.tree.leaves(state)[0].sum()

    counts = (1, args.devices or available_cores())
    env_us, learn_us = (
        [microseconds_of_a_step(fn, count, num_steps) for count in counts]
        for fn in (environment_steps, learning_steps)
    )
    agents = make_program(config).num_candidates
    episodes = config.training.max_episodes
    train_steps = agents * episodes * task.max_steps
    learning = agents * (episodes - config.agent.init_episodes) * task.max_steps
    seconds = (2 * train_steps * env_us[1] + learning * learn_us[1]) / 1e6 / counts[1]
    return pd.DataFrame([{
        "seconds": seconds, "cpu_seconds": seconds * counts[1], "agents": agents,
        "train_steps": train_steps, "how": "projected", "env_us_one_core": env_us[0],
        "env_us": env_us[1], "learn_us_one_core": learn_us[0], "learn_us": learn_us[1],
    }])  # fmt: skip


def microseconds_of_a_step(fn: Callable[[Any], Any], num_devices: int, num_steps: int) -> float:
    """Wall-clock of one step of `fn(key)`, which makes `num_steps`, on each of several devices."""
    import jax

    from sejax.parallel import spread_over_devices

    program = jax.jit(spread_over_devices(fn, num_devices))
    keys = jax.random.split(jax.random.key(0), num_devices)
    jax.block_until_ready(program(keys))
    started = time.perf_counter()
    jax.block_until_ready(program(keys))
    return (time.perf_counter() - started) / num_steps * 1e6


def report(args: argparse.Namespace, timed: pd.DataFrame) -> pd.DataFrame:
    """Writes the CSV, the picture and the table, prints the table and returns it."""
    from sejax.experiments import figures
    from sejax.files import write_text

    write_text(args.out / "summary.csv", timed.to_csv(index=False, float_format="%.6g"))
    cores = int(timed["cores"].iloc[0])
    table = pd.DataFrame([
        {
            "task": ROWS[row.row].env,
            "proxy": ROWS[row.row].proxy.upper(),
            "settings": SETTINGS[row.preset],
            f"paper, {PAPER_CORES} cores": f"{ROWS[row.row].seconds:g} s",
            f"sejax, {cores} cores": f"{show(row.seconds)} s ({row.how})",
            "agents": row.agents,
            "training steps": f"{row.train_steps:,.0f}",
            "CPU µs for a training step": f"{row.cpu_seconds / row.train_steps * 1e6:,.1f}",
        }
        for row in timed.itertuples()
    ])  # fmt: skip
    draw(timed, args)
    title = "Seconds for one outer iteration of NES"
    note = (
        f"The first {args.generations} iterations of a run, compiled before. All tests on the "
        "real task are in them. For RNs our default has the paper's agents and sizes. "
    )
    if args.quick:
        note += "--quick: a few agents with short trainings, not to be compared with the paper's. "
    parts = timed[timed["how"] == "projected"]
    for row in parts.itertuples():
        note += (
            f"HalfCheetah: an environment step takes {row.env_us_one_core:,.0f} µs on one core and "
            f"{row.env_us:,.0f} on each of {cores}, a learning step {row.learn_us_one_core:,.0f} "
            f"and {row.learn_us:,.0f}; projected for agents of which none solves the task."
        )
    command = figures.command(NAME, args, "rows", "generations", "devices")
    common.write_markdown(args.out / "table.md", title, command, table, note.strip())
    figures.print_table(title, table)
    print(f"{args.out}: summary.csv, timings.png and table.md.")
    return table


def show(seconds: float) -> str:
    """Two digits of a short time, whole seconds of a long one."""
    return f"{seconds:,.0f}" if seconds >= 10 else f"{seconds:.2g}"


def draw(timed: pd.DataFrame, args: argparse.Namespace) -> None:
    """Draws the seconds of each row beside the paper's."""
    import matplotlib.pyplot as plt

    from sejax.experiments import figures

    names = [f"{ROWS[row.row].env}\n{ROWS[row.row].proxy.upper()}, {SETTINGS[row.preset]} settings"
             for row in timed.itertuples()]  # fmt: skip
    places = np.arange(len(names))
    cores = int(timed["cores"].iloc[0])
    with plt.rc_context(figures.STYLE):
        figure, axis = plt.subplots(figsize=(7, 0.9 + 0.55 * len(names)), layout="constrained")
        paper = [ROWS[row.row].seconds for row in timed.itertuples()]
        if not args.quick:  # whose trainings are much shorter
            axis.barh(places - 0.19, paper, 0.36, color=figures.VARIED,
                      label=f"paper, {PAPER_CORES} cores")  # fmt: skip
        projected = timed["how"].to_numpy() == "projected"
        bars = axis.barh(places + 0.19, timed["seconds"], 0.36, color=figures.REAL,
                         label=f"sejax, {cores} cores (hatched: projected)")  # fmt: skip
        for bar, is_projected in zip(bars, projected, strict=True):
            bar.set_hatch("///" if is_projected else "")
        axis.set(xscale="log", xlabel="seconds for an outer iteration")
        axis.set_yticks(places, names, fontsize=8)
        axis.invert_yaxis()
        figure.legend(loc="outside upper center", ncols=2, fontsize=9)
        figures.write(figure, args.out / "timings.png")


if __name__ == "__main__":
    main()
