"""`python -m sejax.distill`: the command, its files, resuming, and policies that it is given."""

import os
import shutil
import sys
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from support import refusal, refused

import sejax
from sejax.distill import main
from sejax.distillation import distilling
from sejax.distillation.config import folder_of, read
from sejax.ops import checksummed
from sejax.options import ConfigError
from sejax.proxies import header, zoo

QUICK = (
    *("env=cartpole", "devices=1", "search.num_directions=4", "search.num_top=2"),
    *("search.generations=4", "search.test_every=1", "search.num_tests=2", "num_snapshots=2"),
    *("search.num_starts=2", "search.start_generations=2"),
    *("num_students=2", "num_tested=2", "training.max_steps=60", "training.max_episodes=60"),
    *("training.test_episodes=2", "agent=ddqn"),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("distilled") / "run"
    main([*QUICK, f"run_dir={path}"])
    return path


def test_it_writes_an_se_that_says_what_it_is(folder):
    shown = zoo.describe(header.read(folder))
    curve, rows = pd.read_csv(folder / "search.csv"), pd.read_csv(folder / "students.csv")
    assert curve["generation"].tolist() == [1, 2, 1, 2, 3, 4]
    best = int(curve["start"][curve["test_mean"].iloc[:4].idxmax()])
    assert curve["start"].tolist() == [0, 0, 1, 1, best, best]
    assert rows.groupby(["use", "agent"]).size().to_dict() == {
        ("choose", "ddqn"): 4,
        ("test", "ddqn"): 2,
    }
    assert shown.is_distilled and shown.row["learned with"] == "a policy"
    assert "| policy_return |" in (folder / "card.md").read_text()
    tested = rows[rows["use"] == "test"].groupby("agent")["test_return"].mean()
    assert {x.agent: x.return_mean for x in shown.evaluations} == pytest.approx(tested.to_dict())
    # Searches, the recorded episodes, and all tests of students.
    steps = curve["real_steps"].sum() + rows["real_steps"].sum()
    assert shown.learning.real_steps == steps
    assert shown.learning.train_steps == 6 * 60
    assert rows["policy_return"][rows["use"] == "test"].unique() == [shown.policy_return]


def test_the_se_that_teaches_best_is_kept(folder):
    rows = pd.read_csv(folder / "students.csv")
    chosen = rows[rows["use"] == "choose"].groupby(["generation", "agent"])["test_return"]
    marks = ((chosen.mean() + chosen.min()) / 2).groupby("generation").mean()
    assert sejax.load_proxy(folder).record["generation"] == marks.idxmax()
    assert set(rows[rows["use"] == "test"]["generation"]) == {marks.idxmax()}


@pytest.mark.parametrize("kept", [1, 2, 3, 5])  # tests, of both starts and of the one that went on
def test_a_killed_search_goes_on_to_the_same_se(folder, tmp_path, kept):
    tensors, manifest = checksummed.read(folder / distilling.CHECKPOINT, distilling.KIND)
    half = {name: x[:kept] for name, x in tensors.items()}
    manifest["rows"] = manifest["rows"][:kept]
    packed = checksummed.pack(half, distilling.KIND, manifest)
    (tmp_path / distilling.CHECKPOINT).write_bytes(packed)
    main([*QUICK, f"run_dir={tmp_path}"])
    names = ["use", "generation", "agent", "student", "test_return"]
    one, two = (pd.read_csv(x / "students.csv")[names] for x in (folder, tmp_path))
    pd.testing.assert_frame_equal(one, two)
    assert sejax.load_proxy(folder).fingerprint == sejax.load_proxy(tmp_path).fingerprint


def test_students_that_have_trained_do_not_train_again(folder, tmp_path, monkeypatch):
    path, teach, calls = shutil.copytree(folder, tmp_path / "copy"), distilling.teaching.teach, []
    shutil.rmtree(path / "students")
    for name in ("students.csv", "proxy.safetensors"):
        (path / name).unlink()

    def killed(*args):
        if len(calls) == 1:
            raise KeyboardInterrupt
        calls.append(args)
        return teach(*args)

    monkeypatch.setattr(distilling.teaching, "teach", killed)
    own, config = read([*QUICK, f"run_dir={path}"])
    with pytest.raises(KeyboardInterrupt):
        distilling.distill(own, config, path)
    monkeypatch.setattr(distilling.teaching, "teach", lambda *x: calls.append(x) or teach(*x))
    distilling.distill(own, config, path)
    names = ["use", "generation", "agent", "student", "test_return"]
    one, two = (pd.read_csv(x / "students.csv")[names] for x in (folder, path))
    pd.testing.assert_frame_equal(one, two)
    assert len(calls) == len(one.groupby(["use", "agent"]))  # each kind once


def test_a_policy_whose_file_has_changed_gets_students_of_its_own(tmp_path):
    path, kernel = tmp_path / "policy.npz", np.zeros((2, 4), np.float32)
    words = [*QUICK, f"policy={path}", f"run_dir={tmp_path / 'run'}"]
    for sign in (1.0, -1.0):
        kernel[1] = sign * np.array([0, 0, 1.0, 0.6])
        np.savez(path, kernel_0=kernel, bias_0=np.zeros(2, np.float32))
        main(words)
        rows = pd.read_csv(tmp_path / "run" / "students.csv")
        shown = zoo.describe(header.read(tmp_path / "run"))
        assert rows["policy_return"].unique() == pytest.approx([shown.policy_return])
    assert len(list((tmp_path / "run" / "students").iterdir())) == 2


def test_a_folder_of_another_command_is_left_alone(folder, tmp_path):
    path = shutil.copytree(folder, tmp_path / "copy")
    words = [*QUICK, f"run_dir={path}"]
    for other, said in (
        ("search.step_size=0.5", "search.step_size (0.02 there, 0.5 here)"),
        (f"policy={__name__}:act", "policy (None there"),
        ("agent=dqn", "with agent"),
    ):
        assert said in str(refusal(main, [*words, other]))
    os.truncate(path / distilling.CHECKPOINT, 200)
    assert "damaged" in str(refusal(main, words))
    for text in ("", "a: ["):
        (path / distilling.ASKED).write_text(text)
        assert "must hold distill.yaml as it was written" in str(refusal(main, words))


def act(obs):
    """A policy that a test distils by its name."""
    return (obs[:, 2] + 0.6 * obs[:, 3] > 0).astype(int)


def of_another_shape(obs):
    return np.zeros((len(obs), 2))


def out_of_range(obs):
    return np.full(len(obs), 7)


def fails(obs):
    return 1 // 0


def test_a_run_of_another_command_is_not_overwritten(tmp_path):
    (tmp_path / "checkpoint.safetensors").touch()
    assert refused(main, [*QUICK, f"run_dir={tmp_path}"]) == "run_dir"


def test_files_of_other_things_are_refused(tmp_path):
    np.savez(tmp_path / "other.npz", weights=np.zeros(3))
    np.savez(tmp_path / "turned.npz", kernel_0=np.zeros((4, 2)), bias_0=np.zeros(2))
    for name in ("other", "turned"):
        with pytest.raises(ConfigError, match="policy must"):
            main([*QUICK, f"run_dir={tmp_path}/run", f"policy={tmp_path}/{name}.npz"])


def test_policies_come_from_files_and_functions(tmp_path, capsys):
    layers = {"kernel_0": np.array([[0, 0, 0, 0], [0, 0.3, 1, 0.6]]), "bias_0": np.zeros(2)}
    np.savez(tmp_path / "linear.npz", **layers)
    words = [*QUICK, "copy.episodes=2"]
    main([*words, f"policy={tmp_path}/linear.npz", f"run_dir={tmp_path}/run"])
    assert "policy 200.0\n" in capsys.readouterr().out
    assert sejax.load_proxy(tmp_path / "run").record["policy_return"] == 200.0
    quick = ("copy.rounds=1", "copy.steps=20", "copy.hidden_size=4")
    main([*words, *quick, f"policy={__name__}:act", f"run_dir={tmp_path}/other"])
    assert "its copy" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["reward_form=quadratic"], "reward_form must be left out where actions are discrete"),
        (["num_snapshots=5"], "num_snapshots must be at most 4"),
        (["search.num_top=5"], "search.num_top must be at most search.num_directions"),
        (["search.generationz=5"], "Did you mean search.generations"),
        (["training.stop_rule=plateau"], "training.stop_rule must be never"),
        (["policy=sac"], "policy must be a file or a function"),
        (["policy=nothing.npz"], "policy must be a file of kernel_0"),
        (["policy=nothing:act"], "policy must name a module that can be imported"),
        (["policy=dqn:nothing.zip"], "policy must name an algorithm and a file"),
        (["agent=nothing"], "agent must be one of"),
        (["generations=5"], "generations must be left out .* Set search.generations=N"),
        (["proxy.hidden_size=5"], "proxy.hidden_size must be left out"),
        (["env=cliff_walking"], "must"),
        ([f"policy={__name__}:of_another_shape"], r"policy must give whole numbers from 0 to 1"),
        ([f"policy={__name__}:out_of_range"], r"policy must give whole numbers from 0 to 1"),
        ([f"policy={__name__}:fails"], "policy must act in cartpole; it raised ZeroDivisionError"),
    ],
)
def test_what_cannot_be_is_refused(words, message, tmp_path):
    with pytest.raises(ConfigError, match=message):
        main([*QUICK, f"run_dir={tmp_path}/runs/a", *words])
    assert not (tmp_path / "runs").exists()


def test_the_bonus_for_health_is_left_out_of_searches():
    assert read(["env=hopper"])[0].search.alive_bonus == 1.0
    assert read(["env=hopper", "search.alive_bonus=0"])[0].search.alive_bonus == 0.0
    assert read(["env=halfcheetah"])[0].search.alive_bonus == 0.0
    assert read(["env=halfcheetah"])[1].training.max_steps == 10_000


def test_the_default_folder_tells_policies_apart():
    names = []
    for words in ([], ["policy=ppo:a/model.zip"], ["policy=dqn:model.zip"], ["policy=linear.npz"],
                  ["policy=mine:act"]):  # fmt: skip
        names.append(folder_of(*read(["env=cartpole", *words])).name)
    assert names == ["distill-cartpole-s0", "distill-cartpole-ppo-model-s0",
                     "distill-cartpole-dqn-model-s0", "distill-cartpole-linear-s0",
                     "distill-cartpole-mine-act-s0"]  # fmt: skip


def test_a_model_of_another_algorithm_is_one_line(tmp_path, monkeypatch):
    class DQN:
        @staticmethod
        def load(path, device):
            raise AttributeError("'ActorCriticPolicy' object has no attribute 'q_net'")

    monkeypatch.setitem(sys.modules, "stable_baselines3", SimpleNamespace(DQN=DQN))
    (tmp_path / "ppo.zip").write_bytes(b"")
    words = [*QUICK, f"run_dir={tmp_path / 'run'}", f"policy=dqn:{tmp_path}/ppo.zip"]
    with pytest.raises(
        ConfigError, match=r"policy must be a model that DQN saved; got dqn:.*q_net"
    ):
        main(words)
    assert not (tmp_path / "run").exists()
