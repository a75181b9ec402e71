"""sejax.runs.config: overrides become a configuration; what cannot be is one short message."""

import dataclasses
import functools
import random
import sys
import typing

import pytest
import yaml
from support import ended, printed, refusal

import sejax
from sejax import distill, envs, evaluate, run
from sejax.distill import DistillConfig
from sejax.options import ConfigError, registry
from sejax.options.plain import flatten, parsed
from sejax.runs import commands, preset_files
from sejax.runs import config as configuration
from sejax.runs.compose import expand
from sejax.runs.config import EvaluateConfig, LearnConfig, evaluate_config, plain

OWN_NAME = ["agents=[ddqn,myopic]", "agents.myopic.name=ddqn", "agents.myopic.discount=0"]
composed_with = functools.cache(lambda *overrides: sejax.config(overrides))


def refused(*overrides, make=sejax.config):
    """The error of overrides: one short line that names a field."""
    error = refusal(make, overrides)
    assert error.field
    return error


# --- every choice composes ------------------------------------------------------------------------


@pytest.mark.parametrize("preset", ("best", "paper", "paper_performance", "soft"))
@pytest.mark.parametrize("env", ("cartpole", "acrobot"))
def test_every_task_composes_with_every_preset(env, preset):
    composed = composed_with(f"env={env}", f"preset={preset}")
    assert (composed.name("env"), composed.preset) == (env, preset)
    # An SE gives no sign of the agent's progress: its own returns level off, or a budget ends.
    assert composed.training.stop_rule == "plateau" or composed.training.max_steps is not None
    for group in (composed, composed.agent, composed.es, composed.training):
        for name, kind in typing.get_type_hints(type(group)).items():
            if kind in (int, float, bool, str):
                assert type(getattr(group, name)) is kind, name


@pytest.mark.parametrize("group", ["es", "objective", "exploration"])
def test_every_choice_of_a_group_composes(group):
    for name in registry.names(group):
        env = ["env=cliff_walking"] if name == "count_based" else []
        assert sejax.config([*env, f"{group}={name}"]).name(group) == name


def test_a_task_chooses_its_agent_and_a_proxy_its_objective():
    names = {env: composed_with(f"env={env}").name("agent") for env in envs.names()}
    assert names == {
        "cartpole": "ddqn", "cartpole_v1": "ddqn", "acrobot": "ddqn", "cliff_walking": "q_learning",
        "gridworld_2x2": "q_learning", "mountain_car": "ddqn", "mountain_car_continuous": "td3",
        "pendulum": "td3", "halfcheetah": "td3", "hopper": "td3", "walker2d": "td3",
        "swimmer": "td3", "inverted_pendulum": "td3", "ant": "td3", "reacher": "td3",
    }  # fmt: skip
    assert sejax.config(["env=pendulum", "agent=ppo"]).name("agent") == "ppo"
    assert composed_with("proxy=rn").name("objective") == "reward_threshold"
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
    assert str(sejax.config([word]).resolved_run_dir) == name


def test_values_are_read_by_the_types_of_their_fields():
    read = sejax.config(["es.noise_std=1e-2", "agent.learning_rate=1", "generations=3.0",
                         "stop_when_solved=true", "training.max_steps=null",
                         "training.stop_rule=plateau"])  # fmt: skip
    assert read.es.noise_std == 0.01 and type(read.agent.learning_rate) is float
    assert read.generations == 3 and type(read.generations) is int
    assert read.stop_when_solved is True and read.training.max_steps is None


# --- several agents -------------------------------------------------------------------------------


def test_a_mixture_has_fields_for_each_agent():
    composed = sejax.config(["agents=[td3_discrete,ddqn]", "agents.ddqn.batch_size=32",
                             "agents.td3_discrete.weight=2", "agents.aggregate=min"])  # fmt: skip
    assert composed.name("agent") == "ddqn+td3_discrete"
    assert composed.mixture.aggregate == "min"
    assert composed.weights == (1.0, 2.0)
    assert composed.agents["ddqn"].batch_size == 32
    assert composed.parts()["agent"].weights == (1.0, 2.0)


def test_an_agent_of_a_mixture_may_have_a_name_of_its_own():
    config = sejax.config([*OWN_NAME, "agents.myopic.weight=2"])
    assert sejax.config(["agent=ddqn", *OWN_NAME[1:], "agents.myopic.weight=2"]) == config
    sighted, myopic = config.agents.values()
    assert myopic.discount == 0.0
    assert sighted == sejax.config([]).agent, "with the settings of its preset"
    assert dataclasses.replace(myopic, discount=0.99) == sighted
    assert config.parts()["agent"].names == ("ddqn", "myopic")


@pytest.mark.parametrize("preset", ["best", "paper"])
def test_each_agent_of_a_mixture_has_the_settings_that_it_has_alone(preset):
    words = ("env=acrobot", f"preset={preset}", "training.max_steps=null")
    for key, agent in composed_with(*words, "agents=[td3_discrete,ddqn]").agents.items():
        assert agent == composed_with(*words, f"agent={key}").agent


@pytest.mark.parametrize("name", ["cartpole", "cartpole-rn", "cliff_walking-rn"])
def test_evaluate_trains_the_agents_that_a_proxy_was_learned_with(name):
    config = evaluate_config([f"proxy={name}"])
    learned = sejax.load_proxy(name).learned_agents()
    assert config.agents == learned
    assert config.agent_hparams == "as_learned"
    for key, agent in learned.items():  # as one that is named, too
        assert evaluate_config([f"proxy={name}", f"agent={key}"]).agent == agent
        changed = evaluate_config([f"proxy={name}", f"agent={key}", "agent.discount=0.5"]).agent
        assert changed == dataclasses.replace(agent, discount=0.5)
        default = evaluate_config([f"proxy={name}", f"agent={key}", "agent_hparams=default"])
        assert default.agent == type(agent)()


def test_evaluate_takes_one_of_several_learned_agents_with_its_fields_and_others_by_default():
    learned = sejax.load_proxy("cartpole").learned_agents()
    config = evaluate_config(["proxy=cartpole", "agents=[ppo,sac]", "agents.ppo.epochs=3"])
    expected = {"ppo": dataclasses.replace(learned["ppo"], epochs=3), "sac": sejax.SACConfig()}
    assert config.agents == expected and config.agent_hparams == "default"
    config = evaluate_config(["proxy=cartpole", "agent.discount=0.5"])  # of the task's own agent
    assert config.agent == dataclasses.replace(learned["ddqn"], discount=0.5)


# --- sweeps ---------------------------------------------------------------------------------------


def test_commas_outside_of_brackets_and_quotes_make_a_sweep():
    rest = ["agents=[ddqn,ppo]", "run_dir='a,b'"]
    runs = expand(["seed=0,1", *rest, "es.noise_std=1,2"])
    assert len(runs) == 4 and runs[1] == ["seed=0", *rest, "es.noise_std=2"]
    assert refused("seed=0,1").field == "seed"


def test_the_runs_of_a_sweep_have_folders_of_their_own():
    configs = run.configs_of(["seed=0,1", "es.noise_std=0.03,0.06", "num_seeds=2"])
    folders = {str(config.resolved_run_dir) for config in configs}
    assert len(folders) == 8 and all("noise_std" in folder for folder in folders)
    folders = [
        config.run_dir for config in run.configs_of(["env=cartpole,acrobot", "run_dir=here"])
    ]
    assert folders == ["here/env_cartpole", "here/env_acrobot"]
    configs = evaluate.configs_of(["proxy=cartpole", "seed=1,2"])
    assert [x.out_dir for x in configs] == ["runs/evaluate-seed_1", "runs/evaluate-seed_2"]


# --- preset files ---------------------------------------------------------------------------------


def test_a_preset_file_stands_for_its_overrides(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("env: acrobot\npreset: paper\nes:\n  noise_std: 0.05\nagent.batch_size: 3\n")
    words = ["env=acrobot", "preset=paper", "es.noise_std=0.05", "agent.batch_size=7"]
    assert sejax.config([f"preset={file}", words[-1]]) == sejax.config(words)
    file.write_text(preset_files.file_text(["agents=[ddqn,ppo]", "agents.ppo.weight=2"]))
    assert sejax.config([f"preset={file}"]).weights == (1.0, 2.0)


@pytest.mark.parametrize("overrides", [
    [], ["env=pendulum", "agent=sac"], ["env=cliff_walking", "proxy=rn"], OWN_NAME,
    ["agents=[ddqn,ppo]", "agents.ppo.weight=2"], ["es=snes", "env=gymnax/Catch-bsuite"],
])  # fmt: skip
def test_a_configuration_is_read_back_from_its_values_and_from_a_file(tmp_path, overrides):
    config = sejax.config([*overrides, "run_dir='a b,c=é'", "seed=3"])
    assert configuration.learn_config(plain(config)) == config
    assert configuration.completed(plain(config), config) == plain(config)
    if len(config.agents) == 1:  # as files had it before
        older = plain(config) | {"agent": plain(config)["agents"].popitem()[1], "agents": None}
        assert configuration.learn_config(older) == config
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(plain(config)))
    preset = f"preset={tmp_path / 'config.yaml'}"
    assert sejax.config([preset]) == config
    assert sejax.config([preset, "generations=7"]) == dataclasses.replace(config, generations=7)


@pytest.mark.parametrize("overrides", [None, "env=cartpole", [3], {"env": "cartpole"}])
@pytest.mark.parametrize("make", [sejax.config, evaluate_config])
def test_overrides_are_a_list_of_text(make, overrides):
    assert refusal(make, overrides).field == "overrides"


@pytest.mark.parametrize(
    "text",
    ["", "[1, 2]", "just text", "a: [", "env: 3", "nope: 1", "env: nope", "preset: other.yaml",
     "agent: {batch_size: {x: 1}}", "1: 2", "\x00", "- &a [*a]", "env: &a {x: *a}"],
)  # fmt: skip
def test_a_bad_preset_file_is_one_message(tmp_path, text):
    (tmp_path / "bad.yaml").write_text(text)
    refused(f"preset={tmp_path / 'bad.yaml'}")
    assert refused(f"preset={tmp_path / 'nope.yaml'}").field == "preset"
    assert refused(f"preset={tmp_path}.yaml").field == "preset"


# --- bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("override", "field", "suggested"), [
    ("env=cartpol", "env", "env=cartpole"), ("preset=papers", "preset", "preset=paper"),
    ("es.populaton_size=3", "es.populaton_size", "es.population_size"),
    ("agent.batchsize=3", "agent.batchsize", "agent.batch_size"),
    ("batch_size=3", "batch_size", "agent.batch_size"),
    ("agent.rollout_steps=3", "agent.rollout_steps", "agent=ppo"),
    ("env.goal_reward=-1", "env.goal_reward", "env=cliff_walking"),
    ("foo", "an override", "Write env=cartpole,"),
    ("generations.x=1", "generations", "got {'x': '1'}"),
    ("agents=[ddqn,ppo", "agents", "brackets close"),
    ("agents=[ddqn, ppo]", "agents", "Set agents=[ddqn]."),
    ("es.score_transform=my_rank", "es.score_transform", "es.score_transform=rank?"),
    ("es.score_transform=rank.py:f", "es.score_transform", "es.score_transform=rank:f."),
    ("agent=no_module_of:mine", "agent", "PYTHONPATH"),
    ("agents=[ddqn,td3_discret]", "agents.td3_discret", "td3_discrete"),
    ("agents=[]", "agents", "agents=[ddqn,ppo]"),
    ("agents=[ddqn,ppo] agent.batch_size=3", "agent.batch_size", "agents.ddqn.batch_size=3"),
    ("agents=[ddqn,ppo] agent=sac", "agent", "agents=[ddqn,ppo,sac]"),
    ("agents=[ddqn,ppo] agents.ddqn.batchsize=3", "agents.ddqn.batchsize", "batch_size"),
    ("agents.aggregate=min", "agents.aggregate", "agents=[ddqn,ppo]"),
    ("agents=[ddqn] agents.ddqn.weight=2", "agents.KEY.weight", "agents=[ddqn,ppo]"),
    ("preset=paper env=mountain_car", "preset", "preset=best"),
])  # fmt: skip
def test_bad_input_is_answered_with_what_to_type(override, field, suggested):
    error = refused(*override.split(" "))
    assert error.field == field and suggested in str(error), error


@pytest.mark.parametrize(("override", "field"), [
    (f"{'a' * 5000}=1", f"{'a' * 40}... (5000 characters)"), ("=1", "an override"),
    ("seed=-1", "seed"), ("es.population_size=1.5", "es.population_size"),
    ("es.noise_std=nan", "es.noise_std"), ("agent.hidden_size=[1,2]", "agent.hidden_size"),
    ("stop_when_solved=maybe", "stop_when_solved"), ("generations=1000000000", "generations"),
    ("es.score_transform=a b:c", "an override"), (f"agent=a:{'d' * 5000}", "agent"),
    ("agents=[ddqn,ddqn]", "agents"), ("agents=[ddqn,myopic]", "agents.myopic"),
    ("agents=3", "agent"), ("agents=[ddqn,ppo] agents.ddqn.weight=-1", "agents.ddqn.weight"),
    ("agents=[ddqn,ppo] agents.ddqn.batch_size=0", "agents.ddqn.batch_size"),
    ("agents=[ddqn,td3]", "agents.td3"), ("env=pendulum agent=ddqn", "agent"),
    ("env=cliff_walking agent=sarsa exploration=icm", "exploration"),
    ("training.stop_rule=solved training.solved_by=train", "training.solved_by"),
    ("proxy=rn stop_when_solved=true", "stop_when_solved"),
    ("training.max_episodes=3", "training.max_episodes"),
    ("proxy.done=soft proxy.horizon=null agent=ppo agent.rollout_steps=3000", "training.max_steps"),
    ("es=open_es es.population_size=3", "es.population_size"),
])  # fmt: skip
def test_bad_input_is_one_message_that_names_the_field(override, field):
    assert refused(*override.split(" ")).field == field


@pytest.mark.parametrize(("override", "field"), [
    ("num_agents=3", "proxy"), ("proxy=real agent_hparams=as_learned", "agent_hparams"),
    ("proxy=real training_from=config", "training_from"), ("proxy=cartpole agent=2", "agent"),
    ("proxy=real env=cartpole training.max_steps=9", "training"),
    ("proxy=cartpole agent_hparams=as_learned agent=ppo", "agent"),
    ("proxy=cartpole agent_hparams=as_learned agents=[ddqn,ppo]", "agents"),
    ("proxy=cartpole training.max_steps=3", "training"), ("proxy=cartpole seed=-1", "seed"),
    ("proxy=cartpole generations=3", "generations"), ("proxy=cartpole num_agents=0", "num_agents"),
    ("proxy=cartpole agents=[1,2]", "agents.1"),
    ("proxy=cartpole agents=[ddqn,ppo] agents.ppo.weight=2", "agents.ppo.weight"),
])  # fmt: skip
def test_what_evaluate_cannot_use_is_refused(override, field):
    assert refused(*override.split(), make=evaluate_config).field == field


def test_hundreds_of_random_overrides_are_a_configuration_or_one_message():
    """No traceback, and nothing silent: what was composed has the values that were asked for."""
    rng = random.Random(0)
    names = [*LearnConfig.groups, "preset", "seed", "generations", "devices", "agents"]
    fields = ("batch_size", "noise_std", "hidden_size", "max_steps", "activation", "learning_rate")
    for group in ("agent", "es", "proxy", "training", "objective"):
        names += [f"{group}.{field}" for field in (*fields, "done", "nope")]
    texts = ["0", "1", "-1", "2.5", "1e-3", "64", "nan", "inf", "null", "true", "[]", "[1]", "["]
    texts += ["[ddqn]", "x", "ddqn", "ppo", "acrobot", "rn", "relu", "paper", "threshold", "'", "☃"]
    texts += ["a:b", "${x}", "{a:1}", "0x10", "1_000", "9" * 20, "~", "???"]
    composed = 0
    for _ in range(600):
        overrides = [f"{rng.choice(names)}={rng.choice(texts)}" for _ in range(rng.randint(1, 2))]
        try:
            config = sejax.config(overrides)
        except ConfigError as error:
            assert len(str(error)) <= 300 and error.field, (overrides, error)
            continue
        composed += 1
        values = flatten(plain(config) | {"agent": plain(config)["agents"].popitem()[1]})
        for name, text in dict(x.split("=", 1) for x in overrides).items():
            typed = parsed(text)  # nan is not itself
            assert "." not in name or values[name] == typed or typed != typed, (overrides, name)
    assert composed > 5


# --- the command line -----------------------------------------------------------------------------


@pytest.mark.parametrize("words", [["env=2"], ["agent.batchsize=3"], ["--multirun", "seed=0,1"],
                                   ["--package", "x"], ["-m"], ["--resolve"], ["a b"], ["env=ä"],
                                   ["~env=[[1]]"], ["hydra/job=3"], ["seed=0,x"]])  # fmt: skip
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


@pytest.mark.parametrize(("module", "words", "expected"), [
    (run, [], ["agent.batch_size=64  # transitions", "preset=best", "env: cartpole"]),
    (run, ["agents=[ddqn,ppo]"], ["agents.ddqn.weight=1.0  # share", "agents.aggregate=mean"]),
    (run, ["preset=paper", "seed=3"],
     ["steps of the outer loop. (preset=paper)", "seed=3 (typed)", "=83 (preset=paper)"]),
    (evaluate, ["proxy=cartpole"], ["agents.ppo.epochs=10  # passes over", "(proxy)"]),
    (evaluate, [], ["num_agents=10", "real_training.stop_rule=solved"]),
    (distill, [], ["search.policy_error=0.1", "copy.hidden_size=32  #"]),
])  # fmt: skip
def test_help_shows_each_field_with_its_value_and_text(module, words, expected):
    said = module.help_text(words)
    for text in expected:
        assert text in said
    schema = {run: LearnConfig, evaluate: EvaluateConfig, distill: DistillConfig}[module]
    for field in {x.name for x in dataclasses.fields(schema)} - {"mixture", "weights"}:
        assert field in said


@pytest.mark.parametrize("env", preset_files.tuned("se"))
def test_agents_learn_within_the_default_budget_of_an_se(env):
    spec = envs.spec_of(registry.configure("env", {"name": env}))
    for name in registry.names("agent"):
        agent = registry.find("agent", name)
        if agent.states == spec.states and spec.actions in agent.actions:
            config = sejax.config([f"env={env}", f"agent={name}"])
            longest = config.proxy.max_steps(spec.max_steps)
            before = config.agent.steps_before_learning(longest, spec.max_steps)
            budget = config.training.max_episodes * longest
            budget = min(budget, config.training.max_steps or budget)
            assert budget >= 2 * before, name


@pytest.mark.parametrize("override", ["tracker=wandb", "tracker=tensorboard", "machines=ray"])
def test_a_package_that_is_missing_is_named_before_anything_starts(override, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert f"pip install 'sejax[{override.partition('=')[2]}]'" in str(refused(override))


def test_importing_sejax_imports_nothing_slow_and_touches_nothing():
    program = (
        "import os, sys\n"
        "before = dict(os.environ)\n"
        "import sejax\n"
        "heavy = {'jax', 'jaxlib', 'flax', 'optax', 'numpy', 'gymnax', 'evosax', 'pandas', "
        "'matplotlib'}\n"
        "assert not heavy & set(sys.modules) and dict(os.environ) == before\n"
        "sejax.config(['env=acrobot', 'es=cma_es'])\n"
        "slow = {'gymnax.registration', 'evosax', 'torch', 'brax', 'pandas', 'matplotlib'}\n"
        "assert not slow & set(sys.modules), slow & set(sys.modules)\n"
        "from jax._src import xla_bridge\n"
        "assert not xla_bridge.backends_are_initialized()\n"
    )
    printed(sys.executable, "-c", program)
