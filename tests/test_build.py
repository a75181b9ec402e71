"""sejax.cli.build: a command's configuration, as plain values and as the objects it describes."""

import copy
import functools
import re

import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser

import sejax
from sejax import envs
from sejax.agents.dqn import DDQNConfig
from sejax.cli import config as configuration
from sejax.cli.config import LearnConfig, families_of
from sejax.es.nes import NESConfig
from sejax.options import ConfigError, require, unknown_name
from sejax.training import TrainingConfig

config = functools.cache(lambda *overrides: sejax.config(overrides))
LARGEST = "at most 2147483647, because it is counted in 32 bits"

OUT_OF_RANGE = [
    ("es.noise_std=0", "above 0"), ("es.noise_std=inf", "finite"), ("es.step_size=-1", "above 0"),
    ("es.noise_std=1e38", "at most 1e+06"), ("es.step_size=1e300", "at most 1e+06"),
    ("es.noise_std_decay=0", "(0, 1]"), ("es.step_size_decay=1.1", "(0, 1]"),
    ("es.weight_decay=2", "[0, 1]"), ("es.num_evals=0", "at least 1"),
    ("agent.discount=nan", "[0, 1]"), ("agent.discount=1.01", "[0, 1]"),
    ("agent.epsilon_decay=-0.1", "[0, 1]"), ("agent.learning_rate=0", "above 0"),
    ("agent.batch_size=0", "at least 1"), ("agent.buffer_size=0", "at least 1"),
    ("agent.hidden_size=0", "at least 1"), ("agent.num_layers=0", "at least 1"),
    ("agent.warmup_episodes=-1", "at least 0"), ("proxy.hidden_size=0", "at least 1"),
    ("training.max_episodes=0", "at least 1"), ("training.window=0", "at least 1"),
    ("training.test_episodes=0", "at least 1"), ("training.plateau_tolerance=nan", "at least 0"),
    ("training.plateau_tolerance=inf", "be finite"), ("objective.unsolved_weight=inf", "be finite"),
    ("objective.unsolved_weight=-1", "at least 0"), ("generations=0", "at least 1"),
    ("seed=-1", "[0, 2**31)"), ("seed=2147483648", "[0, 2**31)"), ("num_seeds=0", "at least 1"),
    ("num_parallel=0", "at least 1"), ("devices=0", "at least 1"),
    ("checkpoint_every=0", "at least 1"),
    ("num_parallel=99999999999999999999", LARGEST),
    *((f"{name}={2**31}", LARGEST)
      for name in ("training.max_episodes", "training.max_steps", "training.min_steps",
                   "training.window", "training.test_episodes", "training.tests_between",
                   "agent.warmup_episodes", "agent.batch_size", "agent.buffer_size",
                   "agent.hidden_size", "generations", "num_seeds",
                   "checkpoint_every", "es.num_evals",
                   "es.num_incumbent_evals", "proxy.hidden_size")),
    ("es.population_size=100001", "at most 100000, because each is built by itself"),
    *((f"{name}.num_layers=2147483647", "at most 100, because each is built by itself")
      for name in ("agent", "proxy")),
]  # fmt: skip


@functools.cache
def refusal(word):
    """What is said of a word as typed, and the fix that it ends with."""
    field, _, typed = word.partition("=")
    group, _, name = field.rpartition(".")
    plain = copy.deepcopy(configuration.plain(config("objective=reward_threshold")))
    value = OverridesParser.create().parse_override(word).value()
    (plain[group] if group else plain)[name] = value
    with pytest.raises(ConfigError) as error:
        configuration.learn_config(plain)
    said = str(error.value)
    form = rf"^{re.escape(field)} must .*, because .+; got (.+)\. Set (.+)\.$"
    match = re.match(form, said)
    assert match and (match[1] == typed or float(match[1]) == float(typed)), said
    return said, match[2]


@pytest.mark.parametrize(("word", "rule"), OUT_OF_RANGE)
def test_a_value_out_of_range_is_refused_with_rule_reason_and_fix(word, rule):
    said, fix = refusal(word)
    assert rule in said
    assert fix.partition("=")[0] == word.partition("=")[0]


def test_the_fixes_that_messages_name_are_accepted():
    fixes = {refusal(word)[1] for word, _ in OUT_OF_RANGE}
    assert isinstance(sejax.config(["objective=reward_threshold", *sorted(fixes)]), LearnConfig)


def test_seeds_must_end_within_the_range_too():
    with pytest.raises(ConfigError, match=r"^seed \+ num_seeds - 1 must lie in \[0, 2\*\*31\)"):
        configuration.learn_config(configuration.plain(config()) | {"seed": 2**31 - 2, "num_seeds": 3})


def test_dataclasses_refuse_what_the_command_line_does():
    with pytest.raises(ConfigError, match=r"^es\.population_size must be at least 2, .* got 1\."):
        NESConfig(population_size=1)
    with pytest.raises(ConfigError, match=r"^agent\.activation must be one of .* got 'gelu'"):
        DDQNConfig(activation="gelu")


def test_a_config_error_is_a_value_error_with_the_projects_form():
    assert issubclass(ConfigError, ValueError) and sejax.ConfigError is ConfigError
    with pytest.raises(ConfigError, match=r"^a\.b must hold, because so; got 3\. Set a\.b=1\.$"):
        require(False, "a.b", "hold", "so", 3, "a.b=1")
    require(True, "a.b", "hold", "so", 3, "a.b=1")
    said = str(unknown_name("fruit", "aple", ["pear", "apple", "plum"]))
    assert said.startswith("fruit must be one of apple, ") and "fruit=apple?" in said


# --- as plain values -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("env=acrobot", "preset=paper", "seed=3", "run_dir=some/where"),
        ("es=cma_es", "devices=2", "num_parallel=4", "training.max_steps=1000"),
        ("env=cliff_walking", "proxy=rn", "exploration=count_based", "env.goal_reward=-1"),
        ("agents=[ppo,ddqn]", "agents.ddqn.weight=2", "agents.aggregate=min"),
    ],
    ids=" ".join,
)
def test_a_configuration_survives_being_written_and_read(overrides):
    composed = config(*overrides)
    values = configuration.plain(composed)
    assert configuration.learn_config(values) == composed
    assert configuration.learn_config(yaml.safe_load(yaml.safe_dump(values))) == composed


def test_plain_values_are_a_copy():
    composed = config()
    population = composed.es.population_size
    configuration.plain(composed)["es"]["population_size"] = 99
    assert composed.es.population_size == population != 99


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"es": None}, r"^es must be a choice with its fields"),
        ({"es": {"noise_std": 1.0}}, r"^es must be a choice with its fields, because one is made"),
        ({"training": 3}, r"^training must have fields"),
        ({"training": {"max_episode": 3}}, r"^training\.max_episode must be a field of Training"),
        ({"nothing": 3}, r"^nothing must be a field of LearnConfig"),
        ({"seed": "3"}, r"^seed must be a whole number, because that is its type; got '3'\."),
    ],
)
def test_plain_values_that_are_no_configuration_are_refused(change, said):
    with pytest.raises(ConfigError, match=said):
        configuration.learn_config(configuration.plain(config()) | change)


@pytest.mark.parametrize("missing", ["env", "es", "training", "seed"])
def test_plain_values_that_lack_something_are_refused(missing):
    plain = {k: v for k, v in configuration.plain(config()).items() if k != missing}
    said = {"env": r"^env must be chosen", "es": r"^es must be chosen"}
    with pytest.raises(ConfigError, match=said.get(missing, rf"^{missing} must be given, because")):
        configuration.learn_config(plain)


def test_values_of_before_there_were_families_are_read():
    plain = configuration.plain(config())
    assert plain.pop("agents") is None
    assert configuration.learn_config(plain) == config()


def test_one_agent_or_several_are_given_not_both():
    several = configuration.plain(config("agents=[ppo,ddqn]"))
    assert several["agent"] is None
    with pytest.raises(ConfigError, match=r"^agent must be left out with agents, .*'ddqn'"):
        configuration.learn_config(several | {"agent": {"name": "ddqn"}})
    with pytest.raises(ConfigError, match=r"^agents must hold an agent"):
        configuration.learn_config(several | {"agents": {"aggregate": "min"}})


def test_agents_are_the_same_in_whichever_order_they_stand():
    plain = configuration.plain(config("agents=[ppo,ddqn]"))
    turned = plain | {"agents": dict(reversed(plain["agents"].items()))}
    assert configuration.learn_config(turned) == configuration.learn_config(plain)
    assert [x.key for x in families_of(configuration.learn_config(turned))] == ["ddqn", "ppo"]


def test_configurations_are_hashable_so_that_what_they_build_is_cached():
    first, second = (configuration.learn_config(configuration.plain(config())) for _ in range(2))
    assert first.agent is not second.agent and first == second
    assert hash(first.agent) == hash(second.agent)


# --- as objects ----------------------------------------------------------------------------------


def test_parts_are_what_make_learner_takes_and_are_built_once():
    first, second = (configuration.learn_config(configuration.plain(config())).parts() for _ in range(2))
    assert first.keys() == second.keys() == {
        "task", "agent", "proxy", "es", "objective", "training", "stop_when_solved", "devices",
        "num_parallel",
    }  # fmt: skip
    assert first["task"] is envs.make("cartpole") is first["proxy"].task
    for name in ("task", "agent", "proxy", "objective"):
        assert first[name] is second[name], "the same parts share their compiled programs"
    assert first["training"] == TrainingConfig(max_steps=2000, max_episodes=2000, stop_rule="never")
    assert first["es"] == config().es


def test_a_varied_agent_is_drawn_anew_for_each_training():
    fixed = config("env=gridworld_2x2")
    varied = configuration.learn_config(configuration.plain(fixed) | {"agent_hparams": "varied"})
    agent = varied.parts()["agent"]
    assert agent.varied is not None
    assert fixed.parts()["agent"].varied is None


def test_several_agents_are_families_each_made_as_it_is_alone():
    words = ("env=gridworld_2x2", "agents=[sarsa,q_learning]", "agents.sarsa.weight=3",
             "agents.compared_by=rank")  # fmt: skip
    several = config(*words)
    made, task = several.parts()["agent"], several.task()
    assert (made.names, made.weights) == (("q_learning", "sarsa"), (1.0, 3.0))
    assert (made.config.compared_by, made.config.aggregate) == ("rank", "mean")
    assert made.agents == tuple(sejax.make_agent(x.agent, task) for x in families_of(several))
    varied = configuration.learn_config(configuration.plain(several) | {"agent_hparams": "varied"})
    assert all(agent.varied is not None for agent in varied.parts()["agent"].agents)


def test_a_configuration_that_states_its_spec_is_judged_without_making_the_task(monkeypatch):
    monkeypatch.setattr("sejax.registry.make", None)
    with pytest.raises(ConfigError, match=r"^agent must be one of .*ddqn.* in cartpole"):
        configuration.learn_config(configuration.plain(config()) | {"agent": {"name": "q_learning"}})
