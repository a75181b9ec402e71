"""sejax.envs: the contract of every real task, and parity with Gymnasium."""

import dataclasses

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sejax import envs, registry
from sejax.errors import ConfigError

GYMNASIUM_IDS = {
    "cartpole": "CartPole-v1",
    "cartpole_v1": "CartPole-v1",
    "acrobot": "Acrobot-v1",
    "mountain_car": "MountainCar-v0",
    "mountain_car_continuous": "MountainCarContinuous-v0",
    "pendulum": "Pendulum-v1",
}
CARTPOLE_FIELDS = ("x", "x_dot", "theta", "theta_dot")
STATE_FIELDS = {
    "cartpole": CARTPOLE_FIELDS,
    "cartpole_v1": CARTPOLE_FIELDS,
    "acrobot": ("joint_angle1", "joint_angle2", "velocity_1", "velocity_2"),
    "mountain_car": ("position", "velocity"),
    "mountain_car_continuous": ("position", "velocity"),
    "pendulum": ("theta", "theta_dot"),
}
# Corners of the box that states are drawn from. CartPole: up to the walls (|x| = 2.4, 12 degrees),
# so that a step crosses them. Acrobot and the pendulum: all angles and speeds, where clipping and
# wrapping act. The cars: from the left wall over the goal to the right wall, at all speeds.
CARTPOLE_HIGH = np.array([2.4, 4.0, 12 * 2 * np.pi / 360, 4.0])
ACROBOT_HIGH = np.array([np.pi, np.pi, 4 * np.pi, 9 * np.pi])
PENDULUM_HIGH = np.array([5 * np.pi, 8.0])
CAR_BOX = (np.array([-1.2, -0.07]), np.array([0.6, 0.07]))
STATE_BOX = {
    "cartpole": (-CARTPOLE_HIGH, CARTPOLE_HIGH),
    "cartpole_v1": (-CARTPOLE_HIGH, CARTPOLE_HIGH),
    "acrobot": (-ACROBOT_HIGH, ACROBOT_HIGH),
    "mountain_car": CAR_BOX,
    "mountain_car_continuous": CAR_BOX,
    "pendulum": (-PENDULUM_HIGH, PENDULUM_HIGH),
}
GRIDS = ("cliff_walking", "gridworld_2x2")
# See test_mujoco.py and test_halfcheetah.py.
ON_MUJOCO = {"halfcheetah", "hopper", "walker2d", "swimmer", "inverted_pendulum", "ant", "reacher"}
NAMES = [name for name in envs.names() if name not in ON_MUJOCO]
RIGHT, LEFT, DOWN, UP = range(4)
# An action that does not end the episode from the first state, where 0 would.
QUIET_ACTION = {"cliff_walking": UP}


@pytest.fixture(scope="module")
def env_step():
    """Jitted `step_env` of each task: `(key, state, action)`."""
    tasks = {name: envs.make(name) for name in NAMES}
    return {
        name: jax.jit(lambda k, s, a, task=task: task.env.step_env(k, s, a, task.params))
        for name, task in tasks.items()
    }


@pytest.fixture(scope="module")
def env_reset():
    """Jitted `reset_env` of each task, one after another: `(key) -> (obs, state)`."""
    tasks = {name: envs.make(name) for name in NAMES}
    return {
        name: jax.jit(lambda k, task=task: task.env.reset_env(k, task.params))
        for name, task in tasks.items()
    }


def set_state(name, template, values):
    """The gymnax state with these numbers (leaves `[]`, or `[n]` for `[n, fields]` values)."""
    columns = jnp.asarray(values, None if jax.config.jax_enable_x64 else jnp.float32)
    return template.replace(
        **{field: columns[..., i] for i, field in enumerate(STATE_FIELDS[name])}
    )


def draw_actions(task, rng, num):
    """All discrete actions `[num]`, or continuous ones `[num, 1]` from a box 1.5 times as wide."""
    if task.num_actions is not None:
        return rng.permutation(np.arange(num) % task.num_actions).astype(np.int32)
    actions = rng.uniform(-1.5 * task.max_action, 1.5 * task.max_action, (num, task.action_dim))
    return actions.astype(np.float32)


def gymnasium_step(env, state, action):
    """One step of Gymnasium's dynamics from any state."""
    env.unwrapped.state = np.array(state, np.float64)
    env.unwrapped.steps_beyond_terminated = None
    obs, reward, terminated, _, _ = env.unwrapped.step(action)
    return obs, reward, terminated


# --- contract, over the whole registry -----------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_a_task_is_built_once(name):
    assert envs.make(name) is envs.make(name)
    assert envs.make(name).name == name


@pytest.mark.parametrize("name", GYMNASIUM_IDS)
def test_reset_draws_a_fresh_float_observation_for_each_key(name):
    task = envs.make(name)
    keys = jax.random.split(jax.random.key(0), 50)
    obs, state = jax.jit(jax.vmap(task.env.reset_env, (0, None)))(keys, task.params)
    assert obs.shape == (50, task.obs_dim) and obs.dtype == jnp.float32
    assert np.isfinite(obs).all()
    assert len(np.unique(obs, axis=0)) == 50
    np.testing.assert_array_equal(state.time, 0)


@pytest.mark.parametrize("name", GRIDS)
def test_reset_of_a_grid_world_is_the_index_of_its_start(name):
    task = envs.make(name)
    obs, state = jax.jit(task.env.reset_env)(jax.random.key(0), task.params)
    assert obs.shape == () and obs.dtype == jnp.int32
    assert obs == state.index == {"cliff_walking": 36, "gridworld_2x2": 0}[name]
    assert state.time == 0
    assert task.env.observation_space(task.params).contains(obs)


@pytest.mark.parametrize("name", NAMES)
def test_a_step_returns_what_the_trainer_relies_on(name, env_step, env_reset):
    task = envs.make(name)
    obs, state = env_reset[name](jax.random.key(0))
    for action in draw_actions(task, np.random.default_rng(0), 4):
        next_obs, next_state, reward, terminated, info = env_step[name](
            jax.random.key(1), state, action
        )
        assert next_obs.shape == obs.shape and next_obs.dtype == obs.dtype
        assert reward.shape == () and reward.dtype == jnp.float32
        assert terminated.shape == () and terminated.dtype == bool
        assert info["discount"].shape == () and info["discount"] == 1.0 - terminated
        assert next_state.time == 1


@pytest.mark.parametrize("name", NAMES)
def test_only_the_step_limit_truncates_and_it_does_not_terminate(name, env_step, env_reset):
    task = envs.make(name)
    _, state = env_reset[name](jax.random.key(0))
    action = QUIET_ACTION.get(name, 0)
    for steps_before, truncates in [
        (0, False), (task.max_steps - 2, False), (task.max_steps - 1, True),
    ]:  # fmt: skip
        late = state.replace(time=jnp.int32(steps_before))
        _, after, _, terminated, info = env_step[name](jax.random.key(1), late, action)
        assert task.env.is_truncated(after, task.params) == truncates
        assert not terminated
        assert info["discount"] == 1.0


@pytest.mark.parametrize("name", NAMES)
def test_vmapped_steps_equal_single_ones(name, env_step, env_reset):
    task = envs.make(name)
    keys = jax.random.split(jax.random.key(0), 6)
    each = [env_reset[name](key)[1] for key in keys]
    states = jax.tree.map(lambda *x: jnp.stack(x), *each)
    actions = draw_actions(task, np.random.default_rng(1), 6)
    step = jax.jit(jax.vmap(lambda k, s, a: task.env.step_env(k, s, a, task.params)))
    together = step(keys, states, actions)
    for i in range(6):
        alone = env_step[name](keys[i], jax.tree.map(lambda x, i=i: x[i], states), actions[i])
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_what_is_said_of_a_task_before_it_is_made_is_so(name):
    config = registry.configure("env", {"name": name})
    assert config.facts == envs.facts_of(config) == envs.make(name).facts


def test_a_task_says_what_it_was_made_from():
    for options in ({}, {"goal_reward": -1.0}):
        task = envs.make("cliff_walking", **options)
        assert task.origin == {"name": "cliff_walking", "goal_reward": 0.0} | options
        assert envs.make(**task.origin) is task
    assert dataclasses.replace(task, origin=None).origin is None


def test_a_task_made_by_hand_has_the_limit_that_it_is_given():
    world = envs.make("gridworld_2x2").env
    task = envs.Task(name="mine", env=world)
    assert task.params == world.default_params and task.max_steps == 10
    assert task.solved_reward == np.inf and not task.is_solvable
    shorter = envs.Task(name="mine", env=world, max_steps=3)
    assert shorter.max_steps == shorter.params.max_steps_in_episode == 3
    assert dataclasses.replace(shorter, max_steps=4).params.max_steps_in_episode == 4
    with pytest.raises(ConfigError, match=r"^env\.max_steps must be at least 1"):
        envs.Task(name="mine", env=world, max_steps=0)


# --- the paper's numbers -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "max_steps", "solved_reward"),
    [
        ("cartpole", 200, 195.0),
        ("cartpole_v1", 500, 475.0),
        ("acrobot", 500, -100.0),
        ("cliff_walking", 50, -20.0),
        ("gridworld_2x2", 10, 0.8),
        ("mountain_car", 200, -110.0),
        ("mountain_car_continuous", 999, 90.0),
        ("pendulum", 200, -250.0),
    ],
)
def test_limits_are_the_papers(name, max_steps, solved_reward):
    # Paper, tables of fixed hyperparameters; the 2x2 room's are its authors', the pendulum's are
    # Gymnasium's step limit and our threshold. CartPole-v1 and MountainCar: Gymnasium's registry.
    task = envs.make(name)
    assert (task.max_steps, task.solved_reward) == (max_steps, solved_reward)


@pytest.mark.parametrize(
    ("name", "num_states", "obs_dim", "num_actions", "action_dim", "max_action"),
    [
        ("cartpole", None, 4, 2, 2, 1.0),
        ("cartpole_v1", None, 4, 2, 2, 1.0),
        ("acrobot", None, 6, 3, 3, 1.0),
        ("cliff_walking", 48, 48, 4, 4, 1.0),
        ("gridworld_2x2", 4, 4, 4, 4, 1.0),
        ("mountain_car", None, 2, 3, 3, 1.0),
        ("mountain_car_continuous", None, 2, None, 1, 1.0),
        ("pendulum", None, 3, None, 1, 2.0),
    ],
)
def test_sizes_tell_discrete_from_continuous(
    name, num_states, obs_dim, num_actions, action_dim, max_action
):
    task = envs.make(name)
    assert (task.num_states, task.obs_dim) == (num_states, obs_dim)
    assert (task.num_actions, task.action_dim) == (num_actions, action_dim)
    assert task.max_action == max_action and type(task.max_action) is float


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("cartpole", [-0.05] * 4, [0.05] * 4),
        ("cartpole_v1", [-0.05] * 4, [0.05] * 4),
        ("acrobot", [-0.1] * 4, [0.1] * 4),
        ("mountain_car", [-0.6, 0.0], [-0.4, 0.0]),
        ("mountain_car_continuous", [-0.6, 0.0], [-0.4, 0.0]),
        ("pendulum", [-np.pi, -1.0], [np.pi, 1.0]),
    ],
)
def test_initial_states_fill_the_same_range_as_gymnasiums(name, low, high):
    task = envs.make(name)
    keys = jax.random.split(jax.random.key(0), 400)
    _, state = jax.jit(jax.vmap(task.env.reset_env, (0, None)))(keys, task.params)
    values = np.stack([getattr(state, field) for field in STATE_FIELDS[name]], axis=1)
    low, high = np.array(low), np.array(high)
    margin = 0.025 * (high - low)
    assert (values >= low - 1e-6).all() and (values <= high + 1e-6).all()
    assert (values.min(axis=0) <= low + margin).all()
    assert (values.max(axis=0) >= high - margin).all()
    reference = gymnasium.make(GYMNASIUM_IDS[name]).unwrapped
    reference.reset(seed=0)
    assert (low <= reference.state).all() and (reference.state <= high).all()


# --- parity with Gymnasium -----------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(GYMNASIUM_IDS))
def test_steps_from_states_all_over_the_box_equal_gymnasiums(name, env_reset):
    task = envs.make(name)
    reference = gymnasium.make(GYMNASIUM_IDS[name])
    reference.reset(seed=0)
    rng = np.random.default_rng(0)
    states = rng.uniform(*STATE_BOX[name], (1000, len(STATE_FIELDS[name])))
    actions = draw_actions(task, rng, 1000)
    expected = [gymnasium_step(reference, s, a) for s, a in zip(states, actions, strict=True)]
    expected_obs, expected_reward, expected_terminated = map(np.array, zip(*expected, strict=True))
    if name != "pendulum":  # which never terminates; else both sides of the walls were visited
        assert 0.02 < expected_terminated.mean() < 0.98
    _, template = env_reset[name](jax.random.key(0))

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
def test_two_hundred_random_steps_equal_gymnasiums(name, env_step, env_reset):
    task = envs.make(name)
    reference = gymnasium.make(GYMNASIUM_IDS[name]).unwrapped
    actions = draw_actions(task, np.random.default_rng(1), 200)
    num_episodes = 0
    key = jax.random.key(0)
    _, template = env_reset[name](key)
    terminated = True
    for action in actions:
        if terminated:
            reference.reset(seed=num_episodes)
            state = set_state(name, template, np.array(reference.state))
            num_episodes += 1
        obs, state, reward, terminated, _ = env_step[name](key, state, action)
        expected_obs, expected_reward, expected_terminated, _, _ = reference.step(action)
        # Trajectories of float32 and float64 part slowly: each step is held to 1e-4.
        np.testing.assert_allclose(obs, expected_obs, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(reward, expected_reward, rtol=1e-5, atol=1e-5)
        assert bool(terminated) == expected_terminated
        state = set_state(name, state, np.array(reference.state))
    assert int(state.time) <= 200


def test_acrobot_terminates_when_the_tip_is_above_the_line(env_step, env_reset):
    # Straight up: joint 1 at pi, joint 2 at 0. Height -cos(pi) - cos(pi + 0) = 2 > 1.
    _, state = env_reset["acrobot"](jax.random.key(0))
    state = set_state("acrobot", state, [np.pi, 0.0, 0.0, 0.0])
    _, _, reward, terminated, info = env_step["acrobot"](jax.random.key(0), state, jnp.int32(1))
    assert terminated and reward == 0.0 and info["discount"] == 0.0


@pytest.mark.parametrize(
    ("position", "velocity", "action", "expected"),
    [
        # At the left wall -0.0025 cos(-3.6) = +0.0022418, so 0.0022418 + 0.0015 - 0.05 < 0: stop.
        (-1.2, -0.05, 1.0, (-1.2, 0.0, -0.1, False)),
        # At rest there, full power: 0.0037418.
        (-1.2, 0.0, 1.0, (-1.1962582, 0.0037418, -0.1, False)),
        # cos(1.5) = 0.0707372: 0.01 - 0.0001768 = 0.0098232 onwards, beyond the goal.
        (0.5, 0.01, 0.0, (0.5098232, 0.0098232, 100.0, True)),
        # The same rolling back over the goal: no stop, no end.
        (0.5, -0.01, 0.0, (0.4898232, -0.0101768, 0.0, False)),
        # The right wall stops the position alone.
        (0.6, 0.05, 0.0, (0.6, 0.05 + 0.0025 * 0.2272021, 100.0, True)),
        # Force 3 pushes like 1 and costs like 3; top speed is 0.07.
        (-0.5, 0.07, 3.0, (-0.43, 0.07, -0.9, False)),
    ],
)
def test_the_car_stops_at_the_walls_and_ends_at_the_goal(
    env_step, env_reset, position, velocity, action, expected
):
    name = "mountain_car_continuous"
    _, template = env_reset[name](jax.random.key(0))
    state = set_state(name, template, [position, velocity])
    obs, _, reward, terminated, info = env_step[name](
        jax.random.key(0), state, np.array([action], np.float32)
    )
    np.testing.assert_allclose([*obs, reward], expected[:3], rtol=1e-5, atol=1e-6)
    assert terminated == expected[3] and info["discount"] == 1.0 - expected[3]


@pytest.mark.parametrize("name", ["mountain_car_continuous", "pendulum"])
def test_a_continuous_action_may_be_a_scalar(name, env_step, env_reset):
    _, state = env_reset[name](jax.random.key(0))
    scalar = env_step[name](jax.random.key(0), state, jnp.float32(0.5))
    vector = env_step[name](jax.random.key(0), state, jnp.array([0.5]))
    for a, b in zip(jax.tree.leaves(scalar), jax.tree.leaves(vector), strict=True):
        assert a.shape == b.shape
        np.testing.assert_array_equal(a, b)


# --- grid worlds ---------------------------------------------------------------------------------

MAZE = ("O# G", "  S#", "#O  ")  # walls and borders on all sides, and cells closed in


def step_everywhere(env, params):
    """Steps from all cells by all actions: next index, reward, terminated, `[num_states, 4]`."""

    def step(index, action):
        _, state = env.reset_env(jax.random.key(0), params)
        out = env.step_env(jax.random.key(0), state.replace(index=index), action, params)
        return out[0], out[2], out[3]

    over_actions = jax.vmap(step, (None, 0))
    table = jax.jit(jax.vmap(over_actions, (0, None)))(jnp.arange(env.num_states), jnp.arange(4))
    return [np.asarray(x) for x in table]


def walk(rows, index, action):
    """The cell that a move reaches, by coordinates: its index and its character."""
    cells = {(x, y): c for x, row in enumerate(rows) for y, c in enumerate(row)}
    x, y = divmod(index, len(rows[0]))
    target = {RIGHT: (x, y + 1), LEFT: (x, y - 1), DOWN: (x + 1, y), UP: (x - 1, y)}[action]
    if cells.get(target, "#") == "#":
        target = (x, y)
    return target[0] * len(rows[0]) + target[1], cells[target]


@pytest.fixture(scope="module")
def cliff_table():
    task = envs.make("cliff_walking")
    return step_everywhere(task.env, task.params)


@pytest.mark.parametrize(
    ("rows", "rewards"),
    [
        ([" " * 12] * 3 + ["S" + "O" * 10 + "G"], {" ": -1, "S": -1, "O": -100, "G": 0}),
        (["S ", " G"], {" ": -0.01, "S": -0.01, "G": 1}),
        (MAZE, {" ": -0.01, "S": -0.01, "O": -1, "G": 1, "#": -0.01}),
    ],
    ids=["cliff_walking", "gridworld_2x2", "maze"],
)
def test_every_step_in_a_grid_follows_its_map(rows, rewards, request):
    from sejax.envs.dynamics.gridworld import GridParams, GridWorld

    name = request.node.callspec.id
    if name in GRIDS:
        env, params = envs.make(name).env, envs.make(name).params
    else:
        env, params = GridWorld(rows), GridParams()
    next_index, reward, terminated = step_everywhere(env, params)
    assert next_index.shape == (len(rows) * len(rows[0]), 4)
    for index in range(env.num_states):
        for action in range(4):
            expected, cell = walk(rows, index, action)
            assert next_index[index, action] == expected
            assert reward[index, action] == np.float32(rewards[cell])
            assert terminated[index, action] == (cell in "GO")


def test_known_steps_of_cliff_walking(cliff_table):
    next_index, reward, terminated = cliff_table
    for index, action, expected in [
        (36, UP, (24, -1, False)),
        (36, LEFT, (36, -1, False)),  # the border
        (36, DOWN, (36, -1, False)),
        (36, RIGHT, (37, -100, True)),  # off the cliff
        (34, DOWN, (46, -100, True)),
        (35, DOWN, (47, 0, True)),  # the goal
        (11, RIGHT, (11, -1, False)),
    ]:
        row = (next_index[index, action], reward[index, action], terminated[index, action])
        assert row == expected


def test_the_best_return_of_cliff_walking_is_minus_twelve(cliff_table):
    # 13 moves along the cliff, the last of them free.
    next_index, reward, terminated = cliff_table
    values = np.zeros(48)
    for _ in range(50):
        values = (reward + ~terminated * values[next_index]).max(axis=1)
    assert values[36] == -12
    assert values[35] == 0 and values[0] == -13


def test_the_best_return_of_the_2x2_room_is_two_moves():
    task = envs.make("gridworld_2x2")
    next_index, reward, terminated = step_everywhere(task.env, task.params)
    values = np.zeros(4)
    for _ in range(10):
        values = (reward + ~terminated * values[next_index]).max(axis=1)
    np.testing.assert_allclose(values[0], 0.99, rtol=1e-6)


def test_the_move_into_the_goal_can_be_paid():
    task = envs.make("cliff_walking", goal_reward=-1.0)
    assert envs.make("cliff_walking", goal_reward=-1) is task is not envs.make("cliff_walking")
    _, state = task.env.reset_env(jax.random.key(0), task.params)
    above = state.replace(index=jnp.int32(35))
    for index, action, expected in ((35, DOWN, -1.0), (24, RIGHT, -1.0)):
        got = task.env.step_env(
            jax.random.key(0), above.replace(index=jnp.int32(index)), action, task.params
        )
        assert got[2] == expected
    assert envs.make("cliff_walking").env.step_env(
        jax.random.key(0), above, DOWN, envs.make("cliff_walking").params
    )[2] == 0  # fmt: skip


def test_moves_of_cliff_walking_equal_gymnasiums(cliff_table):
    next_index, reward, terminated = cliff_table
    table = gymnasium.make("CliffWalking-v1").unwrapped.P
    gymnasium_action = {UP: 0, RIGHT: 1, DOWN: 2, LEFT: 3}
    for index in range(37):  # where an agent can be: the three upper rows and the start
        for action in range(4):
            [(_, expected, expected_reward, ends)] = table[index][gymnasium_action[action]]
            if expected_reward == -100:  # there a fall leads back to the start, here it ends
                assert reward[index, action] == -100 and terminated[index, action]
                assert 37 <= next_index[index, action] <= 46
            else:
                assert next_index[index, action] == expected
                assert terminated[index, action] == ends
                assert reward[index, action] == (0 if ends else -1)  # there the goal costs 1


def test_a_grid_episode_runs_to_its_step_limit_if_nothing_ends_it():
    task = envs.make("cliff_walking")
    _, start = task.env.reset_env(jax.random.key(0), task.params)

    def step(state, _):
        _, state, reward, terminated, _ = task.env.step_env(
            jax.random.key(0), state, LEFT, task.params
        )
        return state, (reward, terminated, task.env.is_truncated(state, task.params))

    _, (reward, terminated, truncated) = jax.lax.scan(step, start, None, task.max_steps)
    assert reward.sum() == -50
    assert not terminated.any()
    assert truncated[-1] and not truncated[:-1].any()


# --- errors --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (("S ", "G"), r"one length, .*; got lengths \[2, 1\]\. Fill short rows with spaces\."),
        (("SX", " G"), r"nothing else has a meaning; got \['X'\]\. Use a space for floor\."),
        (("SG", "S "), r"one S, because each episode starts there; got 2\. Mark one cell with S\."),
        (("  ", " G"), r"one S, .*; got 0\."),
    ],
)
def test_a_map_that_is_no_grid_world_is_refused(rows, message):
    from sejax.envs.dynamics.gridworld import GridWorld

    with pytest.raises(ValueError, match=message):
        GridWorld(rows)


def test_an_unknown_task_lists_the_known_ones_nearest_first():
    with pytest.raises(
        ConfigError,
        match=r"^env must be one of acrobot, .*cartpole.*; got 'acrobat'\. "
        r"Did you mean env=acrobot\?$",
    ):
        envs.make("acrobat")
