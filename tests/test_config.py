"""sejax.runs.config: overrides become a configuration; what cannot be is one short message."""

import dataclasses
import functools
import random
import sys

import pytest
import yaml
from support import ended, evaluation, printed, refusal

import sejax
from sejax import evaluate, run
from sejax.agents.mixture import MixtureConfig
from sejax.distill import __main__ as distill
from sejax.distill.policies import CopyConfig
from sejax.evaluate import EvaluateConfig
from sejax.options import ConfigError
from sejax.options.plain import parsed
from sejax.runs import commands
from sejax.runs.config import LearnConfig
from sejax.runs.fresh_agents import worlds_of
from sejax.runs.run_directory import RunDirectory
from sejax.runs.words import expand

OWN_NAME = ["agents=[ddqn,myopic]", "agents.myopic=ddqn", "agents.myopic.discount=0"]


def refused(*overrides, make=sejax.config):
    """The error of overrides: one short line that names a field."""
    error = refusal(make, overrides)
    assert error.field
    return error


# --- every choice composes ------------------------------------------------------------------------


def test_a_task_chooses_its_agent_and_a_proxy_its_objective():
    names = {"acrobot": "ddqn", "cliff_walking": "q_learning", "pendulum": "td3", "ant": "td3"}
    assert {env: sejax.config([f"env={env}"]).name("agent") for env in names} == names
    assert sejax.config(["env=pendulum", "agent=ppo"]).name("agent") == "ppo"
    assert sejax.config(["proxy=rn"]).name("objective") == "reward_threshold"
    assert sejax.config(["proxy=rn", "objective=max_reward"]).name("objective") == "max_reward"


@pytest.mark.parametrize(("word", "name"), [
    ("generations=9", "runs/cartpole-se-ddqn-s0"), ("run_dir=elsewhere", "elsewhere"),
    ("run_dir='with, commas ☃'", "with, commas ☃"), ("run_dir=007", "007"),
    ("exploration=icm", "runs/cartpole-se-ddqn_icm-s0"),
    ("agent_hparams=varied", "runs/cartpole-se-ddqn_varied-s0"),
    ("env=gymnax/CartPole-v1", "runs/gymnax_CartPole-v1-se-ddqn-s0"),
    ("agents=[ppo,ddqn]", "runs/cartpole-se-ddqn+ppo-s0"),
])  # fmt: skip
def test_the_run_directory_names_the_run(word, name):
    assert str(sejax.config([word]).folder) == name


def test_values_are_read_by_the_types_of_their_fields():
    read = sejax.config(["es.noise_std=1e-2", "agent.learning_rate=1", "generations=3.0",
                         "stop_when_solved=true", "training.max_steps=null",
                         "training.stop_rule=plateau"])  # fmt: skip
    assert read.es.noise_std == 0.01 and type(read.agent.learning_rate) is float
    assert read.generations == 3 and type(read.generations) is int
    assert read.stop_when_solved is True and read.training.max_steps is None


# --- several agents -------------------------------------------------------------------------------


def test_each_agent_of_a_mixture_has_fields_and_may_have_a_name_of_its_own():
    config = sejax.config([*OWN_NAME, "mixture.weights.myopic=2", "mixture.aggregate=min"])
    assert config == sejax.config([*OWN_NAME, "agents.myopic.weight=2", "agents.aggregate=min"])
    sighted, myopic = config.agents.values()
    assert config.mixture == MixtureConfig(aggregate="min", weights={"ddqn": 1, "myopic": 2})
    assert sighted == sejax.config([]).agent, "with the settings of its preset"
    assert myopic == dataclasses.replace(sighted, discount=0.0)
    agent = config.parts()["agent"]
    assert agent.names == ("ddqn", "myopic") and agent.weights == (1.0, 2.0)


@pytest.mark.parametrize("preset", ["best", "paper"])
def test_each_agent_of_a_mixture_has_the_settings_that_it_has_alone(preset):
    words = ("env=acrobot", f"preset={preset}", "training.max_steps=null")
    for key, agent in sejax.config([*words, "agents=[td3_discrete,ddqn]"]).agents.items():
        assert agent == sejax.config([*words, f"agent={key}"]).agent


@pytest.mark.parametrize("name", ["cartpole", "cliff_walking-rn"])
def test_evaluate_trains_the_agents_that_a_proxy_was_learned_with(name):
    config = evaluation([f"proxy={name}"])
    learned = sejax.load_proxy(name).learned_agents()
    assert config.agents == learned and config.agent_hparams == "as_learned"
    changed = evaluation([f"proxy={name}", "agent.discount=0.5"]).agents
    assert changed == {k: dataclasses.replace(x, discount=0.5) for k, x in learned.items()}
    for key, agent in learned.items():  # as one that is named, too
        words = [f"proxy={name}", f"agent={key}"]
        changed = evaluation([*words, "agent.discount=0.5"]).agent
        assert changed == dataclasses.replace(agent, discount=0.5)
        assert evaluation([*words, "agent_hparams=default"]).agent == type(agent)()


def test_agents_as_learned_are_random_where_those_of_the_run_were(tmp_path):
    env, params = sejax.load("cliff_walking-rn")
    for hparams in ("default", "varied"):
        config = env.learned_config | {"agent_hparams": hparams}
        sejax.save(tmp_path / "x.safetensors", env, params.weights, config, 0.8)
        proxy = sejax.load_proxy(tmp_path / "x.safetensors")
        assert (sejax.agent_of(proxy).varied is not None) == (hparams == "varied")
        config = evaluation([f"proxy={proxy.path}"])
        (tmp_path / "printed.yaml").write_text(yaml.safe_dump(config.plain()))
        assert evaluation([f"preset={tmp_path}/printed.yaml"]) == config
        assert {x.is_varied for x in worlds_of(config).values()} == {hparams == "varied"}


def test_evaluate_takes_one_of_several_learned_agents_with_its_fields_and_others_by_default():
    learned = sejax.load_proxy("cartpole").learned_agents()
    config = evaluation(["proxy=cartpole", "agents=[ppo,sac]", "agents.ppo.epochs=3"])
    expected = {"ppo": dataclasses.replace(learned["ppo"], epochs=3), "sac": sejax.SACConfig()}
    assert config.agents == expected and config.agent_hparams == "default"
    config = evaluation(["proxy=cartpole", "agents.ddqn.discount=0.5"])  # of all, one changed
    assert config.agents == learned | {"ddqn": dataclasses.replace(learned["ddqn"], discount=0.5)}
    assert evaluation(["proxy=cartpole", "exploration=none"]).agents == learned


# --- sweeps ---------------------------------------------------------------------------------------


def test_commas_outside_of_brackets_and_quotes_make_a_sweep():
    rest = ["agents=[ddqn,ppo]", "run_dir='a,b'"]
    runs = expand(["seed=0,1", *rest, "es.noise_std=1,2"])
    assert len(runs) == 4 and runs[1] == ["seed=0", *rest, "es.noise_std=2"]
    assert refused("seed=0,1").field == "seed"


def test_the_runs_of_a_sweep_have_folders_of_their_own():
    configs = LearnConfig.of_sweep(["seed=0,1", "es.noise_std=0.03,0.06"])
    folders = {str(config.folder) for config in configs}
    assert len(folders) == 4 and all("noise_std" in folder for folder in folders)
    configs = LearnConfig.of_sweep(["env=cartpole,acrobot", "run_dir=here"])
    assert [x.run_dir for x in configs] == ["here/env_cartpole", "here/env_acrobot"]
    configs = LearnConfig.of_sweep(["run_dir=", "seed=0,1"])  # an empty variable of a shell
    assert {x.folder.name for x in configs} == {f"cartpole-se-ddqn-s{i}" for i in (0, 1)}
    assert [x.seed for x in LearnConfig.of_sweep(["seed=0,1", "seed=2,3"])] == [2, 3]
    folders = [x.out_dir for x in EvaluateConfig.of_sweep(["proxy=cartpole,acrobot", "seed=1,2"])]
    assert folders[1] == "runs/evaluate-cartpole_seed_2" and len({*folders}) == 4
    (folder, _) = EvaluateConfig.of_sweep(["proxy=real", "env=acrobot", "seed=1,2"])
    assert folder.out_dir == "runs/evaluate-real-acrobot_seed_1"
    configs = EvaluateConfig.of_sweep(["proxy=a/proxy.safetensors,a/proxy_last.safetensors"])
    assert len({x.out_dir for x in configs}) == 2
    assert refusal(EvaluateConfig.of_sweep, ["proxy=runs/a_b,runs/a/b"]).field == "out_dir"


# --- preset files ---------------------------------------------------------------------------------


def test_a_typed_choice_replaces_that_of_a_preset_file_with_its_fields(tmp_path):
    file = tmp_path / "config.yaml"  # as a run writes it
    learned = sejax.config(["agents=[ddqn,ppo]", "mixture.weights.ppo=2", "exploration=icm"])
    file.write_text(yaml.safe_dump(learned.plain()))
    assert sejax.config([f"preset={file}"]) == learned
    typed = ["es=cma_es", "proxy=rn", "objective=auc", "exploration=none", "agents=[ddqn,sac]"]
    config = sejax.config([f"preset={file}", *typed])
    names = map(config.name, ("es", "proxy", "objective", "exploration", "agent"))
    assert [*names] == ["cma_es", "rn", "auc", "none", "ddqn+sac"]
    assert not sejax.config([f"preset={file}", "agent=ddqn"]).mixture.weights


def test_a_preset_file_stands_for_its_overrides(tmp_path):
    file = tmp_path / "mine.yml"
    file.write_text("env: acrobot\npreset: paper\nes:\n  noise_std: 0.05\nagent.batch_size: 3\n")
    words = ["env=acrobot", "preset=paper", "es.noise_std=0.05", "agent.batch_size=7"]
    assert sejax.config([f"preset={file}", words[-1]]) == sejax.config(words)


@pytest.mark.parametrize("overrides", [
    [], ["env=cliff_walking", "proxy=rn"], [*OWN_NAME, "mixture.weights.myopic=2"],
    ["es=snes", "env=gymnax/Catch-bsuite"],
])  # fmt: skip
def test_a_configuration_is_read_back_from_its_values_and_from_a_file(tmp_path, overrides):
    config = sejax.config([*overrides, "run_dir='a b,c=é'", "seed=3"])
    values = config.plain()
    assert LearnConfig.of_stored(values) == config
    assert RunDirectory(config).completed(values) == values
    if len(config.agents) == 1:  # as files had it before
        older = values | {"agent": config.plain()["agents"].popitem()[1], "agents": None}
        assert LearnConfig.of_stored(older) == config
    preset = tmp_path / "config.yaml"
    preset.write_text(yaml.safe_dump(values))
    changed = sejax.config([f"preset={preset}", "generations=7"])
    assert changed == dataclasses.replace(config, generations=7)


@pytest.mark.parametrize("text", ["", "[1, 2]", "a: [", "env: 3", "proxy: [1]", "nope: 1", "1: 2",
                                  "agent: {batch_size: {x: 1}}", "\x00", "a: &a {}\nb: &b {c: *a}",
                                  "preset: other.yaml", "{a: " * 60 + "{" + 61 * "}"])  # fmt: skip
def test_a_bad_preset_file_is_one_message(tmp_path, text):
    (tmp_path / "bad.yaml").write_text(text)
    refused(f"preset={tmp_path / 'bad.yaml'}")
    assert refused(f"preset={tmp_path / 'nope.yaml'}").field == "preset"


# --- bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("override", "field", "suggested"), [
    ("env=cartpol", "env", "env=cartpole"), ("preset=papers", "preset", "preset=paper"),
    ("agent.batchsize=3", "agent.batchsize", "agent.batch_size"), ("seed=-1", "seed", ""),
    ("batch_size=3", "batch_size", "agent.batch_size"), ("=1", "an override", ""),
    ("agent.rollout_steps=3", "agent.rollout_steps", "agent=ppo"),
    ("env.goal_reward=-1", "env.goal_reward", "env=cliff_walking"),
    ("acrobot", "an override", "env="), ("generations = 3", "an override", "generations=VALUE"),
    ("generations.x=1", "generations", "{'x': '1'}"), ("agents.a.tau=1", "agents.a", "agent.FIELD"),
    ("es.score_transform=my_rank", "es.score_transform", "Set es.score_transform=rank."),
    ("es.score_transform=rank.py:f", "es.score_transform", "es.score_transform=rank:f."),
    ("agent=no_module_of:mine", "agent", "PYTHONPATH"), (f"agent=a:{'d' * 5000}", "agent", ""),
    ("agents=[ddqn,td3_discret]", "agents.td3_discret", "td3_discrete"),
    ("agents=[ddqn,ppo] agent.clip_ratio=1", "agents.ddqn.clip_ratio", "of agent=ppo."),
    ("agents=[ddqn,ppo] agents.ppo.tau=1", "agents.ppo.tau", "of ppo, but of agent=ddqn, "),
    ("agents=[ddqn,ppo] agent=sac", "agent", "agents=[ddqn,ppo,sac] alone."),
    ("agents=[ddqn,ppo] agents.ppo.epoch=3", "agents.ppo.epoch", "agents.ppo.epochs?"),
    ("mixture.aggregate=min", "mixture", "agents=[ddqn,ppo]"), ("es.loss=squared", "es.loss", ""),
    ("preset=paper env=mountain_car", "preset", "preset=best"),
    (f"{'a' * 5000}=1", f"{'a' * 40}... (5000 characters)", ""),
    ("es.population_size=1.5", "es.population_size", ""), ("agents=[ddqn,td3]", "agents.td3", ""),
    ("stop_when_solved=maybe", "stop_when_solved", ""), ("agents=[ddqn,ddqn]", "agents", ""),
    ("agents=[ddqn,ppo] mixture.weights.ddqn=0 mixture.weights.ppo=0", "mixture.weights", ""),
    ("agents=[ddqn,ppo] mixture.weights.ddqn=-1", "mixture.weights.ddqn", ""),
    ("agents=[ddqn,ppo] mixture.weights=1", "mixture.weights", "Set mixture.weights.KEY=VALUE."),
    ("agents=[ddqn,ppo] mixture.weights.ddq=2", "mixture.weights.ddq", "mixture.weights.ddqn?"),
    ("env=cliff_walking agent=sarsa exploration=icm", "exploration", ""),
    ("training.stop_rule=solved training.solved_by=train", "training.solved_by", ""),
    ("proxy.done=soft proxy.horizon=null agent=ppo agent.rollout_steps=3000", "training.max_steps",
     ""), ("training.max_steps=null training.max_episodes=1", "training.max_episodes", "=4"),
    ("agent=ppo proxy.horizon=null training.max_steps=100", "training.max_steps", "max_steps=512"),
    ("es=open_es es.population_size=3", "es.population_size", "es.population_size=4"),
    ("num_seeds=4", "num_seeds", "seed=0,1,2"), ("es.mirrored=yes", "es.mirrored", "be true or "),
    ("es.sigma=0.1", "es.sigma", "noise_std?"), ("agents=[ddqn,ppo", "agents", "in brackets"),
])  # fmt: skip
def test_bad_input_is_one_message_that_names_the_field_and_says_what_to_type(
    override, field, suggested
):
    error = refused(*override.split(" "))
    assert error.field == field and suggested in str(error), error


def test_parts_that_only_a_task_can_judge_are_refused_by_their_agents_name():
    error = refusal(sejax.config(["agents=[ddqn,ppo]", "agents.ppo.num_minibatches=100"]).parts)
    assert error.field == "agents.ppo.num_minibatches" and f"Set {error.field}=64." in str(error)


@pytest.mark.parametrize("part", [{"es": "nes"}, {"machines": 3}, {"proxy": None}, {"agents": {}}])
def test_a_configuration_made_in_python_holds_configurations(part):
    assert refusal(dataclasses.replace, sejax.config(), **part).field == next(iter(part))


@pytest.mark.parametrize(("override", "field"), [
    ("num_agents=3", "proxy"), ("proxy=real agent_hparams=as_learned", "agent_hparams"),
    ("proxy=real training_from=config", "training_from"), ("proxy=cartpole seed=-1", "seed"),
    ("proxy=real env=cartpole training.max_steps=9", "training"),
    ("proxy=cartpole agent_hparams=as_learned agents=[ddqn,sac]", "agents"),
    ("proxy=real env.length=2", "env"),
    ("proxy=cartpole training.max_steps=2000", "training"), ("proxy=cartpole agent=2", "agent"),
    ("proxy=cartpole generations=3", "generations"), ("proxy=cartpole num_agents=0", "num_agents"),
    ("proxy=cartpole agents=[ddqn,ppo] mixture.weights.ppo=2", "mixture.weights.ppo"),
])  # fmt: skip
def test_what_evaluate_cannot_use_is_refused(override, field):
    assert refused(*override.split(), make=evaluation).field == field


def test_hundreds_of_random_overrides_are_a_configuration_or_one_message():
    """No traceback, and nothing silent: what was composed has the values that were typed."""
    for overrides in (None, "env=cartpole", [3], {"env": "cartpole"}):
        assert refusal(sejax.config, overrides).field == "overrides"
    rng = random.Random(0)
    names = [*sejax.config().in_words(sejax.config().plain()), "agents", "agent.nope", "nope"]
    names.remove("run_dir")  # which any text may be
    texts = "0 1 -1 2.5 1e-3 64 nan inf null true [] [1] [ [ddqn] x ddqn ppo acrobot rn relu paper"
    texts = f"{texts} threshold ' ☃ a:b ${{x}} {{a:1}} 0x10 1_000 ~ ??? 9999999999 2 8 0.5".split()
    composed = 0
    for _ in range(400):
        overrides = [f"{rng.choice(names)}={rng.choice(texts)}" for _ in range(rng.randint(1, 2))]
        try:
            config = sejax.config(overrides)
        except ConfigError as error:
            assert len(str(error)) <= 300 and error.field, (overrides, error)
            continue
        composed += 1
        values = config.in_words(config.plain())
        for name, text in dict(x.split("=", 1) for x in overrides).items():
            assert name in ("agent", "agents") or values[name] == parsed(text), (overrides, name)
    assert composed > 10


# --- the command line -----------------------------------------------------------------------------


@pytest.mark.parametrize("words", [["env=2"], ["--multirun", "seed=0,1"], ["a b"], ["~env=[[1]]"]])
@pytest.mark.parametrize("module", [run, evaluate])
def test_a_command_ends_bad_words_with_one_message_and_status_2(
    module, words, monkeypatch, tmp_path, capsys
):
    monkeypatch.chdir(tmp_path)
    command = functools.partial(commands.start, module.main, module.help_text)
    status, out, err = ended(monkeypatch, capsys, command, *words)
    assert status == commands.BAD_INPUT and not out
    assert err.startswith("error: ") and err.count("\n") == 1 and len(err) < 420
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("module", "words", "schema", "expected"), [
    (run, [], LearnConfig, ["agent.batch_size=64  # transitions", "preset=best", "env: cartpole"]),
    (run, ["agents=[ddqn,ppo]"], LearnConfig, ["mixture.weights.ddqn=1.0  # share"]),
    (run, ["preset=paper", "seed=3,4"], LearnConfig, ["seed=3 (typed)", "=83 (preset=paper)"]),
    (evaluate, ["proxy=cartpole"], EvaluateConfig, ["agents.ppo.epochs=10  # passes", "(proxy)"]),
    (distill, ["env=examples.own_task:make_reacher"], CopyConfig, ["search.policy_error=0.1",
     "copy.hidden_size=32  #", "env.size=3  # metres"]),
])  # fmt: skip
def test_help_shows_each_field_with_its_value_and_text(module, words, schema, expected):
    said = module.help_text(words)
    names = {field.name for field in dataclasses.fields(schema)} - {"mixture"}
    for text in (*expected, *names):
        assert text in said


@pytest.mark.parametrize("override", ["tracker=tensorboard", "machines=ray"])
def test_a_package_that_is_missing_is_named_before_anything_starts(override, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert f"pip install '.[{override.partition('=')[2]}]'" in str(refused(override))


def test_importing_sejax_imports_nothing_slow_and_touches_nothing():
    program = """if True:
        import os, sys
        before = dict(os.environ)
        import sejax
        heavy = {"jax", "jaxlib", "flax", "optax", "numpy", "gymnax", "evosax", "pandas"}
        assert not heavy & set(sys.modules) and dict(os.environ) == before
        sejax.config(["env=acrobot", "es=cma_es"])
        slow = {"gymnax.registration", "evosax", "torch", "brax", "pandas", "matplotlib"}
        assert not slow & set(sys.modules), slow & set(sys.modules)
        import sejax.check
        assert "matplotlib.pyplot" not in sys.modules  # it would choose how pictures are shown
        from jax._src import xla_bridge
        assert not xla_bridge.backends_are_initialized()
    """
    printed(sys.executable, "-c", program)


@pytest.mark.parametrize(("agent", "batch_size"), [("sac", 64), ("ddqn", 7)])
def test_an_agent_that_is_typed_takes_the_place_of_those_of_a_file(agent, batch_size, tmp_path):
    path = tmp_path / "mine.yaml"
    for text in ("agents: {ddqn: {name: ddqn, batch_size: 7}}", "agent: ddqn\nagent.batch_size: 7"):
        path.write_text(text)
        config = sejax.config([f"preset={path}", f"agent={agent}"])
        assert {key: x.batch_size for key, x in config.agents.items()} == {agent: batch_size}
        assert sejax.config([f"preset={path}", "agent.batch_size=9"]).agent.batch_size == 9
    path.write_text("agents: {a: {name: ddqn, tau: 0.5}, b: {name: sac, tau: 0.5}}")
    config = sejax.config([f"preset={path}", "agents.a=ddqn", "agents.b=td3_discrete"])
    assert [x.tau for x in config.agents.values()] == [0.5, sejax.TD3Config().tau]
    path.write_text("agent.tau: 0.5")
    assert sejax.config([f"preset={path}", "agents.ddqn.tau=0.7"]).agent.tau == 0.7
