"""`python -m sejax.check`: is a learned environment more than a policy?"""

import dataclasses
import importlib
import json
import pickle
import shutil

import numpy as np
import pandas as pd
import pytest
from support import is_drawn, refusal, refuse, refused

import sejax
from sejax.myopia import Judgement, judge, verdict_of
from sejax.ops.checksummed import pack, unpack
from sejax.proxies.exact import make_exact
from sejax.runs import fresh_agents

checking = importlib.import_module("sejax.check")  # `sejax.check` is its function
ROOM = ("env=gridworld_2x2", "proxy.hidden_size=4", "training.max_steps=50")
WHOLE = (*ROOM, "proxy.horizon=null", "proxy.initial_state=real", "proxy.done=threshold")
FEW = {"num_agents": 5, "devices": 1, "real_training.max_steps": 50}


def save(path, *words):
    """A proxy of random weights, and what it says it was learned with."""
    config = sejax.config(words)
    env = config.parts()["proxy"]
    record = {"learning": {"command": "a test", "generations": 1, "real_steps": 1000}}
    sejax.save(path, env, env.init_weights(np.uint32([0, 3])), config.plain(), 0.8, **record)
    return path


def run(path, **fields):
    words = [f"{name}={value}" for name, value in {"proxy": path, **FEW, **fields}.items()]
    return checking.findings(checking.CheckConfig.of_words(words))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A checked SE of whole episodes: the folder with its file, and what was found."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, run(save(folder / "mine.safetensors", *WHOLE), out_dir=folder / "check")


# --- verdicts -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kinds", "verdict"), [
    (["policy", "dynamics"], "a stored policy"), (["dynamics"], "its dynamics teach"),
    (["dynamics", "teaches little"], "its dynamics teach"), (["teaches little"], "teaches little"),
    (["dynamics", "open"], "undecided: 7 more agents"),
])  # fmt: skip
def test_the_verdict_is_that_of_all_algorithms(kinds, verdict):
    judgements = [Judgement(x, 0.0, 0.0, 0.0, 7 if x == "open" else 99) for x in kinds]
    assert verdict_of(judgements) == verdict


def test_as_many_more_agents_decide_as_are_said():
    """Of the same spread: the interval's width falls with the root of their number."""
    myopic, far = np.tile([0.0, 100.0], 10), np.full(20, 100.0)
    few = judge(myopic, far, 0.0, 100.0)
    assert judge(far, far, 110.0, 100.0).verdict == "teaches little"  # untrained agents solve it
    rn = np.linspace(-3000, -2000, 20)  # which takes as many steps as its task: no gain
    assert judge(rn - 9000, rn, rn, 0.0).verdict == "teaches little"
    assert judge(rn - 9000, rn, rn - 3000, 0.0).verdict == "dynamics"
    assert few.verdict == "dynamics"
    with pytest.raises(ValueError, match="seeds are paired"):
        judge(myopic[:1], far, 0.0, 100.0)
    near = judge(np.tile([70.0, 100.0], 10), far, 0.0, 100.0)  # loses 15, the margin is 10
    assert near.verdict == "open"
    more = -(-(20 + near.missing) // 2)
    assert judge(np.tile([70.0, 100.0], more), np.full(2 * more, 100.0), 0.0, 100.0).low > 10


# --- the command ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_policy_that_is_written_down_is_a_stored_policy(tmp_path, capsys):
    task = sejax.envs.make("cartpole")
    gains = np.array([0.1, 0.3, 1.0, 0.6])  # of `experiments.common.bandits`
    states = np.random.default_rng(0).normal(0, [1.0, 0.5, 0.1, 0.5], (1000, 4))
    env, weights = make_exact(task, [(np.stack([-gains, gains]), np.zeros(2))], states)
    config = sejax.config(["env=cartpole"]).plain()
    sejax.save(tmp_path / "mine.safetensors", env, weights, {"agents": config["agents"],
               "training": config["training"]}, policy_return=200.0)  # fmt: skip
    found = run(tmp_path / "mine.safetensors", out_dir=tmp_path / "out", algorithms="[]")
    assert found["verdict"] == "a stored policy" and found["judgements"]["ddqn"]["loss"] == 0
    assert found["worlds"]["the proxy"]["test_return_mean"] > 195
    assert found["null_se"]["return"] >= 195 and found["null_se"]["real_steps"] < 200_000
    assert found["worlds"]["the null SE"]["test_return_mean"] > 150 and not found["cost"]
    assert len({found["worlds"][x]["train_steps_mean"] for x in ("the null SE", "the proxy")}) == 1
    assert "verdict: a stored policy\n" in capsys.readouterr().out


def test_a_check_has_a_row_for_each_comparison_and_writes_what_it_returns(whole, capsys):
    folder, found = whole
    names = ["the proxy, discount 0", "the proxy, discount 0.5", "the proxy, discount 0.9",
             "the proxy", "the proxy, other algorithms", "the real task", "the real task, tuned",
             "nothing"]  # fmt: skip
    assert list(found["worlds"]) == names
    shares = [found["worlds"][name]["solved"].split(" ")[0] for name in names]
    assert shares[:5] == [*["q_learning"] * 4, "sarsa"]
    steps = [found["worlds"][name]["train_steps_mean"] for name in names]
    assert steps[:5] == [50] * 5 and steps[-1] == 1
    assert found["cost"]["agents_to_break_even"] == "never"  # its agents do not solve the task
    assert json.loads((folder / "check/check.json").read_text()) == found
    assert is_drawn(folder / "check/check.png")
    assert run(folder / "mine.safetensors", out_dir=folder / "check") == found  # trains nobody
    shown = capsys.readouterr().out
    assert "training on nothing: done ..." in shown and f"verdict: {found['verdict']}" in shown


def test_a_killed_check_goes_on_to_the_same(whole, tmp_path, monkeypatch):
    folder, found = whole
    path, out = folder / "mine.safetensors", tmp_path / "out"
    calls, train = [], fresh_agents.train

    def dies(*job):
        calls.append(job)
        return refuse() if len(calls) == 3 else train(*job)

    monkeypatch.setattr(fresh_agents, "train", dies)
    with pytest.raises(AssertionError):
        run(path, out_dir=out)
    assert run(path, out_dir=out) == found and len(calls) == 1 + 8
    one, two = train(*calls[0]), train(*pickle.loads(pickle.dumps(calls[0])))  # as machines=ray
    np.testing.assert_array_equal(one["test_return"], two["test_return"])
    shutil.copytree(out, tmp_path / "other")
    assert refused(run, path, out_dir=tmp_path / "other", seed=1, num_agents=9) == "out_dir"
    proxy = sejax.load_proxy(path)  # the same weights, but of another SE
    env = dataclasses.replace(proxy.env.config, min_steps=3).make(proxy.task)
    how = proxy.params.weights, proxy.config, proxy.discount
    sejax.save(path := tmp_path / "mine.safetensors", env, *how)
    assert "proxy.min_steps (1" in str(refusal(run, path, out_dir=tmp_path / "other"))


def test_agents_that_fail_on_the_task_save_nothing(whole):
    worlds = {checking.TASK: (40, -1.0), checking.TUNED: (50, 1.0), checking.OWN: (9, 1.0)}
    summary = pd.DataFrame(worlds, ["train_steps_mean", "test_return_mean"]).T
    cost = checking._cost(sejax.load_proxy(whole[0] / "mine.safetensors"), summary)
    assert cost["agents_to_break_even"] == 20  # of 1000 real steps


@pytest.mark.slow
def test_a_reward_network_is_judged_by_training_steps(tmp_path):
    path = save(tmp_path / "rn.safetensors", "env=gridworld_2x2", "proxy=rn")
    found = run(path, out_dir=tmp_path / "out", algorithms="[]")
    assert "the null SE" not in found["worlds"] and not found["null_se"]
    steps = {name: row["train_steps_mean"] for name, row in found["worlds"].items()}
    lost = steps["the proxy, discount 0"] - steps["the proxy"]
    assert found["judgements"]["q_learning"]["loss"] == pytest.approx(lost)


@pytest.mark.parametrize(("fields", "field"), [
    ({"proxy": "nope"}, "proxy"), ({"proxy": "real"}, "proxy"), ({"agent": "ddqn"}, "agent"),
    ({"algorithms": "[td3]"}, "algorithms"), ({"num_agents": 4}, "num_agents"),
    ({"algorithms": "[q_learning]"}, "algorithms"),
    ({"baseline": "false"}, "baseline"), ({"agent_hparams": "varied"}, "agent_hparams"),
])  # fmt: skip
def test_what_cannot_be_judged_is_refused(fields, field, whole, tmp_path, monkeypatch):
    monkeypatch.setattr(checking, "_trained", refuse)
    error = refusal(run, whole[0] / "mine.safetensors", out_dir=tmp_path / "out", **fields)
    assert error.field == field and (field != "algorithms" or error.details["use"] == "[sarsa]")
    assert not (tmp_path / "out").exists()


def test_no_agents_have_random_hyperparameters(tmp_path, monkeypatch):
    """A discount of 0 would be drawn again, and rows would compare different agents."""
    worlds, train = [], fresh_agents.train
    monkeypatch.setattr(fresh_agents, "train", lambda *x: worlds.append(x[1]) or train(*x))
    run(save(tmp_path / "x.safetensors", *WHOLE, "agent_hparams=varied"), out_dir=tmp_path / "out")
    assert worlds and not any(world.is_varied for world in worlds)


def test_damaged_files_and_tasks_that_are_not_here_are_refused(whole, tmp_path, monkeypatch):
    data, path = (whole[0] / "mine.safetensors").read_bytes(), tmp_path / "other.safetensors"
    monkeypatch.setattr(checking, "_trained", refuse)
    path.write_bytes(data[:-9])
    assert refused(run, path) == "proxy"
    tensors, header = unpack(data, "sejax")
    header["config"]["env"] = {"name": "their:Task"}
    path.write_bytes(pack(tensors, "sejax", header))
    assert refused(run, path) == "task"
