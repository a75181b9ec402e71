"""MuJoCo behind XLA's foreign function interface, and the tasks on it beside Gymnasium's."""

import functools
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from support import assert_equal, has_compiler, refusal

from sejax import envs
from sejax.envs.mujoco.tasks import HalfCheetah, Hopper
from sejax.gym import GYMNASIUM_IDS
from sejax.ops.parallel import spread_over_devices

gymnasium = pytest.importorskip("gymnasium")
mujoco = pytest.importorskip("mujoco")
if not has_compiler():
    pytest.skip("no C++ compiler", allow_module_level=True)

from sejax.envs.mujoco import library  # noqa: E402, which imports mujoco
from sejax.envs.mujoco.physics import of_gymnasium  # noqa: E402

IDS = {name: x for name, x in GYMNASIUM_IDS.items() if x.endswith("-v5")}
NAMES = tuple(IDS)
# Gymnasium's keyword arguments, other than its defaults.
OPTIONS = {
    "hopper": {"ctrl_cost_weight": 0.1, "healthy_reward": 2.0, "terminate_when_unhealthy": False},
    "walker2d": {"forward_reward_weight": 0.5},
    "ant": {"contact_cost_weight": 0.1, "include_cfrc_ext_in_observation": False},
    "reacher": {"reward_dist_weight": 3.0, "reward_control_weight": 0.5},
}
NUM_STEPS = 1000
# Beyond the bounds, where MuJoCo clips and costs go on; so small that the pole stands for a while.
SCALE = {"inverted_pendulum": 0.01}
RENAMED = {"reward_forward": "reward_run"}  # the paper's name, of v3, for halfcheetah alone


def in_gymnasium(name, **options):
    """Gymnasium's environment, without a step limit."""
    pytest.importorskip("imageio", reason="pip install 'gymnasium[mujoco]'")
    return gymnasium.make(IDS[name], **options).unwrapped


@functools.cache
def walk_of(task):
    """`walk(key, actions)`: `(start, obs, steps)` with leaves `[step]` in `steps`; jitted."""

    def walk(key, actions):
        obs, state = task.env.reset_env(key, task.params)

        def step(state, action):
            obs, state, *rest = task.env.step_env(None, state, action, task.params)
            return state, (obs, state.physics, *rest)

        return state.physics, obs, jax.lax.scan(step, state, actions)[1]

    return jax.jit(walk)


def draw_actions(task, num_steps, seed=0):
    scale = SCALE.get(task.name, 1.2) * task.max_action
    shape = (num_steps, task.action_dim)
    return np.float32(np.random.default_rng(seed).uniform(-scale, scale, shape))


def integration_state(words, model):
    """What MuJoCo steps on from, as doubles `[n]`, of a state of `Physics`."""
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION)
    return np.asarray(words).view(np.float64)[..., :size]


def start_of(words, model):
    """Positions and velocities; the time is before them."""
    state = integration_state(words, model)
    return state[..., 1 : 1 + model.nq], state[..., 1 + model.nq : 1 + model.nq + model.nv]


def play_in_gymnasium(env, qpos, qvel, actions):
    """First observation, and of each step `(obs, reward, terminated, info, state)`."""
    env.reset(seed=0)
    mujoco.mj_resetData(env.model, env.data)
    env.set_state(qpos, qvel)
    first, steps = env._get_obs(), []
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    for action in actions:
        obs, reward, terminated, _, info = env.step(action)
        state = np.empty(mujoco.mj_stateSize(env.model, kind))
        mujoco.mj_getState(env.model, env.data, state, kind)
        steps.append((obs, reward, terminated, info, state))
    return first, jax.tree.map(lambda *x: np.array(x), *steps)


# --- equal to Gymnasium --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "options"), [*((name, {}) for name in NAMES), *OPTIONS.items()], ids=str
)
def test_a_thousand_steps_equal_gymnasiums(name, options):
    task, env = envs.make(name, **options), in_gymnasium(name, **options)
    actions = draw_actions(task, NUM_STEPS)
    start, first, steps = jax.device_get(walk_of(task)(jax.random.key(1), actions))
    obs, states, reward, terminated, info = steps
    expected_first, expected = play_in_gymnasium(env, *start_of(start, env.model), actions)
    np.testing.assert_allclose(first, expected_first, rtol=0, atol=1e-6)
    np.testing.assert_allclose(obs, expected[0], rtol=0, atol=1e-5)
    np.testing.assert_allclose(reward, expected[1], rtol=0, atol=1e-5)
    np.testing.assert_array_equal(terminated, expected[2])
    np.testing.assert_array_equal(info["discount"], 1.0 - terminated)
    renamed = RENAMED if name == "halfcheetah" else {}
    told = {renamed.get(key, key): value for key, value in expected[3].items()}
    assert {*info} == {*told, "discount"}
    for key, value in told.items():
        np.testing.assert_allclose(info[key], value, rtol=0, atol=1e-5, err_msg=key)
    np.testing.assert_array_equal(integration_state(states, env.model), expected[4])
    if name in ("hopper", "walker2d", "inverted_pendulum"):  # both kinds of steps were compared
        can_end = options.get("terminate_when_unhealthy", True)
        assert terminated.any() == can_end and not terminated.all()


@pytest.mark.parametrize("name", ["hopper", "walker2d", "ant"])
def test_who_is_healthy_is_as_in_gymnasium_on_both_sides_of_every_bound(name):
    task, env, num = envs.make(name), in_gymnasium(name), 300
    rng = np.random.default_rng(0)
    qpos = np.float32(env.init_qpos + rng.uniform(-0.3, 0.3, (num, env.model.nq)))
    qpos[:, 2 if name == "ant" else 1] = rng.uniform(0.1, 2.5, num)
    qvel = np.float32(rng.uniform(-1, 1, (num, env.model.nv)) * rng.choice([1, 102], (num, 1)))
    physics = task.env.physics
    healthy = jax.jit(jax.vmap(lambda *x: task.env.task.is_healthy(physics.reset(*x)[1])))(
        qpos, qvel
    )
    expected = []
    for row in zip(qpos, qvel, strict=True):
        env.set_state(*row)
        expected.append(env.is_healthy)
    np.testing.assert_array_equal(healthy, expected)
    assert 10 < np.sum(expected) < num - 10


@pytest.mark.parametrize("name", NAMES)
def test_resets_are_drawn_as_gymnasiums(name):
    task, env, num = envs.make(name), in_gymnasium(name), 300
    keys = jax.random.split(jax.random.key(0), num)
    # What `reset_env` begins from, as tested above.
    ours = np.concatenate(jax.jit(jax.vmap(task.env.task.draw_start))(keys), axis=1)
    env.reset(seed=0)
    theirs = np.empty_like(ours)
    for row in theirs:
        env.reset_model()
        row[:] = env.state_vector()
    for mine, reference in zip(ours.T, theirs.T, strict=True):
        if np.ptp(reference) == 0:  # the speed of the reacher's target
            np.testing.assert_array_equal(mine, reference)
        else:
            assert stats.ks_2samp(mine, reference).pvalue > 1e-4


# --- pure, in every transformation ---------------------------------------------------------------


@pytest.fixture(scope="module")
def ant_walks():
    """`(walk, keys, actions, each)`: an ant's walks, and what they give one after another."""
    task = envs.make("ant")
    keys, actions = jax.random.split(jax.random.key(0), 6), draw_actions(task, 40)
    one = walk_of(task)
    each = [jax.device_get(one(key, actions)) for key in keys]
    return one, keys, actions, jax.tree.map(lambda *x: np.stack(x), *each)


def test_batches_devices_and_threads_equal_single_walks_to_the_bit(ant_walks):
    one, keys, actions, each = ant_walks
    nested = jax.vmap(jax.vmap(one, (0, None)), (0, None))
    together = jax.jit(nested)(keys.reshape(2, 3), actions)
    assert_equal(jax.tree.map(lambda x: x.reshape(6, *x.shape[2:]), together), each)
    spread = spread_over_devices(lambda key: one(key, actions), num_devices=2, num_parallel=1)
    assert_equal(jax.jit(spread)(keys), each)
    with ThreadPoolExecutor(3) as pool:
        walks = list(pool.map(lambda key: one(key, actions), keys))
    assert_equal(jax.tree.map(lambda *x: np.stack(x), *map(jax.device_get, walks)), each)


def test_a_walk_goes_on_from_its_state_whatever_was_stepped_between(ant_walks):
    _, _, actions, each = ant_walks
    ant, hopper = of_gymnasium("ant.xml", 5, True), of_gymnasium("hopper.xml", 4)
    ant_step, hopper_step = jax.jit(ant.step), jax.jit(hopper.step)
    _, _, (_, states, *_) = jax.tree.map(lambda x: x[2], each)
    other = hopper.reset(jnp.ones(6), jnp.zeros(6))[0]
    for before, after, action in zip(states[:10], states[1:11], actions[1:11], strict=True):
        other, _ = hopper_step(other, action[:3])
        ant_step(states[-1], -action)
        np.testing.assert_array_equal(ant_step(before, action)[0], after)


def test_a_step_rounds_what_changed_and_not_where_it_is():
    """Far from the origin single precision would round the velocity to a grid of 0.16 m/s."""
    physics = of_gymnasium("half_cheetah.xml", 5)
    step = jax.jit(physics.step)
    changes = []
    for x in (0.0, 1e5):
        state, _ = physics.reset(jnp.zeros(9).at[0].set(x), jnp.ones(9))
        changes.append(step(state, jnp.full(6, 0.5))[1].qpos_change)
    np.testing.assert_allclose(changes[0], changes[1], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "ctrl", [[1, 5, 1], [1, np.nan, 1], [1, np.inf, 1], [0.1, -np.inf, 0], [1, -1e11, 0.3]]
)
def test_odd_controls_are_taken_as_mujoco_takes_them_and_leave_no_log(ctrl, monkeypatch, tmp_path):
    physics = of_gymnasium("hopper.xml", 4)
    data = mujoco.MjData(physics.model)
    data.qpos[:], data.ctrl[:] = 1, np.float32(ctrl)
    monkeypatch.chdir(tmp_path)
    state, _ = physics.reset(jnp.ones(6), jnp.zeros(6))
    _, now = jax.jit(physics.step)(state, jnp.array(ctrl))
    assert not list(tmp_path.iterdir())
    mujoco.mj_step(physics.model, data, 4)
    np.testing.assert_array_equal(now.qpos, np.float32(data.qpos))
    np.testing.assert_array_equal(now.qvel, np.float32(data.qvel))
    task = envs.make("hopper")  # which charges for them as they are
    _, state = task.env.reset_env(jax.random.key(0), task.params)
    _, _, reward, _, _ = task.env.step_env(None, state, jnp.array(ctrl), task.params)
    assert np.isfinite(reward) == np.isfinite(ctrl).all()


def test_a_simulation_that_explodes_begins_anew_and_leaves_no_log(monkeypatch, tmp_path, capfd):
    physics = of_gymnasium("hopper.xml", 4)
    step = jax.jit(physics.step)
    monkeypatch.chdir(tmp_path)
    rest, _ = physics.reset(physics.model.qpos0, jnp.zeros(6))
    resting = step(rest, jnp.zeros(3))[1].qpos
    state, _ = physics.reset(jnp.ones(6), jnp.zeros(6).at[3:].set(1e11))
    exploded = step(state, jnp.zeros(3))[1]
    np.testing.assert_allclose(exploded.qpos, resting, atol=1e-6)
    said = "".join(capfd.readouterr())  # XLA may have said something
    assert not list(tmp_path.iterdir()) and "WARNING" not in said, said


# --- what cannot be ------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(4,), (), (2, 3)])
def test_controls_of_another_shape_are_an_error(shape):
    physics = of_gymnasium("hopper.xml", 4)
    state, _ = physics.reset(jnp.ones(6), jnp.zeros(6))
    with pytest.raises(jax.errors.JaxRuntimeError, match="ctrl must have shape"):
        jax.block_until_ready(physics.step(state, jnp.zeros(shape)))


def no_compiler(patch):
    patch.setenv("CXX", "no-such-compiler")


def unloadable_library(patch):
    patch.setattr(library, "build", lambda path: path.write_text("nothing"))


@pytest.mark.parametrize("config", [HalfCheetah(), Hopper()], ids=["halfcheetah", "hopper"])
@pytest.mark.parametrize("without", [
    no_compiler,
    lambda patch: patch.setenv("CXX", "ls --no-standard-library"),
    unloadable_library,
    lambda patch: patch.setitem(sys.modules, "mujoco", None),
    lambda patch: patch.setitem(sys.modules, "gymnasium", None),
    lambda patch: patch.setattr(jax, "default_backend", lambda: "gpu"),
])  # fmt: skip
def test_where_mujoco_cannot_run_one_message_says_what_can_be_done(
    config, without, monkeypatch, tmp_path
):
    monkeypatch.setenv("SEJAX_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(library, "_load", library._load.__wrapped__)  # as if never loaded
    without(monkeypatch)
    error = refusal(config.make)
    assert error.field == "env" and str(error).startswith(f"env cannot be {config.name}, which ")
    assert ("env.backend=mjx" in str(error)) == (config.name == "halfcheetah")
    assert unloadable_library is without or not list(tmp_path.iterdir())


# --- slow: builds and long runs ------------------------------------------------------------------


@pytest.mark.slow
def test_builders_at_the_same_time_leave_one_library_in_place_of_a_broken_one(tmp_path):
    path = tmp_path / library.file_name()
    path.write_text("nothing")
    words = {"SEJAX_CACHE_DIR": ".", "cwd": tmp_path}
    with ThreadPoolExecutor(3) as pool:
        programs = pool.map(lambda _: run_program("memory", "reacher", "10", **words), range(3))
        assert all(str(path) in program.stdout for program in programs)
    assert [*tmp_path.iterdir()] == [path] and path.stat().st_size > 10_000


PROGRAM = """
import resource, sys
import jax, jax.numpy as jnp, numpy as np
from sejax.envs.mujoco import library
if sys.argv[1] == "sanitizers":
    # Undefined, since MuJoCo's headers know clang's sanitizers alone.
    library.FLAGS = (*library.FLAGS, "-g", "-fsanitize=address,undefined",
                     "-fno-sanitize-recover=all", "-U__SANITIZE_ADDRESS__")
from sejax import envs
for name in sys.argv[2].split(","):
    task, num_steps = envs.make(name), int(sys.argv[3])

    def walk(key):
        def step(i, carry):
            state, total = carry
            action = jnp.sin(i * 0.3 + jnp.arange(task.action_dim, dtype=jnp.float32))
            _, state, reward, *_ = task.env.step_env(None, state, action, task.params)
            return state, total + reward

        state = task.env.reset_env(key, task.params)[1]
        return jax.lax.fori_loop(0, num_steps, step, (state, jnp.float32(0)))[1]

    walks = jax.jit(jax.vmap(walk)).lower(jax.random.split(jax.random.key(0), 2)).compile()
    grown = []
    for seed in range(3):
        out = walks(jax.random.split(jax.random.key(seed), 2))
        assert np.isfinite(out).all()
        grown.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    assert grown[2] - grown[1] < 2048, grown  # KiB, in as many steps
print("done", library.load()._name)
"""


def run_program(*arguments, cwd=None, **variables):
    environment = {**os.environ, "XLA_FLAGS": "", **variables}
    command = [sys.executable, "-c", PROGRAM, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=cwd)
    assert done.returncode == 0 and done.stdout.startswith("done"), done.stdout + done.stderr
    return done


@pytest.mark.slow
def test_sanitizers_find_nothing_in_walks(tmp_path):
    # The sanitizer comes first in a process, and must find the functions that throw exceptions.
    commands = [
        [*library.compiler(), f"-print-file-name={name}"]
        for name in ("libasan.so", "libstdc++.so.6")
    ]
    runtimes = [subprocess.check_output(command, text=True).strip() for command in commands]
    if not all(map(os.path.isabs, runtimes)):
        pytest.skip("the compiler has no address sanitizer")
    done = run_program(
        "sanitizers", ",".join(NAMES), "100", LD_PRELOAD=" ".join(runtimes),
        SEJAX_CACHE_DIR=str(tmp_path), ASAN_OPTIONS="detect_leaks=0",
    )  # fmt: skip
    assert str(tmp_path) in done.stdout and "runtime error" not in done.stderr


@pytest.mark.slow
def test_memory_does_not_grow_over_a_million_steps():
    run_program("memory", "reacher", "200000")  # two walks, three times
