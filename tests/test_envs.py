"""sejax.envs: what every task obeys, parity with Gymnasium and gymnax, and the grid worlds."""

import dataclasses
import math

import gymnasium
import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments import spaces
from scripted import MAX_EPISODES, MAX_STEPS, ScriptedEnv, script, scripted_agent
from support import assert_close, assert_equal, paper_training, refused

from sejax import envs
from sejax.envs.gridworld import CLIFF_WALKING, ROOM_2X2, GridParams, GridWorld
from sejax.envs.wrappers import repeat_actions
from sejax.gym import GYMNASIUM_IDS, RealTask
from sejax.options import ConfigError
from sejax.options.plain import configure
from sejax.training import make_trainer

KEY = jax.random.key(0)
CLASSIC = ["cartpole", "acrobot", "mountain_car", "mountain_car_continuous", "pendulum"]
CAR = {"position": (-1.2, 0.6), "velocity": (-0.07, 0.07)}
# Where states are drawn from. CartPole: up to the walls (|x| = 2.4, 12 degrees), so that a step
# crosses them. Acrobot and the pendulum: all angles and speeds, where clipping and wrapping act.
# The cars: from the left wall over the goal to the right wall, at all speeds.
WALL, PI = math.radians(12), np.pi
STATES = {
    "cartpole": {
        "x": (-2.4, 2.4), "x_dot": (-4.0, 4.0), "theta": (-WALL, WALL), "theta_dot": (-4.0, 4.0),
    },
    "acrobot": {
        "joint_angle1": (-PI, PI), "joint_angle2": (-PI, PI),
        "velocity_1": (-4 * PI, 4 * PI), "velocity_2": (-9 * PI, 9 * PI),
    },
    "mountain_car": CAR,
    "mountain_car_continuous": CAR,
    "pendulum": {"theta": (-5 * PI, 5 * PI), "theta_dot": (-8.0, 8.0)},
}  # fmt: skip
RIGHT, LEFT, DOWN, UP = range(4)


def make(name):
    """The task, or a skip where its package is missing."""
    try:
        return envs.make(name)
    except ConfigError as error:
        pytest.skip(str(error))


def draw_actions(task, rng, num):
    """All discrete actions `[num]`, or continuous ones from a box 1.5 times as wide."""
    if task.num_actions is not None:
        return rng.permutation(np.arange(num) % task.num_actions).astype(np.int32)
    actions = rng.uniform(-1.5 * task.max_action, 1.5 * task.max_action, (num, task.action_dim))
    return actions.astype(np.float32)


# --- contract, over the whole registry -----------------------------------------------------------


@pytest.mark.parametrize("name", envs.names())
def test_a_task_is_what_its_configuration_says_of_it(name):
    task, spec = make(name), envs.spec_of(configure("env", {"name": name}))
    for field in dataclasses.fields(envs.TaskSpec):
        assert getattr(task, field.name) == getattr(spec, field.name)
    assert task.name == name and task is envs.make(**task.origin)
    again = envs.TaskSpec.of_interface(task.interface)
    assert again.interface == task.interface and again.max_action == task.max_action
    assert {*task.augmented_keys} <= {*task.info_keys}
    assert task.env.default_params == task.params
    observation = task.env.observation_space(task.params)
    action = task.env.action_space(task.params)
    assert isinstance(observation, spaces.Discrete) == (task.num_states is not None)
    assert isinstance(action, spaces.Discrete) == (task.num_actions is not None)
    obs, _ = jax.eval_shape(task.env.reset, KEY)
    assert obs.shape == observation.shape and obs.dtype == observation.dtype


@pytest.mark.parametrize("name", envs.names())
def test_steps_return_what_the_inner_loop_relies_on(name):
    task = make(name)
    env, params, num = task.env, task.params, 4
    actions = draw_actions(task, np.random.default_rng(0), num)

    def step(key, action, time):
        obs, state = env.reset_env(key, params)
        out = env.step_env(key, state.replace(time=time), action, params)
        return obs, state, out, env.is_truncated(out[1], params)

    keys = jax.random.split(KEY, num)
    times = jnp.array([0, 0, task.max_steps - 2, task.max_steps - 1])
    obs, state, (next_obs, next_state, reward, terminated, info), truncated = jax.jit(
        jax.vmap(step)
    )(keys, actions, times)
    assert next_obs.shape == obs.shape and next_obs.dtype == obs.dtype
    assert jax.tree.structure(next_state) == jax.tree.structure(state)
    assert reward.shape == (num,) and reward.dtype == jnp.float32
    assert terminated.shape == (num,) and terminated.dtype == bool
    np.testing.assert_array_equal(info["discount"], 1.0 - terminated)
    np.testing.assert_array_equal(state.time, 0)
    np.testing.assert_array_equal(next_state.time, times + 1)
    np.testing.assert_array_equal(truncated, [False, False, False, True])
    assert all(info[key].shape == (num,) for key in task.info_keys)
    if task.num_states is None:
        assert len(np.unique(obs, axis=0)) == num and np.isfinite(next_obs).all()
    alone = jax.jit(step)(keys[1], actions[1], times[1])[2]
    batched = jax.tree.map(lambda x: x[1], (next_obs, next_state, reward, terminated))
    assert_close(alone[:4], batched, rtol=1e-5, atol=1e-5)


def test_a_task_made_by_hand_has_the_limit_that_it_is_given():
    world = envs.make("gridworld_2x2").env
    task = envs.Task(name="mine", env=world)
    assert task.params == world.default_params and task.max_steps == 10
    assert task.solved_reward == np.inf and not task.is_solvable and task.origin is None
    shorter = envs.Task(name="mine", env=world, max_steps=3)
    assert shorter.max_steps == shorter.params.max_steps_in_episode == 3
    longer = dataclasses.replace(shorter, max_steps=4)
    assert longer.max_steps == longer.params.max_steps_in_episode == 4


OURS = {  # where Gymnasium has no threshold, or other rules
    "pendulum": (200, -250.0),
    "cliff_walking": (50, -20.0),  # paper, appendix, tables of fixed hyperparameters
    "gridworld_2x2": (10, 0.8),  # its authors' code
    "halfcheetah": (1000, 3000.0),  # paper
    "walker2d": (1000, 4000.0),
}
CARTPOLES = {"cartpole": "CartPole-v0", "cartpole_v1": "CartPole-v1"}


@pytest.mark.parametrize("name", envs.names())
def test_limits_thresholds_and_spaces_are_the_papers_and_gymnasiums(name):
    task = make(name)
    expected = None
    if name not in OURS:
        spec = gymnasium.spec((GYMNASIUM_IDS | CARTPOLES)[name])
        expected = spec.max_episode_steps, spec.reward_threshold
    assert (task.max_steps, task.solved_reward) == OURS.get(name, expected)
    if name in GYMNASIUM_IDS:
        real = gymnasium.make(GYMNASIUM_IDS[name]).unwrapped
        assert real.observation_space.shape == (task.obs_dim,)
        assert real.action_space == RealTask.of_spec(task).action_space


# --- the classic tasks, beside Gymnasium and gymnax ----------------------------------------------


def step_from(name, env, params):
    """One step from each state, `(values [n, fields], actions)`, jitted."""
    _, template = env.reset_env(KEY, params)

    def step(values, action):
        fields = dict(zip(STATES[name], values, strict=True))
        return env.step_env(KEY, template.replace(**fields), action, params)

    return jax.jit(jax.vmap(step))


def draw_steps(name, num=1000):
    """States from all over the box, `[num, fields]`, and actions."""
    rng = np.random.default_rng(0)
    low, high = np.transpose([*STATES[name].values()])
    return rng.uniform(low, high, (num, len(low))), draw_actions(envs.make(name), rng, num)


@pytest.mark.parametrize("name", CLASSIC)
def test_a_thousand_steps_equal_gymnasiums(name):
    task, reference = envs.make(name), gymnasium.make(GYMNASIUM_IDS[name]).unwrapped
    reference.reset(seed=0)
    states, actions = draw_steps(name)
    expected = []
    for state, action in zip(states, actions, strict=True):
        reference.state, reference.steps_beyond_terminated = np.array(state), None
        expected.append(reference.step(action)[:3])
    expected_obs, expected_reward, expected_terminated = map(np.array, zip(*expected, strict=True))
    if name != "pendulum":  # which never terminates; else both sides of the walls were visited
        assert 0.02 < expected_terminated.mean() < 0.98
    # In float64 the equations are Gymnasium's, up to its float32 observation.
    with jax.enable_x64(True):
        obs, _, reward, terminated, _ = step_from(name, task.env, task.params)(states, actions)
    np.testing.assert_allclose(obs, expected_obs, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(terminated, expected_terminated)
    np.testing.assert_allclose(reward, expected_reward, atol=1e-6)
    # In float32, as we run them, Acrobot's fastest spins amplify rounding in a step of a thousand.
    step = step_from(name, task.env, task.params)
    obs, after, _, terminated, _ = step(np.float32(states), actions)
    over = jax.vmap(task.env.is_terminated, (0, None))(after, task.params)
    np.testing.assert_array_equal(over, terminated)
    error = np.abs(obs - expected_obs) / (1 + np.abs(expected_obs))
    assert np.quantile(error.max(axis=1), 0.998) < 1e-4
    assert error.max() < 1e-2
    assert (terminated == expected_terminated).mean() > 0.998


def test_a_loop_of_gymnax_sees_what_it_sees_with_gymnaxs_own():
    params = envs.make("cartpole").params.replace(max_steps_in_episode=12)

    def walk(env, params):
        def step(carry, action):
            key, state = carry
            key, key_step = jax.random.split(key)
            obs, state, *rest = env.step(key_step, state, action, params)
            return (key, state), (obs, *rest)

        return jax.lax.scan(step, (KEY, env.reset(KEY, params)[1]), jnp.arange(40) % 2)[1]

    theirs, theirs_params = gymnax.make("CartPole-v1")
    theirs_params = theirs_params.replace(max_steps_in_episode=12)
    ours = walk(envs.make("cartpole").env, params)
    assert ours[3].sum() > 2  # truncated, and reset
    assert_equal(ours, walk(theirs, theirs_params))


# --- grid worlds ---------------------------------------------------------------------------------

MAZE = ("O# G", "  S#", "#O  ")  # walls and borders on all sides, and cells closed in


def step_everywhere(env, params):
    """Steps from all cells by all actions: next index, reward, terminated, `[num_states, 4]`."""

    def step(index, action):
        _, state = env.reset_env(KEY, params)
        out = env.step_env(KEY, state.replace(index=index), action, params)
        return out[0], out[2], out[3]

    over_actions = jax.vmap(step, (None, 0))
    table = jax.jit(jax.vmap(over_actions, (0, None)))(jnp.arange(env.spaces[0].n), jnp.arange(4))
    return [np.asarray(x) for x in table]


def walk(rows, index, action):
    """The cell that a move reaches, by coordinates: its index and its character."""
    cells = {(x, y): c for x, row in enumerate(rows) for y, c in enumerate(row)}
    x, y = divmod(index, len(rows[0]))
    target = {RIGHT: (x, y + 1), LEFT: (x, y - 1), DOWN: (x + 1, y), UP: (x - 1, y)}[action]
    if cells.get(target, "#") == "#":
        target = (x, y)
    return target[0] * len(rows[0]) + target[1], cells[target]


@pytest.mark.parametrize(("name", "rows", "rewards"), [
    ("cliff_walking", CLIFF_WALKING, {" ": -1, "S": -1, "O": -100, "G": 0}),
    ("gridworld_2x2", ROOM_2X2, {" ": -0.01, "S": -0.01, "G": 1}),
    ("maze", MAZE, {" ": -0.01, "S": -0.01, "O": -1, "G": 1, "#": -0.01}),
])  # fmt: skip
def test_every_step_in_a_grid_follows_its_map(name, rows, rewards):
    env, params = GridWorld(rows), GridParams()
    if name != "maze":
        env, params = envs.make(name).env, envs.make(name).params
    next_index, reward, terminated = step_everywhere(env, params)
    assert next_index.shape == (len(rows) * len(rows[0]), 4)
    for index, action in np.ndindex(next_index.shape):
        expected, cell = walk(rows, index, action)
        assert next_index[index, action] == expected
        assert reward[index, action] == np.float32(rewards[cell])
        assert terminated[index, action] == (cell in "GO")
    obs, state = env.reset_env(KEY, params)
    assert obs == state.index == "".join(rows).index("S")
    assert {refused(GridWorld, wrong) for wrong in (["S", " G"], ["  "], ["SX"])} == {"rows"}


def test_the_move_into_the_goal_can_be_paid():
    task = envs.make("cliff_walking", goal_reward=-1.0)
    assert envs.make("cliff_walking", goal_reward=-1) is task != envs.make("cliff_walking")
    assert task.origin == {"name": "cliff_walking", "goal_reward": -1.0}
    _, reward, _ = step_everywhere(task.env, task.params)
    assert reward[35, DOWN] == reward[24, RIGHT] == -1.0
    assert refused(envs.make, "cliff_walking", goal_reward=float("nan")) == "env.goal_reward"


# --- decisions that last, against stepping by hand ------------------------------------------------


@pytest.mark.parametrize("start", [0, 6, 8])
def test_a_decision_is_three_steps_or_as_many_as_the_episode_has_left(start):
    task = envs.make("cartpole")
    params = task.params.replace(max_steps_in_episode=10)
    env = repeat_actions(task.env, 3)
    obs, state = task.env.reset_env(KEY, params)
    state = state.replace(time=start)
    _, repeated, reward, terminated, info = jax.jit(env.step_env)(KEY, state, 1, params)
    total, num_steps = 0.0, 0
    while num_steps < 3 and state.time < 10:
        obs, state, step_reward, _, _ = task.env.step_env(KEY, state, 1, params)
        total, num_steps = total + step_reward, num_steps + 1
    assert info["sejax_num_steps"] == num_steps == min(3, 10 - start)
    assert reward == total and not terminated
    assert env.is_truncated(repeated, params) == (start + num_steps >= 10)
    np.testing.assert_allclose(env.get_obs(repeated), obs, rtol=1e-6)


def test_nothing_happens_after_an_episode_has_terminated():
    task = envs.make("mountain_car_continuous")
    env = repeat_actions(task.env, 4)
    _, state = task.env.reset_env(KEY, task.params)
    state = state.replace(position=jnp.float32(0.449), velocity=jnp.float32(0.05))
    _, end, reward, terminated, info = env.step_env(KEY, state, jnp.ones(1), task.params)
    assert terminated and info["sejax_num_steps"] == 1 and reward == pytest.approx(100 - 0.1)
    assert end.position == pytest.approx(0.449 + 0.05, abs=3e-3)  # one step further, not four


def test_a_trainer_counts_steps_of_the_world():
    agent = scripted_agent()
    agent = dataclasses.replace(agent, spec=dataclasses.replace(agent.spec, action_repeat=3))
    training = paper_training(max_episodes=MAX_EPISODES, stop_rule="never")
    train = jax.jit(make_trainer(agent, ScriptedEnv(), training))
    result = train(KEY, script([1.0] * MAX_EPISODES, [99] * MAX_EPISODES))
    assert result.train_steps == MAX_EPISODES * MAX_STEPS  # 3 + 1 steps in each episode
    assert result.episodes == MAX_EPISODES
    np.testing.assert_array_equal(result.returns, 1.0)
