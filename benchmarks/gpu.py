"""How fast sejax is on a GPU, beside the CPU of the same machine.

Checks first: how far apart a tiny run is on both, whether the compiled program of a
generation stays on the device and copies no large array, and how many kernels a step launches at
least. Then figures: agent steps a second with more and more agents in one batch, generations of
CartPole of 144 and of 4,096 candidates, ten thousand agents on the shipped SE, HalfCheetah on brax.
No figure begins after `--minutes`, or if the one before tells that it would not end in time; the
table says which are left out.

    pip install 'sejax[brax]' && python benchmarks/gpu.py --json gpu.json

Without a GPU it measures the first device that there is. Seconds are wall-clock of the second call,
compilation apart. Kernels are counted without a GPU, in the program that is lowered for CUDA: of
the operations in the body of the training loop, those that XLA cannot fuse into their neighbours.
"""

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import common
import jax
import jax.numpy as jnp
import numpy as np

import sejax
from sejax.bilevel import make_bilevel
from sejax.runs import config as configuration
from sejax.runs.runtime import configure_jax
from sejax.training import TrainingConfig, make_trainer

WIDTHS = (16, 64, 256, 1024, 4096, 16_384)  # agents in one batch
STEPS = 512  # of an agent in the figures of throughput
# Operations that start a kernel, or a call of a library, of their own.
ALONE = (
    *("dot_general", "convolution", "reduce", "reduce_window", "gather", "scatter", "sort"),
    *("dynamic_update_slice", "custom_call", "rng_bit_generator", "cholesky", "triangular_solve"),
)


class World(NamedTuple):
    """What agents of a kind train on: the words of its run, and a shipped SE; else a fresh one."""

    words: tuple[str, ...]
    proxy: str | None = None


AGENTS = {
    "quick DDQN": World(("env=cartpole", "agent=ddqn"), "cartpole"),
    "the paper's DDQN": World(("env=cartpole", "agent=ddqn", "preset=paper")),
    "PPO": World(("env=cartpole", "agent=ppo"), "cartpole"),
    "TD3": World(("env=mountain_car_continuous", "agent=td3"), "mountain_car_continuous"),
}


def main() -> None:
    args = common.parse_args(__doc__, add_options)
    configure_jax()
    sejax.configure_xla()  # each core is a device
    try:
        cpu = jax.devices("cpu")[0]
    except RuntimeError as error:
        raise SystemExit("error: JAX_PLATFORMS must have the CPU too. Unset it.") from error
    device = jax.devices(args.platform)[0] if args.platform else jax.devices()[0]
    has_card = device.platform != "cpu"
    clock = Clock(args.minutes * 60 * (2 / 3 if has_card else 1))
    result: dict[str, Any] = {
        "machine": common.machine(("jax", "sejax")), "card": device.device_kind,
        "platform": device.platform, "checks": checks(device, cpu),
        "kernels": {name: kernels(name, args) for name in agents_of(args)},
    }  # fmt: skip
    show_checks(result)
    rows = []
    for what, make, size in figures(args, device):
        found = clock.measure(what, make, size)
        rows.append({"what": what, "agents": size, "on": device.platform, **found})
    result["figures"] = rows + (of_cpu(args) if has_card else [])
    show_figures(result)
    common.finish("gpu", args, result)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--minutes", type=float, default=7.5, help="for the figures, at most")
    parser.add_argument("--platform", help="of the device: cuda, rocm, tpu, cpu; the first if none")


def of_cpu(args: argparse.Namespace) -> list[dict[str, Any]]:
    """The figures of this machine's CPU, as sejax computes where there is no other device."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cpu.json"
        command = [sys.executable, __file__, f"--json={path}", f"--minutes={args.minutes / 3}"]
        environ = os.environ | {"JAX_PLATFORMS": "cpu"}
        subprocess.run(command, env=environ, stdout=subprocess.DEVNULL, check=True)
        rows: list[dict[str, Any]] = json.loads(path.read_text())["figures"]
        return rows


def agents_of(args: argparse.Namespace) -> tuple[str, ...]:
    return tuple(AGENTS)[:1] if args.quick else tuple(AGENTS)


# --- checks --------------------------------------------------------------------------------------


def checks(device: Any, cpu: Any) -> dict[str, Any]:
    """The same tiny run on the device and on the CPU, and what its program holds there."""
    words = ["env=cartpole", "es.population_size=4", "generations=2", "devices=1",
             "training.max_steps=64", "training.max_episodes=64"]  # fmt: skip
    config = configuration.config(words)
    learned = {}
    for where in (device, cpu):
        with jax.default_device(where):
            learn = jax.jit(sejax.make_learner(config))
            compiled = learn.lower(jax.random.key(0)).compile()
            learned[where] = compiled(jax.random.key(0))
            if where is device:
                text = compiled.as_text()
    one, two = (jax.tree.leaves(jax.device_get(learned[x].weights)) for x in (device, cpu))
    apart = max(float(np.abs(x - y).max()) for x, y in zip(one, two, strict=True))
    return {"largest_difference_of_weights": apart} | facts_of(text or "")


def facts_of(text: str) -> dict[str, Any]:
    """What a compiled program says of itself: visits of the host, and copies of large arrays."""
    visits = ("infeed", "outfeed", "send(", "recv(", "xla_python", "callback")
    copies = [line for line in text.splitlines() if " copy(" in line and is_large(line)]
    return {
        "visits_of_the_host": sum(text.count(word) for word in visits),
        "copies_of_large_arrays": len(copies),
    }


def is_large(line: str) -> bool:
    """Whether an instruction's result has at least 100,000 numbers."""
    shape = line.partition("[")[2].partition("]")[0].split(",")
    return bool(np.prod([int(x) for x in shape if x.strip().isdigit()]) >= 100_000)


def kernels(name: str, args: argparse.Namespace) -> dict[str, Any]:
    """Kernels of a training step of 64 agents side by side, at least, by operation.

    They are those of the largest loop of the program; a loop within it counts once.
    """
    with mock.patch("sejax.ops.parallel.on_cpu", lambda: False):  # the program of a GPU
        train, keys, params = training_of(name, 64, 8 if args.quick else STEPS)
        traced = jax.jit(jax.vmap(train, (0, None))).trace(keys, params)
    module = traced.lower(lowering_platforms=("cuda",)).compiler_ir()
    functions = {x.attributes["sym_name"].value: x for x in module.body.operations}
    loops = [count(loop, functions) for loop in loops_of(functions["main"], functions)]
    largest = max(loops, key=lambda each: each.total(), default=Counter())
    return {"a_step": largest.total(), "of": dict(largest.most_common())}


def loops_of(op: Any, functions: dict[str, Any]) -> Iterator[Any]:
    """The outermost loops below an operation."""
    for inner in inside(op):
        if name_of(inner) == "while":
            yield inner
        elif name_of(inner) == "call":
            yield from loops_of(functions[inner.attributes["callee"].value], functions)
        else:
            yield from loops_of(inner, functions)


def count(op: Any, functions: dict[str, Any]) -> Counter[str]:
    """The operations of `ALONE` below an operation."""
    found: Counter[str] = Counter()
    for inner in inside(op):
        name = name_of(inner)
        if name in ALONE:
            found[name] += 1
        elif name == "call":
            found += count(functions[inner.attributes["callee"].value], functions)
        else:
            found += count(inner, functions)
    return found


def inside(op: Any) -> Iterator[Any]:
    return (inner for region in op.regions for block in region for inner in block.operations)


def name_of(op: Any) -> str:
    return str(op.operation.name).partition(".")[2]


# --- figures -------------------------------------------------------------------------------------


class Program(NamedTuple):
    """What is measured.

    Attributes:
      run: computes once, and returns the steps that it took.
      facts: of the program, such as the bytes that it holds.
    """

    run: Callable[[], int]
    facts: dict[str, float]


Make = Callable[[], Program]


def figures(args: argparse.Namespace, device: Any) -> Iterator[tuple[str, Make, int]]:
    """What is measured: its name, what makes its program, and the number of agents."""
    widths = WIDTHS[:1] if args.quick else WIDTHS
    steps = 64 if args.quick else STEPS
    on_device = partial(compiled, device)
    for name in agents_of(args):
        for width in widths:
            yield f"{name} trains", on_device(partial(throughput, name, width, steps)), width
    if args.quick:
        return
    for size in (144, 4096):
        yield "a generation of CartPole", on_device(partial(generation, size)), size
    on_se = partial(throughput, "PPO", 10_000, steps)
    yield "agents on the shipped SE of CartPole", on_device(on_se), 10_000
    for width in (16, 256):
        yield "steps of HalfCheetah on brax", on_device(partial(cheetah, width)), width


def compiled(device: Any, parts: Callable[[], tuple[Callable[..., Any], tuple[Any, ...]]]) -> Make:
    """A program of JAX for a device; `parts` gives the function and its arguments."""

    def make() -> Program:
        with jax.default_device(device):
            fn, arguments = parts()
            program = jax.jit(fn).lower(*arguments).compile()
        used = program.memory_analysis()
        sizes = (getattr(used, f"{x}_size_in_bytes", 0) for x in ("argument", "output", "temp"))
        return Program(lambda: int(program(*arguments)), {"bytes": sum(sizes)})

    return make


def fresh_se(run: Any) -> tuple[Any, Any]:
    """The SE of a run before it has learned, and its params."""
    env = run.parts()["proxy"]
    return env, env.params(env.init_weights(jax.random.key(0)))


def training_of(name: str, num: int, steps: int) -> tuple[Callable[..., Any], Any, Any]:
    """The training of one agent for so many steps, keys for `num` of them, and the SE's params."""
    world = AGENTS[name]
    run = configuration.config(world.words)
    env, params = sejax.load(world.proxy) if world.proxy else fresh_se(run)
    config = dataclasses.replace(run.agent, **early(run.agent))
    agent = sejax.make_agent(config, env.task)
    training = TrainingConfig(max_steps=steps, max_episodes=steps, stop_rule="never")
    return make_trainer(agent, env, training), jax.random.split(jax.random.key(0), num), params


def early(config: Any) -> dict[str, Any]:
    """Learning from the first steps on, so that a short training is like a long one."""
    return {"warmup_episodes": 0} if hasattr(config, "warmup_episodes") else {}


def throughput(name: str, num: int, steps: int) -> Any:
    train, keys, params = training_of(name, num, steps)
    fn = sejax.spread_over_devices(lambda key: train(key, params).train_steps)
    return (lambda keys: fn(keys).sum()), (keys,)


def generation(size: int) -> Any:
    # Pairs of candidates, and the incumbent's 16 trainings.
    words = ["env=cartpole", f"es.population_size={(size - 16) // 2}", "devices=1"]
    bilevel = make_bilevel(**configuration.config(words).parts())
    state = jax.jit(bilevel.init)(jax.random.key(0))

    def run(state: Any) -> Any:  # depends on all of it, or XLA would leave parts out
        after, info = bilevel.generation(state)
        mean = bilevel.layout.strategy.incumbent(after.es_state)
        return info.train_steps.sum() * jnp.isfinite(mean).all()

    return run, (state,)


def cheetah(num: int) -> Any:
    """Steps of so many robots side by side, random actions."""
    task = sejax.envs.make("halfcheetah", backend="mjx")

    def one(key: jax.Array) -> Any:
        _, state = task.env.reset_env(key, task.params)

        def step(state: Any, key: jax.Array) -> Any:
            action = jax.random.uniform(key, (task.action_dim,), minval=-1.0, maxval=1.0)
            obs, state, *_ = task.env.step_env(key, state, action, task.params)
            return state, jnp.isfinite(obs).all()

        return jax.lax.scan(step, state, jax.random.split(key, 50))[1].sum()

    keys = jax.random.split(jax.random.key(0), num)
    return (lambda keys: jax.vmap(one)(keys).sum()), (keys,)


class Clock:
    """Measures as long as there is time.

    Attributes:
      left: seconds.
    """

    def __init__(self, seconds: float):
        self.left = seconds
        self._last: dict[str, tuple[int, float]] = {}  # agents and seconds of what was measured

    def measure(self, what: str, make: Make, agents: int) -> dict[str, Any]:
        """Makes the program, runs it twice, and times the second run."""
        size, seconds = self._last.get(what, (agents, 0.0))
        if self.left <= 2 * seconds * agents / size:
            return {"left_out": "no time left"}
        started = time.perf_counter()
        try:
            program = make()
            compile_s = time.perf_counter() - started
            steps = program.run()
            again = time.perf_counter()
            program.run()
            wall_s = time.perf_counter() - again
        except (RuntimeError, sejax.ConfigError) as error:  # out of memory, or an extra is missing
            return {"left_out": str(error).partition("\n")[0][:120]}
        finally:
            self.left -= time.perf_counter() - started
        self._last[what] = agents, wall_s
        return {"steps": steps, "wall_s": wall_s, "compile_s": compile_s,
                "steps_per_s": steps / wall_s, **program.facts}  # fmt: skip


# --- what is printed -----------------------------------------------------------------------------


def show_checks(result: dict[str, Any]) -> None:
    for name, value in result["checks"].items():
        print(f"{name.replace('_', ' ')}: {value:g}")
    rows = [[name, each["a_step"], ", ".join(f"{n} {op}" for op, n in each["of"].items())]
            for name, each in result["kernels"].items()]  # fmt: skip
    common.print_table("Kernels of an agent step, at least", ["agent", "kernels", "of"], rows)


def show_figures(result: dict[str, Any]) -> None:
    rows = []
    for row in result["figures"]:
        start = [row["what"], f"{row['agents']:,}", row["on"]]
        if "left_out" in row:
            rows.append([*start, row["left_out"], "", "", ""])
            continue
        rows.append([
            *start, f"{row['steps_per_s']:,.0f}", f"{row['wall_s']:.2f}", f"{row['compile_s']:.1f}",
            f"{row['bytes'] / 1e6:,.1f}" if "bytes" in row else "",
        ])  # fmt: skip
    columns = ["what", "agents", "on", "steps/s", "s", "compile s", "MB"]
    common.print_table(f"{result['card']} ({result['platform']})", columns, rows)


if __name__ == "__main__":
    main()
