"""The store: entries of the same settings, whole or not there. Kills: test_run_directory.py."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from support import refusal, refused

from sejax.ops.checksummed import pack, unpack
from sejax.runs.store import LOCK, Store

SETTINGS = {"env": {"name": "cartpole"}, "seed": 0, "sizes": (1, 2), "devices": 1}


@pytest.fixture
def folder(tmp_path):
    """A store with one entry."""
    Store(tmp_path, SETTINGS).put("rounds", {"x": np.float32([1, np.nan])}, rows=[{"a": 1}])
    return tmp_path


def test_an_entry_comes_back_and_another_is_none(folder):
    store = Store(folder, SETTINGS)
    tensors, values = store.get("rounds")
    np.testing.assert_array_equal(tensors["x"], np.float32([1, np.nan]))
    assert values == {"rows": [{"a": 1}]} and store.get("others") is None
    store.put("rounds", text="x" * 100_000)
    assert store.get("rounds") == ({}, {"text": "x" * 100_000})
    assert [path.name for path in folder.iterdir()] == ["rounds.safetensors"]


def test_entries_of_other_settings_are_refused_with_what_differs(folder, monkeypatch):
    error = refusal(Store(folder, SETTINGS | {"seed": 3}, field="work").get, "rounds")
    assert error.field == "work" and "seed (0 there, 3 here)" in str(error)
    assert Store(folder, SETTINGS | {"devices": 2}, free={"devices"}).get("rounds")
    with_default = Store(folder, SETTINGS | {"new": 1})
    monkeypatch.setattr(Store, "completed", lambda _, stored: stored | {"new": 1})
    assert with_default.get("rounds") and Store(folder, SETTINGS).get("rounds")


def test_odd_settings_are_the_same_when_read_again(tmp_path):
    odd = {"nan": float("nan"), "tuple": (1, 2), "small": 1e-05, "text": "ä\n: #", "none": None,
           "inf": float("inf"), "word": "yes", "bytes": os.fsdecode(b"\xc3\x28")}  # fmt: skip
    Store(tmp_path, odd).put("rounds")
    assert Store(tmp_path, odd).get("rounds") == ({}, {})


# --- damage --------------------------------------------------------------------------------------


def test_every_flipped_bit_and_lost_byte_is_noticed():
    whole = pack({"x": np.arange(3)}, "note", {"text": "three", "format_version": 1})
    assert unpack(whole, "note")[1]["text"] == "three"
    flipped = [
        whole[:place] + bytes([whole[place] ^ 1 << bit]) + whole[place + 1 :]
        for place in range(len(whole))
        for bit in range(8)
    ]
    lost = [whole[:place] + whole[place + 1 :] for place in range(len(whole))]
    added = [whole[:place] + b"0" + whole[place:] for place in range(len(whole) + 1)]
    for damaged in (*flipped, *lost, *added):
        with pytest.raises(ValueError, match=r"it cannot be read|its content does not match"):
            unpack(damaged, "note")


def test_a_damaged_entry_or_a_folder_is_refused(folder):
    path, store = folder / "rounds.safetensors", Store(folder, SETTINGS)
    (folder / "other.safetensors").write_bytes(path.read_bytes())
    path.write_bytes(path.read_bytes()[:-1])
    assert refused(store.get, "rounds") == refused(store.get, "other") == "run_dir"
    path.unlink()
    path.mkdir()
    assert refused(store.get, "rounds") == "run_dir"


# --- locks ---------------------------------------------------------------------------------------


HOLD = """
import pathlib, sys
from sejax.runs.store import Store
with Store(pathlib.Path(sys.argv[1]), {}):
    print("held", flush=True)
    sys.stdin.readline()
"""


def test_a_folder_is_a_processs_own_until_it_is_killed_and_unused_it_is_removed(tmp_path):
    folder = tmp_path / "new"
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    with process:
        assert process.stdout.readline() == "held\n"
        assert refused(Store(folder, SETTINGS).__enter__) == "run_dir"
        process.send_signal(signal.SIGKILL)
        process.wait(timeout=60)
    with Store(folder, SETTINGS) as store:
        assert refused(Store(folder, SETTINGS).__enter__) == "run_dir"
        store.put("rounds")
    assert store.get("rounds") == ({}, {})
    with Store(folder, SETTINGS) as first:
        (folder / LOCK).unlink()  # by hand, as if it were stale
        with Store(folder, SETTINGS), pytest.raises(FileNotFoundError):
            first.put("rounds")
    with Store(tmp_path / "other", SETTINGS):
        pass
    assert not (tmp_path / "other").exists()
