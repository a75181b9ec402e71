"""sejax.envs.stoa: environments of other suites step as their own interface says.

`make test-suites` runs this with the suites installed.
"""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sejax
from sejax.options import ConfigError
from sejax.run import main

pytest.importorskip("stoa")


def needs(suite):
    """Skips the test if the suite is not installed."""
    pytest.importorskip({"playground": "mujoco_playground"}.get(suite, suite))


def native(suite, name):
    """`(reset, step)` of the suite's own; a step gives `(state, reward, has ended, obs)`."""
    if suite in ("navix", "jumanji"):
        env = importlib.import_module(suite).make(name)
    if suite == "navix":
        read = lambda x: (x, x.reward, x.is_termination() | x.is_truncation(), x.observation)  # noqa: E731
        return (lambda key: read(env.reset(key))), lambda state, a, key: read(env.step(state, a))
    if suite == "jumanji":
        read = lambda out: (out[0], out[1].reward, out[1].last(), out[1].observation)  # noqa: E731
        return (lambda key: read(env.reset(key))), lambda state, a, key: read(env.step(state, a))
    if suite == "xminigrid":
        env, params = importlib.import_module(suite).make(name)
        read = lambda x: (x, x.reward, x.last(), x.observation)  # noqa: E731
        return (
            lambda key: read(env.reset(params, key)),
            lambda state, a, key: read(env.step(params, state, a)),
        )
    if suite == "brax":
        env = importlib.import_module("brax.envs").get_environment(name)
    if suite == "playground":
        registry = importlib.import_module("mujoco_playground").registry
        env = registry.load(name, config_overrides={"impl": "jax"})
    if suite in ("brax", "playground"):
        read = lambda x: (x, x.reward, x.done, x.obs)  # noqa: E731
        return (lambda key: read(env.reset(key))), lambda state, a, key: read(env.step(state, a))
    raise AssertionError(suite)


# Those whose steps are not random: stoa splits keys in its own way.
IDS = ["navix/Navix-Empty-5x5-v0", "jumanji/Maze-v0", "xminigrid/MiniGrid-Empty-5x5",
       "brax/inverted_pendulum", "playground/CartpoleBalance"]  # fmt: skip


@pytest.mark.filterwarnings("default")  # of suites, about themselves
@pytest.mark.parametrize("name", IDS)
def test_a_step_is_the_suites_own(name):
    suite, _, own = name.partition("/")
    needs(suite)
    task = sejax.envs.make(f"stoa/{name}")
    reset, step = native(suite, own)
    key = jax.random.key(3)
    _, state = task.env.reset_env(key, task.params)
    theirs, _, _, obs = reset(key)
    rng = np.random.default_rng(0)
    step_env, step = jax.jit(task.env.step_env), jax.jit(step)
    for time in range(1, 41):
        action = jnp.float32(rng.uniform(-1, 1, task.action_dim))  # theirs lie there too
        if task.num_actions is not None:
            action = jnp.int32(rng.integers(task.num_actions))
        mine, state, reward, terminated, _ = step_env(key, state, action, task.params)
        theirs, wanted, ended, obs = step(theirs, action, key)
        flat = np.concatenate([np.ravel(x) for x in jax.tree.leaves(obs)])
        np.testing.assert_allclose(mine, flat.astype(np.float32), rtol=1e-4, atol=1e-5)
        assert float(reward) == pytest.approx(float(wanted), rel=1e-4)
        assert bool(terminated | task.env.is_truncated(state, task.params)) == bool(ended)
        assert int(state.time) == time
        if ended:
            break
    assert time > 1 and mine.shape == (task.obs_dim,)


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(
    "name",
    [
        *IDS,
        "jumanji/Game2048-v1",
        "pgx/2048",
        "pgx/minatar-breakout",
        "craftax/Craftax-Classic-Symbolic-v1",
    ],
)
def test_agents_train_there(name):
    needs(name.partition("/")[0])
    task = sejax.envs.make(f"stoa/{name}")
    agent = sejax.make_agent(sejax.PPOConfig(rollout_steps=32), task)
    training = sejax.TrainingConfig(max_steps=96, max_episodes=96, stop_rule="never")
    train = sejax.make_trainer(agent, task.env, training)
    result = jax.jit(jax.vmap(train, (0, None)))(
        jax.random.split(jax.random.key(0), 2), task.params
    )
    np.testing.assert_array_equal(result.train_steps, [96, 96])
    assert not result.nonfinite.any()


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("name", [*IDS[:-1], "pgx/2048"])
def test_a_reward_network_is_learned_there(name, tmp_path):
    needs(name.partition("/")[0])
    main([
        *(f"env=stoa/{name}", "env.solved_reward=0.9", "proxy=rn", "agent=ppo"),
        *("generations=2", "es.population_size=2", "training.max_episodes=3", "devices=1"),
        *("agent.rollout_steps=32", "training.test_episodes=1", f"run_dir={tmp_path}"),
    ])  # fmt: skip
    assert sejax.load_proxy(tmp_path).task.name == f"stoa/{name}"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("stoa/nothing/x", "env must be one of .*stoa/navix/ID"),
        ("stoa/navix", "env must be one of"),
        ("stoa/navix/nothing", "env must be an environment that navix can make here"),
        ("stoa/pgx/chess", "env must have one player; got 2 of them"),
    ],
)
def test_what_does_not_fit_is_refused(name, message):
    pytest.importorskip(
        name.split("/")[1] if name.count("/") > 1 and "nothing/" not in name else "stoa"
    )
    with pytest.raises(ConfigError, match=message):
        sejax.envs.make(name)
