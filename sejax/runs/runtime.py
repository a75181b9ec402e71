"""How the commands start XLA. Libraries that import sejax keep their own settings."""

import contextlib
import hashlib
import os
import platform
from importlib.metadata import version
from pathlib import Path

import jax

import sejax
from sejax.ops import files
from sejax.ops.modes import require_modes

QUOTA = Path("/sys/fs/cgroup/cpu.max")  # of a container: "200000 100000", or "max 100000"
_NEVER_SECONDS = 1_000_000


def available_cores() -> int:
    """CPU cores that this process may use: its affinity, or a container's quota if it is less."""
    is_affine = hasattr(os, "sched_getaffinity")
    cores: float = len(os.sched_getaffinity(0)) if is_affine else os.cpu_count() or 1
    with contextlib.suppress(OSError, ValueError):
        quota, period = map(int, QUOTA.read_text().split())
        cores = min(cores, quota / period)
    return max(1, int(cores))


def platform_error() -> str:
    """The message if jax lacks `JAX_PLATFORMS`, which makes other code fail; else empty."""
    if platforms := os.environ.get("JAX_PLATFORMS"):
        try:
            jax.devices()
        except (RuntimeError, AssertionError):
            rule = "must name what jax was installed for and finds here"
            return f"JAX_PLATFORMS {rule}; got {platforms}. Set JAX_PLATFORMS=cpu."
    return ""


def configure_xla(num_devices: int | None = None) -> None:
    """Sets XLA up for one CPU device per core; without effect once jax has computed.

    A flag that the user has set in `XLA_FLAGS` stays. The time limits of collectives are lifted.
    Devices reach the gather at the end of a generation at very different times, and XLA would
    abort the process after a minute of waiting.

    Args:
      num_devices: CPU devices; None for one per core.
    """
    count = num_devices or available_cores()
    flags = {
        "--xla_force_host_platform_device_count": count,
        "--xla_cpu_multi_thread_eigen": "false",
        "--xla_cpu_collective_call_warn_stuck_timeout_seconds": _NEVER_SECONDS,
        "--xla_cpu_collective_call_terminate_timeout_seconds": _NEVER_SECONDS,
    }
    users = os.environ.get("XLA_FLAGS", "")
    added = [f"{flag}={value}" for flag, value in flags.items() if flag not in users]
    os.environ["XLA_FLAGS"] = " ".join([users, *added]).strip()
    if count == 1:
        # With one device XLA would hand pieces of the step to a second thread. That doubles the
        # CPU time for no gain: handing a piece over takes longer than computing it.
        os.environ.setdefault("NPROC", "1")


def configure_jax() -> None:
    """Sets jax up for the commands; settings of the user stay.

    Matrices are multiplied in single precision on GPUs too, as on CPUs and in `sejax.gym`. By
    default recent GPUs round factors to ten bits, which makes a proxy another one there.

    Compiled programs are kept between runs, in a folder for this kind of CPU. `SEJAX_CACHE_DIR`
    moves the folder; set to nothing, it switches the cache off.

    Raises:
      ConfigError: if jax computes in 64 bits.
    """
    require_modes()
    if jax.config.jax_default_matmul_precision is None:
        jax.config.update("jax_default_matmul_precision", "highest")
    root = files.cache_folder()
    if root is not None and not jax.config.jax_compilation_cache_dir:
        jax.config.update("jax_compilation_cache_dir", str(root / cpu_name()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def cpu_name() -> str:
    """A name of this kind of CPU: code compiled for another kind is rejected or unsafe."""
    lines = [platform.processor()]
    with contextlib.suppress(OSError):
        of_cores = Path("/proc/cpuinfo").read_text().splitlines()
        fields = ("model name", "flags", "Features", "CPU part")
        lines = sorted({x for x in of_cores if x.startswith(fields)}) or lines
    digest = hashlib.sha256("\n".join(lines).encode()).hexdigest()[:12]
    return f"{platform.machine()}-{digest}"


def versions() -> dict[str, str]:
    """Versions of the packages that decide a run's numbers."""
    return {"sejax": sejax.__version__, "jax": version("jax"), "jaxlib": version("jaxlib")}
