"""sejax.presets: the settings that were published are the paper's, number for number."""

import dataclasses
import functools

import pytest

import sejax
from experiments.common.reward_networks import STUDIES
from sejax.agents.ppo import PPOConfig
from sejax.options import ConfigError, registry
from sejax.runs import preset_files

composed_with = functools.cache(lambda *overrides: sejax.config(overrides))
ENVS = ("cartpole", "acrobot")

# Table "Hyperparameter configuration spaces optimized for learning SEs": CartPole-v0, Acrobot-v1.
OPTIMIZED = {
    "es.step_size": (0.148, 0.727),
    "es.noise_std": (0.0124, 0.0114),
    "es.mirrored": (True, True),
    "es.score_transform": ("all_better_2", "all_better_2"),
    "proxy.num_layers": (1, 1),
    "proxy.hidden_size": (83, 167),
    "proxy.activation": ("leaky_relu", "prelu"),
    "agent.warmup_episodes": (1, 20),
    "agent.batch_size": (199, 149),
    "agent.learning_rate": (0.000304, 0.00222),
    "agent.tau": (0.00848, 0.0209),
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
    # Algorithm 1: psi <- psi + alpha / (n_p sigma) * sum F_i eps_i, for n_o steps.
    "es.update_rule": ("paper", "paper"),
    "es.num_evals": (1, 1),
    "es.weight_decay": (0, 0),
    "es.noise_std_decay": (1, 1),
    "stop_when_solved": (False, False),
    "objective.name": ("max_reward", "max_reward"),
}


def value_at(composed, path):
    group, _, name = path.rpartition(".")
    if name == "name":
        return composed.name(group)
    return getattr(getattr(composed, group) if group else composed, name)


@pytest.mark.parametrize("path", [*OPTIMIZED, *FIXED])
def test_the_papers_preset_holds_the_numbers_of_its_tables(path):
    for column, env in enumerate(ENVS):
        composed = composed_with(f"env={env}", "preset=paper")
        assert value_at(composed, path) == (OPTIMIZED | FIXED)[path][column]


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
        assert composed.training == sejax.TrainingConfig(
            stop_rule="plateau", max_steps=None, max_episodes=1000
        )
        assert composed.stop_when_solved


# Table "Default agent hyperparameters"; what docs/agents.md says of DQN; the authors' discrete TD3
# (its block in their default configuration); Haarnoja et al. (2018), table 1.
PAPERS = {
    "warmup_episodes": 10, "batch_size": 128, "learning_rate": 0.001, "tau": 0.01, "discount": 0.99,
    "epsilon_decay": 0.9, "num_layers": 2, "hidden_size": 128, "activation": "relu",
    "buffer_size": 100_000,
}  # fmt: skip
AGENTS = {
    "ddqn": PAPERS | {"exploration_steps": None},
    "dueling_ddqn": PAPERS | {"feature_dim": 128, "stream_hidden_size": 128},
    "dqn": PAPERS | {"double": False, "epsilon_min": 0.05, "exploration_steps": 1000},
    "td3_discrete": {
        "learning_rate": 5e-4, "tau": 0.01, "policy_delay": 2, "batch_size": 128,
        "activation": "tanh", "hidden_size": 128, "num_layers": 2, "layer_norm": True,
        "temperature": 1.0, "one_hot_actions": False, "action_noise_std": 0.1,
        "target_noise_std": 0.2, "target_noise_clip": 0.5,
    },
    "sac": {
        "learning_rate": 3e-4, "discount": 0.99, "num_layers": 2, "hidden_size": 256,
        "batch_size": 256, "activation": "relu", "target_entropy": -1.0,
        "tau": 0.005,
    },
}  # fmt: skip


@pytest.mark.parametrize("agent", AGENTS)
def test_agents_of_the_performance_preset_are_those_of_their_papers(agent):
    config = composed_with("env=cartpole", "preset=paper_performance", f"agent={agent}").agent
    wanted = AGENTS[agent]
    assert {name: getattr(config, name) for name in wanted} == wanted


@pytest.mark.parametrize("agent", [*AGENTS, "ppo", "td3"])
def test_classes_have_the_defaults_of_the_command(agent):
    env = "gymnax/MountainCarContinuous-v0" if agent == "td3" else "gymnax/MountainCar-v0"
    composed = composed_with(f"env={env}", f"agent={agent}")
    assert composed.agent == type(composed.agent)()
    assert composed.proxy == sejax.SyntheticConfig()
    assert composed.training == sejax.TrainingConfig()
    assert composed.es == sejax.NESConfig()


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
    "agent.warmup_episodes": (None, 1, 50, 20),
    "agent.batch_size": (None, 192, 192, 192),
    "agent.tau": (None, 0.01, 0.01, 0.01),
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


@pytest.mark.parametrize("path", LEARNING_RNS)
def test_the_papers_preset_holds_the_numbers_of_its_tables_for_rns(path):
    for env, expected in zip(RN_TASKS, LEARNING_RNS[path], strict=True):
        composed = composed_with(f"env={env}", "proxy=rn", "preset=paper")
        if expected is not None:
            assert value_at(composed, path) == expected


@pytest.mark.parametrize("env", ["mountain_car_continuous", "halfcheetah", "pendulum"])
def test_the_best_preset_has_a_quick_td3_for_continuous_tasks(env):
    composed = composed_with(f"env={env}", "proxy=rn")
    assert composed.name("agent") == "td3"
    assert composed.agent.hidden_size == composed.agent.batch_size == 64
    assert composed.agent.warmup_episodes <= composed.training.max_episodes // 5
    # Only on Pendulum, which never terminates, does it matter whether it learns at all.
    assert composed.training.time_limit_is_terminal == (env != "pendulum")


@pytest.mark.parametrize(
    ("env", "preset"),
    [("mountain_car_continuous", "paper"), ("halfcheetah", "paper"), ("halfcheetah", "best")],
)
def test_ppo_on_rns_is_the_papers_and_trains_for_more_episodes(env, preset):
    composed = composed_with(f"env={env}", "proxy=rn", f"preset={preset}", "agent=ppo")
    assert composed.training.max_episodes == 1000
    assert composed.agent == STUDIES[env].transfer_agent  # see test_experiments_rn.py


def test_the_best_preset_has_a_quick_ppo_for_mountain_car_continuous():
    """The paper's, which learns eight or sixteen times as often, in fewer and shorter trainings."""
    study = STUDIES["mountain_car_continuous"]
    composed = composed_with("env=mountain_car_continuous", "proxy=rn", "agent=ppo")
    assert composed.training.max_episodes < 100 and composed.es.num_evals > 1
    for quick in (composed.agent, study.tuned_agent):
        assert 7 * quick.rollout_length(999) < study.transfer_agent.rollout_length(999) == 1999
        freed = {"rollout_steps": None, "learning_rate": 3e-4, "init_action_std": 0.5}
        assert dataclasses.replace(quick, **freed) == study.transfer_agent


@pytest.mark.parametrize("env", ["cartpole", "mountain_car", "mountain_car_continuous"])
def test_ppo_on_ses_is_the_default(env):
    assert composed_with(f"env={env}", "agent=ppo").agent == PPOConfig()


# --- the files -----------------------------------------------------------------------------------


def test_what_is_tuned_is_known():
    assert preset_files.names() == ["best", "distilled", "paper", "paper_performance", "soft"]
    assert preset_files.tuned("rn") == [
        "cartpole", "cliff_walking", "halfcheetah", "mountain_car_continuous", "pendulum",
    ]  # fmt: skip
    assert preset_files.tuned("se", "paper") == ["acrobot", "cartpole"]
    assert preset_files.is_tuned("acrobot", "se") and not preset_files.is_tuned("acrobot", "rn")


def test_every_file_is_of_a_task_and_proxy_and_has_settings_of_known_choices():
    for path in preset_files.PRESETS.glob("*-*.yaml"):
        env, _, proxy = path.stem.rpartition("-")
        assert proxy in registry.names("proxy")
        assert env in (preset_files.GENERAL, *registry.names("env"))
        for name, section in preset_files.sections_of(env, proxy).items():
            assert name in preset_files.names()
            for group in ("agent", "es", "objective"):
                assert set(section.get(f"with_{group}", {})) <= set(registry.names(group))


def test_a_section_has_the_settings_of_the_one_it_is_like_where_it_says_nothing():
    paper, best = (
        composed_with("env=cartpole", "proxy=rn", f"preset={p}") for p in ("paper", "best")
    )
    assert paper.proxy.variant == "additive_potential"
    assert best.proxy.variant == "exclusive_potential"
    assert paper.agent == best.agent and paper.training == best.training
    assert (paper.es.step_size, best.es.step_size) == (0.5, 0.5)


@pytest.mark.parametrize("proxy", ["se", "rn"])
def test_a_task_without_a_file_has_general_settings(proxy):
    composed = composed_with("env=gymnax/MountainCar-v0", f"proxy={proxy}")
    if proxy == "se":  # whose settings are the defaults in Python
        assert composed.generations == 100
    else:
        assert composed.proxy == sejax.RewardConfig() and composed.generations == 50
        assert composed.training == sejax.TrainingConfig(
            stop_rule="solved", max_steps=None, max_episodes=100, test_episodes=1
        )
    with pytest.raises(ConfigError, match=r"preset must be one .*cartpole.* Set preset=best"):
        sejax.config(["env=gymnax/MountainCar-v0", f"proxy={proxy}", "preset=paper"])


@pytest.mark.parametrize(("env", "steps"), [("mountain_car", 2000), ("halfcheetah", 200)])
def test_settings_of_an_objective_hold_for_that_objective(env, steps):
    for _ in range(2):  # which leaves the preset as it is
        assert sejax.config([f"env={env}"]).objective.first_eval_steps == steps
    assert not hasattr(sejax.config([f"env={env}", "objective=auc"]).objective, "first_eval_steps")
