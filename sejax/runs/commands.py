"""What the commands share: their start, `--help`, exit codes, and messages."""

import contextlib
import inspect
import io
import os
import re
import signal
import sys
import textwrap
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import yaml

from sejax.options import ConfigError, FailedError, as_text, place_of, registry, require, told
from sejax.options.plain import merge
from sejax.runs import presets, runtime
from sejax.runs.command_config import CommandConfig
from sejax.runs.words import expand

BAD_INPUT, FAILED, INTERRUPTED, CLOSED = 2, 1, 130, 141  # as shells give SIGINT and SIGPIPE
HELP, PRINT_CONFIG = ("--help", "-h"), "--print-config"


def start(
    main: Callable[[Sequence[str]], object],
    help_text: Callable[[Sequence[str]], str],
    configs_of: Callable[[Sequence[str]], Iterable[CommandConfig]] | None = None,
    resumes: bool = True,
) -> None:
    """Runs a command on the words of the command line; errors become a message and an exit code.

    Args:
      main: the command, a function of its overrides.
      help_text: the text of `--help`, a function of the overrides.
      configs_of: the configurations that `--print-config` prints, a function of the overrides; None
        if the command lacks this option.
      resumes: whether the same command goes on from what is saved.
    """
    words = sys.argv[1:]
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _stop)
    goes_on = " What has ended is saved; the same command goes on from there."
    with messages(goes_on if resumes else ""):
        is_known = configs_of or PRINT_CONFIG not in words
        require(is_known, PRINT_CONFIG, "is of sejax.run and sejax.evaluate alone. Leave it out.")
        overrides = [word for word in words if word not in (*HELP, PRINT_CONFIG)]
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="backslashreplace")  # as stderr; for terminals in ASCII
        if sys.path[0] != "":  # `python -m` has put the current folder there, if it still exists
            sys.path.insert(0, "")
        Path.cwd()  # raises if the folder is gone
        runtime.configure_xla(_devices(overrides))  # before a plugin starts jax's devices
        if {*HELP} & {*words}:
            print(help_text(overrides))
        elif configs_of and PRINT_CONFIG in words:
            configs = (config.plain() for config in configs_of(overrides))
            print(yaml.safe_dump_all(configs, sort_keys=False), end="")
        else:
            runtime.configure_jax()
            main(overrides)


def help_of(command: type[CommandConfig], about: str | None, overrides: Sequence[str]) -> str:
    """What `--help` prints: about the command, choices of each group, fields of the words' choices.

    If a value is not the default, the layer that sets it stands beside it.
    """
    overrides = [*command.help_words, *expand(overrides)[0]]  # the first run of a sweep
    layers = command.layers_of(overrides)
    tree = merge(*layers.values())
    config = command.of_tree(tree)
    lines = [str(about), "Choices (group=choice):"]
    for group in ("agent", *command.groups()):
        prefixes = [f"{prefix}ID" for prefix in registry.PREFIXES if group == "env"]
        names = ", ".join([*registry.names(group), *prefixes, "module:attribute"])
        lines += [textwrap.fill(f"  {group}: {names}", 98, subsequent_indent=" " * 6)]
    lines += ["  agents: [agent,agent,...]"]
    if "preset" in vars(config):
        known = presets.sections_of(*(presets.choice_in(tree, x) for x in ("env", "proxy")))
        lines += [f"  preset: {', '.join([*known, 'FILE.yaml'])}"]
    lines += ["", "Fields of these choices (field=value), with their values:"]
    classes = [("", command), *((name, type(x)) for name, x in vars(config).items())]
    classes += [(config.group_of(key), type(x)) for key, x in config.agents.items()]
    sources = dict[str, str]()
    for layer, values in layers.items():
        source = "" if layer == "default" else f" ({layer})"
        sources |= dict.fromkeys(config.in_words(values), source)
    choices = (*command.groups(), *map(config.group_of, config.agents))
    fields = {name: x for name, x in config.in_words(config.plain()).items() if name not in choices}
    return "\n".join([*lines, field_lines(fields, classes, sources)])


def field_lines(
    values: Mapping[str, Any], classes: Iterable[tuple[str, type]], sources: Mapping[str, str]
) -> str:
    """Lines of `--help`: each field with its value, its text, and where its value comes from.

    Args:
      values: plain values by the fields' names.
      classes: groups of fields, each with the class whose docstring has the texts.
      sources: texts for the ends of the lines, such as the layer that sets a value.
    """
    of_groups = ((group, help_texts(cls).items()) for group, cls in classes)
    texts = {f"{group}.{name}".lstrip("."): x for group, of_cls in of_groups for name, x in of_cls}
    lines = []
    for name, value in values.items():
        text = texts.get(name, texts.get(".".join(name.split(".")[:2])))  # a key's is its field's
        about = f"  # {text}" if text else ""
        line = f"  {name}={as_text(value)}{about}{sources.get(name, '')}"
        lines.append(textwrap.fill(line, 98, subsequent_indent=" " * 6, break_long_words=False))
    return "\n".join(lines)


def help_texts(cls: type) -> dict[str, str]:
    """The texts of attributes by name, from the docstrings of a class, its bases, or a function."""
    texts: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        doc = inspect.cleandoc(base.__doc__ or "")
        sections = re.findall(r"^(?:Attributes|Args):\n((?:  .*\n?|\n)*)", doc, re.MULTILINE)
        entries = re.findall(r"^  (\w+): (.*(?:\n    .*)*)", "".join(sections), re.MULTILINE)
        texts |= {name: " ".join(text.split()) for name, text in entries}
    return texts


def _stop(number: int, frame: FrameType | None) -> NoReturn:
    """Treats SIGTERM as Ctrl-C, with the exit code that shells give SIGTERM."""
    # A library's callback may swallow the exception; then a second signal raises it again.
    again = threading.Timer(2.0, os.kill, (os.getpid(), number))
    again.daemon = True
    again.start()
    raise KeyboardInterrupt(128 + number)


def _devices(overrides: Sequence[str]) -> int | None:
    """The largest number that words `devices=` ask for, before these are checked; None without."""
    texts = [word.removeprefix("devices=") for word in overrides if word.startswith("devices=")]
    return max(map(int, re.findall(r"\b[1-9]\d{0,3}\b", ",".join(texts))), default=None)


@contextlib.contextmanager
def messages(goes_on: str = "") -> Iterator[None]:
    """Ends the process with one message if its block meets bad input or a file that fails.

    Args:
      goes_on: what follows "Interrupted.", after Ctrl-C or SIGTERM.
    """
    try:
        yield
    except ConfigError as error:
        fail(runtime.platform_error() or str(error), BAD_INPUT)
    except KeyboardInterrupt as stop:
        print(f"Interrupted.{goes_on}", flush=True)
        leave(stop.args[0] if stop.args else INTERRUPTED)
    except BrokenPipeError:  # the reader has closed the pipe
        leave(CLOSED)
    except FailedError as error:
        fail(str(error), FAILED)
    except OSError as error:
        message = f"A file could not be written or read: {error}. Files written before are whole"
        fail(f"{message}; run the same command again.", FAILED)
    except Exception as error:
        if message := runtime.platform_error():
            fail(message, BAD_INPUT)
        if "RESOURCE_EXHAUSTED" in str(error) or "Out of memory" in str(error):
            message = f"There is not enough memory: {str(error).splitlines()[0]}"
            fail(f"{message} Smaller networks, buffers or populations need less.", FAILED)
        if not place_of(error):
            raise
        traceback.print_exc()
        fail(f"code of your own raised {told(error)}", FAILED)


def fail(message: str, status: int) -> NoReturn:
    """Prints the message and ends the process."""
    print(f"error: {message}", file=sys.stderr)
    sys.exit(status)


def leave(status: int) -> NoReturn:
    """Ends the process at once, even while a program is still running on the devices."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(BrokenPipeError):
            stream.flush()
    os._exit(status)
