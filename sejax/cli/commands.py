"""What the commands share: Hydra's start, exit codes, and messages."""

import contextlib
import functools
import hashlib
import io
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import NoReturn, TypeVar

from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf.errors import OmegaConfBaseException

from sejax import registry
from sejax.cli import compose, runtime
from sejax.errors import ConfigError, FailedError
from sejax.ops.files import as_file_name

BAD_INPUT, FAILED, INTERRUPTED = 2, 1, 130
LONGEST_NAME = 120  # characters of a folder's
Given = TypeVar("Given")
Result = TypeVar("Result")


def start(name: str, main: Callable[[], object]) -> None:
    """Runs a Hydra main function; what Hydra refuses becomes one message and exit code 2.

    Args:
      name: of the command: run or evaluate.
      main: decorated by `hydra.main`.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then raises, and the message is ours.
    with _messages() as words:
        words += _prepared()
        if {"--help", "-h"} & set(sys.argv[1:]):
            print(compose.help_text(name, words))
            return
        compose.register(name, words)
        main()


def name_in_sweep(known: Collection[str]) -> str:
    """What tells a job of a Hydra sweep from the others, for its folder; empty outside of sweeps.

    Args:
      known: fields that the folder's name has already.
    """
    job = HydraConfig.get() if HydraConfig.initialized() else None
    if job is None or job.mode != RunMode.MULTIRUN:
        return ""
    swept = [word for word in job.overrides.task if word not in sys.argv]
    words = [word for word in swept if word.partition("=")[0].lstrip("+") not in known]
    name = as_file_name(",".join(words))
    return name if len(name) <= LONGEST_NAME else hashlib.sha256(name.encode()).hexdigest()[:16]


def start_with_words(main: Callable[[Sequence[str]], object], help_text: str) -> None:
    """Runs a main function that reads the words itself; errors become messages as of `start`."""
    with _messages() as words:
        words += _prepared()
        if {"--help", "-h"} & set(sys.argv[1:]):
            print(help_text)
            return
        guarded(main)(words)


def _prepared() -> list[str]:
    """Sets the process up, and returns the words after the command."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a terminal of few letters
    sys.argv[1:] = compose.hydra_words([_quoted(word) for word in sys.argv[1:]])
    words = [word for word in sys.argv[1:] if not word.startswith("-")]
    if sys.path[0] != "":  # `python -m` has put the current folder there, if it still exists
        sys.path.insert(0, "")
    Path.cwd()
    runtime.configure_xla(_devices(words))  # before a plugin imports what starts jax's devices
    return words


@contextlib.contextmanager
def _messages() -> Iterator[list[str]]:
    """Ends the process with one message for what was refused; yields a list for the words.

    Within it, of what is nobody's plugin only what the command line names is imported.
    """
    words: list[str] = []
    try:
        with registry.only_typed(sys.argv[1:]):
            yield words
    except (HydraException, OmegaConfBaseException) as error:
        fail(str(compose.translate_hydra_error(error, words)), BAD_INPUT)
    except ConfigError as error:
        fail(str(error), BAD_INPUT)
    except BrokenPipeError:  # whoever reads has seen enough
        leave(0)
    except FileNotFoundError as error:
        fail(f"The current folder is gone ({error}). Change to one that exists.", FAILED)


def _quoted(word: str) -> str:
    """A word as Hydra's grammar reads it, which knows letters outside of ASCII in quotes alone."""
    name, equals, value = word.partition("=")
    if not equals or value.isascii() or value[:1] in "'\"[{":
        return word
    # Within quotes a backslash is one, but before a quote.
    escaped = re.sub(r"(\\*)('|$)", lambda m: 2 * m[1] + (m[2] and "\\'"), value)
    return f"{name}='{escaped}'"


def _devices(words: Sequence[str]) -> int | None:
    """The number of devices that is asked for, if it is one; what is not is refused later.

    One where trainings are computed elsewhere.
    """
    if any(word.startswith("machines=") and word != "machines=local" for word in words):
        return 1
    values = [word.removeprefix("devices=") for word in words if word.startswith("devices=")]
    return int(values[-1]) if values and re.fullmatch(r"[1-9]\d{0,3}", values[-1]) else None


def guarded(main: Callable[[Given], Result]) -> Callable[[Given], Result]:
    """Decorates a main function: bad input and files that fail become a message and exit code.

    Inside of Hydra's call, as Hydra prints lines of its own for an exception that leaves it.
    """

    @functools.wraps(main)
    def run(given: Given) -> Result:
        try:
            return main(given)
        except ConfigError as error:
            fail(str(error), BAD_INPUT)
        except OSError as error:
            fail(
                f"A file could not be written or read: {error}. All that was written before is "
                f"whole; run the same command again to go on from there.",
                FAILED,
            )
        except FailedError as error:
            fail(str(error), FAILED)
        except RuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error) and "Out of memory" not in str(error):
                raise
            fail(
                f"There is not enough memory: {str(error).splitlines()[0]} Smaller networks, "
                f"buffers or populations need less.",
                FAILED,
            )

    return run


def fail(message: str, status: int) -> NoReturn:
    """Prints the message and ends the process."""
    print(f"error: {message}", file=sys.stderr)
    sys.exit(status)


@contextlib.contextmanager
def interrupts_held() -> Iterator[None]:
    """Ctrl-C is heard at the end of the block, so that what it writes is finished first."""
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    heard: list[int] = []
    signal.signal(signal.SIGINT, lambda number, frame: heard.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if heard:
        raise KeyboardInterrupt


def leave(status: int) -> NoReturn:
    """Ends the process at once, even while a program is still running on the devices."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(BrokenPipeError):
            stream.flush()
    os._exit(status)
