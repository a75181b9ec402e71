"""Sets of proxies: several of one shape in one file."""

import jax
import numpy as np
import pytest

import sejax
from sejax.cli import config as configuration
from sejax.options import ConfigError


@pytest.fixture(scope="module")
def ses(tmp_path_factory):
    """A file with three SEs of random weights: its path and the weights."""
    path = tmp_path_factory.mktemp("ses") / "ses.safetensors"
    config = sejax.config(
        ["proxy.hidden_size=4", "training.max_steps=40", "agent.warmup_episodes=0"]
    )
    env = config.parts()["proxy"]
    weights = [env.init_weights(jax.random.key(i)) for i in range(3)]
    records = [{"score": 1.0 + i, "generation": 4 + i, "seed": 7 + i} for i in range(3)]
    sejax.save_set(path, env, weights, records, configuration.plain(config))
    return path, weights


def assert_equal_trees(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def test_a_set_that_is_saved_and_loaded_is_the_same(ses):
    path, weights = ses
    loaded = sejax.load_set(path)
    assert len(loaded) == 3 and loaded.task.name == "cartpole"
    for i in range(3):
        assert_equal_trees(loaded[i].params.weights, weights[i])
    np.testing.assert_array_equal(loaded.scores, [1, 2, 3])
    assert [record["generation"] for record in loaded.records] == [4, 5, 6]
    np.testing.assert_array_equal(loaded.seeds, [7, 8, 9])
    assert len({loaded[i].fingerprint for i in range(3)}) == 3
    assert_equal_trees(loaded[:2].weights, jax.tree.map(lambda x: x[:2], loaded.weights))
    assert list(loaded.ranked(2).seeds) == [9, 8]
    assert list(loaded[loaded.scores >= 2].seeds) == [8, 9]


def test_all_ses_of_a_set_step_at_once(ses):
    loaded = sejax.load_set(ses[0])
    env = loaded.env
    key = jax.random.key(0)
    obs, state = env.reset_env(key, loaded[0].params)

    def reward(weights):
        params = env.params(weights, loaded.discount)
        return env.step_env(key, state, jax.numpy.int32(1), params)[2]

    rewards = jax.vmap(reward)(loaded.weights)
    np.testing.assert_allclose(rewards, [reward(x.params.weights) for x in loaded], rtol=1e-6)
    assert obs.shape == (4,) and len(set(np.asarray(rewards).tolist())) == 3


def test_a_single_proxy_is_a_set_of_one(ses, tmp_path):
    env, weights = sejax.load_set(ses[0]).env, ses[1][0]
    sejax.save(tmp_path / "p.safetensors", env, weights, score=12.5, generation=7, seed=2)
    loaded = sejax.load_set(tmp_path / "p.safetensors")
    assert (len(loaded), loaded.scores[0], loaded.seeds[0]) == (1, 12.5, 2)
    assert_equal_trees(loaded[0].params.weights, weights)
    assert loaded[0].fingerprint == sejax.load_set(ses[0])[0].fingerprint


def test_files_that_are_no_set_are_refused(ses, tmp_path):
    path, weights = ses
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(ConfigError, match=r"source must be a single proxy.*load_set reads sets"):
        sejax.load(path)
    with pytest.raises(ConfigError, match=r"fixed must be .*is damaged"):
        sejax.load_set(damaged, option="fixed")
    other = sejax.config(["proxy.hidden_size=5"]).parts()["proxy"]
    with pytest.raises(ConfigError, match="weights must "):
        sejax.save_set(tmp_path / "other.safetensors", other, weights, [{}] * 3)
    with pytest.raises(ConfigError, match="does not exist"):
        sejax.load_set(tmp_path / "none.safetensors")
