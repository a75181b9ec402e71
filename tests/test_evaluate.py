"""`python -m sejax.evaluate`: fresh agents on a stored proxy, and on the real task."""

import dataclasses
import functools
import itertools
import json
import pickle
import sys

import gymnax
import jax
import pandas as pd
import pytest
from support import evaluation, paper_ppo, paper_se, paper_training, refusal, refused

import sejax
from sejax import envs
from sejax.agents.ppo import PPOConfig
from sejax.evaluate import evaluate
from sejax.evaluation import make_evaluator
from sejax.ops.checksummed import pack, unpack
from sejax.options.plain import configure, to_plain
from sejax.runs.fresh_agents import loaded, summarise, worlds_of

# An SE for DDQN agents, whose episodes may be as long as the task's.
SE = ("proxy.hidden_size=4", "training.max_steps=50", "agent.warmup_episodes=0", "proxy.done=soft",
      "proxy.horizon=null")  # fmt: skip
# An SE for tables, which compile fast, learned with 50 steps; and how they are evaluated.
ROOM_SE = ("env=gridworld_2x2", "proxy.hidden_size=4", "training.max_steps=50")
ROOM = ("num_agents=2", "real_training.max_episodes=2", "devices=1")


def evaluate_config(*overrides):
    return evaluation(overrides)


@functools.cache
def learned(*words):
    """A proxy of random weights, and the configuration that it says it was learned with."""
    config = sejax.config(words)
    env = config.parts()["proxy"]
    return config, env, env.init_weights(jax.random.key(3))


def save(path, *words):
    config, env, weights = learned(*words)
    discount = next(iter(config.agents.values())).discount
    sejax.save(path, env, weights, config.plain(), discount, score=1.0, seed=0)
    return path


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """The file of an SE for DDQN agents."""
    return save(tmp_path_factory.mktemp("proxy") / "proxy.safetensors", *SE)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """The file of an SE for tables."""
    return save(tmp_path_factory.mktemp("room") / "proxy.safetensors", *ROOM_SE)


def test_evaluation_writes_a_row_for_each_agent_and_their_means(room, tmp_path, capsys):
    words = "agents=[sarsa,q_learning]", "agents.sarsa.learning_rate=0.5", f"out_dir={tmp_path}"
    mean = evaluate(evaluate_config(f"proxy={room}", *words, *ROOM))
    table = pd.read_csv(tmp_path / "evaluation.csv")
    worlds, agents = ("the proxy", "the real task"), ("q_learning", "sarsa")
    counts = table.groupby(["world", "agent"]).size().to_dict()
    assert counts == dict.fromkeys(itertools.product(worlds, agents), 2)
    on_proxy = table[table.world == "the proxy"]
    assert mean == pytest.approx(on_proxy.test_return.mean(), rel=1e-5)
    assert (on_proxy.train_steps == 50).all()  # as the proxy was learned
    of_sarsa = table[(table.world == "the real task") & (table.agent == "sarsa")]
    summary = json.loads((tmp_path / "evaluation.json").read_text())
    steps = summary["the real task"]["sarsa"]["train_steps_mean"]
    assert steps == pytest.approx(of_sarsa.train_steps.mean())
    printed = capsys.readouterr().out
    assert "2 fresh agents of each algorithm" in printed and printed.count("sarsa") == 4


@pytest.mark.parametrize("world", ["the proxy", "the real task"])
def test_one_agent_in_one_world_has_no_deviation(world, room, tmp_path, capsys):
    words = {"the proxy": f"proxy={room} baseline=false"}.get(world, "proxy=real env=gridworld_2x2")
    evaluate(evaluate_config(*words.split(), *ROOM, "num_agents=1", f"out_dir={tmp_path}"))
    printed = capsys.readouterr().out
    assert "nan" not in printed and "1 fresh q_learning agents" in printed
    (row,) = pd.read_csv(tmp_path / "evaluation.csv").to_dict("records")
    assert (row["world"], row["agent"]) == (world, "q_learning")


OwnPPO = type("OwnPPO", (PPOConfig,), {})  # which is not registered


def budget_for(training, agent, learned_with, length):
    """The training on an SE of cartpole of this length, 1 or 200, that others were learned with."""
    config = sejax.SyntheticConfig(hidden_size=2, horizon=1 if length == 1 else None)
    agents = {str(i): to_plain(x, "agent") for i, x in enumerate(learned_with)}
    learned = {"training": to_plain(training), "agents": agents}
    env = config.make(envs.make("cartpole")).with_default_params(None, learned)
    return sejax.training_of(env, agent)


def test_initial_episodes_beyond_the_proxys_own_extend_its_step_budget(stored):
    proxy = sejax.load_proxy(stored)  # learned with no initial episode and 50 steps
    (then,), training = proxy.learned_agents().values(), sejax.training_of(proxy)
    waits = dataclasses.replace(then, warmup_episodes=3)
    long, short, own = (*(paper_ppo(update_episodes=x) for x in (2, 1)), OwnPPO())
    for agent, learned_with, length, budget in (
        (then, [then], 200, 50), (waits, [then], 200, 50 + 3 * 200), (long, [then], 200, 50 + 401),
        (own, [own], 200, 50), (then, [], 200, 50),  # nobody knows what it was learned with
        (long, [then, short], 200, 50 + 200),  # the one that waits longest counts
        # A rollout is as long as the task's episodes, initial episodes are as long as the proxy's.
        (long, [then], 1, 50 + 401), (waits, [then], 1, 50 + 3),
    ):  # fmt: skip
        assert budget_for(training, agent, learned_with, length).max_steps == budget
    # Of one step each: as many episodes more.
    assert budget_for(training, long, [then], 1).max_episodes == training.max_episodes + 401
    assert budget_for(paper_training(), PPOConfig(), [then], 200) == paper_training()


def test_each_of_several_agents_trains_as_long_as_it_must(tmp_path):
    """An SE learned with two families: neither they nor others wait beyond their budget."""
    words = ("agents=[ddqn,ppo]", "agents.ddqn.warmup_episodes=2", "agents.ppo.rollout_steps=100",
             "proxy.hidden_size=4", "training.max_steps=4000", *SE[3:])  # fmt: skip
    path = save(tmp_path / "proxy.safetensors", *words)
    worlds = worlds_of(evaluate_config(
        f"proxy={path}", "agents=[ddqn,dueling_ddqn,ppo]", "agents.dueling_ddqn.warmup_episodes=10",
        "agents.ppo.rollout_steps=null"))  # fmt: skip
    budgets = {key: x.max_steps for key, x in worlds["the proxy"].trainings.items()}
    # Learned with 4000 steps, of which DDQN waits 2 * 200; others wait 10 episodes.
    waits = {"ddqn": 2 * 200, "dueling_ddqn": 10 * 200, "ppo": 10 * 200 + 1}
    assert budgets == {key: 4000 + wait - 2 * 200 for key, wait in waits.items()}
    as_learned = evaluate_config(f"proxy={path}", "agent_hparams=as_learned")
    assert as_learned.agents == learned(*words)[0].agents
    assert worlds_of(as_learned)["the proxy"].trainings["ppo"].max_steps == 4000


@pytest.mark.parametrize(("proxy", "words", "field"), [
    ("stored", "training_from=config training.solved_by=train training.stop_rule=solved",
     "training.solved_by"),
    ("stored", "training_from=config training.max_steps=300 agent.warmup_episodes=2",
     "training.max_steps"),
    ("cartpole-rn", "real_training.solved_by=train", "real_training.solved_by"),
    ("stored", "env=acrobot", "env"), ("room", "agent=ddqn", "agent"), ("real", "seed=1", "env"),
    ("real", "env=cartpole agent=q_learning", "agent"), ("nope", "seed=1", "proxy"),
    ("nope/proxy.safetensors", "seed=1", "proxy"), ("d" * 10_000, "seed=1", "proxy"),
    ("room", "out_dir=setup.py/x", "out_dir"), ("stored", "proxy_kind=rn", "proxy_kind"),
])  # fmt: skip
def test_what_cannot_be_trained_is_refused_before_anything_starts(
    proxy, words, field, stored, room, monkeypatch, tmp_path
):
    (tmp_path / "setup.py").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sejax.evaluate._train_and_test", None)
    path = {"stored": stored, "room": room}.get(proxy, proxy)
    assert refused(evaluate, evaluate_config(f"proxy={path}", *words.split())) == field


@pytest.mark.parametrize(("word", "expected"), [
    ("agent_hparams=as_learned", True), ("real_training.time_limit_is_terminal=false", False),
    ("agent=td3", False),
])  # fmt: skip
def test_agents_of_an_rn_take_the_time_limit_as_they_learned_it(word, expected, tmp_path):
    """They do not bootstrap there; on the real task beside the RN they do likewise; words win."""
    path = save(tmp_path / "proxy.safetensors", "env=mountain_car_continuous", "proxy=rn")
    for world in worlds_of(evaluate_config(f"proxy={path}", word)).values():
        assert world.trainings["td3"].time_limit_is_terminal == expected


def test_an_se_that_does_not_say_how_long_agents_trained_needs_the_config(room, tmp_path):
    """Tests on the real task, by which agents there stop, are not for an SE."""
    proxies, bare = sejax.load_set(room), tmp_path / "bare.safetensors"
    sejax.save(bare, proxies.env, proxies[0].params.weights)
    words = f"proxy={bare}", "agent=q_learning"
    assert refused(worlds_of, evaluate_config(*words)) == "training_from"
    given = "training_from=config", "training.max_steps=7", "training.stop_rule=never"
    world = worlds_of(evaluate_config(*words, *given))["the proxy"]
    assert world.trainings["q_learning"].max_steps == 7


def test_agents_like_those_of_the_run_bring_their_exploration(tmp_path):
    """An RN learned with Q-learning agents and a count-based bonus."""
    words = "env=cliff_walking", "proxy=rn", "exploration=count_based", "exploration.count_power=2"
    path = save(tmp_path / "proxy.safetensors", *words)
    config = evaluate_config(f"proxy={path}", "agent_hparams=as_learned")
    worlds, learner = worlds_of(config), learned(*words)[0]
    assert (config.agents, config.exploration) == (learner.agents, learner.exploration)
    # Its dynamics are real.
    assert worlds["the proxy"].trainings == {"q_learning": config.real_training}
    for typed in ("agent=q_learning", "exploration=count_based", "exploration.reward_scale=0.1"):
        words = f"proxy={path}", "agent_hparams=as_learned", typed
        assert evaluate_config(*words).exploration == config.exploration


def test_agents_that_are_named_have_the_hyperparameters_of_the_run(tmp_path, monkeypatch):
    """Also plugins that the user types, and the right one of two agents of one name."""
    (tmp_path / "typed_agent.py").write_text(
        "from dataclasses import dataclass\nfrom sejax import DDQNConfig\n"
        "@dataclass(frozen=True, kw_only=True)\nclass Own(DDQNConfig):\n    tau: float = 0.5\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    words = ["env=cartpole", "agents=[ddqn,typed_agent:Own]", "agents.typed_agent_Own.tau=0.03"]
    path = save(tmp_path / "mixed.safetensors", *words)
    config = evaluate_config(f"proxy={path}", words[1])
    assert config.agents["typed_agent_Own"].tau == 0.03
    words = "agents=[ddqn] agents.tuned.name=ddqn agents.tuned.tau=0.7 agents.ddqn.tau=0.2"
    path = save(tmp_path / "twice.safetensors", "env=cartpole", *words.split())
    assert evaluate_config(f"proxy={path}", "agent=ddqn").agent.tau == 0.2


def test_a_proxy_knows_what_it_was_learned_with(room, tmp_path):
    config, proxies = learned(*ROOM_SE)[0], sejax.load_set(room)
    assert proxies.learned_agents() == config.agents
    for group in ("exploration", "es", "objective"):
        assert proxies.learned_with(group) == getattr(config, group)
    bare = tmp_path / "bare.safetensors"
    sejax.save(bare, proxies.env, proxies[0].params.weights, {"agent": {"name": "my:Agent"}})
    assert refused(sejax.load_proxy(bare).learned_agents) == "agent"
    # No other agent takes its place.
    assert refused(evaluate_config, f"proxy={bare}") == "agents.my_Agent"
    assert list(evaluate_config(f"proxy={bare}", "agent=sarsa").agents) == ["sarsa"]
    assert "my" not in sys.modules


def test_where_no_agent_is_named_it_is_the_tasks_own(room, tmp_path):
    """Also for a stranger's task, which is not imported: what agents see is in the file."""
    theirs = tmp_path / "theirs.safetensors"
    task = dataclasses.replace(envs.make("pendulum"), name="theirs")
    vars(task)["origin"] = {"name": "their:Task"}
    env = paper_se(hidden_size=4, initial_state="learned", horizon=1).make(task)
    sejax.save(theirs, env, env.init_weights(jax.random.key(0)))
    for proxy, agent in ((room, "q_learning"), ("pendulum agent_hparams=default", "td3"),
                         (theirs, "td3"), ("nope", "ddqn"),
                         ("real env=gridworld_2x2", "q_learning"), ("real", "ddqn")):  # fmt: skip
        config = evaluate_config(*f"proxy={proxy}".split())
        assert config.agent == configure("agent", {"name": agent})
    # An older file, which lacks that: its task's name is not imported, nor made.
    tensors, header = unpack(theirs.read_bytes(), "sejax")
    header.pop("interface")
    theirs.write_bytes(pack(tensors, "sejax", header))
    assert evaluate_config(f"proxy={theirs}").agent == sejax.DDQNConfig()
    assert "their" not in sys.modules


def test_a_proxy_of_a_task_made_by_hand_takes_the_typed_task(tmp_path, monkeypatch):
    env = sejax.config(["env=gridworld_2x2"]).parts()["proxy"]
    monkeypatch.setitem(vars(env.task), "origin", None)
    sejax.save(path := tmp_path / "mine.safetensors", env, env.init_weights(jax.random.key(0)))
    config = evaluate_config(f"proxy={path}", "env=sejax.envs.gridworld:GridWorld2x2")
    assert loaded(config).task.is_solvable


def test_an_evaluations_mean_leaves_no_agent_out():
    agents = pd.DataFrame({"world": "w", "test_return": [10.0, float("nan"), -20.0], "nonfinite": [
        False, True, False], "train_steps": 5, "train_episodes": 1})  # fmt: skip
    row = summarise(agents, ["world"]).loc["w"]
    assert (row["test_return_mean"], row["num_nonfinite"]) == (-10.0, 1)


def test_a_test_that_may_never_end_is_refused_beside_the_training_budget():
    env = gymnax.make("Pendulum-v1")[0]
    task = sejax.Task(name="endless", env=env, max_steps=1_000_000_000)
    agent = sejax.make_agent(sejax.TD3Config(), task)
    training = sejax.TrainingConfig(max_steps=60, max_episodes=60)
    error = refusal(make_evaluator, agent, env, task, training)
    assert error.field == "env.max_steps" and "at most 1,000,000" in str(error)


def test_pickling_an_agent_says_what_to_send_in_its_place():
    agent = sejax.make_agent(sejax.DDQNConfig(hidden_size=4), sejax.envs.make("cartpole"))
    with pytest.raises(TypeError, match="Send its configuration"):
        pickle.dumps(agent)
