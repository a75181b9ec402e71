"""Checkpoints: what comes back, what is noticed, what is never deleted."""

import errno
import gc
import json
import os
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import save as serialize

from sejax.cli import checkpoints
from sejax.ops import sealed
from sejax.ops.files import remove_leftovers

KIND = "sejax_checkpoint"


def small(value: int = 0) -> dict[str, np.ndarray]:
    return {"x": np.array([value, 2], np.int16)}


def save(folder, *generations: int) -> None:
    for generation in generations:
        checkpoints.save(folder, generation, small(generation), {"at": generation})


def names(folder) -> set[str]:
    return {path.name for path in folder.iterdir()}


def files_of(*generations: int) -> set[str]:
    return {f"sejax-generation-{generation}.safetensors" for generation in generations}


def bits(leaf) -> bytes:
    is_key = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if is_key else leaf).tobytes()


@pytest.mark.parametrize("implementation", ["threefry2x32", "rbg"])
def test_a_state_comes_back_bit_for_bit(tmp_path, implementation):
    state = {
        "key": jax.random.split(jax.random.key(3, impl=implementation), 2),
        "bfloat16": jnp.array([[1.5, -0.0]], jnp.bfloat16),
        "special": jnp.array([jnp.nan, jnp.inf, -0.0, 1e-45]),
        "empty": jnp.zeros((0, 3)),
        "flag": jnp.array(True),
        "host": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "large": np.array(2**62),
        "nested": [(jnp.arange(3), None), {"y": np.uint8(7)}],
    }
    checkpoints.save(tmp_path, 7, state, {"config": {"name": "ä"}})
    restored, generation, record, problems = checkpoints.restore_newest(tmp_path, state)
    assert (generation, record, problems) == (7, {"config": {"name": "ä"}}, [])
    assert jax.tree.structure(restored) == jax.tree.structure(state)
    for got, put in zip(jax.tree.leaves(restored), jax.tree.leaves(state), strict=True):
        assert got.dtype == put.dtype and got.shape == put.shape and bits(got) == bits(put)
        assert isinstance(got, type(put))


def test_restored_leaves_are_tied_to_no_device_and_can_be_changed(tmp_path):
    placed = jax.device_put(jnp.arange(3.0), jax.devices()[1])
    checkpoints.save(tmp_path, 1, {"x": placed, "y": np.arange(3)}, None)
    state, *_ = checkpoints.restore_newest(tmp_path, {"x": placed, "y": np.arange(3)})
    assert not state["x"].committed
    state["y"][0] = 5


def test_the_shapes_of_a_state_are_template_enough(tmp_path):
    state = {"key": jax.random.key(1), "x": jnp.arange(3)}
    checkpoints.save(tmp_path, 1, state, None)
    template = jax.eval_shape(lambda: state)
    restored, generation, _, _ = checkpoints.restore_newest(tmp_path, template)
    assert generation == 1
    assert [bits(x) for x in restored.values()] == [bits(x) for x in state.values()]


def test_without_a_checkpoint_the_template_comes_back(tmp_path):
    template = small()
    state, *rest = checkpoints.restore_newest(tmp_path / "none", template)
    assert state is template and rest == [0, None, []]
    assert checkpoints.newest_record(tmp_path / "none") is None


def test_only_the_newest_two_are_kept(tmp_path):
    save(tmp_path, 1, 2, 9, 10)
    assert names(tmp_path) == files_of(9, 10)


def test_every_flipped_bit_is_noticed(tmp_path):
    save(tmp_path, 5)
    path = checkpoints.path_of(tmp_path, 5)
    whole = path.read_bytes()
    sealed.unseal(whole, KIND)
    for index in range(len(whole)):
        for bit in range(8):
            damaged = bytearray(whole)
            damaged[index] ^= 1 << bit
            with pytest.raises(sealed.DamagedError):
                sealed.unseal(bytes(damaged), KIND)


def test_every_cut_and_every_added_byte_is_noticed(tmp_path):
    save(tmp_path, 5)
    whole = checkpoints.path_of(tmp_path, 5).read_bytes()
    for damaged in [*(whole[:size] for size in range(len(whole))), whole + b"\0", b"\0" + whole]:
        with pytest.raises(sealed.DamagedError):
            sealed.unseal(damaged, KIND)


def test_a_damaged_checkpoint_is_named_and_the_one_before_is_used(tmp_path):
    save(tmp_path, 4, 5)
    newest = checkpoints.path_of(tmp_path, 5)
    newest.write_bytes(newest.read_bytes()[:-1] + b"\xff")
    state, generation, record, problems = checkpoints.restore_newest(tmp_path, small())
    assert (state["x"][0], generation, record) == (4, 4, {"at": 4})
    assert problems == [f"Checkpoint {newest} is passed over: it is damaged, as its content does "
                        f"not match its digest."]  # fmt: skip
    assert checkpoints.newest_record(tmp_path) == (4, {"at": 4})


@pytest.mark.parametrize("manifest", ["[]", "null", "3", "{}", "", "[" * 99999, '{"sha256": 3}'])
def test_a_manifest_that_is_something_else_is_one_sentence(tmp_path, manifest):
    save(tmp_path, 1)
    newest = checkpoints.path_of(tmp_path, 2)
    newest.write_bytes(serialize({}, metadata={KIND: manifest}))
    _, generation, _, problems = checkpoints.restore_newest(tmp_path, small())
    assert generation == 1 and len(problems) == 1 and str(newest) in problems[0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format_version": 2}, "its format is 2, and this version of sejax reads 1"),
        ({"generation": 3}, "it is that of generation 3"),
        ({"generation": "2"}, "it is that of generation '2'"),
        ({"leaves": None}, "its leaves are not described"),
        ({"leaves": [["['x']", "int16[2]"]]}, "its tensors are not those of its"),
        ({"more": 1}, "its manifest is not that of a checkpoint"),
    ],
)
def test_a_whole_file_that_says_something_else_is_one_sentence(tmp_path, changes, message):
    manifest = {"format_version": 1, "generation": 2, "leaves": [], "record": None} | changes
    newest = checkpoints.path_of(tmp_path, 2)
    newest.write_bytes(sealed.seal({}, KIND, manifest))
    _, generation, _, problems = checkpoints.restore_newest(tmp_path, small())
    assert generation == 0 and len(problems) == 1 and message in problems[0]


@pytest.mark.parametrize(
    ("template", "message"),
    [
        ({"x": np.zeros(3, np.int16)}, "['x'] is int16[2] there, int16[3] here"),
        ({"x": np.zeros(2, np.int32)}, "['x'] is int16[2] there, int32[2] here"),
        ({"y": np.zeros(2, np.int16)}, "['y'] is missing there, int16[2] here"),
        ({}, "['x'] is int16[2] there, missing here"),
    ],
)
def test_a_state_of_another_structure_is_one_sentence(tmp_path, template, message):
    save(tmp_path, 1)
    state, generation, _, problems = checkpoints.restore_newest(tmp_path, template)
    assert state is template and generation == 0
    assert len(problems) == 1 and f"its state has another structure ({message})" in problems[0]


def test_a_key_of_another_kind_is_another_structure(tmp_path):
    checkpoints.save(tmp_path, 1, {"key": jax.random.key(0)}, None)
    template = {"key": jax.random.key(0, impl="rbg")}
    _, _, _, problems = checkpoints.restore_newest(tmp_path, template)
    assert "['key'] is key<fry>[] there, key<rbg>[] here" in problems[0]


def test_files_and_folders_of_others_survive(tmp_path):
    theirs = ["2019", "2020", "2021", "2022", "99999", "sejax-generation-3.safetensors.d"]
    for name in theirs:
        (tmp_path / name).mkdir()
        (tmp_path / name / "photo").write_text("precious")
    for name in ("0.json", "sejax-generation-007.safetensors", "sejax-generation-²"):
        (tmp_path / name).write_text("precious")
        theirs.append(name)
    save(tmp_path, *range(6))
    assert names(tmp_path) == {*theirs, *files_of(4, 5)}
    assert all((tmp_path / name / "photo").exists() for name in theirs[:6])


def test_a_file_of_others_with_our_name_survives(tmp_path):
    for generation in (1, 2, 3):
        checkpoints.path_of(tmp_path, generation).write_text("precious")
    checkpoints.path_of(tmp_path, 4).mkdir()
    save(tmp_path, 5, 6, 7, 8)
    assert names(tmp_path) == files_of(1, 2, 3, 4, 7, 8)


def test_files_of_higher_numbers_do_not_cost_our_own(tmp_path):
    for generation in (50, 60, 70):
        checkpoints.path_of(tmp_path, generation).write_text("")
    save(tmp_path, 1, 2, 3)
    assert names(tmp_path) == files_of(2, 3, 50, 60, 70)
    assert checkpoints.restore_newest(tmp_path, small())[1] == 3


def test_nothing_is_deleted_through_a_link(tmp_path):
    elsewhere, run = tmp_path / "elsewhere", tmp_path / "run"
    save(elsewhere, 1, 2)
    run.mkdir()
    for generation in (1, 2):
        checkpoints.path_of(run, generation).symlink_to(checkpoints.path_of(elsewhere, generation))
    save(run, 3, 4, 5)
    assert names(elsewhere) == files_of(1, 2) and names(run) == files_of(1, 2, 4, 5)
    (tmp_path / "linked").symlink_to(elsewhere)
    save(tmp_path / "linked", 3, 4)
    assert names(elsewhere) == files_of(1, 2, 3, 4)


def test_a_full_disk_leaves_the_checkpoints_before(tmp_path, monkeypatch):
    save(tmp_path, 1, 2)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(handle, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        with pytest.raises(OSError, match="No space left"):
            save(tmp_path, 3)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_is_read_only_is_an_oserror(tmp_path):
    save(tmp_path, 1)
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(OSError):
            save(tmp_path, 2)
    finally:
        tmp_path.chmod(0o700)


def test_a_file_is_on_the_disk_before_it_takes_its_name(tmp_path, monkeypatch):
    done, fsync, replace = [], os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (done.append("sync"), fsync(handle)))
    monkeypatch.setattr(os, "replace", lambda a, b: (done.append("name"), replace(a, b)))
    save(tmp_path, 1)
    assert done == ["sync", "name"]


def test_many_saves_leave_nothing_behind(tmp_path):
    state = {"key": jax.random.key(0), "x": jnp.ones(1000)}

    def objects_and_files_after(count: int) -> tuple[int, int]:
        for generation in range(count):
            checkpoints.save(tmp_path, generation, state, {"config": {"a": 1}})
        gc.collect()
        return len(gc.get_objects()), len(os.listdir("/dev/fd"))

    objects, files = objects_and_files_after(20)
    more_objects, more_files = objects_and_files_after(100)
    assert more_objects - objects < 50 and more_files == files
    shutil.rmtree(tmp_path)


def test_a_checkpoint_can_be_read_without_sejax(tmp_path):
    from safetensors import safe_open

    save(tmp_path, 3)
    with safe_open(checkpoints.path_of(tmp_path, 3), "np") as file:
        assert json.loads(file.metadata()[KIND])["record"] == {"at": 3}
        assert file.get_tensor("0000['x']").tolist() == [3, 2]


def test_leftovers_of_killed_processes_go_and_all_else_stays(tmp_path):
    dead = [".a.csv.sejax-0123abcd.csv", ".b.sejax-0123abcd", "..c.sejax-0123abcd"]
    theirs = [".a.csv.x1y2z3w4.csv", ".a.csv.sejax-0123abcd.txt", "a.sejax-0123abcd", ".sejax",
              ".a.csv.sejax-0123ABCD.csv", ".a.csv.sejax-0123abcd0.csv"]  # fmt: skip
    for name in dead + theirs:
        (tmp_path / name).write_text("x")
    (tmp_path / ".d.sejax-0123abcd").mkdir()
    (tmp_path / ".e.sejax-0123abcd").symlink_to(tmp_path / "a.sejax-0123abcd")
    assert sorted(path.name for path in remove_leftovers(tmp_path)) == sorted(dead)
    assert names(tmp_path) == {*theirs, ".d.sejax-0123abcd", ".e.sejax-0123abcd"}
    assert remove_leftovers(tmp_path / "none") == []
