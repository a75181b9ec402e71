"""How the commands start: odd words, folders and terminals."""

import functools
import io
import os
import runpy
import signal
import subprocess
import sys
import threading
import warnings
from importlib.util import find_spec
from pathlib import Path
from unittest.mock import MagicMock

import jax
import pytest
from support import ended, refusal

import sejax
from sejax import __main__ as program
from sejax.options.plain import with_home
from sejax.runs import commands, runtime


def test_a_terminal_of_few_letters_shows_what_it_can(monkeypatch, capsys, tmp_path):
    shown = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdout", shown)
    ended(monkeypatch, capsys, lambda: commands.start(lambda _: print("12.0 ± 4.8"), str))
    shown.flush()
    assert shown.buffer.getvalue() == b"12.0 \\xb1 4.8\n"


def test_a_current_folder_that_is_gone_is_one_message(tmp_path, monkeypatch, capsys):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    status, _, said = ended(monkeypatch, capsys, functools.partial(commands.start, print, str))
    assert status == commands.FAILED and said.startswith("error: ") and said.count("\n") == 1


# --- what people type ----------------------------------------------------------------------------


@pytest.mark.parametrize(("words", "fix"), [
    (["--env", "cartpole"], "Write env=VALUE."), (["--env=cartpole"], "Write env=cartpole."),
    (["acrobot"], "Write env=acrobot or proxy=acrobot."), (["env pole"], "Write env=pole."),
])  # fmt: skip
def test_what_is_no_override_is_answered_with_one(words, fix):
    assert fix in str(refusal(sejax.config, words))


@pytest.mark.parametrize(("words", "code"), [([], 0), (["--help"], 0), (["x=1"], 2)])
def test_without_a_command_they_are_listed_a_line_each(monkeypatch, capsys, words, code):
    status, *said = ended(monkeypatch, capsys, program.main, *words)
    text = said[code > 0].removeprefix("error: There is no command x=1. Write sejax run x=1.\n")
    assert status == code and text.count("\n") == len(program.COMMANDS) + 2
    assert all(f"\n  {name} " in text for name in program.COMMANDS)


@pytest.mark.parametrize("name", program.COMMANDS)
def test_a_command_by_its_word_is_the_module_of_that_name(monkeypatch, capsys, name):
    by_module = functools.partial(runpy.run_module, f"sejax.{name}", None, "__main__", True)
    with warnings.catch_warnings(action="ignore"):  # that it has been imported before
        by_word = ended(monkeypatch, capsys, program.main, name, "--help")
        assert ended(monkeypatch, capsys, by_module, "--help") == by_word
    assert by_word[0] == 0 and by_word[1].count("\n") > 5


def test_an_error_in_code_of_ones_own_ends_with_its_place(monkeypatch, capsys, tmp_path):
    (tmp_path / "my_code.py").write_text("def fails(x):\n    return 1 / x\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    import my_code

    main = functools.partial(commands.start, lambda _: my_code.fails(0), str)
    status, _, said = ended(monkeypatch, capsys, main)
    assert status == commands.FAILED and said.startswith("Traceback")
    raised = "ZeroDivisionError: division by zero (my_code.py:2: return 1 / x)"
    assert said.endswith(f"\nerror: code of your own raised {raised}\n")


def test_sigterm_is_heard_as_ctrl_c_is(monkeypatch, capsys):
    left, again, said = [], [], []
    monkeypatch.setattr(commands, "leave", left.append)
    monkeypatch.setattr(threading, "Timer", lambda *call: again.append(call) or MagicMock())
    before = signal.getsignal(signal.SIGTERM)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's & has it ignored
    for number in (signal.SIGTERM, signal.SIGINT):
        main = functools.partial(commands.start, lambda _, x=number: signal.raise_signal(x), str)
        said.append(ended(monkeypatch, capsys, main)[1])
    signal.signal(signal.SIGTERM, before)
    assert [call[2] for call in again] == [(os.getpid(), signal.SIGTERM)]
    assert left == [143, 130] and all(x.startswith("Interrupted. What has ended") for x in said)


def test_a_platform_that_jax_lacks_is_one_line_with_the_variable(tmp_path):
    platform = "nonsense" if find_spec("jax_cuda12_plugin") else "cuda"
    words = [sys.executable, "-m", "sejax.run", f"run_dir={tmp_path / 'run'}"]
    environment = os.environ | {"JAX_PLATFORMS": platform}
    done = subprocess.run(words, capture_output=True, text=True, env=environment)
    assert done.returncode == commands.BAD_INPUT and not (tmp_path / "run").exists()
    *_, last = done.stderr.splitlines()
    assert last.startswith("error: JAX_PLATFORMS must") and last.endswith("JAX_PLATFORMS=cpu.")


def test_64_bits_are_refused_with_one_line():
    error = jax.enable_x64(True)(refusal)(runtime.configure_jax)
    assert error.field == "jax_enable_x64" and "Set JAX_ENABLE_X64=false." in str(error)


def test_a_tilde_is_the_home_folder_in_every_text(monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    assert sejax.config(["run_dir=~/a"]).folder == Path("/home/me/a")
    assert with_home("sqlite:///~/a.db") == "sqlite:////home/me/a.db"
    assert all(with_home(text) == text for text in ("a~", "~me/a", "/a/~/b", "a:b"))


def test_there_are_as_many_devices_as_any_run_of_a_sweep_needs():
    lines = "devices=1,2", "devices=x", "machines=ray", "machines=ray,local devices=2"
    assert [commands._devices(words.split()) for words in lines] == [2, None, None, 2]
