"""`python -m sejax.distill`: the command, its files, resuming, and policies that it is given."""

import os
import shutil
import sys
from types import SimpleNamespace

import jax
import numpy as np
import pandas as pd
import pytest
from support import refused

import sejax
from sejax.distill import policies, teaching
from sejax.distill.__main__ import DistillConfig, evaluations_of, main
from sejax.proxies import header, zoo

QUICK = (
    *("env=cartpole", "agent=ddqn", "devices=1", "num_students=2", "num_tested=2"),
    *("search.num_directions=4", "search.num_top=2", "search.generations=4", "num_snapshots=2"),
    *("search.test_every=1", "search.num_tests=2", "search.num_starts=2"),
    *("search.start_generations=2", "training.max_steps=60", "training.test_episodes=2"),
    *("copy.rounds=1", "copy.episodes=2", "copy.steps=300", "copy.hidden_size=0"),
)
POLICY = f"policy={__name__}:act"
SIGN = 1.0  # of the policy that a test distils by its name


def act(obs):
    return (SIGN * (obs[:, 2] + 0.6 * obs[:, 3]) > 0).astype(int)


def of_another_shape(obs):
    return np.zeros((len(obs), 2))


def out_of_range(obs):
    return np.full(len(obs), 7)


def fails(obs):
    return 1 // 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("distilled") / "run"
    main([*QUICK, f"run_dir={path}"])
    return path


@pytest.fixture
def copied(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "copy")


def test_the_se_that_teaches_best_is_written_and_says_what_it_is(folder):
    shown = zoo.describe(header.read(folder))
    curve, rows = pd.read_csv(folder / "search.csv"), pd.read_csv(folder / "students.csv")
    best = int(curve["start"][curve["test_mean"].iloc[:4].idxmax()])
    assert curve["start"].tolist() == [0, 0, 1, 1, best, best]
    assert curve["generation"].tolist() == [1, 2, 1, 2, 3, 4]
    chosen, tested = (rows[rows["use"] == use] for use in ("choose", "test"))
    by_se = chosen.groupby("generation")["test_return"]
    assert len(by_se) == 2 and (by_se.size() == 2).all() and len(tested) == 2
    assert shown.generation == ((by_se.mean() + by_se.min()) / 2).idxmax()
    assert set(tested["generation"]) == {shown.generation}
    assert set(tested["policy_return"]) == {shown.policy_return}
    (evaluation,) = shown.evaluations
    assert evaluation.return_mean == pytest.approx(tested["test_return"].mean())
    assert shown.policy_return is not None and "policy_return:" in shown.card
    # Searches, the recorded episodes, and all tests of students.
    assert shown.learning.real_steps == curve["real_steps"].sum() + rows["real_steps"].sum()
    assert shown.learning.train_steps == 6 * 60


@pytest.mark.parametrize("lost", ["search/start?-[13]*", "students/*"])
def test_a_killed_command_goes_on_to_the_same_file(copied, folder, lost):
    for path in [*copied.glob(lost), *copied.glob("*.csv"), copied / "proxy.safetensors"]:
        path.unlink()
    main([*QUICK, f"run_dir={copied}"])
    one, two = (pd.read_csv(x / "students.csv").drop(columns="cpu_s") for x in (folder, copied))
    pd.testing.assert_frame_equal(one, two)
    assert sejax.load_proxy(folder).fingerprint == sejax.load_proxy(copied).fingerprint


def test_a_finished_command_trains_nobody_again(copied, monkeypatch):
    monkeypatch.setattr(teaching, "teach", lambda *_: pytest.fail("it trains"))
    (copied / "proxy.safetensors").unlink()
    main([*QUICK, f"run_dir={copied}"])
    assert (copied / "proxy.safetensors").exists()


@pytest.mark.parametrize("other", ["search.step_size=0.5", POLICY, "agent=dqn", "num_tested=3"])
def test_a_folder_of_another_command_is_left_alone(folder, other):
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*.*")}
    assert refused(main, [*QUICK, f"run_dir={folder}", other]) == "run_dir"
    assert before == {path: path.stat().st_mtime_ns for path in before}


def test_damaged_files_and_runs_of_another_command_are_refused(copied):
    words = [*QUICK, f"run_dir={copied}"]
    os.truncate(next(copied.glob("search/*")), 200)
    assert refused(main, words) == "run_dir"
    (copied / "distill.safetensors").unlink()
    assert refused(main, words) == "run_dir"  # it holds an SE
    (copied / "proxy.safetensors").rename(copied / "checkpoint.safetensors")
    assert refused(main, [*words, POLICY]) == "run_dir"  # it holds a run
    (copied / "distill.safetensors").write_bytes(b"")
    assert refused(main, words) == "run_dir"


@pytest.mark.slow
def test_a_function_that_has_changed_gets_students_of_its_own(tmp_path, monkeypatch):
    returns = []
    for sign in (1.0, -1.0):
        monkeypatch.setattr(sys.modules[__name__], "SIGN", sign)
        main([*QUICK, POLICY, f"run_dir={tmp_path}"])
        returns.append(zoo.describe(header.read(tmp_path)).policy_return)
        assert pd.read_csv(tmp_path / "students.csv")["policy_return"].unique() == returns[-1:]
    assert returns[0] == 200.0 > returns[1]
    assert len(list((tmp_path / "students").iterdir())) == 2


def test_an_algorithm_whose_students_diverge_counts_as_the_worst():
    rows = pd.DataFrame({"agent": ["a", "b"], "test_return": [np.nan, 3.0], "train_steps": [1, 1]})
    assert [x["return_mean"] for x in evaluations_of(rows)] == [3.0, 3.0]


def test_an_agent_is_trained_once_and_its_steps_are_counted(tmp_path, monkeypatch):
    words = [*QUICK, "policy=ddqn", "copy.agent_steps=200", f"run_dir={tmp_path}"]
    main(words)
    monkeypatch.setattr(policies, "make_trainer", lambda *_: pytest.fail("it trains again"))
    first = sejax.load_proxy(tmp_path).fingerprint
    (tmp_path / "proxy.safetensors").unlink()
    main(words)
    assert sejax.load_proxy(tmp_path).fingerprint == first
    shown, rows = zoo.describe(header.read(tmp_path)), pd.read_csv(tmp_path / "students.csv")
    assert shown.learning.real_steps > 200 + 2 * shown.policy_return + rows["real_steps"].sum()


@pytest.mark.parametrize("word", [
    *("num_snapshots=0", "search.num_top=5", "search.generationz=5", "agent=nothing"),
    *("generations=5", "proxy.hidden_size=5", "training.max_steps=0"),
    *("policy=sax", "policy=nothing:act", "policy=td3"),
    *(f"policy={__name__}:{x}" for x in ("SIGN", "of_another_shape", "out_of_range", "fails")),
])  # fmt: skip
def test_what_cannot_be_is_refused_and_leaves_nothing(word, tmp_path):
    assert refused(main, [*QUICK, f"run_dir={tmp_path}/runs/a", word]) == word.partition("=")[0]
    assert not (tmp_path / "runs").exists()


def test_a_model_of_another_algorithm_is_refused(tmp_path, monkeypatch):
    class DQN:
        @staticmethod
        def load(path, device):
            raise AttributeError("it has no 'q_net'")

    monkeypatch.setitem(sys.modules, "stable_baselines3", SimpleNamespace(DQN=DQN))
    for name in ("dqn", "nothing"):
        words = [*QUICK, f"run_dir={tmp_path / 'run'}", f"policy={name}:ppo.zip"]
        assert refused(main, words) == "policy"
    assert not (tmp_path / "run").exists()


def test_actions_of_uneven_bounds_are_those_of_the_task(monkeypatch):
    """A task's own actions lie in [-1, 1], if the environment's do not lie in some [-x, x]."""
    space = SimpleNamespace(low=np.zeros(2), high=np.float32([1, 4]))
    actions = np.tile([0.5, 5.0], (3, 1))  # one is beyond the bounds
    model = SimpleNamespace(action_space=space, predict=lambda obs, deterministic: (actions, None))
    sb3 = SimpleNamespace(SAC=SimpleNamespace(load=lambda path, device: model))
    monkeypatch.setitem(sys.modules, "stable_baselines3", sb3)
    task = SimpleNamespace(name="uneven", num_actions=None, action_dim=2, max_action=1.0)
    act = policies.policy_of("sac:model.zip", task, 1, jax.random.key(0))
    np.testing.assert_allclose(act(np.zeros((3, 5))), [[0.0, 1.0]] * 3)
    model.action_space = SimpleNamespace(n=2)
    assert refused(policies.policy_of, "sac:model.zip", task, 1, jax.random.key(0)) == "policy"


def test_a_preset_files_values_stand_before_the_defaults(tmp_path):
    (file := tmp_path / "x.yaml").write_text("{env: pendulum, agent: ppo, training.max_steps: 777}")
    config = DistillConfig.of_words([f"preset={file}"])
    found = (*config.agents, config.training.max_steps, config.preset, config.agent.rollout_steps)
    assert found == ("ppo", 777, "distilled", 256)
    assert "td3" in DistillConfig.of_words([f"preset={file}", "agents=[ppo,td3]"]).agents
    file.write_text("{env: pendulum, agent_hparams: varied}")  # which students have not
    assert refused(DistillConfig.of_words, [f"preset={file}"]) == "agent_hparams"


def test_defaults_are_those_of_the_task():
    config = DistillConfig.of_words(["env=hopper"])
    assert config.search.alive_bonus == 1.0 and config.training.max_steps == 10_000
    assert DistillConfig.of_words(["env=hopper", "search.alive_bonus=0"]).search.alive_bonus == 0.0
    assert DistillConfig.of_words(["env=halfcheetah"]).search.alive_bonus == 0.0
    for steps, episodes in ((700, 700), ("null", 2000)):
        config = DistillConfig.of_words(["env=cartpole", f"training.max_steps={steps}"])
        assert config.training.max_episodes == episodes and [*config.agents] == ["ddqn", "ppo"]


@pytest.mark.parametrize(("words", "name"), [
    ([], "distill-cartpole-s0"), (["policy=ppo"], "distill-cartpole-ppo-s0"),
    (["policy=ppo:a/model.zip"], "distill-cartpole-ppo-model-s0"),
    (["policy=mine:act", "seed=2"], "distill-cartpole-mine-act-s2"),
])  # fmt: skip
def test_the_default_folder_tells_policies_apart(words, name):
    assert DistillConfig.of_words(["env=cartpole", *words]).folder.name == name
