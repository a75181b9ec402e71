"""The store: entries of the same settings, whole or not there. Kills: test_run_directory.py."""

import numpy as np
import pytest
from support import refusal, refused

from sejax.runs.store import Store

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


def test_entries_of_other_settings_are_refused_with_what_differs(folder):
    error = refusal(Store(folder, SETTINGS | {"seed": 3}, field="work").get, "rounds")
    assert error.field == "work" and "seed (0 there, 3 here)" in str(error)
    more = SETTINGS | {"devices": 2}
    assert Store(folder, more, free={"devices"}).get("rounds")
    with_default = Store(
        folder, SETTINGS | {"new": 1}, completed=lambda stored: stored | {"new": 1}
    )
    assert with_default.get("rounds")


def test_a_damaged_entry_is_refused(folder):
    path = folder / "rounds.safetensors"
    path.write_bytes(path.read_bytes()[:-1])
    assert refused(Store(folder, SETTINGS).get, "rounds") == "run_dir"


def test_a_locked_folder_is_ones_own_and_an_unused_one_is_removed(tmp_path):
    folder = tmp_path / "new"
    with Store(folder, SETTINGS) as store:
        assert refused(Store(folder, SETTINGS).lock) == "run_dir"
    assert not folder.exists()
    with store:
        store.put("rounds")
    assert store.get("rounds") == ({}, {})
