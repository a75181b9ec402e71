"""experiments.rn_studies: agents and bonuses are those of the paper's tables."""

import pytest

from experiments.rn_studies import STUDIES

# The tables of default hyperparameters, for agents that are trained on learned RNs. SARSA and TD3
# are not here: see `STUDIES`.
AFTER_LEARNING = {
    ("cliff_walking", "agent"): {"learning_rate": 1.0, "discount": 0.8, "epsilon_init": 0.1,
                                 "epsilon_min": 0.1, "epsilon_decay": 0.0},
    ("cartpole", "agent"): {
        "warmup_episodes": 1, "batch_size": 32, "learning_rate": 0.00025, "tau": 0.01,
        "discount": 0.99, "epsilon_init": 1.0, "epsilon_min": 0.1, "epsilon_decay": 0.9,
        "num_layers": 1, "hidden_size": 64, "activation": "relu", "buffer_size": 1_000_000,
    },
    ("cartpole", "transfer_agent"): {
        "warmup_episodes": 1, "batch_size": 32, "learning_rate": 0.00025, "tau": 0.01,
        "discount": 0.99, "epsilon_init": 1.0, "epsilon_min": 0.1, "epsilon_decay": 0.9,
        "num_layers": 1, "hidden_size": 64, "activation": "relu", "buffer_size": 1_000_000,
        "feature_dim": 128, "stream_num_layers": 1, "stream_hidden_size": 128,
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


@pytest.mark.parametrize(("env", "which"), AFTER_LEARNING)
def test_agents_after_learning_rns_are_those_of_the_papers_tables(env, which):
    agent = getattr(STUDIES[env], which)
    expected = AFTER_LEARNING[env, which]
    assert {name: getattr(agent, name) for name in expected} == expected


@pytest.mark.parametrize("env", BONUSES)
def test_bonuses_beside_rns_are_those_of_the_papers_tables(env):
    (bonus,) = STUDIES[env].bonuses.values()
    assert {name: getattr(bonus, name) for name in BONUSES[env]} == BONUSES[env]
    if env != "cliff_walking":  # an ICM
        assert (bonus.feature_dim, bonus.hidden_size) == (32, 128)
