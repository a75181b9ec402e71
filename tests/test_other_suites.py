"""examples/other_suites.py: environments of other suites step as their own interface says.

`make test-suites` runs this with the suites installed.
"""

import importlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import refused

import sejax
from sejax.run import main

pytest.importorskip("stoa")
pytestmark = pytest.mark.filterwarnings("default")  # of suites, about themselves


@pytest.fixture
def make(monkeypatch):
    """The task of a suite and an id, or a skip."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "examples")

    def make(suite, env_id):
        pytest.importorskip({"playground": "mujoco_playground"}.get(suite, suite))
        return sejax.envs.make("other_suites:task", suite=suite, env_id=env_id)

    return make


def native(suite, name):
    """`(reset, step, read)` of the suite's own; `read` gives reward, whether it ended, and obs."""
    if suite == "xminigrid":
        env, params = importlib.import_module(suite).make(name)
        read = lambda x: (x.reward, x.last(), x.observation)  # noqa: E731
        return lambda key: env.reset(params, key), lambda *x: env.step(params, *x), read
    if suite == "brax":
        env = importlib.import_module("brax.envs").get_environment(name)
    elif suite == "playground":
        registry = importlib.import_module("mujoco_playground").registry
        env = registry.load(name, config_overrides={"impl": "jax"})
    else:
        env = importlib.import_module(suite).make(name)
    read = {
        "navix": lambda x: (x.reward, x.is_termination() | x.is_truncation(), x.observation),
        "jumanji": lambda out: (out[1].reward, out[1].last(), out[1].observation),
    }.get(suite, lambda x: (x.reward, x.done, x.obs))
    if suite == "jumanji":
        return env.reset, lambda out, action: env.step(out[0], action), read
    return env.reset, env.step, read


# Those whose steps are not random: stoa splits keys in its own way.
IDS = [("navix", "Navix-Empty-5x5-v0"), ("jumanji", "Maze-v0"),
       ("xminigrid", "MiniGrid-Empty-5x5"), ("brax", "inverted_pendulum"),
       ("playground", "CartpoleBalance")]  # fmt: skip
RANDOM = [("jumanji", "Game2048-v1"), ("pgx", "2048"), ("pgx", "minatar-breakout"),
          ("craftax", "Craftax-Classic-Symbolic-v1")]  # fmt: skip


@pytest.mark.parametrize(("suite", "name"), IDS)
def test_a_step_is_the_suites_own(make, suite, name):
    task, (reset, step, read) = make(suite, name), native(suite, name)
    key = jax.random.key(3)
    _, state = task.env.reset_env(key, task.params)
    theirs = reset(key)
    rng = np.random.default_rng(0)
    step_env, step = jax.jit(task.env.step_env), jax.jit(step)
    for time in range(1, 41):
        action = jnp.float32(rng.uniform(-1, 1, task.action_dim))  # theirs lie there too
        if task.num_actions is not None:
            action = jnp.int32(rng.integers(task.num_actions))
        obs, state, reward, terminated, _ = step_env(key, state, action, task.params)
        theirs = step(theirs, action)
        expected_reward, has_ended, expected_obs = read(theirs)
        flat = np.concatenate([np.ravel(x) for x in jax.tree.leaves(expected_obs)])
        np.testing.assert_allclose(obs, flat.astype(np.float32), rtol=1e-4, atol=1e-5)
        assert float(reward) == pytest.approx(float(expected_reward), rel=1e-4)
        assert bool(terminated | task.env.is_truncated(state, task.params)) == bool(has_ended)
        assert int(state.time) == time
        if has_ended:
            break
    assert time > 1 and obs.shape == (task.obs_dim,)


@pytest.mark.parametrize(("suite", "name"), [*IDS, *RANDOM])
def test_a_reward_network_is_learned_there(make, suite, name, tmp_path):
    task = make(suite, name)
    main([
        *("env=other_suites:task", f"env.suite={suite}", f"env.env_id={name}"),
        *("env.solved_reward=0.9", "proxy=rn", "agent=ppo", "training.max_steps=96"),
        *("generations=2", "es.population_size=2", "training.max_episodes=96", "devices=1"),
        *("agent.rollout_steps=32", "training.test_episodes=1", f"run_dir={tmp_path}"),
    ])  # fmt: skip
    assert sejax.load_proxy(tmp_path, task=task).task is task


def test_two_players_are_refused(make):
    assert refused(make, "pgx", "chess") == "env"
