"""How every test runs: two CPU devices, warnings as errors, compiled programs kept between runs."""

import atexit
import gc
import os
from importlib.metadata import version
from pathlib import Path

# Compilation is most of the time here. LLVM's optimisation is off, which halves it, and so are the
# emitters that take fusions through MLIR, which takes a third off the rest; XLA's own passes, whose
# result test_program.py reads, stay on. Processes that tests start have these too unless they
# clear them.
_FLAGS = (
    "--xla_backend_optimization_level=0",
    # From jaxlib 0.11 on the flag is unknown, of which XLA dies.
    *(["--xla_cpu_use_fusion_emitters=false"] if version("jaxlib").startswith("0.10.") else []),
    "--xla_cpu_parallel_codegen_split_count=1",
    "--xla_force_host_platform_device_count=2",
    "--xla_cpu_multi_thread_eigen=false",
    "--xla_cpu_collective_call_warn_stuck_timeout_seconds=100000",
    "--xla_cpu_collective_call_terminate_timeout_seconds=100000",
)
os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *_FLAGS]).strip()
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import hypothesis  # noqa: E402
import jax  # noqa: E402
import pytest  # noqa: E402

from sejax.runs.runtime import cpu_name  # noqa: E402

_CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"), "sejax-tests", cpu_name())
jax.config.update("jax_compilation_cache_dir", str(_CACHE))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.05)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)

# Compilation happens inside examples, so that their duration says nothing.
hypothesis.settings.register_profile(
    "sejax", deadline=None, derandomize=True, max_examples=30, database=None
)
hypothesis.settings.load_profile("sejax")


# What is imported stays, and tracing makes many objects that reference counts free: looking
# through all of them at Python's usual pace takes a tenth of the time.
gc.freeze()
gc.set_threshold(50_000, 20, 20)


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("filterwarnings", "error")
    # A cache that cannot be read or written costs time and fails nothing.
    config.addinivalue_line("filterwarnings", "ignore:.*persistent compilation cache:UserWarning")


@pytest.fixture(scope="session", autouse=True)
def _two_cpu_devices():
    if jax.device_count() < 2:
        pytest.exit("jax was initialised before conftest.py could ask for two CPU devices", 3)


def pytest_sessionfinish() -> None:
    """Ends a worker at once: jax takes seconds to free what ends with the process."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        atexit.register(os._exit, 0)


# Files that take longest come first, or one process would be left with one of them at the end.
LONGEST = ("test_claims", "test_run", "test_agents", "test_search", "test_examples", "test_probes",
           "test_distill", "test_policy_search", "test_run_directory", "test_bilevel")  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sorts the files of tests, with `--no-loadscope-reorder`."""
    items.sort(key=lambda item: item.path.stem not in LONGEST)
