"""The shared library that `step.cc` becomes: built on first use, and kept."""

import contextlib
import ctypes
import functools
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
from importlib.metadata import version
from pathlib import Path

import jax
import mujoco

from sejax import files
from sejax.errors import ConfigError, shortened

SOURCE = Path(__file__).with_name("step.cc")
FLAGS = ("-O2", "-std=c++17", "-shared", "-fPIC")
COMPILERS = ("c++", "g++", "clang++")  # tried in this order, after $CXX
TARGETS = {"sejax_mujoco_reset": "SejaxMujocoReset", "sejax_mujoco_step": "SejaxMujocoStep"}


class NoCompilerError(ConfigError):
    """There is no C++ compiler, or it cannot build the library."""


@functools.cache
def load() -> ctypes.CDLL:
    """The library of this process, whose handlers XLA then knows as `TARGETS`.

    It is built if it is not in the cache folder (`sejax.files.cache_folder`), which takes some
    seconds. Processes that build it at the same time do not disturb each other. With the cache
    switched off, or where it cannot be written, each process builds its own.

    Raises:
      NoCompilerError: if it has to be built and cannot be.
    """
    folder = files.cache_folder()
    if folder is not None:
        with contextlib.suppress(OSError):
            return _register(_built_in(folder))
    with tempfile.TemporaryDirectory() as temporary:
        return _register(_built_in(Path(temporary)))


def file_name() -> str:
    """What the library is called: there is one for each version of all that it is made of."""
    parts = (SOURCE.read_text(), " ".join(FLAGS), version("mujoco"), version("jaxlib"),
             platform.system(), platform.machine(), *platform.libc_ver(),
             *_given_compiler()[1:])  # fmt: skip
    digest = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]
    return f"mujoco-{version('mujoco')}-jaxlib-{version('jaxlib')}-{platform.machine()}-{digest}.so"


def build(path: Path) -> None:
    """Compiles the library.

    The code is for any CPU of this kind: nearly all time passes in MuJoCo, which comes compiled.
    MuJoCo is bound by its file's name alone, as the process has it loaded already.

    Raises:
      NoCompilerError: if there is no compiler, or it fails.
    """
    package = Path(mujoco.__file__).parent
    (shared,) = (x for x in package.glob("libmujoco*") if x.suffix == ".dylib" or ".so" in x.name)
    command = [*_compiler(), *FLAGS, f"-I{package / 'include'}", f"-I{jax.ffi.include_dir()}",
               str(SOURCE), str(shared), "-o", str(path)]  # fmt: skip
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        said = getattr(error, "stderr", None) or str(error)
        raise NoCompilerError(
            f"{command[0]} failed with: {shortened(said.strip(), 1000)}"
        ) from error


def _built_in(folder: Path) -> Path:
    path = folder / file_name()
    if not path.exists():
        with files.atomic_path(path) as temporary:
            build(temporary)
    return path


def _compiler() -> list[str]:
    """The command of a C++ compiler, with the options that `CXX` may have."""
    for command in (_given_compiler(), *([name] for name in COMPILERS)):
        if command and shutil.which(command[0]):
            return command
    raise NoCompilerError(f"found none of $CXX, {', '.join(COMPILERS)}")


def _given_compiler() -> list[str]:
    return shlex.split(os.environ.get("CXX", ""))


def _register(path: Path) -> ctypes.CDLL:
    library = ctypes.CDLL(str(path))
    library.SejaxMujocoRegister.argtypes = [ctypes.c_int64, ctypes.c_void_p]
    library.SejaxMujocoRegister.restype = None
    library.SejaxMujocoLength.argtypes = [ctypes.c_void_p]
    library.SejaxMujocoLength.restype = ctypes.c_int64
    for target, symbol in TARGETS.items():
        handler = jax.ffi.pycapsule(getattr(library, symbol))
        jax.ffi.register_ffi_target(target, handler, platform="cpu")
    return library
