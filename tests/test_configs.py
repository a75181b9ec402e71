"""sejax.configs: every choice composes, presets hold the paper's numbers, bad input is refused."""

import functools
import re
import subprocess
import sys

import pytest
import yaml

import sejax
from sejax import envs
from sejax.agents.configs import AGENT_CONFIGS
from sejax.configs import (
    CONF_DIR,
    EVOSAX_ALGORITHMS,
    DDQNConfig,
    EnvConfig,
    EvosaxConfig,
    LearnConfig,
    NESConfig,
    TrainingConfig,
    config,
    from_dict,
    to_dict,
)
from sejax.errors import ConfigError, require, unknown_name
from sejax.experiments.rn_studies import STUDIES

composed_with = functools.cache(lambda *overrides: config(overrides))
ENVS = ("cartpole", "acrobot")
BEST_SES = sorted((CONF_DIR / "tuned" / "best").glob("*-se.yaml"))
PRESETS = ("best", "paper", "paper_performance")


def message(*overrides):
    """What a user is told about these overrides."""
    with pytest.raises(ConfigError) as error:
        config(overrides)
    return str(error.value)


# --- every choice composes -----------------------------------------------------------------------


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("env", ENVS)
def test_every_task_composes_with_every_preset(env, preset):
    composed = composed_with(f"env={env}", f"preset={preset}")
    assert isinstance(composed, LearnConfig)
    assert (composed.env.name, composed.preset) == (env, preset)
    # An SE gives no sign of the agent's progress: its own returns level off, or a budget ends.
    assert composed.training.stop_rule == "plateau" or composed.training.max_steps is not None


@pytest.mark.parametrize("name", EVOSAX_ALGORITHMS)
def test_every_algorithm_of_evosax_composes(name):
    composed = config([f"es={name}"])
    assert composed.es == EvosaxConfig(name=name)


@pytest.mark.parametrize("name", ["max_reward", "reward_threshold"])
def test_every_objective_composes(name):
    assert config([f"objective={name}"]).objective.name == name


def test_without_overrides_it_is_the_best_cartpole_se():
    composed = config()
    assert (composed.env.name, composed.proxy.name, composed.agent.name) == (
        "cartpole", "se", "ddqn",
    )  # fmt: skip
    assert composed.preset == "best" and composed.es.name == "nes"
    assert str(composed.resolved_run_dir) == "runs/cartpole-se-ddqn-s0"


def test_the_yaml_files_give_every_field_a_value_of_its_type():
    for env in ENVS:
        for preset in PRESETS:
            composed = composed_with(f"env={env}", f"preset={preset}")
            for group in (composed, composed.agent, composed.es, composed.training):
                for name, field in type(group).__dataclass_fields__.items():
                    value = getattr(group, name)
                    if field.type in ("int", "float", "bool", "str", int, float, bool, str):
                        assert type(value).__name__ == getattr(field.type, "__name__", field.type)


def test_overrides_win_over_presets():
    composed = config(["preset=paper", "es.noise_std=0.7", "agent.batch_size=3", "generations=9"])
    assert (composed.es.noise_std, composed.agent.batch_size, composed.generations) == (0.7, 3, 9)
    assert composed.es.step_size == 0.148  # the preset's, where nothing was said


def test_the_run_directory_names_the_run():
    composed = config(["env=acrobot", "seed=7"])
    assert str(composed.resolved_run_dir) == "runs/acrobot-se-ddqn-s7"
    assert str(config(["run_dir=elsewhere"]).resolved_run_dir) == "elsewhere"


# --- presets and the paper's tables --------------------------------------------------------------

# Table "Hyperparameter configuration spaces optimized for learning SEs": CartPole-v0, Acrobot-v1.
OPTIMIZED = {
    "es.step_size": (0.148, 0.727),
    "es.noise_std": (0.0124, 0.0114),
    "es.mirrored": (True, True),
    "es.score_transform": ("all_better_2", "all_better_2"),
    "proxy.num_layers": (1, 1),
    "proxy.hidden_size": (83, 167),
    "proxy.activation": ("leaky_relu", "prelu"),
    "agent.init_episodes": (1, 20),
    "agent.batch_size": (199, 149),
    "agent.learning_rate": (0.000304, 0.00222),
    "agent.target_update_rate": (0.00848, 0.0209),
    "agent.discount": (0.988, 0.991),
    "agent.epsilon_init": (0.809, 0.904),
    "agent.epsilon_min": (0.0371, 0.0471),
    "agent.epsilon_decay": (0.961, 0.899),
    "agent.num_layers": (1, 1),
    "agent.hidden_size": (57, 112),
    "agent.activation": ("tanh", "leaky_relu"),
}
# Table "Subset of the hyperparameter configuration spaces that we kept fixed". Episode length and
# solved reward are the tasks' own: see test_envs.py.
FIXED = {
    "generations": (200, 200),  # n_o
    "training.max_episodes": (1000, 1000),  # n_e
    "training.test_episodes": (10, 10),  # n_te
    "es.population_size": (16, 16),  # n_p
    "agent.buffer_size": (100_000, 100_000),
    "training.window": (10, 10),  # d
    "training.plateau_tolerance": (0.01, 0.01),  # C_diff
}
# Table "Default agent hyperparameters".
DEFAULT_AGENT = {
    "agent.init_episodes": 10,
    "agent.batch_size": 128,
    "agent.learning_rate": 0.001,
    "agent.target_update_rate": 0.01,
    "agent.discount": 0.99,
    "agent.epsilon_decay": 0.9,
    "agent.num_layers": 2,
    "agent.hidden_size": 128,
    "agent.activation": "relu",
    "agent.buffer_size": 100_000,
    "training.max_episodes": 1000,
}


def value_at(composed, path):
    for name in path.split("."):
        composed = getattr(composed, name)
    return composed


@pytest.mark.parametrize("path", [*OPTIMIZED, *FIXED])
def test_the_papers_preset_holds_the_numbers_of_its_tables(path):
    for column, env in enumerate(ENVS):
        composed = composed_with(f"env={env}", "preset=paper")
        assert value_at(composed, path) == (OPTIMIZED | FIXED)[path][column]


def test_the_papers_preset_follows_algorithm_1():
    # psi <- psi + alpha / (n_p sigma) * sum F_i eps_i, for n_o steps whatever is solved.
    for env in ENVS:
        composed = composed_with(f"env={env}", "preset=paper")
        assert composed.es.update_rule == "paper" and composed.es.num_evals == 1
        assert composed.es.weight_decay == 0 and composed.es.noise_std_decay == 1
        assert composed.stop_when_solved is False
        assert composed.objective.name == "max_reward"


@pytest.mark.parametrize("path", DEFAULT_AGENT)
def test_the_performance_preset_has_the_papers_default_agent(path):
    for env in ENVS:
        composed = composed_with(f"env={env}", "preset=paper_performance")
        assert value_at(composed, path) == DEFAULT_AGENT[path]


def test_the_performance_preset_is_how_those_ses_were_made():
    # The authors' configuration files: sigma 0.05, alpha 1, 128 LeakyReLU units, at most 50
    # generations, stopped when solved; epsilon from 1 to 0.01.
    for env in ENVS:
        composed = composed_with(f"env={env}", "preset=paper_performance")
        assert (composed.es.noise_std, composed.es.step_size) == (0.05, 1.0)
        assert (composed.es.update_rule, composed.es.score_transform) == ("authors", "all_better_2")
        assert (composed.proxy.hidden_size, composed.proxy.activation) == (128, "leaky_relu")
        assert composed.generations == 50
        assert (composed.agent.epsilon_init, composed.agent.epsilon_min) == (1.0, 0.01)


def test_the_performance_preset_stops_when_solved():
    assert composed_with("env=cartpole", "preset=paper_performance").stop_when_solved
    assert composed_with("env=acrobot", "preset=paper_performance").stop_when_solved


def test_the_dataclass_defaults_are_the_papers_default_agent():
    for path, expected in DEFAULT_AGENT.items():
        group, name = path.split(".")
        schema = {"agent": DDQNConfig, "training": TrainingConfig}[group]
        assert getattr(schema(), name) == expected


# Appendix "Reward Network Hyperparameters": the tables for learning RNs, a column for each task.
RN_TASKS = ("cliff_walking", "cartpole", "mountain_car_continuous", "halfcheetah")
LEARNING_RNS = {
    "generations": (50,) * 4,
    "es.population_size": (16,) * 4,
    "es.step_size": (0.5,) * 4,
    "es.noise_std": (0.1,) * 4,
    "es.mirrored": (True,) * 4,
    "es.score_transform": ("all_better_2",) * 4,
    "objective.unsolved_weight": (100,) * 4,
    "training.test_episodes": (1,) * 4,
    "training.max_episodes": (100,) * 4,
    "proxy.num_layers": (1,) * 4,
    "proxy.hidden_size": (32, 64, 128, 128),
    "proxy.activation": ("prelu",) * 4,
    "agent.name": ("q_learning", "ddqn", "td3", "td3"),
    "agent.learning_rate": (1.0, 0.003, 0.003, 0.003),
    "agent.discount": (0.8, 0.99, 0.99, 0.98),
    "agent.init_episodes": (None, 1, 50, 20),
    "agent.batch_size": (None, 192, 192, 192),
    "agent.target_update_rate": (None, 0.01, 0.01, 0.01),
    "agent.num_layers": (None, 1, 2, 2),
    "agent.hidden_size": (None, 64, 128, 128),
    "agent.activation": (None, "leaky_relu", "leaky_relu", "relu"),
    "agent.buffer_size": (None, 1_000_000, 100_000, 100_000),
    "agent.epsilon_init": (0.01, 0.8, None, None),
    "agent.epsilon_min": (0.01, 0.03, None, None),
    "agent.epsilon_decay": (0.0, 0.95, None, None),
    "agent.policy_delay": (None, None, 1, 1),
    "agent.action_repeat": (None, None, 2, 1),
    "agent.action_noise_std": (None, None, 0.05, 0.05),
    "agent.target_noise_std": (None, None, 0.2, 0.2),
    "agent.target_noise_clip": (None, None, 0.5, 0.5),
}
# The tables of default hyperparameters, for agents that are trained on learned RNs. SARSA's are not
# here: see `STUDIES`.
AFTER_LEARNING = {
    ("cliff_walking", "agent"): {"learning_rate": 1.0, "discount": 0.8, "epsilon_init": 0.1,
                                 "epsilon_min": 0.1, "epsilon_decay": 0.0},
    ("cartpole", "agent"): {
        "init_episodes": 1, "batch_size": 32, "learning_rate": 0.00025, "target_update_rate": 0.01,
        "discount": 0.99, "epsilon_init": 1.0, "epsilon_min": 0.1, "epsilon_decay": 0.9,
        "num_layers": 1, "hidden_size": 64, "activation": "relu", "buffer_size": 1_000_000,
    },
    ("cartpole", "transfer_agent"): {
        "init_episodes": 1, "batch_size": 32, "learning_rate": 0.00025, "target_update_rate": 0.01,
        "discount": 0.99, "epsilon_init": 1.0, "epsilon_min": 0.1, "epsilon_decay": 0.9,
        "num_layers": 1, "hidden_size": 64, "activation": "relu", "buffer_size": 1_000_000,
        "feature_dim": 128, "stream_num_layers": 1, "stream_hidden_size": 128,
    },
    ("mountain_car_continuous", "agent"): {
        "init_episodes": 50, "batch_size": 256, "learning_rate": 0.0003, "discount": 0.99,
        "target_update_rate": 0.005, "policy_delay": 2, "action_repeat": 2,
        "action_noise_std": 0.1, "target_noise_std": 0.2, "target_noise_clip": 0.5,
        "num_layers": 2, "hidden_size": 128, "activation": "relu", "buffer_size": 100_000,
    },
    ("halfcheetah", "agent"): {
        "init_episodes": 20, "batch_size": 256, "learning_rate": 0.0003, "discount": 0.99,
        "target_update_rate": 0.005, "policy_delay": 2, "action_repeat": 1,
        "action_noise_std": 0.1, "target_noise_std": 0.2, "target_noise_clip": 0.5,
        "num_layers": 2, "hidden_size": 128, "activation": "relu", "buffer_size": 100_000,
    },
    ("mountain_car_continuous", "transfer_agent"): {
        "epochs": 80, "learning_rate": 0.0003, "update_episodes": 10, "discount": 0.99,
        "action_repeat": 5, "value_weight": 1, "entropy_weight": 0.01, "clip_ratio": 0.2,
        "num_layers": 2, "hidden_size": 64, "activation": "relu",
    },
    ("halfcheetah", "transfer_agent"): {
        "epochs": 10, "learning_rate": 0.00001, "update_episodes": 1, "discount": 0.99,
        "action_repeat": 1, "value_weight": 1, "entropy_weight": 0.001, "clip_ratio": 0.2,
        "num_layers": 2, "hidden_size": 128, "activation": "tanh",
    },
}  # fmt: skip
# "Optimized value" of the tables of the ICM, and of the count-based agents.
BONUSES = {
    "cliff_walking": {"reward_scale": 0.1},
    "cartpole": {"learning_rate": 0.00001, "forward_weight": 0.05, "reward_scale": 0.03},
    "mountain_car_continuous": {"learning_rate": 0.0005, "forward_weight": 0.1,
                                "reward_scale": 0.01},
    "halfcheetah": {"learning_rate": 0.00001, "forward_weight": 0.001, "reward_scale": 0.1},
}  # fmt: skip


@pytest.mark.parametrize("path", LEARNING_RNS)
def test_the_papers_preset_holds_the_numbers_of_its_tables_for_rns(path):
    for env, expected in zip(RN_TASKS, LEARNING_RNS[path], strict=True):
        composed = composed_with(f"env={env}", "proxy=rn", "preset=paper")
        if expected is not None:
            assert value_at(composed, path) == expected


@pytest.mark.parametrize("env", ["mountain_car_continuous", "halfcheetah"])
def test_ppo_trains_for_more_episodes_on_rns(env):
    composed = composed_with(f"env={env}", "proxy=rn", "preset=paper", "agent=ppo")
    assert composed.training.max_episodes == 1000


@pytest.mark.parametrize(("env", "which"), AFTER_LEARNING)
def test_agents_after_learning_rns_are_those_of_the_papers_tables(env, which):
    agent = getattr(STUDIES[env], which)
    expected = AFTER_LEARNING[env, which]
    assert {name: getattr(agent, name) for name in expected} == expected


@pytest.mark.parametrize("env", BONUSES)
def test_bonuses_beside_rns_are_those_of_the_papers_tables(env):
    (bonus,) = STUDIES[env].bonuses.values()
    assert {name: getattr(bonus, name) for name in BONUSES[env]} == BONUSES[env]
    if bonus.name == "icm":
        assert (bonus.feature_dim, bonus.hidden_size) == (32, 128)


# --- bad input -----------------------------------------------------------------------------------


def test_a_population_of_one_is_refused_with_the_whole_message():
    assert message("es.population_size=1") == (
        "es.population_size must be at least 2, because scores are compared within a generation; "
        "got 1. Set es.population_size=16."
    )


@pytest.mark.parametrize("env", [path.stem.removesuffix("-se") for path in BEST_SES])
def test_agents_learn_within_the_default_budget_of_an_se(env):
    kind = envs.kind(env)
    for name, agent in AGENT_CONFIGS.items():
        if agent.states == kind.states and kind.actions in agent.actions:
            config = sejax.config([f"env={env}", f"agent={name}"])
            before = config.agent.steps_before_learning(kind.max_steps)
            budget = config.training.max_steps or config.training.max_episodes * kind.max_steps
            assert budget >= 2 * before, name


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (("env=acrobot", "agent=dueling_ddqn", "agent.init_episodes=10"),
         "training.max_steps must exceed 5000, because dueling_ddqn learns nothing before with "
         "agent.init_episodes=10; got 4000."),
        (("agent=ppo", "agent.update_episodes=20"),
         "training.max_steps must exceed 4001, because ppo learns nothing before"),
        (("training.stop_rule=solved", "training.solved_by=train"),
         "training.solved_by must be test with stop_rule=solved"),
        (("env=cliff_walking", "proxy=rn", "training.solved_by=train"),
         "training.solved_by must be test with stop_rule=solved"),
    ],
)  # fmt: skip
def test_trainings_that_cannot_teach_or_judge_are_refused(overrides, said):
    assert message(*overrides).startswith(said)


def test_only_cliff_walking_has_a_choice_of_goal_reward():
    assert config(["env=cliff_walking", "env.goal_reward=-1"]).env.make().params.goal_reward == -1
    assert message("env=cliff_walking", "env.goal_reward=nan").startswith("env.goal_reward must be")
    with pytest.raises(ConfigError, match="goal_reward must be null in gridworld_2x2"):
        EnvConfig(name="gridworld_2x2", goal_reward=1.0)
    said = message("env=cartpole", "env.goal_reward=-1")
    assert "env.goal_reward, which another choice of env has" in said


def test_episodes_that_may_end_early_need_no_long_budget():
    sejax.config(["proxy.done=threshold", "training.max_steps=100"])
    sejax.config(["proxy=rn", "training.max_steps=100"])


def test_a_value_that_is_no_number_is_refused_with_the_whole_message():
    assert message("es.noise_std=nan") == (
        "es.noise_std must be above 0 and finite, because members must differ; got nan. "
        "Set es.noise_std=0.05."
    )


@pytest.mark.parametrize(
    ("override", "field", "nearest"),
    [
        ("env=cartpol", "env", "cartpole"),
        ("agent=dqn", "agent", "ddqn"),
        ("es=nez", "es", "nes"),
        ("es=open-es", "es", "open_es"),
        ("preset=papers", "preset", "paper"),
        ("objective=max_rewards", "objective", "max_reward"),
        ("es.score_transform=all_beter_2", "es.score_transform", "all_better_2"),
        ("proxy.activation=leakyrelu", "proxy.activation", "leaky_relu"),
        ("training.stop_rule=plato", "training.stop_rule", "plateau"),
    ],
)
def test_an_unknown_choice_lists_the_known_ones_nearest_first(override, field, nearest):
    got = override.partition("=")[2]
    said = message(override)
    assert said.startswith(f"{field} must be one of {nearest}")
    assert f"got '{got}'" in said and f"Did you mean {field}={nearest}?" in said


@pytest.mark.parametrize(
    ("override", "nearest"),
    [
        ("es.populaton_size=3", "es.population_size"),
        ("generation=3", "generations"),
        ("agent.learningrate=0.1", "agent.learning_rate"),
        ("es=open_es es.populationsize=4", "es.population_size"),
        ("proxy=rn variant=additive_potential", "proxy.variant"),  # the right field, without group
    ],
)
def test_an_unknown_field_names_the_nearest_one(override, nearest):
    *choices, last = override.split()
    said = message(*choices, last)
    assert last.partition("=")[0] in said and f"Did you mean {nearest}?" in said


def test_a_field_that_another_algorithm_has_is_not_suggested():
    assert "Did you mean es.mirrored?" not in message("es=open_es", "es.mirrored=true")


@pytest.mark.parametrize(
    "overrides", [("proxy.name=rn",), ("env.name=no_such_task",), ("agent.name=dqn",)], ids=" ".join
)
def test_a_name_that_no_choice_has_is_refused(overrides):
    message(*overrides)


@pytest.mark.parametrize(
    ("override", "field"),
    [
        ("es.population_size=abc", "es.population_size"),
        ("es.population_size=1.5", "es.population_size"),
        ("es.noise_std=much", "es.noise_std"),
        ("stop_when_solved=maybe", "stop_when_solved"),
        ("agent.hidden_size=[1,2]", "agent.hidden_size"),
        ("training.max_episodes=null", "training.max_episodes"),
        ("seed=x", "seed"),
    ],
)
def test_a_value_of_another_type_is_refused_and_the_field_named(override, field):
    said = message(override)
    assert field in said and "\n" not in said


OUT_OF_RANGE = [
    ("es.noise_std=0", "above 0"), ("es.noise_std=inf", "finite"), ("es.step_size=-1", "above 0"),
    ("es.noise_std_decay=0", "(0, 1]"), ("es.step_size_decay=1.1", "(0, 1]"),
    ("es.weight_decay=2", "[0, 1]"), ("es.num_evals=0", "at least 1"),
    ("agent.discount=nan", "[0, 1]"), ("agent.discount=1.01", "[0, 1]"),
    ("agent.epsilon_decay=-0.1", "[0, 1]"), ("agent.learning_rate=0", "above 0"),
    ("agent.batch_size=0", "at least 1"), ("agent.buffer_size=0", "at least 1"),
    ("agent.hidden_size=0", "at least 1"), ("agent.num_layers=0", "at least 1"),
    ("agent.init_episodes=-1", "at least 0"), ("proxy.hidden_size=0", "at least 1"),
    ("training.max_episodes=0", "at least 1"), ("training.window=0", "at least 1"),
    ("training.test_episodes=0", "at least 1"), ("training.plateau_tolerance=nan", "at least 0"),
    ("objective.unsolved_weight=-1", "at least 0"), ("generations=0", "at least 1"),
    ("seed=-1", "[0, 2**31)"), ("seed=2147483648", "[0, 2**31)"), ("num_seeds=0", "at least 1"),
    ("lanes=0", "at least 1"), ("devices=0", "at least 1"), ("checkpoint_every=0", "at least 1"),
]  # fmt: skip


@functools.cache
def refusal(override):
    """What is said, and the fix that it ends with."""
    field, _, value = override.partition("=")
    said = message(override)
    form = rf"^{re.escape(field)} must .*, because .+; got {re.escape(value)}(\.0)?\. Set (.+)\.$"
    match = re.match(form, said)
    assert match, said
    return said, match.group(2)


@pytest.mark.parametrize(("override", "rule"), OUT_OF_RANGE)
def test_a_value_out_of_range_is_refused_with_rule_reason_and_fix(override, rule):
    said, fix = refusal(override)
    assert rule in said
    assert fix.partition("=")[0] == override.partition("=")[0]


def test_the_fixes_that_messages_name_are_accepted():
    fixes = {refusal(override)[1] for override, _ in OUT_OF_RANGE}
    assert isinstance(config(sorted(fixes)), LearnConfig)


def test_an_odd_population_is_refused_where_evosax_pairs_perturbations():
    assert message("es=open_es", "es.population_size=3") == (
        "es.population_size must be even, because evosax's algorithms pair opposite perturbations; "
        "got 3. Set es.population_size=4."
    )


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
        ("es=cma_es", "devices=2", "lanes=4", "training.max_steps=1000"),
    ],
    ids=" ".join,
)
def test_a_configuration_survives_being_written_and_read(overrides):
    composed = config(overrides)
    values = to_dict(composed)
    assert from_dict(values) == composed
    assert from_dict(yaml.safe_load(yaml.safe_dump(values))) == composed


def test_plain_values_are_a_copy():
    composed = config(["es.population_size=16"])
    to_dict(composed)["es"]["population_size"] = 99
    assert composed.es.population_size == 16


def test_configurations_are_hashable_so_that_what_they_build_is_cached():
    assert hash(config().agent) == hash(config().agent)
    assert config().agent is not config().agent and config() == config()


# --- imports -------------------------------------------------------------------------------------


def test_importing_sejax_and_composing_imports_nothing_heavy():
    program = (
        "import os, sys\n"
        "before = dict(os.environ)\n"
        "import sejax\n"
        "from sejax import errors\n"
        "sejax.config(['env=acrobot', 'es=cma_es'])\n"
        "try:\n"
        "    sejax.config(['env=acrobat'])\n"
        "except sejax.ConfigError:\n"
        "    pass\n"
        "import sejax.envs\n"
        "sejax.envs.names()\n"
        "heavy = {'jax', 'jaxlib', 'flax', 'gymnax', 'evosax', 'optax', 'torch', 'brax', 'numpy'}\n"
        "print(sorted(heavy & set(sys.modules)), dict(os.environ) == before)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.strip() == "[] True", done.stdout + done.stderr
