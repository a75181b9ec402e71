"""`python -m sejax.evaluate`, and proxies as files."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from hydra import compose, initialize_config_dir

import sejax
from sejax.agents.configs import PPOConfig
from sejax.configs import CONF_DIR, evaluate_from_hydra
from sejax.errors import ConfigError
from sejax.evaluate import _prepare, evaluate
from sejax.proxies import io as proxy_io
from sejax.proxies.reward import make_reward
from sejax.proxies.synthetic import make_synthetic

TINY = ["agent.hidden_size=4", "agent.batch_size=4", "agent.init_episodes=0", "num_agents=3",
        "real_training.max_episodes=2"]  # fmt: skip


def evaluate_config(*overrides: str):
    folder = CONF_DIR.parent / "evaluate"
    with initialize_config_dir(str(folder), version_base="1.3"):
        return evaluate_from_hydra(compose("evaluate", overrides=[*TINY, *overrides]))


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """A proxy file with random weights: its path, environment and weights."""
    path = tmp_path_factory.mktemp("proxy") / "proxy.safetensors"
    config = sejax.config(["proxy.hidden_size=4", "training.max_steps=50", "agent.init_episodes=0"])
    from sejax import envs

    env = make_synthetic(envs.make("cartpole"), config.proxy)
    weights = env.init_weights(jax.random.key(3))
    sejax.save(path, config, weights, score=12.5, generation=7, seed=0)
    return path, env, weights


def test_a_proxy_that_is_saved_and_loaded_is_the_same(stored):
    path, env, weights = stored
    loaded_env, params = sejax.load(path)
    assert loaded_env is env, "the same configuration shares one environment, hence its programs"
    for a, b in zip(jax.tree.leaves(weights), jax.tree.leaves(params.weights), strict=True):
        np.testing.assert_array_equal(a, b)
    metadata = proxy_io.load_proxy(path.parent).metadata
    assert metadata["score"] == 12.5 and metadata["generation"] == 7
    assert metadata["format_version"] == 1


def test_a_loaded_proxy_steps_as_a_gymnax_environment(stored):
    env, params = sejax.load(stored[0])
    obs, state = env.reset(jax.random.key(0), params)
    obs, state, reward, _terminated, truncated, _info = env.step(
        jax.random.key(1), state, jnp.int32(1), params
    )
    assert obs.shape == (4,) and reward.shape == () and not truncated


def test_a_damaged_file_is_refused(stored, tmp_path):
    damaged = tmp_path / "proxy.safetensors"
    damaged.write_bytes(stored[0].read_bytes()[:-20])
    with pytest.raises(ConfigError, match=r"whole safetensors file.*which is damaged"):
        sejax.load(damaged)


def test_a_foreign_safetensors_file_is_refused(tmp_path):
    from safetensors.numpy import save_file

    save_file({"x": np.zeros(3)}, tmp_path / "x.safetensors")
    with pytest.raises(ConfigError, match="a file that sejax has written"):
        sejax.load(tmp_path / "x.safetensors")


def test_tensors_of_another_shape_are_refused(stored, tmp_path):
    _, _env, weights = stored
    config = sejax.config(["proxy.hidden_size=5"])
    sejax.save(tmp_path / "p.safetensors", config, weights)
    with pytest.raises(ConfigError, match="must hold the tensors of the network"):
        sejax.load(tmp_path / "p.safetensors")


def test_an_unknown_name_lists_the_shipped_ones():
    with pytest.raises(ConfigError, match=r"proxy must be one of .*got 'carpole'"):
        sejax.load("carpole")


def test_evaluation_writes_a_row_for_each_agent_and_their_means(stored, tmp_path, capsys):
    mean = evaluate(evaluate_config(f"proxy={stored[0]}", f"out_dir={tmp_path}"))
    table = pd.read_csv(tmp_path / "evaluation.csv")
    assert table.groupby("world").size().to_dict() == {"the proxy": 3, "the real task": 3}
    assert mean == pytest.approx(table[table.world == "the proxy"].test_return.mean(), rel=1e-5)
    summary = json.loads((tmp_path / "evaluation.json").read_text())
    steps = table[table.world == "the real task"].train_steps.mean()
    assert summary["the real task"]["train_steps_mean"] == pytest.approx(steps)
    assert (tmp_path / "evaluation.png").stat().st_size > 10_000
    assert "3 fresh ddqn agents" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "steps"),
    [([], 50), (["training_from=config", "training.max_steps=90", "training.stop_rule=never"], 90)],
)
def test_agents_train_as_the_proxy_was_learned_or_as_configured(given, steps, stored, tmp_path):
    overrides = [f"proxy={stored[0]}", f"out_dir={tmp_path}", "baseline=false", *given]
    evaluate(evaluate_config(*overrides))
    assert (pd.read_csv(tmp_path / "evaluation.csv").train_steps == steps).all()


def test_initial_episodes_beyond_the_proxys_own_extend_its_step_budget(stored):
    from sejax.evaluation import training_as_learned

    proxy = proxy_io.load_proxy(stored[0])  # learned with no initial episode and 50 steps
    agent = dataclasses.replace(proxy.config.agent, init_episodes=3)
    assert training_as_learned(proxy, agent).max_steps == 50 + 3 * 200
    assert training_as_learned(proxy, PPOConfig(update_episodes=2)).max_steps == 50 + 401
    assert training_as_learned(proxy, proxy.config.agent).max_steps == 50


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["training.max_steps=90"], "training must be left as it is.*training_from=config"),
        (["proxy=real", "env=cartpole", "training_from=config"], "training_from must be proxy"),
        (["proxy=real", "env=cartpole", "agent_hparams=nes"], "agent_hparams must be default"),
        (["agent_hparams=nes"], "agent must be left out with agent_hparams=nes.*batch_size=4"),
        (["proxy=real", "env=cartpole", "training.max_steps=9"], r"training must.*Set real_train"),
        (["seed=-1"], r"seed must lie in \[0, 2\*\*31\)"),
    ],
)  # fmt: skip
def test_settings_that_cannot_be_or_have_no_effect_are_refused(given, message, stored):
    with pytest.raises(ConfigError, match=message):
        evaluate_config(f"proxy={stored[0]}", *given)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["training.solved_by=train", "training.stop_rule=solved"], "training.solved_by must be"),
        (["training.max_steps=300", "agent.init_episodes=2"], "max_steps must exceed 400"),
    ],
)
def test_trainings_that_sejax_run_refuses_are_refused(given, message, stored):
    config = evaluate_config(f"proxy={stored[0]}", "training_from=config", *given)
    with pytest.raises(ConfigError, match=message):
        evaluate(config)


def test_agents_on_rewards_of_a_network_do_not_stop_by_these(tmp_path):
    config = sejax.config(["proxy=rn"])
    env = make_reward(config.env.make(), config.proxy)
    sejax.save(tmp_path / "proxy.safetensors", config, env.init_weights(jax.random.key(0)))
    overrides = [f"proxy={tmp_path}", "real_training.solved_by=train"]
    with pytest.raises(ConfigError, match=r"real_training\.solved_by must be test"):
        evaluate(evaluate_config(*overrides))


def test_one_agent_has_no_deviation(tmp_path, capsys):
    overrides = ["proxy=real", "env=cartpole", "num_agents=1", f"out_dir={tmp_path}"]
    evaluate(evaluate_config(*overrides))
    assert "nan" not in capsys.readouterr().out


def test_agents_of_the_nes_run_bring_their_exploration(tmp_path, capsys):
    """An RN learned with Q-learning agents and a count-based bonus."""
    config = sejax.config(["env=cliff_walking", "proxy=rn", "exploration=count_based"])
    env = make_reward(config.env.make(), config.proxy)
    path = tmp_path / "proxy.safetensors"
    sejax.save(path, config, env.init_weights(jax.random.key(0)))
    folder = CONF_DIR.parent / "evaluate"
    overrides = [f"proxy={path}", "agent_hparams=nes", "num_agents=2", "baseline=false",
                 "real_training.max_episodes=2"]  # fmt: skip
    with initialize_config_dir(str(folder), version_base="1.3"):
        composed = evaluate_from_hydra(compose("evaluate", overrides=overrides))
    _task, worlds, agent, exploration, _ = _prepare(composed)
    assert (agent, exploration) == (config.agent, config.exploration)
    assert worlds["the proxy"][2] == composed.real_training  # its dynamics are real
    evaluate(composed)
    assert "2 fresh q_learning agents" in capsys.readouterr().out


def test_the_real_task_alone_can_be_evaluated(tmp_path):
    evaluate(evaluate_config("proxy=real", "env=cartpole", f"out_dir={tmp_path}"))
    assert set(pd.read_csv(tmp_path / "evaluation.csv").world) == {"the real task"}


def test_a_proxy_of_another_task_is_refused(stored):
    with pytest.raises(ConfigError, match=r"acrobot for a proxy of cartpole\. Set env=cartpole"):
        evaluate(evaluate_config(f"proxy={stored[0]}", "env=acrobot"))


def test_a_missing_proxy_says_what_to_set():
    with pytest.raises(ConfigError, match="proxy must be given"):
        evaluate_config()


def test_registering_with_gymnax_is_idempotent():
    import gymnax

    ids = sejax.register_gymnax()
    assert sejax.register_gymnax() == ids
    for env_id in ids:
        _env, params = gymnax.make(env_id)
        shipped = sejax.load(env_id.removeprefix("sejax/"))[1]
        assert jnp.array_equal(jax.tree.leaves(params)[0], jax.tree.leaves(shipped)[0])
