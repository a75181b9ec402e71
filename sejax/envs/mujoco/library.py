"""The shared library of `step.cc`: built on first use, then kept."""

import contextlib
import ctypes
import functools
import hashlib
import os
import platform
import subprocess
import tempfile
import threading
from importlib.metadata import version
from pathlib import Path

import jax
import mujoco

from sejax.ops import files
from sejax.options import ConfigError, shortened, told

SOURCE = Path(__file__).with_name("step.cc")
FLAGS = ("-O2", "-std=c++17", "-shared", "-fPIC")
TARGETS = {"sejax_mujoco_reset": "SejaxMujocoReset", "sejax_mujoco_step": "SejaxMujocoStep"}
_LOADING = threading.Lock()


def load() -> ctypes.CDLL:
    """The library of this process; registers its handlers with XLA as `TARGETS`.

    If it is not in the cache folder (`sejax.ops.files.cache_folder`), it is built, which takes some
    seconds. Processes that build it at the same time do not disturb each other. Each process builds
    its own library if the cache is switched off, cannot be written, or its files cannot be loaded.

    Raises:
      ConfigError: if it has to be built and cannot be, or JAX's default device is no CPU; the
        message says what helps.
    """
    if (backend := jax.default_backend()) != "cpu":
        raise ConfigError("", f"must run on the CPU; got {backend}. Set JAX_PLATFORMS=cpu")
    with _LOADING:  # XLA takes only one library in a process
        return _load()


@functools.cache
def _load() -> ctypes.CDLL:
    folder = files.cache_folder()
    kept = folder / file_name() if folder else None
    with contextlib.suppress(OSError):  # as if there is no file yet
        if kept is not None:
            return _register(kept)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as temporary:
        built = Path(temporary) / file_name()
        build(built)
        with contextlib.suppress(OSError):
            if kept is not None:
                files.write_bytes(kept, built.read_bytes())
                return _register(kept)
        try:
            return _register(built)
        except OSError as error:
            fix = "Set SEJAX_CACHE_DIR, or TMPDIR, to a folder that programs can be run from"
            raise ConfigError("", f"cannot load its library ({told(error)}). {fix}") from error


def file_name() -> str:
    """The library's name, another one for each version of anything that it is built from."""
    versions = f"mujoco-{version('mujoco')}-jaxlib-{version('jaxlib')}-{platform.machine()}"
    source = SOURCE.read_text(encoding="utf-8")
    parts = (source, *FLAGS, *compiler()[1:], versions, platform.system(), *platform.libc_ver())
    digest = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]
    return f"{versions}-{digest}.so"


def build(path: Path) -> None:
    """Compiles the library.

    The code is for any CPU of this architecture: nearly all time passes in MuJoCo, which comes
    compiled. MuJoCo is linked by its file's name alone, as the process has already loaded it.

    Raises:
      ConfigError: if the compiler is missing or fails.
    """
    package = Path(mujoco.__file__).parent
    mujoco_library = min(package.glob("libmujoco*"))
    includes = f"-I{package / 'include'}", f"-I{jax.ffi.include_dir()}"
    command = [*compiler(), *FLAGS, *includes, str(SOURCE), str(mujoco_library), "-o", str(path)]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        reason = shortened(error if isinstance(error, OSError) else error.stderr.strip(), 120)
        rule = f"needs a C++ compiler; {command[0]} failed with: {reason}. Mend that, or set CXX"
        raise ConfigError("", rule) from error


def compiler() -> list[str]:
    """The command of a C++ compiler, with the options that `CXX` may have."""
    return (os.environ.get("CXX") or "c++").split()


def _register(path: Path) -> ctypes.CDLL:
    library = ctypes.CDLL(str(path.absolute()))  # else the system's folders would be searched
    library.SejaxMujocoRegister.argtypes = [ctypes.c_int64, ctypes.c_void_p]
    library.SejaxMujocoRegister.restype = None
    library.SejaxMujocoLength.argtypes = [ctypes.c_void_p]
    library.SejaxMujocoLength.restype = ctypes.c_int64
    for target, symbol in TARGETS.items():
        handler = jax.ffi.pycapsule(getattr(library, symbol))
        jax.ffi.register_ffi_target(target, handler, platform="cpu")
    return library
