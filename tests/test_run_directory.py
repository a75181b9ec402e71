"""A run directory: resume, damage, kills at every file operation, two processes."""

import errno
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

import sejax
from sejax.cli import checkpoints, metrics, run_lock
from sejax.cli.metrics import COLUMNS
from sejax.cli.run_directory import RunDirectory, open_for
from sejax.errors import ConfigError
from sejax.serialize import flatten

CONFIG = {"seed": 0, "generations": 9, "checkpoint_every": 1, "run_dir": None,
          "es": {"noise_std": 0.0124, "population_size": 16}}  # fmt: skip
SEEDS = [0, 1]
TEMPLATE = {"x": np.zeros(2, np.int64)}


def state_after(generation: int) -> dict[str, np.ndarray]:
    return {"x": np.array([generation, 7 * generation + 1])}


def info_of(start: int, length: int, active=None, **columns) -> SimpleNamespace:
    """Rows that depend on generation and seed only; `[generation, seed]` each."""
    generation = np.broadcast_to(np.arange(start, start + length)[:, None], (length, len(SEEDS)))
    values = {name: (generation / 3 + np.arange(len(SEEDS))).astype(np.float32) for name in COLUMNS}
    values |= {"generation": generation, "active": np.ones(generation.shape, bool)}
    values |= {"num_nonfinite": np.zeros_like(generation), "env_steps_total": generation * 2**31}
    values |= columns if active is None else {**columns, "active": np.array(active)}
    return SimpleNamespace(**values)


def open_run(path: Path, **changes) -> RunDirectory:
    return RunDirectory.open(path, CONFIG | changes, SEEDS)


def go(path: Path, generations: int, chunk: int = 1, **changes) -> int:
    """A session of a run; returns where it went on from, which must be a whole earlier moment."""
    changes = {"generations": generations, "checkpoint_every": chunk} | changes
    with open_run(path, **changes) as directory:
        state, start, _ = directory.resume(TEMPLATE)
        assert state["x"].tolist() == (state_after(start) if start else TEMPLATE)["x"].tolist()
        assert keys(directory.rows) == [(g, s) for g in range(start) for s in SEEDS]
        for generation in range(start, generations, chunk):
            length = min(chunk, generations - generation)
            directory.append(info_of(generation, length), wall_s=1.0)
            directory.proxy.write_text(f"proxy of {generation + length - 1}")
            directory.commit(generation + length, state_after(generation + length))
    return start


def keys(rows) -> list[tuple[int, int]]:
    return [(int(row["generation"]), int(row["seed"])) for row in rows]


def refused(path: Path, message: str, **changes) -> str:
    """The message of a refusal that leaves every file as it is."""
    before = content(path)
    with pytest.raises(ConfigError, match=message) as error, open_run(path, **changes) as directory:
        directory.resume(TEMPLATE)
    assert content(path) == before
    assert str(error.value).endswith("Set run_dir=FOLDER.")
    return str(error.value)


def content(path: Path) -> dict[str, bytes | None]:
    return {str(p.relative_to(path)): p.read_bytes() if p.is_file() else None
            for p in path.rglob("*")}  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A run of five generations."""
    path = tmp_path_factory.mktemp("runs") / "whole"
    go(path, 5)
    return path


@pytest.fixture
def run(whole, tmp_path) -> Path:
    """A copy of it, to be damaged."""
    return Path(shutil.copytree(whole, tmp_path / "run"))


# Resume


def test_a_run_has_these_files(whole):
    assert {path.name for path in whole.iterdir()} == {
        "config.yaml", "metrics.csv", "checkpoint", "proxy.safetensors"
    }  # fmt: skip
    assert (whole / "metrics.csv").read_text().startswith(",".join(COLUMNS) + "\n0,0,")
    assert yaml.safe_load((whole / "config.yaml").read_text()) == CONFIG | {"generations": 5}


@pytest.mark.parametrize("chunk", [1, 2, 5])
def test_a_run_in_two_sessions_equals_one_in_one(whole, tmp_path, chunk):
    go(tmp_path, 3, chunk)
    assert go(tmp_path, 5, chunk) == 3
    for name in ("metrics.csv", "proxy.safetensors"):
        assert (tmp_path / name).read_bytes() == (whole / name).read_bytes()


def test_a_finished_run_is_left_as_it_is(run):
    before = content(run)
    assert go(run, 5) == 5
    assert content(run) == before


def test_rows_after_the_checkpoint_are_dropped(run):
    with (run / "metrics.csv").open("ab") as file:
        file.write(b"5,0" + b",1" * (len(COLUMNS) - 2) + b"\n5,1,0.3")
    assert go(run, 6) == 5


def test_after_a_damaged_checkpoint_the_rows_of_the_one_before_count(run, whole):
    newest = checkpoints.path_of(run / "checkpoint", 5)
    newest.write_bytes(newest.read_bytes()[:-10])
    with open_run(run) as directory:
        _, generation, problems = directory.resume(TEMPLATE)
        assert generation == 4 and len(problems) == 1 and str(newest) in problems[0]
        assert directory.finished_generations == 4
    assert go(run, 5) == 4
    assert (run / "metrics.csv").read_bytes() == (whole / "metrics.csv").read_bytes()


def test_seeds_that_are_over_have_no_more_rows(tmp_path):
    with open_run(tmp_path) as directory:
        directory.resume(TEMPLATE)
        directory.append(info_of(0, 2, [[True, True], [False, True]]), 1.0)
        directory.commit(4, state_after(4))
    with open_run(tmp_path) as directory:
        assert directory.resume(TEMPLATE)[1] == 4
        assert keys(directory.rows) == [(0, 0), (0, 1), (1, 1)]
        assert directory.finished_generations == 2
        directory.append(info_of(4, 1, [[False, False]]), 1.0)


def test_a_generation_that_does_not_follow_on_is_an_error(tmp_path):
    with open_run(tmp_path) as directory:
        directory.resume(TEMPLATE)
        for start in (1, -1):
            with pytest.raises(ValueError, match="seed 0 has 0 generations"):
                directory.append(info_of(start, 1), 1.0)
        assert not directory.metrics.exists()


def test_integers_are_written_as_they_are(tmp_path):
    large = [[2**31, 2**70]]
    info = info_of(0, 1, env_steps_total=large, num_nonfinite=np.array([[2**63 - 1, 0]]))
    with open_run(tmp_path) as directory:
        directory.resume(TEMPLATE)
        directory.append(info, 1.0)
        assert [row["env_steps_total"] for row in directory.rows] == [str(x) for x in large[0]]
        assert directory.rows[0]["num_nonfinite"] == str(2**63 - 1)


def test_floats_read_back_as_the_same_float32(tmp_path):
    values = np.array([[0.1, np.nan], [-np.inf, 1e-45]], np.float32)
    with open_run(tmp_path) as directory:
        directory.resume(TEMPLATE)
        directory.append(info_of(0, 2, incumbent_mean=values), 12.3456)
        read = [np.float32(row["incumbent_mean"]) for row in directory.rows]
        assert directory.rows[0]["wall_s"] == "12.346"
    np.testing.assert_array_equal(read, values.ravel())


def test_several_families_have_columns_of_their_own(tmp_path):
    def open_families(*keys):
        return RunDirectory.open(tmp_path, CONFIG, SEEDS, families=keys)

    info = info_of(0, 1)
    each = np.arange(4).reshape(1, 2, 2)  # [generation, seed, family]
    info.families = SimpleNamespace(**dict.fromkeys(metrics.FAMILY_COLUMNS, each))
    with open_families("ddqn", "ppo") as directory:
        directory.resume(TEMPLATE)
        directory.append(info, 1.0)
        directory.commit(1, state_after(1))
        assert list(directory.rows[0])[-5:] == [
            "num_nonfinite_ddqn", "incumbent_mean_ppo", "population_mean_ppo",
            "train_steps_mean_ppo", "num_nonfinite_ppo",
        ]  # fmt: skip
        written = [[row[f"incumbent_mean_{key}"] for key in ("ddqn", "ppo")]
                   for row in directory.rows]  # fmt: skip
        assert written == [["0", "1"], ["2", "3"]]
        kept = list(directory.rows)
    with open_families("ddqn", "ppo") as directory:
        assert directory.resume(TEMPLATE)[1] == 1 and directory.rows == kept
    assert metrics.columns_of(["ddqn"]) == metrics.columns_of() == COLUMNS


def test_rows_are_the_same_read_or_kept(tmp_path):
    with open_run(tmp_path) as directory:
        directory.resume(TEMPLATE)
        assert directory.rows == []
        directory.append(info_of(0, 2), 1.0)
        kept = list(directory.rows)
        directory._table._rows = None
        assert directory.rows == kept and len(kept) == 4


def test_many_rows_are_added_at_the_end_of_one_file(tmp_path, monkeypatch):
    written, write = [], os.write
    with open_run(tmp_path) as directory:
        directory.resume(TEMPLATE)
        monkeypatch.setattr(os, "fsync", lambda handle: None)
        monkeypatch.setattr(os, "write", lambda h, x: (written.append(len(x)), write(h, x))[1])
        directory.append(info_of(0, 1), 1.0)
        first = directory.metrics.stat()
        for generation in range(1, 10_000):
            directory.append(info_of(generation, 1), 1.0)
        last = directory.metrics.stat()
    assert last.st_ino == first.st_ino and len(written) == 10_000
    assert sum(written) == last.st_size and max(written) < 1000


def test_the_summary_is_json(tmp_path):
    with open_run(tmp_path) as directory:
        directory.write_summary(ended="solved", best_score=1.5)
    assert json.loads((tmp_path / "run.json").read_text()) == {"ended": "solved", "best_score": 1.5}


def test_settings_are_flattened_by_their_names():
    assert flatten({"a": 1, "b": {"c": {"d": 2}, "e": 3}}) == {"a": 1, "b.c.d": 2, "b.e": 3}


def test_a_refusal_does_not_import_jax(run):
    code = (
        "import sys; from sejax.cli.run_directory import RunDirectory\n"
        f"try: RunDirectory.open({str(run)!r}, {{'seed': 3}}, [3])\n"
        "except ValueError as error: print(error)\n"
        "assert 'jax' not in sys.modules"
    )
    (run / "config.yaml").unlink()
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert said.returncode == 0, said.stderr
    assert "seed (0 there, 3 here)" in said.stdout


# Metrics that are not those of the checkpoint (finding 1)


def edit(number: int, change) -> object:
    """An edit of the file's lines, of which 0 names the columns and 1 to 10 are rows."""

    def edited(text: str) -> str:
        lines = text.splitlines(keepends=True)
        lines[number : number + 1] = change(lines[number])
        return "".join(lines)

    return edited


DAMAGE = {
    "a row is missing": (edit(4, lambda row: []), "1 of seed 1 is missing before line 6"),
    "a row is doubled": (edit(4, lambda row: [row, row]), "line 6 has generation 1 of seed 1 once"),
    "the last row is missing": (edit(10, lambda row: []), "seed 1 has 4 of 5 generations"),
    "a digit": (edit(4, lambda row: [row.replace("3333", "3334", 1)]), "not those that were wr"),
    "a digit of the last row": (edit(10, lambda row: [row.replace("1.000", "1.001")]), "not those"),
    "a seed": (edit(4, lambda row: [row.replace("1,1,", "1,5,", 1)]), "line 5 is of seed 5"),
    "columns": (edit(0, lambda row: [row.replace("seed", "sead")]), "line 1 does not name the col"),
    "words": (edit(2, lambda row: ["good morning\n"]), "line 3 is not a row"),
    "a huge number": (edit(2, lambda row: ["9" * 9999 + row]), "line 3 is not a row"),
    "line ends": (lambda text: text.replace("\n", "\r\n"), "line 1 does not name the columns"),
    "nothing": (lambda text: "", "it is empty"),
    "half": (lambda text: text[: len(text) // 2], "seed 0 has 2 of 5 generations"),
    "a doubled row at the end": (lambda text: text + text.splitlines()[-1] + "\n", "once more"),
    "a later row at the end": (lambda text: text + text[text.rfind("\n4,1") + 1 :].replace(
        "4,1", "6,1", 1), "generation 5 of seed 1 is missing before line 12"),
    "words at the end": (lambda text: text + "my notes\n", "line 12 is not a row"),
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGE)
def test_metrics_that_the_checkpoint_does_not_vouch_for_are_refused(run, damage):
    change, message = DAMAGE[damage]
    path = run / "metrics.csv"
    path.write_bytes(change(path.read_text()).encode())
    said = refused(run, "vouches for", generations=8)
    assert message in said and str(path) in said


def test_missing_metrics_are_refused(run):
    (run / "metrics.csv").unlink()
    assert "it is missing" in refused(run, "vouches for")


def test_metrics_that_are_a_folder_are_refused(run):
    (run / "metrics.csv").unlink()
    (run / "metrics.csv").mkdir()
    refused(run, "vouches for.*Is a directory")


@pytest.mark.parametrize("bit", range(8))
def test_a_flipped_bit_anywhere_in_the_metrics_is_refused(run, bit):
    path = run / "metrics.csv"
    data = path.read_bytes()
    table = metrics.Metrics(path, SEEDS)
    with open_run(run) as directory:
        vouched = directory._record["metrics"]
    table.check(vouched)
    for index in range(0, len(data), 7):
        path.write_bytes(data[:index] + bytes([data[index] ^ 1 << bit]) + data[index + 1 :])
        with pytest.raises(metrics.MetricsError):
            table.check(vouched)


def test_metrics_that_another_program_changes_during_the_run_are_an_oserror(tmp_path):
    with open_run(tmp_path) as directory:
        directory.resume(TEMPLATE)
        directory.append(info_of(0, 1), 1.0)
        directory.metrics.write_text("")
        with pytest.raises(OSError, match="another program has changed it"):
            directory.append(info_of(1, 1), 1.0)
        directory.metrics.unlink()
        with pytest.raises(FileNotFoundError):
            directory.append(info_of(1, 1), 1.0)


# Runs that have lost files (findings 4 and 11)


def test_a_run_that_lost_its_checkpoints_is_not_replaced(run):
    shutil.rmtree(run / "checkpoint")
    refused(run, r"keep the checkpoints of a run.*with 5 generations and no whole checkpoint")
    refused(run, "with 5 generations", checkpoint_every=9)


def test_checkpoints_that_are_all_damaged_are_named_in_the_refusal(run):
    for path in (run / "checkpoint").iterdir():
        path.write_bytes(b"")
    said = refused(run, "no whole checkpoint")
    assert said.count("is passed over: it is damaged") == 2


def test_a_checkpoint_of_another_structure_is_named_in_the_refusal(run):
    message = r"\['x'\] is int64\[2\] there, int64\[3\] here"
    with pytest.raises(ConfigError, match=message), open_run(run) as directory:
        directory.resume({"x": np.zeros(3, np.int64)})


def test_proxies_without_metrics_and_checkpoints_are_not_replaced(run):
    shutil.rmtree(run / "checkpoint")
    (run / "metrics.csv").unlink()
    refused(run, r"with proxy\.safetensors, without metrics\.csv and no whole checkpoint")


def test_rows_of_a_first_chunk_that_was_cut_start_anew(tmp_path):
    with open_run(tmp_path, checkpoint_every=3) as directory:
        directory.resume(TEMPLATE)
        directory.append(info_of(0, 3), 1.0)
    assert go(tmp_path, 5, chunk=3) == 0


def test_metrics_of_something_else_are_not_replaced(tmp_path):
    with open_run(tmp_path) as directory:
        directory.resume(TEMPLATE)
    (tmp_path / "metrics.csv").write_text("date,weight\n1 May,80\n")
    refused(tmp_path, "line 1 does not name the columns")


def test_another_configuration_is_refused_with_its_fields(run):
    said = refused(run, "differs in", es={"noise_std": 0.1, "population_size": 16}, seed=1)
    assert "es.noise_std (0.0124 there, 0.1 here), seed (0 there, 1 here)" in said
    assert "population_size" not in said


def test_free_fields_may_change_and_are_written_when_the_run_goes_on(run):
    go(run, 7, run_dir="elsewhere", devices=3)
    stored = yaml.safe_load((run / "config.yaml").read_text())
    assert (stored["generations"], stored["run_dir"], stored["devices"]) == (7, "elsewhere", 3)


def test_a_run_of_a_version_without_a_field_goes_on_with_its_default(tmp_path):
    words = ["proxy=rn", f"run_dir={tmp_path}"]
    with open_for(sejax.config(words)) as directory:
        directory.resume(TEMPLATE)
    stored = yaml.safe_load((tmp_path / "config.yaml").read_text())
    (tmp_path / "proxy.safetensors").touch()  # of a generation
    assert stored["proxy"].pop("output_scale") == 1.0
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(stored))
    with pytest.raises(ConfigError, match=r"proxy.output_scale \(1.0 there, 0.5 here\)\. Take"):
        open_for(sejax.config([*words, "proxy.output_scale=0.5"]))
    with pytest.raises(ConfigError, match=r"es.noise_std \(\S+ there, 0.5 here\)\. Take"):
        open_for(sejax.config([*words, "es.noise_std=0.5"]))
    open_for(sejax.config(words)).close()
    stored["es"]["fashion"] = 1  # of a version that had other fields
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(stored))
    with pytest.raises(ConfigError, match=r"es.fashion \(1 there, None here\)"):
        open_for(sejax.config(words))


def test_a_run_that_failed_before_its_first_generation_is_in_nobodys_way(tmp_path):
    words = [f"run_dir={tmp_path}", "generations=1"]
    with open_for(sejax.config([*words, "proxy.hidden_size=1000"])) as directory:
        directory.resume(TEMPLATE)
    with open_for(sejax.config([*words, "proxy.hidden_size=4"])) as directory:
        directory.resume(TEMPLATE)
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["proxy"]["hidden_size"] == 4


def test_with_the_configuration_lost_that_of_the_checkpoint_counts(run, whole):
    (run / "config.yaml").unlink()
    said = refused(run, "differs in", es={"noise_std": 0.1, "population_size": 16})
    assert "es.noise_std (0.0124 there, 0.1 here)" in said
    assert go(run, 5) == 5
    assert content(run) == content(whole)


def test_an_edited_configuration_is_compared_with_that_of_the_checkpoint(run):
    text = (run / "config.yaml").read_text().replace("0.0124", "0.1")
    (run / "config.yaml").write_text(text)
    refused(run, r"noise_std \(0\.0124 there, 0\.1 here\)",
            es={"noise_std": 0.1, "population_size": 16})  # fmt: skip


@pytest.mark.parametrize("kept", ["metrics.csv", "proxy.safetensors", "checkpoint"])
def test_files_of_a_run_without_any_configuration_are_not_replaced(run, kept):
    for path in (run / "checkpoint").iterdir():
        path.write_bytes(b"")
    for name in {"config.yaml", "metrics.csv", "proxy.safetensors"} - {kept}:
        (run / name).unlink()
    refused(run, "without config.yaml")


CONFIGS = {
    "empty": (b"", "is empty"),
    "null": (b"null\n", "is empty"),
    "a list": (b"- 1\n- 2\n", "holds a list"),
    "a number": (b"3", "holds a int"),
    "not UTF-8": (b"a: \xff\xfe\n", "is not UTF-8 text"),
    "no YAML": (b"a: [1\nb: }", "cannot be read"),
    "a tag": (b"!!python/object/apply:os.system ['true']", "cannot be read"),
    "nested": (b"[" * 1000, "cannot be read"),
    "zeros": (b"\0" * 100, "cannot be read"),
}


@pytest.mark.parametrize("damage", CONFIGS)
def test_a_damaged_configuration_is_one_clear_message(run, damage):
    data, message = CONFIGS[damage]
    (run / "config.yaml").write_bytes(data)
    said = refused(run, "must hold the configuration of its run")
    assert message in said and "\n" not in said and "the newest checkpoint has it too" in said
    shutil.rmtree(run / "checkpoint")
    assert "the newest checkpoint" not in refused(run, "must hold the configuration of its run")


def test_a_configuration_of_another_program_is_refused_briefly(run):
    other = {f"field{i}": "x" * 500 for i in range(100)}
    (run / "config.yaml").write_text(yaml.safe_dump(other))
    assert len(refused(run, "and 9. more")) < 2000


def test_a_checkpoint_of_another_use_is_refused(run):
    checkpoints.save(run / "checkpoint", 6, state_after(6), {"mine": 1})
    refused(run, "must hold checkpoints of its own run")


def test_a_run_of_other_seeds_is_refused(run):
    directory = RunDirectory.open(run, CONFIG, [0, 2])
    with pytest.raises(ConfigError, match="must hold checkpoints of its own run"), directory:
        directory.resume(TEMPLATE)


def test_odd_values_of_a_configuration_are_the_same_when_read_again(tmp_path):
    odd = {"nan": float("nan"), "tuple": (1, 2), "small": 1e-05, "text": "ä\n: #", "none": None,
           "inf": float("inf"), "word": "yes", "bytes": os.fsdecode(b"\xc3\x28")}  # fmt: skip
    go(tmp_path, 1, odd=odd)
    assert go(tmp_path, 2, odd=odd) == 1


def test_a_folder_that_cannot_be_written_is_a_clear_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"must be a folder that can be written.*Set run_dir=F"):
        open_run(tmp_path / "file" / "run")


def test_the_hint_ends_each_refusal(run):
    with pytest.raises(ConfigError, match=r"differs in.*Choose another --out\.$"):
        RunDirectory.open(run, {"seed": 3}, SEEDS, hint="Choose another --out.")


def test_foreign_files_beside_a_run_are_left_alone(run):
    for folder in (run, run / "checkpoint"):
        (folder / "2019").mkdir()
        (folder / "2019" / "photo").write_text("precious")
        (folder / ".notes.csv.abcd1234.csv").write_text("precious")
    go(run, 9)
    for folder in (run, run / "checkpoint"):
        assert (folder / "2019" / "photo").exists()
        assert (folder / ".notes.csv.abcd1234.csv").exists()


# Full disks and kills (findings 9 and 15)


@pytest.mark.parametrize("name", ["write", "fsync", "replace"])
def test_a_full_disk_is_an_oserror_and_loses_nothing(run, monkeypatch, name):
    before = content(run)

    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    with open_run(run) as directory:
        directory.resume(TEMPLATE)
        before |= {"config.yaml": (run / "config.yaml").read_bytes()}
        with monkeypatch.context() as patch:
            patch.setattr(os, name, full)
            with pytest.raises(OSError, match="No space left"):
                directory.append(info_of(5, 1), 1.0)
                directory.commit(6, state_after(6))
            with pytest.raises(OSError, match="No space left"):
                directory.write_summary(ended="solved")
    if name != "replace":
        assert content(run) == before
    assert go(run, 6) == 5


def test_a_row_that_was_half_written_is_taken_back_when_the_disk_is_full(run, monkeypatch):
    write = os.write

    def half(handle, data):
        write(handle, data[: len(data) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    with open_run(run, generations=5) as directory:
        directory.resume(TEMPLATE)
        before = content(run)
        with monkeypatch.context() as patch:
            patch.setattr(os, "write", half)
            with pytest.raises(OSError, match="No space left"):
                directory.append(info_of(5, 1), 1.0)
        assert content(run) == before
        directory.append(info_of(5, 1), 1.0)
        assert len(directory.rows) == 12


class Killed(BaseException):
    """The process is no more."""


def kill_at(patch: pytest.MonkeyPatch, count: int) -> list[str]:
    """From file operation number `count` on none happens; of a write that is it, half does."""
    done: list[str] = []

    def guard(name):
        real = getattr(os, name)

        def operation(*arguments, **options):
            done.append(name)
            if len(done) == count + 1 and name == "write":
                real(arguments[0], arguments[1][: len(arguments[1]) // 2])
            if len(done) > count:
                raise Killed
            return real(*arguments, **options)

        return operation

    for name in ("open", "write", "fsync", "replace", "unlink", "truncate", "ftruncate", "mkdir"):
        patch.setattr(os, name, guard(name))
    return done


def killed(monkeypatch, count: int, *arguments, **options) -> bool:
    """Whether a session of a run met its kill."""
    with monkeypatch.context() as patch:
        kill_at(patch, count)
        try:
            go(*arguments, **options)
        except Killed:
            return True
    return False


def saved(path: Path) -> int:
    newest = checkpoints.newest_record(path / "checkpoint")
    return newest[0] if newest else 0


@pytest.mark.parametrize("chunk", [1, 2])
def test_a_run_killed_at_any_file_operation_goes_on_from_a_whole_moment(
    whole, tmp_path, monkeypatch, chunk
):
    count = 0
    while killed(monkeypatch, count, path := tmp_path / str(count), 5, chunk):
        committed = saved(path)
        assert go(path, 5, chunk) == committed
        assert (path / "metrics.csv").read_bytes() == (whole / "metrics.csv").read_bytes()
        assert {file.name for file in path.iterdir()} == {file.name for file in whole.iterdir()}
        assert not [file for file in path.rglob(".*")], "no temporaries are left"
        count += 1
    assert count > 40


@pytest.mark.parametrize("rows", [0, 1])
def test_a_second_session_killed_at_any_file_operation_does_too(whole, tmp_path, monkeypatch, rows):
    count = 0
    first = tmp_path / "first"
    go(first, 3)
    with open_run(first) as directory:
        directory.resume(TEMPLATE)
        directory.append(info_of(3, rows), 1.0)
    while True:
        path = Path(shutil.copytree(first, tmp_path / str(count)))
        if not killed(monkeypatch, count, path, 5):
            break
        committed = saved(path)
        assert committed >= 3 and go(path, 5) == committed
        assert (path / "metrics.csv").read_bytes() == (whole / "metrics.csv").read_bytes()
        assert (path / "config.yaml").read_bytes() == (whole / "config.yaml").read_bytes()
        count += 1
    assert count > 20


def test_a_first_chunk_that_was_cut_may_be_cut_again_with_other_chunks(
    whole, tmp_path, monkeypatch
):
    count = 0
    first = tmp_path / "first"
    with open_run(first, checkpoint_every=3) as directory:
        directory.resume(TEMPLATE)
        directory.append(info_of(0, 3), 1.0)
        directory.proxy.write_text("proxy of 2")
    while True:
        path = Path(shutil.copytree(first, tmp_path / str(count)))
        if not killed(monkeypatch, count, path, 5, chunk=1):
            break
        committed = saved(path)
        assert go(path, 5) == committed
        assert (path / "metrics.csv").read_bytes() == (whole / "metrics.csv").read_bytes()
        count += 1
    assert count > 40


def test_rows_are_on_the_disk_before_the_checkpoint_that_vouches_for_them(run, monkeypatch):
    done = []
    fsync, replace = os.fsync, os.replace

    def synced(handle):
        done.append(("fsync", os.fstat(handle).st_ino))
        fsync(handle)

    def replaced(source, target):
        done.append(("replace", Path(target).name))
        replace(source, target)

    with open_run(run) as directory:
        directory.resume(TEMPLATE)
        monkeypatch.setattr(os, "fsync", synced)
        monkeypatch.setattr(os, "replace", replaced)
        directory.append(info_of(5, 1), 1.0)
        directory.commit(6, state_after(6))
        rows = ("fsync", directory.metrics.stat().st_ino)
    assert done.index(rows) < done.index(("replace", "sejax-generation-6.safetensors"))


def test_leftovers_of_killed_runs_are_removed_and_those_in_use_are_not(run):
    from sejax.ops.files import atomic_path

    dead = run / ".metrics.csv.sejax-0123abcd.csv"
    dead.write_text("half")
    with atomic_path(run / "picture.png") as temporary:
        go(run, 6)
        assert not dead.exists() and temporary.exists()
    assert (run / "picture.png").exists()


# Two processes (finding 14)

HOLD = """
import sys
from sejax.cli.run_directory import RunDirectory
directory = RunDirectory.open(sys.argv[1], {}, [0])
print("held", flush=True)
sys.stdin.readline()
"""


def hold(path: Path) -> subprocess.Popen[str]:
    """Another process that uses the folder until it reads a line."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(path)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout.readline() == "held\n"
    return process


def test_a_second_process_is_told_who_uses_the_folder(tmp_path):
    with hold(tmp_path) as process:
        said = f"in use by process {process.pid} on {platform.node()}. Wait until it ends, or stop"
        with pytest.raises(ConfigError, match="one process at a time") as error:
            open_run(tmp_path)
        assert said in str(error.value)
        process.communicate("end\n", timeout=60)
    assert not (tmp_path / "sejax.lock").exists()
    open_run(tmp_path).close()


def test_the_lock_of_a_killed_process_is_taken_over(tmp_path):
    with hold(tmp_path) as process:
        process.send_signal(signal.SIGKILL)
        process.wait(timeout=60)
        assert (tmp_path / "sejax.lock").exists()
        with open_run(tmp_path):
            owner = json.loads((tmp_path / "sejax.lock").read_text())
            assert owner == {"pid": os.getpid(), "host": platform.node()}
    assert not (tmp_path / "sejax.lock").exists()


def test_a_folder_is_free_again_after_a_refusal_or_when_it_is_forgotten(run):
    refused(run, "differs in", seed=3)
    directory = open_run(run)
    with pytest.raises(ConfigError, match=f"in use by process {os.getpid()}"):
        open_run(run)
    del directory
    directory = open_run(run)
    directory.close()
    directory.close()


@pytest.mark.parametrize("text", ["", "[]", "\0", '{"pid": "x"}', "9" * 5000])
def test_a_lock_file_that_says_nothing_is_taken_over(tmp_path, text):
    (tmp_path / "sejax.lock").write_text(text)
    open_run(tmp_path).close()


def test_a_lock_that_is_a_link_is_not_followed(tmp_path):
    (tmp_path / "precious").write_text("precious")
    (tmp_path / "sejax.lock").symlink_to(tmp_path / "precious")
    with pytest.raises(ConfigError, match="must be a folder that can be written"):
        open_run(tmp_path)
    assert (tmp_path / "precious").read_text() == "precious"


def test_without_locks_in_the_file_system_a_live_process_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(run_lock, "try_lock", lambda handle: None)
    with open_run(tmp_path), pytest.raises(ConfigError, match=r"remove .*sejax\.lock"):
        open_run(tmp_path)
    open_run(tmp_path).close()


@pytest.mark.parametrize(("host", "free"), [(platform.node(), True), ("elsewhere", False)])
def test_without_locks_only_a_dead_process_of_this_machine_is_stale(
    tmp_path, monkeypatch, host, free
):
    monkeypatch.setattr(run_lock, "try_lock", lambda handle: None)
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait(timeout=60)
    (tmp_path / "sejax.lock").write_text(json.dumps({"pid": ended.pid, "host": host}))
    if free:
        open_run(tmp_path).close()
    else:
        with pytest.raises(ConfigError, match=f"process {ended.pid} on elsewhere"):
            open_run(tmp_path)
