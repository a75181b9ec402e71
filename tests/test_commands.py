"""How the commands start: odd words, folders and terminals."""

import io
import os
import subprocess
import sys

import jax
import pytest

from sejax.cli import commands, runtime
from sejax.options import FailedError


def test_without_a_home_there_is_no_compilation_cache(monkeypatch):
    def nobodys_home():
        raise RuntimeError("Could not determine home directory.")

    changed = []
    monkeypatch.delenv("SEJAX_CACHE_DIR", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(runtime.Path, "home", nobodys_home)
    monkeypatch.setattr(jax.config, "update", lambda *change: changed.append(change))
    runtime.configure_jax()
    assert not [name for name, _ in changed if "cache" in name]


@pytest.mark.parametrize(
    ("words", "devices"),
    [(["devices=3"], 3), (["devices=3", "devices=2"], 2), (["devices=0"], None),
     (["devices=99999999999"], None), (["devices=x"], None), (["seed=1"], None)],
)  # fmt: skip
def test_devices_are_known_before_anything_is_composed(words, devices):
    assert commands._devices(words) == devices


def test_a_terminal_of_few_letters_shows_what_it_can(monkeypatch, tmp_path):
    shown = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdout", shown)
    monkeypatch.setattr(sys, "argv", ["run"])
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(os, "environ", dict(os.environ))
    commands.start(lambda overrides: print("12.0 ± 4.8"), str)
    shown.flush()
    assert shown.buffer.getvalue() == b"12.0 \\xb1 4.8\n"


def test_computing_that_cannot_go_on_is_one_message(capsys):
    with pytest.raises(SystemExit) as left, commands.messages():
        raise FailedError("5 workers have failed.")
    assert left.value.code == commands.FAILED
    assert capsys.readouterr().err == "error: 5 workers have failed.\n"


def test_a_current_folder_that_is_gone_is_one_message(tmp_path):
    gone = tmp_path / "gone"
    gone.mkdir()
    script = "import os, sys; os.rmdir(os.getcwd()); sys.argv = ['run']; " \
             "from sejax.cli import commands; commands.start(print, str)"  # fmt: skip
    done = subprocess.run([sys.executable, "-c", script], cwd=gone, capture_output=True, text=True)
    assert done.returncode == commands.FAILED
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
    assert "Traceback" not in done.stderr
