"""sejax.envs: the contract of every real task, and parity with Gymnasium."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sejax import envs
from sejax.errors import ConfigError

GYMNASIUM_IDS = {"cartpole": "CartPole-v1", "acrobot": "Acrobot-v1"}
STATE_FIELDS = {
    "cartpole": ("x", "x_dot", "theta", "theta_dot"),
    "acrobot": ("joint_angle1", "joint_angle2", "velocity_1", "velocity_2"),
}
# Half-widths of the box that states are drawn from. CartPole: up to the walls (|x| = 2.4, 12
# degrees), so that a step crosses them. Acrobot: all angles and speeds, where clipping and
# wrapping act.
STATE_BOX = {
    "cartpole": (2.4, 4.0, 12 * 2 * np.pi / 360, 4.0),
    "acrobot": (np.pi, np.pi, 4 * np.pi, 9 * np.pi),
}


@pytest.fixture(scope="module")
def env_step():
    """Jitted `step_env` of each task: `(key, state, action)`."""
    tasks = {name: envs.make(name) for name in envs.names()}
    return {
        name: jax.jit(lambda k, s, a, task=task: task.env.step_env(k, s, a, task.params))
        for name, task in tasks.items()
    }


def set_state(name, template, values):
    """The gymnax state with these four numbers (leaves `[]`, or `[n]` for `[n, 4]` values)."""
    columns = jnp.asarray(values, None if jax.config.jax_enable_x64 else jnp.float32)
    return template.replace(
        **{field: columns[..., i] for i, field in enumerate(STATE_FIELDS[name])}
    )


def gymnasium_step(env, state, action):
    """One step of Gymnasium's dynamics from any state."""
    env.unwrapped.state = np.array(state, np.float64)
    env.unwrapped.steps_beyond_terminated = None
    obs, reward, terminated, _, _ = env.unwrapped.step(int(action))
    return obs, reward, terminated


# --- contract, over the whole registry -----------------------------------------------------------


@pytest.mark.parametrize("name", envs.names())
def test_a_task_is_built_once(name):
    assert envs.make(name) is envs.make(name)
    assert envs.make(name).name == name


@pytest.mark.parametrize("name", envs.names())
def test_reset_draws_a_fresh_float_observation_for_each_key(name):
    task = envs.make(name)
    keys = jax.random.split(jax.random.key(0), 50)
    obs, state = jax.jit(jax.vmap(task.env.reset_env, (0, None)))(keys, task.params)
    assert obs.shape == (50, task.obs_dim) and obs.dtype == jnp.float32
    assert np.isfinite(obs).all()
    assert len(np.unique(obs, axis=0)) == 50
    np.testing.assert_array_equal(state.time, 0)


@pytest.mark.parametrize("name", envs.names())
def test_a_step_returns_what_the_trainer_relies_on(name, env_step):
    task = envs.make(name)
    obs, state = task.env.reset_env(jax.random.key(0), task.params)
    for action in range(task.num_actions):
        next_obs, next_state, reward, terminated, info = env_step[name](
            jax.random.key(1), state, jnp.int32(action)
        )
        assert next_obs.shape == obs.shape and next_obs.dtype == jnp.float32
        assert reward.shape == () and reward.dtype == jnp.float32
        assert terminated.shape == () and terminated.dtype == bool
        assert info["discount"].shape == () and info["discount"] == 1.0 - terminated
        assert next_state.time == 1


@pytest.mark.parametrize("name", envs.names())
def test_only_the_step_limit_truncates_and_it_does_not_terminate(name):
    task = envs.make(name)
    _, state = task.env.reset_env(jax.random.key(0), task.params)
    for steps_before, truncates in [
        (0, False), (task.max_steps - 2, False), (task.max_steps - 1, True),
    ]:  # fmt: skip
        _, _, _, terminated, truncated, info = task.env.step(
            jax.random.key(1), state.replace(time=jnp.int32(steps_before)), 0, task.params
        )
        assert truncated == truncates
        assert not terminated
        assert info["discount"] == 1.0


@pytest.mark.parametrize("name", envs.names())
def test_vmapped_steps_equal_single_ones(name, env_step):
    task = envs.make(name)
    keys = jax.random.split(jax.random.key(0), 6)
    _, states = jax.vmap(task.env.reset_env, (0, None))(keys, task.params)
    actions = jnp.arange(6) % task.num_actions
    step = jax.jit(jax.vmap(lambda k, s, a: task.env.step_env(k, s, a, task.params)))
    together = step(keys, states, actions)
    for i in range(6):
        alone = env_step[name](keys[i], jax.tree.map(lambda x, i=i: x[i], states), actions[i])
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-5, atol=1e-6)


# --- the paper's numbers -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "max_steps", "solved_reward", "obs_dim", "num_actions"),
    [("cartpole", 200, 195.0, 4, 2), ("acrobot", 500, -100.0, 6, 3)],
)
def test_limits_are_the_papers(name, max_steps, solved_reward, obs_dim, num_actions):
    # Paper, table "Subset of the hyperparameter configuration spaces that we kept fixed".
    task = envs.make(name)
    assert (task.max_steps, task.solved_reward) == (max_steps, solved_reward)
    assert (task.obs_dim, task.num_actions) == (obs_dim, num_actions)


@pytest.mark.parametrize(("name", "bound"), [("cartpole", 0.05), ("acrobot", 0.1)])
def test_initial_states_fill_the_same_range_as_gymnasiums(name, bound):
    task = envs.make(name)
    keys = jax.random.split(jax.random.key(0), 400)
    _, state = jax.jit(jax.vmap(task.env.reset_env, (0, None)))(keys, task.params)
    values = np.stack([getattr(state, field) for field in STATE_FIELDS[name]])
    assert np.abs(values).max() <= bound
    assert (values.max(axis=1) > 0.95 * bound).all()
    assert (values.min(axis=1) < -0.95 * bound).all()
    reference = gymnasium.make(GYMNASIUM_IDS[name]).unwrapped
    reference.reset(seed=0)
    assert np.abs(reference.state).max() <= bound


# --- parity with Gymnasium -----------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(GYMNASIUM_IDS))
def test_steps_from_states_all_over_the_box_equal_gymnasiums(name):
    task = envs.make(name)
    reference = gymnasium.make(GYMNASIUM_IDS[name])
    reference.reset(seed=0)
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (1000, 4)) * np.array(STATE_BOX[name])
    actions = rng.integers(0, task.num_actions, 1000)
    expected = [gymnasium_step(reference, s, a) for s, a in zip(states, actions, strict=True)]
    expected_obs, expected_reward, expected_terminated = map(np.array, zip(*expected, strict=True))
    assert 0.02 < expected_terminated.mean() < 0.98  # both sides of the walls were visited
    _, template = task.env.reset_env(jax.random.key(0), task.params)

    def step(values, action):
        state = set_state(name, template, values)
        return task.env.step_env(jax.random.key(0), state, action, task.params)

    # In float64 the equations are Gymnasium's, up to its float32 observation.
    with jax.enable_x64(True):
        obs, _, reward, terminated, _ = jax.jit(jax.vmap(step))(states, actions)
    np.testing.assert_allclose(obs, expected_obs, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(terminated, expected_terminated)
    np.testing.assert_allclose(reward, expected_reward, atol=1e-6)
    # In float32, as we run them, Acrobot's fastest spins amplify rounding in a step of a thousand.
    obs, _, _, terminated, _ = jax.jit(jax.vmap(step))(np.float32(states), actions)
    error = np.abs(obs - expected_obs) / (1 + np.abs(expected_obs))
    assert np.quantile(error.max(axis=1), 0.998) < 1e-4
    assert error.max() < 1e-2
    assert (terminated == expected_terminated).mean() > 0.998


@pytest.mark.parametrize("name", sorted(GYMNASIUM_IDS))
def test_two_hundred_random_steps_equal_gymnasiums(name, env_step):
    task = envs.make(name)
    reference = gymnasium.make(GYMNASIUM_IDS[name]).unwrapped
    rng = np.random.default_rng(1)
    num_episodes = 0
    key = jax.random.key(0)
    _, template = task.env.reset_env(key, task.params)
    terminated = True
    for _ in range(200):
        if terminated:
            reference.reset(seed=num_episodes)
            state = set_state(name, template, np.array(reference.state))
            num_episodes += 1
        action = rng.integers(task.num_actions)
        obs, state, reward, terminated, _ = env_step[name](key, state, jnp.int32(action))
        expected_obs, expected_reward, expected_terminated, _, _ = reference.step(action)
        # Trajectories of float32 and float64 part slowly: each step is held to 1e-4.
        np.testing.assert_allclose(obs, expected_obs, rtol=1e-4, atol=1e-4)
        assert reward == expected_reward
        assert bool(terminated) == expected_terminated
        state = set_state(name, state, np.array(reference.state))
    assert int(state.time) <= 200


def test_acrobot_terminates_when_the_tip_is_above_the_line(env_step):
    # Straight up: joint 1 at pi, joint 2 at 0. Height -cos(pi) - cos(pi + 0) = 2 > 1.
    task = envs.make("acrobot")
    _, state = task.env.reset_env(jax.random.key(0), task.params)
    state = set_state("acrobot", state, [np.pi, 0.0, 0.0, 0.0])
    _, _, reward, terminated, info = env_step["acrobot"](jax.random.key(0), state, jnp.int32(1))
    assert terminated and reward == 0.0 and info["discount"] == 0.0


# --- errors --------------------------------------------------------------------------------------


def test_an_unknown_task_lists_the_known_ones_nearest_first():
    with pytest.raises(
        ConfigError,
        match=r"^env must be one of acrobot, .*cartpole.*; got 'acrobat'\. "
        r"Did you mean env=acrobot\?$",
    ):
        envs.make("acrobat")
