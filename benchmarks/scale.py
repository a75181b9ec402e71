"""What handing trainings out costs: generations by worker processes and by the local program.

Generations of CartPole SEs (default settings, 144 trainings) on one core and on two: by the local
program with as many devices, and with `machines=ray` and as many workers, with the driver and Ray's
own processes on the same cores. All run the same generations, one after the other in turns; their
scores must be equal to the last digit. "overhead" compares wall-clock generation by generation.
"serial" is the driver's time before the first share leaves and after the last has come: ask and
tell. "idle" is the share of the workers' time in which they did not compute, from `machines.csv`.
Two more sides take the time of what is handed out, in their own process: of groups of lanes, as
they are by default, and of single trainings (`num_parallel=1`).

From these times `scale_model.py` says what a generation takes with one worker and with two, which
is held against what was measured, and with more. `--out FOLDER` stores figure and table; `--model
JSON` measures nothing and takes what an earlier `--json` stored.
"""

import argparse
import contextlib
import csv
import dataclasses
import functools
import json
import os
import tempfile
from collections.abc import Callable, Hashable, Iterator
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import common
import numpy as np
from scale_model import Costs, World, draw, hand_out_pending_s, simulate

from sejax.machines.chunks import CAPACITY

GROUPS, ALONE = "trainings-lanes", "trainings-1"
SIDES = {
    "local-1": "local, 1 device",
    "ray-1": "Ray, 1 worker",
    "local-2": "local, 2 devices",
    "ray-2": "Ray, 2 workers",
    GROUPS: "in the driver",
    ALONE: "in the driver, num_parallel=1",
}
WORKERS = (1, 2, 10, 100, 1000)
GRID = sorted({round(10 ** (i / 8)) for i in range(25)} | set(WORKERS))  # of the figure
GIGABIT = 125e6  # bytes a second
HALFCHEETAH = Path(__file__).parents[1] / "results/scale/halfcheetah_trainings.csv"
HALFCHEETAH_DIMS = 2433


class Measured(NamedTuple):
    """What a side measures.

    Attributes:
      chunks: generations, as `sejax.cli.session.Chunks`.
      extra: what else there is to tell of the last generation, given its wall-clock seconds.
      ready: what else the side says when it has started.
    """

    chunks: Any
    extra: Callable[[float], dict[str, Any]]
    ready: dict[str, Any]


def main() -> None:
    """Runs the benchmark, or one of its sides."""
    args = common.parse_args(__doc__, add_options)
    if args.side:
        serve(args)
        return
    if args.model:
        result = json.loads(args.model.read_text())
    else:
        where = common.machine(("jax", "ray", "sejax"))
        result = {"machine": where} | measure_sides(args)
    result["model"] = model(result)
    show(result)
    if args.out:
        write(result, args.out)
    common.finish("scale", args, result)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this benchmark."""
    parser.add_argument("--generations", type=int, help="after the first (2 if --quick, else 9)")
    parser.add_argument("--cores", type=int, nargs=2, default=common.available_cores()[:2])
    parser.add_argument("--model", type=Path, metavar="JSON", help="of an earlier --json")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="for scale.png and table.md")
    parser.add_argument("overrides", nargs="*", help="of the configuration, after env=cartpole")


# --- what is measured -----------------------------------------------------------------------------


def measure_sides(args: argparse.Namespace) -> dict[str, Any]:
    """Runs the same generations on each side in turns."""
    count = args.generations or (2 if args.quick else 9)
    options = ("--seed", args.seed, "--cores", *args.cores)
    samples: dict[str, list[dict[str, Any]]] = {name: [] for name in SIDES}
    with contextlib.ExitStack() as stack:
        sides = {}
        for name in SIDES:
            side = common.Side(__file__, name, *options, *args.overrides)
            sides[name] = stack.enter_context(side)
            assert side.ready  # one after the other: clusters look for free ports
        print("All sides are ready.", flush=True)
        for generation in range(count + 1):
            for name, side in sides.items():
                sample = side.ask()
                if generation:  # the first one warms up
                    samples[name].append(sample)
        about = sides["ray-1"].ready
    return summarise(samples) | about


def summarise(samples: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """Each side's medians, and the overhead generation by generation."""
    scores = {name: [sample.pop("scores") for sample in samples[name]] for name in samples}
    del scores[ALONE]  # another number of lanes rounds otherwise
    times = {name: [sample.pop("seconds") for sample in samples[name]] for name in (GROUPS, ALONE)}
    sides: dict[str, Any] = {}
    for name, each in samples.items():
        sides[name] = {key: median(sample[key] for sample in each) for key in each[0]}
        sides[name]["wall_s_all"] = [sample["wall_s"] for sample in each]
    overhead = {}
    for n in (1, 2):
        pairs = zip(samples[f"ray-{n}"], samples[f"local-{n}"], strict=True)
        ratios = [ray["wall_s"] / local["wall_s"] - 1 for ray, local in pairs]
        overhead[str(n)] = common.spread(ratios)
    return {
        "sides": sides,
        "overhead": overhead,
        "equal_scores": all(each == scores["local-1"] for each in scores.values()),
        "seconds": times,
    }


def serve(args: argparse.Namespace) -> None:
    """A side: the generations of one run, one at a time."""
    kind, _, number = args.side.partition("-")
    cores = args.cores[: 2 if number == "2" else 1]
    os.sched_setaffinity(0, cores)
    os.environ["RAY_ADDRESS"] = "local"  # a cluster of its own
    from sejax.cli.runtime import configure_jax, configure_xla

    configure_xla(len(cores) if kind == "local" else 1)
    import jax

    import sejax

    configure_jax()
    num_parallel = ["num_parallel=1"] if args.side == ALONE else []
    config = sejax.config(["env=cartpole", f"seed={args.seed}", *args.overrides, *num_parallel])
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        path = Path(folder)
        make = {"local": local_side, "ray": ray_side, "trainings": trainings_side}[kind]
        side: Measured = stack.enter_context(make(config, path, len(cores)))
        save = stack.enter_context(files_of(config, path, side.chunks))
        state = initial(config, side.chunks)
        program = side.chunks.learner
        about = {"trials": len(program.family_of_trial), "dims": program.num_dims,
                 "num_parallel": config.num_parallel
                 or program.cpu_num_parallel[0] or 1}  # fmt: skip

        def advance() -> Any:
            return jax.block_until_ready(side.chunks.advance(state, 1))

        def handle(_: dict[str, Any]) -> dict[str, Any]:
            nonlocal state
            (state, info), times = common.measure(advance)
            _, saving = common.measure(functools.partial(save, state, info))
            scores = np.ravel(info.member_scores).tolist()
            extra = side.extra(times["wall_s"])
            return times | {"files_s": saving["wall_s"], "scores": scores} | extra

        common.serve(about | side.ready, handle)


def initial(config: Any, chunks: Any) -> Any:
    """The state of a run before its first generation."""
    import jax

    keys = jax.vmap(jax.random.key)(config.seed + jax.numpy.arange(config.num_seeds))
    return jax.tree.map(lambda x: x.copy(), chunks.init(keys))


@contextlib.contextmanager
def local_side(config: Any, folder: Path, num_cores: int) -> Iterator[Measured]:
    """The compiled program with a device for each core."""
    from sejax.cli import session

    chunks = session.make_chunks(config)
    chunks.compile(config.num_seeds, 1)
    yield Measured(chunks, lambda wall_s: {}, {})


@contextlib.contextmanager
def ray_side(config: Any, folder: Path, num_cores: int) -> Iterator[Measured]:
    """A worker process for each core."""
    from sejax.machines.configs import RayConfig

    with RayConfig(workers=num_cores).make(config, folder, lambda text: None) as chunks:
        state = initial(config, chunks)
        chunks.advance(state, 1)
        while len(last_rows(folder)) < num_cores:  # a generation waits for the first worker only
            chunks.advance(state, 1)
        ready = {"pending_s": pending_in_ray()}
        yield Measured(chunks, functools.partial(of_ledger, folder, num_cores), ready)


def last_rows(folder: Path) -> list[dict[str, str]]:
    """The last generation's rows of `machines.csv`: those of one wall-clock time."""
    with (folder / "machines.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return [row for row in rows if row["wall_s"] == rows[-1]["wall_s"]]


def of_ledger(folder: Path, num_workers: int, wall_s: float) -> dict[str, Any]:
    """What the workers did in the last generation, which took the driver `wall_s`."""
    rows = last_rows(folder)

    def total(name: str) -> float:
        return sum(float(row[name]) for row in rows)

    handing_s = float(rows[0]["wall_s"])
    return {
        **{name: total(name) for name in ("shares", "busy_s", "bytes_out", "bytes_in", "lost")},
        "worker_cpu_s": total("cpu_s"),
        "handing_s": handing_s,
        "serial_s": wall_s - handing_s,
        "idle": 1 - total("busy_s") / (num_workers * wall_s),
    }


def pending_in_ray() -> float:
    """Seconds that the crew's looking takes for each share more that workers have."""
    import ray

    never = ray.remote(num_cpus=0, resources={"nowhere": 1})(lambda: None).remote()
    wait_for = ray.remote(num_cpus=0)(lambda _: None)
    waiting, done = [wait_for.remote(never) for _ in range(1000)], ray.put(0)

    def look(count: int) -> None:
        references = [*waiting[:count], done]
        ray.wait(references, num_returns=1)
        ray.wait(references, num_returns=len(references), timeout=0)

    def seconds(count: int) -> float:
        return median(common.measure(lambda: look(count))[1]["wall_s"] for _ in range(20))

    each = (seconds(1000) - seconds(10)) / 990
    for reference in [*waiting, never]:
        ray.cancel(reference)
    return max(0.0, each)


class Here:
    """A crew of this process alone, which computes when it is given something."""

    def __init__(self, scorer: Any):
        self.scorer = scorer
        self.seconds: list[float] = []
        self._came: list[tuple[Hashable, Any]] = []
        self._is_recruited = False

    def recruit(self) -> list[Hashable]:
        new: list[Hashable] = [] if self._is_recruited else [0]
        self._came += [(worker, self.scorer.prepare()) for worker in new]
        self._is_recruited = True
        return new

    def send(self, worker: Hashable, work: Any) -> None:
        scored = self.scorer.score(work)
        self.seconds.append(scored.seconds)
        self._came.append((worker, scored))

    def wait(self, timeout_s: float) -> list[tuple[Hashable, Any]]:
        came, self._came = self._came, []
        return came

    def dismiss(self, worker: Hashable) -> None:
        pass


@contextlib.contextmanager
def trainings_side(config: Any, folder: Path, num_cores: int) -> Iterator[Measured]:
    """Shares of one group of lanes each, scored in this process."""
    from sejax.bilevel import make_program
    from sejax.cli import build
    from sejax.machines import scorer
    from sejax.machines.chunks import RemoteChunks
    from sejax.machines.handout import HandOut

    program = make_program(**config.parts() | {"devices": 1})
    capacities = tuple(
        config.num_parallel or num_parallel or 1 for num_parallel in program.cpu_num_parallel
    )
    crew = Here(scorer.Scorer(build.to_plain(config), capacities, scorer.versions(), 0))
    with RemoteChunks(program, HandOut(crew, capacities, capacities)) as chunks:
        chunks.compile(config.num_seeds, 1)

        def extra(wall_s: float) -> dict[str, Any]:
            seconds, crew.seconds = crew.seconds, []
            return {"seconds": seconds}

        yield Measured(chunks, extra, {})


@contextlib.contextmanager
def files_of(config: Any, folder: Path, chunks: Any) -> Iterator[Callable[[Any, Any], None]]:
    """Writes what a run writes after a chunk of generations, as `sejax.cli.session.run` does."""
    import jax

    from sejax.cli import session
    from sejax.cli.run_directory import open_for

    config = dataclasses.replace(config, run_dir=str(folder / "run"))
    with open_for(config) as directory:
        directory.restore(initial(config, chunks))
        proxies = session.Proxies(config, directory.path, chunks.learner)

        def save(state: Any, info: Any) -> None:
            host_state, info = jax.device_get((state, info))
            directory.append(info, 0.0)
            proxies.save(host_state)
            directory.commit(int(host_state.generation[0]), state)

        yield save


# --- what follows from it -------------------------------------------------------------------------


def model(result: dict[str, Any]) -> dict[str, Any]:
    """The model at 1 and 2 workers beside the measured figures, and for more."""
    one = result["sides"]["ray-1"]
    share_s = (one["cpu_s"] - one["serial_s"]) / one["shares"]
    costs = Costs(
        serial_s=one["serial_s"],
        share_s=share_s,
        gap_s=max(0.0, (one["handing_s"] - one["busy_s"]) / one["shares"] - share_s),
        pending_s=result["pending_s"] + hand_out_pending_s(),
        bytes_each=(one["bytes_out"] + one["bytes_in"]) / len(result["seconds"][GROUPS][0]),
    )
    checks = {}
    for n in (1, 2):
        side = result["sides"][f"ray-{n}"]
        said = median(check(times, n, costs, result).wall_s for times in result["seconds"][GROUPS])
        checks[str(n)] = {
            "model_s": said, "measured_s": side["wall_s"], "error": said / side["wall_s"] - 1
        }  # fmt: skip
    worlds, wired = worlds_of(result), dataclasses.replace(costs, bandwidth=GIGABIT)
    of = next(iter(worlds.values()))
    curves = {name: {str(n): vars(world.simulate(n, wired, of)) for n in GRID}
              for name, world in worlds.items()}  # fmt: skip
    return {"costs": vars(wired), "checks": checks, "worlds": curves}


def check(seconds: list[float], num_workers: int, costs: Costs, result: dict[str, Any]) -> Any:
    """What the model says of a measured generation.

    Its times come from a side of its own, at other moments of the machine: they are scaled to what
    the workers computed in all.
    """
    scale = result["sides"][f"ray-{num_workers}"]["busy_s"] / sum(seconds)
    capacity = -(-CAPACITY // result["num_parallel"])
    return simulate(scale * np.array(seconds), num_workers, costs, capacity)


def worlds_of(result: dict[str, Any]) -> dict[str, World]:
    """What the model is shown for; the first is what was measured."""
    groups, alone = (np.ravel(result["seconds"][name]) for name in (GROUPS, ALONE))
    worlds = {}
    for population in (64, 1024):
        trials = 2 * population + 16
        world = World(seconds=groups, count=trials // result["num_parallel"], num_trials=trials,
                      capacity=-(-CAPACITY // result["num_parallel"]),
                      dims=result["dims"])  # fmt: skip
        worlds[f"CartPole SE, {trials:,} trainings"] = world
        worlds[f"CartPole SE, {trials:,} trainings, num_parallel=1"] = dataclasses.replace(
            world, seconds=alone, count=trials, capacity=CAPACITY
        )
    with HALFCHEETAH.open(encoding="utf-8") as file:
        seconds = np.array([float(row["cpu_s"]) for row in csv.DictReader(file)])
    worlds["HalfCheetah RN, 48 trainings"] = World(
        seconds=seconds, count=48, num_trials=48, capacity=CAPACITY, dims=HALFCHEETAH_DIMS
    )
    return worlds


def show(result: dict[str, Any]) -> None:
    """Prints what was measured, and what the model says."""
    rows = []
    for name, side in result["sides"].items():
        row = [SIDES[name], f"{side['wall_s']:.3f}", f"{side['cpu_s']:.3f}"]
        if "idle" in side:
            row += [f"{side['worker_cpu_s']:.3f}", f"{1e3 * side['serial_s']:.1f}",
                    f"{side['idle']:.1%}", f"{side['shares']:.0f}",
                    f"{side['bytes_out']:,.0f}", f"{side['bytes_in']:,.0f}"]  # fmt: skip
        rows.append([*row, *[""] * (9 - len(row)), f"{1e3 * side['files_s']:.0f}"])
    columns = ["medians", "wall s", "CPU s", "workers' CPU s", "serial ms", "idle", "shares",
               "bytes out", "in", "files ms"]  # fmt: skip
    title = f"A generation of CartPole SEs, {result['trials']} trainings"
    common.print_table(title, columns, rows)
    for n, ratios in result["overhead"].items():
        low, middle, high = (f"{ratios[key]:.1%}" for key in ("min", "median", "max"))
        print(f"Ray / local with {n}: {middle} more wall-clock ({low} to {high}).")
    print(f"Equal scores: {result['equal_scores']}.")
    for name, what in (
        (GROUPS, f"a group of {result['lanes']} lanes"),
        (ALONE, "a training alone"),
    ):
        times = ", ".join(f"{1e3 * x:.1f}" for x in quantiles(result["seconds"][name]))
        print(f"Times of {what}, ms (0, 5, 50, 95, 100%): {times}.")
    for n, check in result["model"]["checks"].items():
        print(f"Model with {n}: {check['model_s']:.3f} s, measured {check['measured_s']:.3f} s "
              f"({check['error']:+.1%}).")  # fmt: skip
    columns, rows = table_of(result)
    common.print_table("Model, over 1 Gbit/s", columns, rows)


def quantiles(seconds: list[list[float]]) -> list[float]:
    """Of all generations' times."""
    return np.quantile(np.ravel(seconds), (0, 0.05, 0.5, 0.95, 1)).tolist()


def table_of(result: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Columns and rows of what the model says."""
    columns = ["a generation of", "workers", "s", "speed-up", "idle", "serial s", "shares sent s",
               "wire s", "trainings, divided at will, s", "longest share s"]  # fmt: skip
    rows = []
    for name, points in result["model"]["worlds"].items():
        for n in WORKERS:
            p = points[str(n)]
            times = (p[key] for key in ("serial_s", "driver_s", "wire_s", "ideal_s", "longest_s"))
            rows.append([
                name, f"{n:,}", f"{p['wall_s']:.3g}", f"{points['1']['wall_s'] / p['wall_s']:.3g}",
                f"{p['idle']:.0%}", *(f"{x:.2g}" for x in times),
            ])  # fmt: skip
    return columns, rows


def write(result: dict[str, Any], folder: Path) -> None:
    """Stores figure and table."""
    folder.mkdir(parents=True, exist_ok=True)
    draw(result["model"]["worlds"], folder / "scale.png")
    columns, rows = table_of(result)
    lines = [columns, ["---"] * len(columns), *rows]
    text = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    (folder / "table.md").write_text(f"# Model of many workers\n\n{text}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
