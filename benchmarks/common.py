"""What the benchmarks share: arguments, measuring subprocesses, tables and the RESULT line.

Each benchmark is a parent that only asks and prints, and *sides*: subprocesses of the same script
(`--side NAME`) that set up their own threads and devices, compile, and then measure on request.
Settings of one side never reach another, and a side starts once, however often it measures. Sides
take turns, so that a disturbance of the machine meets all of them.
"""

import argparse
import contextlib
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Any

from rich.console import Console
from rich.progress import track
from rich.table import Table

Handler = Callable[[dict[str, Any]], dict[str, Any]]
Answers = dict[str, list[dict[str, Any]]]  # of each side, one for each time that it measured
PAIR = ("sejax", "torch")  # the sides of a comparison with PyTorch


def parse_args(
    description: str | None, add_options: Callable[[argparse.ArgumentParser], None]
) -> argparse.Namespace:
    """Arguments that every benchmark takes, and its own; `--side` is for its subprocesses."""
    summary = (description or "").partition("\n")[0]
    parser = argparse.ArgumentParser(description=summary)
    parser.add_argument("--quick", action="store_true", help="a small version, in under 50 seconds")
    parser.add_argument("--json", type=Path, metavar="PATH", help="write the result there as well")
    parser.add_argument("--seed", type=int, default=0, help="of the first proxy and agents")
    parser.add_argument("--side", help=argparse.SUPPRESS)
    add_options(parser)
    return parser.parse_args()


def add_core(parser: argparse.ArgumentParser) -> None:
    """The option of the core that all sides are kept to."""
    parser.add_argument("--core", type=int, default=available_cores()[-1])


# --- sides ---------------------------------------------------------------------------------------


class Side:
    """A subprocess that answers requests, a JSON object on a line each way."""

    def __init__(self, script: str, name: str, *options: object):
        command = [sys.executable, script, "--side", name, *map(str, options)]
        self.name = name
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    @cached_property
    def ready(self) -> dict[str, Any]:
        """What the side says once it has started; waits for that."""
        return self._read()

    def ask(self, **request: Any) -> dict[str, Any]:
        """The side's answer.

        Raises:
          RuntimeError: if the side has ended; its own error is on stderr.
        """
        assert self.ready is not None and self._process.stdin is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return self._read()

    def close(self) -> None:
        """Lets the side end and waits for it."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()

    def __enter__(self) -> "Side":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _read(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            status = self._process.wait()
            raise RuntimeError(
                f"side {self.name!r} ended with status {status}; see its error above."
            )
        return json.loads(line)


@contextlib.contextmanager
def sides_of(script: str, names: Sequence[str], **options: object) -> Iterator[dict[str, Side]]:
    """Sides of a script by their names, with these options of the command line."""
    words = [word for name, value in options.items() for word in (option(name), value)]
    with contextlib.ExitStack() as stack:
        yield {name: stack.enter_context(Side(script, name, *words)) for name in names}


def option(name: str) -> str:
    """A name as an option of the command line."""
    return f"--{name.replace('_', '-')}"


def in_turns(
    sides: Mapping[str, Side], requests: Sequence[dict[str, Any]], warm_up: bool = True
) -> Answers:
    """The sides' answers to each request; all sides answer one before the next is made.

    Args:
      sides: by their names.
      requests: what they are asked.
      warm_up: whether the first request is made once before, and not counted.
    """
    answers: Answers = {name: [] for name in sides}
    first = requests[:1] if warm_up else []
    for place, request in enumerate(track([*first, *requests], "Measuring", transient=True)):
        for name, side in sides.items():
            answer = side.ask(**request)
            if place >= len(first):
                answers[name].append(answer)
    return answers


def serve(ready: dict[str, Any], handle: Handler) -> None:
    """A side's main loop: says that it is ready, then answers until its input ends."""
    print(json.dumps(ready), flush=True)
    for line in sys.stdin:
        print(json.dumps(handle(json.loads(line))), flush=True)


def measure(fn: Callable[[], Any]) -> tuple[Any, dict[str, float]]:
    """What `fn` returns, and its wall-clock and CPU seconds (all threads of this process)."""
    wall, cpu = time.perf_counter(), time.process_time()
    out = fn()
    return out, {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}


def available_cores() -> list[int]:
    """Numbers of the cores that this process may use."""
    return sorted(os.sched_getaffinity(0))


# --- results -------------------------------------------------------------------------------------


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, smallest and largest of repeated measurements."""
    return {"median": median(values), "min": min(values), "max": max(values)}


def show_spread(values: dict[str, float] | None, digits: int = 1) -> str:
    """`median (min to max)`, or `-` if nothing was measured."""
    if values is None:
        return "-"
    middle, low, high = (f"{values[k]:,.{digits}f}" for k in ("median", "min", "max"))
    return f"{middle} ({low} to {high})"


def compare_with_torch(answers: Answers) -> dict[str, Any]:
    """CPU microseconds of a step on each side of `PAIR` that is there, and the ratio in pairs.

    Answers have `cpu_s`, `wall_s` and `steps`.
    """
    times = {
        side: [1e6 * each["cpu_s"] / each["steps"] for each in mine]
        for side, mine in answers.items()
    }
    row: dict[str, Any] = {f"{side}_us": spread(values) for side, values in times.items()}
    if set(PAIR) <= times.keys():
        ratios = [b / a for a, b in zip(*(times[side] for side in PAIR), strict=True)]
        row |= {"ratio": spread(ratios), "ratios": [round(ratio, 2) for ratio in ratios]}
    return row


def share_of_core(every: Sequence[Answers]) -> float:
    """The median share of a core that the sides got."""
    return median(
        each["cpu_s"] / each["wall_s"]
        for answers in every for mine in answers.values() for each in mine
    )  # fmt: skip


def show_comparison(
    title: str, what: str, rows: Mapping[str, dict[str, Any]], share: float
) -> None:
    """Prints a table of rows from `compare_with_torch`, by their names, and `share_of_core`."""
    columns = ("sejax_us", "torch_us", "ratio")
    print_table(
        f"CPU microseconds per agent step on one core{title}, median (min to max)",
        [what, "sejax", "PyTorch", "PyTorch / sejax"],
        [[name, *(show_spread(row.get(column)) for column in columns)]
         for name, row in rows.items()],
    )  # fmt: skip
    print(f"Share of the core that these processes got: {share:.0%}")


def machine(packages: Sequence[str] = ("jax", "torch", "sejax")) -> dict[str, Any]:
    """Where this was measured; the load before the start says how busy the machine was.

    Args:
      packages: those whose versions matter.
    """
    return {
        "cpu": _cpu_model(),
        "cores": len(available_cores()),
        "load_before": round(os.getloadavg()[0], 2),
        "python": platform.python_version(),
        **{package: version(package) for package in packages},
    }


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Prints rows; the first column is text, the others are numbers."""
    table = Table(title=title, title_justify="left")
    for i, column in enumerate(columns):
        table.add_column(column, justify="right" if i else "left", no_wrap=True)
    for row in rows:
        table.add_row(*map(str, row))
    console = Console()
    Console(width=max(console.width, 110)).print(table)


def finish(benchmark: str, args: argparse.Namespace, result: dict[str, Any]) -> None:
    """Says where this was measured, writes the JSON file if asked for, and prints the RESULT line.

    Args:
      benchmark: its name.
      args: from `parse_args`.
      result: what was measured; `result["machine"]`, if there, is from `machine`.
    """
    if where := result.get("machine"):
        print(
            f"{where['cpu']}, {where['cores']} cores, load before the start {where['load_before']}"
        )
    result = {"benchmark": benchmark, "quick": args.quick} | result
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(json.dumps(result, indent=2) + "\n")
    print(f"RESULT {json.dumps(result)}")
