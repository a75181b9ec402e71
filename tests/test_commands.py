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
from sejax.ops.files import cache_folder
from sejax.options.plain import expanded
from sejax.runs import commands, runtime


def test_without_a_home_there_is_no_compilation_cache(monkeypatch):
    for name in ("SEJAX_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("os.path.expanduser", lambda path: path)  # as where nobody's home is known
    assert cache_folder() is None


@pytest.mark.parametrize(
    ("words", "devices"),
    [(["devices=3"], 3), (["devices=3", "devices=2"], 2), (["devices=0"], None),
     (["devices=99999999999"], None), (["devices=x"], None), (["seed=1"], None)],
)  # fmt: skip
def test_devices_are_known_before_anything_is_composed(words, devices):
    assert commands._devices(words) == devices


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
    assert status == commands.FAILED
    assert said.startswith("error: ") and said.count("\n") == 1


# --- what people type ----------------------------------------------------------------------------


@pytest.mark.parametrize("words", [["--env", "cartpole"], ["--env=cartpole"], ["-agent"]])
def test_an_option_with_dashes_is_answered_with_an_override(monkeypatch, capsys, words):
    main = functools.partial(commands.start, sejax.config, str)
    status, _, said = ended(monkeypatch, capsys, main, *words)
    assert status == commands.BAD_INPUT and said.count("\n") == 1 and "Write env=cartpole" in said


@pytest.mark.parametrize("words", [[], ["--help"]])
def test_without_a_word_the_commands_are_listed_a_line_each(monkeypatch, capsys, words):
    status, said, _ = ended(monkeypatch, capsys, program.main, *words)
    assert status == 0 and said.count("\n") == len(program.COMMANDS) + 2
    assert all(f"\n  {name} " in said for name in program.COMMANDS)


@pytest.mark.parametrize(
    ("word", "meant"), [("train", "sejax run."), ("seed=1", "sejax run seed=1.")]
)
def test_an_unknown_command_lists_the_known_ones(monkeypatch, capsys, word, meant):
    status, _, said = ended(monkeypatch, capsys, program.main, word)
    assert status == commands.BAD_INPUT
    assert said.startswith(f"error: There is no command {word}. Write {meant}\n")
    assert said.count("\n") == len(program.COMMANDS) + 3


@pytest.mark.parametrize("name", program.COMMANDS)
def test_a_command_by_its_word_is_the_module_of_that_name(monkeypatch, capsys, name):
    def by_module():
        runpy.run_module(f"sejax.{name}", run_name="__main__", alter_sys=True)

    with warnings.catch_warnings(action="ignore"):  # that it has been imported before
        by_word = ended(monkeypatch, capsys, program.main, name, "--help")
        assert ended(monkeypatch, capsys, by_module, "--help") == by_word
    assert by_word[0] == 0 and by_word[1].count("\n") > 5


def test_an_error_in_code_of_ones_own_ends_with_its_place(monkeypatch, capsys, tmp_path):
    (tmp_path / "my_code.py").write_text("def fails(x):\n    return 1 / x\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    import my_code

    def main():
        with commands.messages():
            my_code.fails(0)

    status, _, said = ended(monkeypatch, capsys, main)
    assert status == commands.FAILED and said.startswith("Traceback")
    raised = "ZeroDivisionError: division by zero (my_code.py:2: return 1 / x)"
    assert said.endswith(f"\nerror: code of your own raised {raised}\n")


def test_an_error_of_sejaxs_own_is_raised_as_it_is(monkeypatch, capsys):
    with pytest.raises(TypeError):
        ended(monkeypatch, capsys, functools.partial(commands.start, int, str), "x")


def test_sigterm_is_heard_as_ctrl_c_is(monkeypatch, capsys):
    left, again, said = [], [], []
    monkeypatch.setattr(commands, "leave", left.append)
    monkeypatch.setattr(threading, "Timer", lambda *call: again.append(call) or MagicMock())
    before = signal.getsignal(signal.SIGTERM)
    for number in (signal.SIGTERM, signal.SIGINT):
        main = functools.partial(commands.start, lambda _, x=number: signal.raise_signal(x), str)
        said.append(ended(monkeypatch, capsys, main)[1])
    signal.signal(signal.SIGTERM, before)
    assert [call[2] for call in again] == [(os.getpid(), signal.SIGTERM)]
    assert left == [143, 130] and said == ["Interrupted.\n"] * 2


def test_a_platform_that_jax_lacks_is_one_line_with_the_variable(tmp_path):
    platform = "nonsense" if find_spec("jax_cuda12_plugin") else "cuda"
    words = [sys.executable, "-m", "sejax.run", f"run_dir={tmp_path / 'run'}"]
    environment = os.environ | {"JAX_PLATFORMS": platform}
    ended = subprocess.run(words, capture_output=True, text=True, env=environment)
    assert ended.returncode == commands.BAD_INPUT and not (tmp_path / "run").exists()
    *_, last = ended.stderr.splitlines()
    assert last.startswith("error: JAX_PLATFORMS must") and last.endswith("JAX_PLATFORMS=cpu.")


def test_64_bits_are_refused_with_one_line():
    with jax.enable_x64(True):
        error = refusal(runtime.configure_jax)
    assert error.field == "jax_enable_x64" and "Set JAX_ENABLE_X64=false." in str(error)


def test_a_tilde_is_the_home_folder_in_every_text(monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    assert sejax.config(["run_dir=~/a"]).resolved_run_dir == Path("/home/me/a")
    assert expanded("sqlite:///~/a.db") == "sqlite:////home/me/a.db"
    for text in ("a~", "~me/a", "/a/~/b", "a:b"):
        assert expanded(text) == text
