"""Runs on a Ray cluster of two nodes here, whose processes are killed meanwhile.

They need the extra `ray`, which `dev` has not (70 MB): `make test-ray`. Other clusters of this
machine are left alone: ports and folders are our own, and so are the processes that are ended.
"""

import contextlib
import importlib.util
import os
import random
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest
from safetensors.numpy import load_file
from support import metrics

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("ray") is None, reason="needs the extra ray: make test-ray"
    ),
]

GENERATIONS = 12
RUN = [
    *(sys.executable, "-m", "sejax.run", "env=cartpole", "es.population_size=8"),
    *(f"generations={GENERATIONS}", "checkpoint_every=1"),
]
ENVIRONMENT = {
    **{name: x for name, x in os.environ.items() if not name.startswith(("XLA_FLAGS", "RAY_"))},
    "PYTHONPATH": str(Path(__file__).parents[1]),
    "RAY_AUTH_MODE": "token",
    "RAY_AUTH_TOKEN": secrets.token_hex(32),
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_worker_niceness": "0",  # beside whatever else runs here
}


def wait_for(what, seconds=120):
    """What `what()` returns as soon as it is something."""
    end = time.monotonic() + seconds
    while not (found := what()):
        assert time.monotonic() < end
        time.sleep(0.05)
    return found


def command_line(pid):
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    return ""


def is_there(pid):
    """Whether a process is, and is no dead one whose parent has not looked."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def processes(session):
    """Those of a session: of the process that has begun it, and its descendants."""
    found = []
    for pid in (int(path.name) for path in Path("/proc").glob("[0-9]*")):
        with contextlib.suppress(ProcessLookupError):
            if os.getsid(pid) == session and is_there(pid):
                found.append(pid)
    return found


def end(process):
    """Kills a process and its session."""
    while found := processes(process.pid):
        for pid in found:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
    process.wait()


def started(folder, environment, *command):
    """A process in a session of its own, and the file with what it says."""
    log = folder / f"{time.monotonic_ns()}.log"
    with log.open("w") as said:
        options = {"stdin": subprocess.DEVNULL, "stdout": said, "stderr": subprocess.STDOUT}
        process = subprocess.Popen(command, start_new_session=True, env=environment, **options)
    return process, log


class Node:
    """A node of one CPU; its processes are those of a session."""

    def __init__(self, folder, *words):
        start = sys.executable, "-m", "ray.scripts.scripts", "start", "--block", "--num-cpus=1"
        limits = "--node-ip-address=127.0.0.1", "--object-store-memory=100000000"
        self.process, self.log = started(folder, ENVIRONMENT, *start, *limits, *words)
        wait_for(lambda: "Ray runtime started" in self.log.read_text())

    def workers(self):
        mine = processes(self.process.pid)
        return [pid for pid in mine if command_line(pid).startswith("ray::call")]

    def kill(self):
        end(self.process)


class Cluster:
    """Two nodes."""

    def __init__(self, folder):
        self.folder = folder
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.environment = {**ENVIRONMENT, "RAY_ADDRESS": f"127.0.0.1:{self.port}"}
        words = "--head", f"--port={self.port}", "--include-dashboard=false"
        self.head = Node(folder, *words, f"--temp-dir={folder}")
        self.join()

    def join(self):
        self.other = Node(self.folder, f"--address=127.0.0.1:{self.port}")

    def workers(self):
        return self.head.workers() + self.other.workers()

    def replace_other(self):
        """Ends the second node at once; a new one joins."""
        self.other.kill()
        self.join()

    def close(self):
        self.other.kill()
        self.head.kill()


@pytest.fixture(scope="module")
def folder():
    """A folder whose path is short, as that of a socket must be."""
    with tempfile.TemporaryDirectory(prefix="sejax", ignore_cleanup_errors=True) as made:
        yield Path(made)


@pytest.fixture(scope="module")
def cluster(folder):
    made = Cluster(folder)
    yield made
    made.close()


class Driver:
    """A command, as a process."""

    def __init__(self, folder, *words, environment=ENVIRONMENT):
        self.folder = folder
        folder.mkdir(exist_ok=True)
        command = *RUN, f"run_dir={folder / 'run'}", *words
        self.process, self.log = started(folder, environment, *command)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        end(self.process)

    def wait(self, status=0):
        assert self.process.wait(timeout=500) == status, self.log.read_text()

    def generations(self):
        path = self.folder / "run" / "metrics.csv"
        return len(path.read_text().splitlines()) - 1 if path.exists() else 0


def results(folder):
    """What must not differ: metrics without times, and the proxies' weights."""
    weights = {
        (name, layer): x.tolist()
        for name in ("proxy", "proxy_last")
        for layer, x in load_file(folder / "run" / f"{name}.safetensors").items()
    }
    return metrics(folder / "run"), weights


@pytest.fixture(scope="module")
def wanted(tmp_path_factory):
    """What a run of this process gives."""
    folder = tmp_path_factory.mktemp("local")
    with Driver(folder, "devices=1") as driver:
        driver.wait()
    return results(folder)


def kill_worker(cluster, driver, rng):
    os.kill(rng.choice(wait_for(cluster.workers)), signal.SIGKILL)


def kill_node(cluster, driver, rng):
    cluster.replace_other()


@contextlib.contextmanager
def lose_node(cluster, driver, rng):
    """No other node comes until the run has ended."""
    cluster.other.kill()
    yield driver
    cluster.join()


def kill_driver(cluster, driver, rng):
    driver.process.kill()
    driver.process.wait()
    return Driver(driver.folder, "machines=ray", environment=cluster.environment)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("fault", [kill_worker, kill_node, lose_node, kill_driver])
def test_a_run_has_the_same_rows_whatever_is_killed_and_when(
    cluster, wanted, tmp_path, fault, seed
):
    rng = random.Random(f"{fault.__name__} {seed}")
    with Driver(tmp_path, "machines=ray", environment=cluster.environment) as driver:
        wait_for(cluster.workers)
        moment = rng.uniform(0, GENERATIONS - 4)  # in generations of some 0.2 s
        wait_for(lambda: driver.generations() >= int(moment))
        time.sleep(moment % 1 * 0.2)
        there = set(cluster.workers())
        with fault(cluster, driver, rng) or contextlib.nullcontext(driver) as last:
            last.wait()
    assert results(tmp_path) == wanted
    wait_for(lambda: not any(map(is_there, there)))


def test_a_run_goes_on_with_or_without_the_cluster(cluster, wanted, tmp_path):
    for generations, machines in ((4, "local"), (8, "ray"), (12, "local")):
        words = f"machines={machines}", f"generations={generations}"
        with Driver(tmp_path, *words, environment=cluster.environment) as driver:
            driver.wait()
    assert results(tmp_path) == wanted


def test_a_run_whose_own_cluster_dies_ends_with_one_message(folder, tmp_path):
    environment = ENVIRONMENT | {"RAY_TMPDIR": str(folder)}
    words = "machines=ray", "machines.address=local", "machines.workers=1", "generations=1000"
    with Driver(tmp_path, *words, environment=environment) as driver:
        wait_for(driver.generations)
        (raylet,) = (
            pid for pid in processes(driver.process.pid) if "raylet/raylet" in command_line(pid)
        )
        os.kill(raylet, signal.SIGKILL)
        driver.wait(1)
    said = [x for x in driver.log.read_text().splitlines() if x.startswith("error: ")]
    assert len(said) == 1 and "saved" in said[0]


def test_a_stopped_worker_of_a_killed_driver_makes_room(cluster, wanted, tmp_path):
    with Driver(tmp_path, "machines=ray", environment=cluster.environment) as driver:
        wait_for(driver.generations)
        stopped = cluster.workers()
        for pid in stopped:
            os.kill(pid, signal.SIGSTOP)
    with Driver(tmp_path, "machines=ray", environment=cluster.environment) as driver:
        driver.wait()
    assert results(tmp_path) == wanted
    assert not any(map(is_there, stopped))


@pytest.fixture
def heard():
    """Ctrl-C is heard by the processes that are started, whatever started this one."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("heard")
@pytest.mark.parametrize("given", [signal.SIGINT, signal.SIGKILL])
def test_nothing_is_left_of_a_driver_that_started_its_own_ray(folder, tmp_path, given):
    environment = ENVIRONMENT | {"RAY_ADDRESS": "local", "RAY_TMPDIR": str(folder)}
    words = "machines=ray", "machines.workers=2", "generations=1000"
    with Driver(tmp_path, *words, environment=environment) as driver:
        wait_for(driver.generations)
        driver.process.send_signal(given)
        driver.wait({signal.SIGINT: 130, signal.SIGKILL: -signal.SIGKILL}[given])
        wait_for(lambda: not processes(driver.process.pid))
    said = driver.log.read_text().splitlines()
    left = [x for x in said if not x.startswith("generation ") and not x.endswith(" ...")]
    assert len(left) == (given == signal.SIGINT), left
