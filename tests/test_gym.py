"""sejax.gym: the same SEs as in JAX, alone and side by side, as Gymnasium environments."""

import dataclasses
import pickle
import sys
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from support import forge, paper_se, printed, random_like, refused, shapes_of

import sejax.gym
from sejax import envs
from sejax.gym import RealTask, SyntheticGymEnv, SyntheticVectorEnv, SyntheticWorld, make, make_vec
from sejax.ops.checksummed import pack, unpack
from sejax.options import ConfigError, registry
from sejax.proxies import MAX_ABS_VALUE
from sejax.proxies.header import find, pretrained_files

KEY = jax.random.key(0)
SMALL = {"hidden_size": 5}
BANDIT = {"initial_state": "learned", "horizon": 1, "done": "threshold"}
ALONE_AND_MANY = pytest.mark.parametrize("num_envs", [None, 3])


def jax_se(task="cartpole", **config):
    task = envs.make(task) if isinstance(task, str) else task
    return registry.make("proxy", paper_se(**SMALL | config), task)


def random_weights(env, seed=0, scale=0.5):
    return random_like(shapes_of(env.init_weights, KEY), seed, scale)


@pytest.fixture
def stored(tmp_path):
    """Writes an SE and returns its file."""

    def write(env, weights=None):
        path = tmp_path / "se.safetensors"
        sejax.save(path, env, random_weights(env) if weights is None else weights)
        return path

    return write


def world_of(task="cartpole", max_steps=4, outputs=None, **config):
    """An SE of random weights, or of constant outputs, whatever it sees."""
    real = gymnasium.make(sejax.gym.GYMNASIUM_IDS[task], max_episode_steps=max_steps)
    task = RealTask.of_env(real)
    config = paper_se(**SMALL | {"done": "threshold"} | config)
    units = config.networks(*map(spaces.flatdim, (task.observation_space, task.action_space)))
    like = {k: np.zeros(shape) for k, shape in sejax.gym.networks.shapes_of(units).items()}
    weights = random_like(like, seed=1, scale=0.0 if outputs else 0.5)
    for head, value in (outputs or {}).items():
        weights[f"{head}/Dense_1/bias"][:] = value
    return SyntheticWorld(weights, config, task)


def env_of(world, num_envs=None):
    """One environment of an SE, or several side by side."""
    return SyntheticVectorEnv(world, num_envs) if num_envs else SyntheticGymEnv(world)


def an_env(stored, source):
    """Of the name of a shipped proxy, or of an SE's task and configuration."""
    return make(source if isinstance(source, str) else stored(jax_se(source[0], **source[1])))


# --- the same as in JAX --------------------------------------------------------------------------


def assert_close(got, expected):
    """Up to the rounding of sums, whose terms may be as large as the largest of the values."""
    largest = np.abs(np.asarray(expected, np.float64)).max(initial=0.0)
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=max(1e-5, 1e-6 * largest))


STEPPED = [
    ("cartpole", {"done": "soft"}),
    ("acrobot", {"done": "threshold", "num_layers": 2, "activation": "prelu"}),
    ("gridworld_2x2", {"done": "threshold", "activation": "relu", "state_units": "bounds"}),
    ("mountain_car", {"done": "threshold", "state_units": "bounds", "initial_state": "learned"}),
    ("cartpole", {"done": "threshold", "state_units": "bounds", "horizon": 2}),
    ("pendulum", {"done": "threshold", "state_units": "bounds", "horizon": 1}),
    ("pendulum", {"done": "bernoulli", "activation": "tanh", "initial_state": "learned"}),
    ("mountain_car_continuous", {"done": "threshold", "horizon": 3}),
    ("cartpole", BANDIT),
    ("gridworld_2x2", {"done": "soft", "horizon": 1}),
    ("pendulum", {**BANDIT, "state_units": "bounds", "reward_form": "distance"}),
    ("cartpole", {"done": "soft", "min_steps": 3}),
    ("cartpole", {"done": "bernoulli", "min_steps": 4, "horizon": 6}),
]


@pytest.mark.parametrize(("task", "config"), STEPPED, ids=str)
def test_every_step_is_that_of_the_se_in_jax(stored, task, config):
    """All that both say of steps from the same states."""
    jax_env = jax_se(task, **config)
    weights = random_weights(jax_env, scale=1.0)
    if config["done"] == "bernoulli":  # far out, where any draw says the same
        last = weights["done"]["Dense_1"]
        last["kernel"], last["bias"] = 1e3 * last["kernel"], 1e3 * last["bias"]
    env, params = make(stored(jax_env, weights)), jax_env.params(weights)
    step = jax.jit(jax_env.step_env)
    empty = jax.eval_shape(jax_env.reset_env, KEY, params)[1]
    env.reset(seed=0)
    env.action_space.seed(0)
    num_ended = 0
    for i in range(40):
        state = empty.replace(vector=jnp.asarray(env._vector), time=jnp.int32(env._time))
        action = env.action_space.sample()
        expected = step(jax.random.key(i), state, jnp.asarray(action), params)
        obs, reward, terminated, truncated, info = env.step(action)
        kinds = [type(x) for x in (reward, terminated, truncated, info["discount"])]
        assert kinds == [float, bool, bool, float]
        assert_close(obs, expected[0])
        assert_close(reward, expected[2])
        assert_close(info["discount"], expected[4]["discount"])
        assert terminated == expected[3]
        assert truncated == bool(jax_env.is_truncated(expected[1], params))
        if terminated or truncated:
            num_ended += 1
            env.reset()
    assert num_ended > 0


@pytest.mark.parametrize("scale", [0.5, 1e4], ids=["usual", "beyond what is absurd"])
def test_learned_initial_states_are_the_same_function_of_the_noise(stored, scale):
    jax_env = jax_se(**BANDIT)
    weights = random_weights(jax_env, scale=scale)
    env = make(stored(jax_env, weights))
    expected, _ = jax_env.reset_env(KEY, jax_env.params(weights))
    noise = np.asarray(jax.random.normal(KEY, (4,)))
    np.testing.assert_allclose(env.world.first(noise), expected, rtol=1e-5, atol=1e-5)
    assert (np.abs(expected).max() == MAX_ABS_VALUE) == (scale > 1)


@pytest.mark.parametrize("initial_state", ["learned", "noise"])
def test_noise_of_initial_states_is_standard_normal(stored, initial_state):
    jax_env = jax_se(**BANDIT | {"initial_state": initial_state})
    env = make(stored(jax_env, random_weights(jax_env, scale=0.0)))  # which adds nothing to it
    env.reset(seed=0)
    noise = np.stack([env.reset()[0] for _ in range(2000)])
    np.testing.assert_allclose(noise.mean(axis=0), 0, atol=5 / 2000**0.5)
    np.testing.assert_allclose(np.cov(noise.T), np.eye(4), atol=5 * (2 / 2000) ** 0.5)


# --- side by side --------------------------------------------------------------------------------

MODES = ["NextStep", "SameStep"]
SES = {
    "bandit": {"horizon": 1, "initial_state": "learned"},
    "longer than a block of starts": {"horizon": 2, "initial_state": "noise"},
    "cut": {"max_steps": 3, "initial_state": "learned"},
    "drawn ends": {"done": "bernoulli", "initial_state": "learned"},
    "real starts and drawn ends": {"done": "bernoulli"},
    "soft": {"done": "soft"},
    "of a least length": {"done": "soft", "min_steps": 2},
    "continuous actions": {"task": "pendulum", "max_steps": 3, "state_units": "bounds"},
}


def listed(tree):
    """A tree whose arrays of objects, which final observations are, are lists."""
    return jax.tree.map(lambda x: x.tolist() if np.asarray(x).dtype.kind == "O" else x, tree)


def assert_same(got, expected, tolerance=1e-5):
    """Of what two environments return, nested infos and final observations included."""
    got, expected = listed(got), listed(expected)
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    for a, b in zip(*map(jax.tree.leaves, (got, expected)), strict=True):
        assert np.asarray(a).dtype == np.asarray(b).dtype and np.shape(a) == np.shape(b)
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", SES)
def test_lanes_are_single_environments(name, mode):
    world, num_envs = world_of(**SES[name]), 3
    lanes = SyntheticVectorEnv(world, num_envs, mode)
    singles = SyncVectorEnv([lambda: SyntheticGymEnv(world)] * num_envs, autoreset_mode=mode)
    assert lanes.metadata == singles.metadata | {"autoreset_mode": AutoresetMode(mode)}
    assert lanes.observation_space == singles.observation_space
    assert lanes.action_space == singles.action_space
    lanes.action_space.seed(0)
    assert_same(lanes.reset(seed=5), singles.reset(seed=5))
    num_ended = 0
    for _ in range(sejax.gym.synthetic.PREFETCHED + 4):
        actions = lanes.action_space.sample()
        got = lanes.step(actions)
        assert_same(got, singles.step(actions))
        num_ended += (got[2] | got[3]).sum()
    assert num_ended > num_envs
    for seed in (None, 7, [3, None, 8]):
        assert_same(lanes.reset(seed=seed), singles.reset(seed=seed))
    with pytest.raises(gymnasium.error.Error, match="-1"):
        lanes.reset(seed=[1, 2, -1])
    assert_same(lanes.reset(), singles.reset())  # the refused seeds changed nothing


def test_gymnasium_makes_the_shipped_ones_by_their_names():
    ids = [f"sejax.gym:sejax/{name}" for name in pretrained_files()]
    assert sejax.gym.register() == sejax.gym.register() == ids
    env = gymnasium.make("sejax/cartpole")
    assert env.spec.id == "sejax/cartpole" and "TimeLimit" not in str(env)
    assert Path(env.spec.kwargs["source"]).is_absolute()  # whatever is in the current folder
    assert gymnasium.make("sejax/cartpole", render_mode="rgb_array")  # as make_vec_env of SB3 asks
    own = {"vectorization_mode": "vector_entry_point", "autoreset_mode": AutoresetMode.SAME_STEP}
    for name, options in (("sejax/cartpole", {}), ("sejax.gym:sejax/cartpole", own)):
        made = gymnasium.make_vec(name, num_envs=3, **options)
        assert isinstance(made, SyntheticVectorEnv) and made.spec.id == "sejax/cartpole"
        obs, _ = made.reset(seed=4)
        assert obs.shape == (3, 4)  # products of other shapes round otherwise on some machines
        np.testing.assert_allclose(obs[0], make("cartpole").reset(seed=4)[0], rtol=0, atol=1e-6)


# --- ends ----------------------------------------------------------------------------------------


def test_ends_are_drawn_with_their_probability():
    count, probability = 2000, 0.3
    lanes = env_of(world_of(outputs={"done": probability}, done="bernoulli"), count)
    lanes.reset(seed=0)
    share = lanes.step(np.zeros(count, int))[2].mean()
    assert abs(share - probability) < 5 * (probability * (1 - probability) / count) ** 0.5


@ALONE_AND_MANY
@pytest.mark.parametrize("outputs", [
    {"state": np.inf}, {"reward": np.nan}, {"done": -np.inf}, {"state": 2e6}, {"reward": -2e6},
], ids=str)  # fmt: skip
@pytest.mark.parametrize(("mode", "min_steps"), [("soft", 1), ("soft", 2), ("bernoulli", 1)])
def test_an_absurd_or_nonfinite_output_ends_the_episode_where_it_was(
    mode, min_steps, outputs, num_envs
):
    world = world_of(done=mode, min_steps=min_steps, outputs={"reward": 2.0})
    _, last_bias = world._layers[-1]
    last_bias += [*[outputs.get("state", 0)] * 4, outputs.get("reward", 0), outputs.get("done", 0)]
    env = env_of(world, num_envs)
    first, _ = env.reset(seed=0)
    obs, reward, terminated, _, info = env.step(np.zeros(env.action_space.shape, int))
    assert (obs == first).all() and np.all(reward == 0.0) and np.all(terminated)
    assert np.all(info["discount"] == 0.0)


def test_an_overflow_within_the_networks_ends_the_episode_without_a_warning():
    env = env_of(world_of(outputs={"done": 0.0}))
    for kernel, _ in env.world._layers:
        kernel[:] = 3e38
    env.reset(seed=0)
    assert env.step(0)[2]


# --- as a Gymnasium environment ------------------------------------------------------------------

CHECKED = [
    ("cartpole", {"done": "threshold"}),
    ("cartpole", BANDIT),
    ("pendulum", {"done": "bernoulli"}),
    ("gridworld_2x2", {"done": "bernoulli"}),
]


@pytest.mark.parametrize("source", [*CHECKED, *pretrained_files()], ids=str)
@pytest.mark.filterwarnings(
    "ignore:.*Box observation space m.*imum value is -?infinity:UserWarning",
    "ignore:.*recommend using a symmetric and normalized space:UserWarning",  # Pendulum's torque
    "ignore:.*different from the unwrapped version:UserWarning",
    "ignore:.*Not able to test alternative:UserWarning",
)
def test_gymnasiums_checker_passes(stored, source):
    check_env(an_env(stored, source), skip_render_check=True)


def test_spaces_are_the_tasks_without_bounds_of_the_observations(stored):
    env = make("acrobot")
    assert env.observation_space == spaces.Box(-np.inf, np.inf, (6,), np.float32)
    assert env.action_space == spaces.Discrete(3)
    assert env.render_mode is None and env.metadata["render_modes"] == []
    env = make(stored(jax_se("cliff_walking")))
    assert env.observation_space == spaces.Discrete(48)
    assert env.action_space == spaces.Discrete(4)
    assert env.reset(seed=0) == (36, {})  # the map's S, at the beginning of its last row


def test_a_seed_makes_episodes_again_and_starts_are_the_real_tasks(stored):
    real, path = gymnasium.make("CartPole-v1"), stored(jax_se())
    env = make(path)

    def play(seed):
        seen = [env.reset(seed=seed)[0]]
        for _ in range(3):
            seen += [env.step(1)[0], env.reset()[0]]
        return np.stack(seen)

    np.testing.assert_array_equal(play(5), play(5))
    assert not np.allclose(play(5), play(6))
    np.testing.assert_array_equal(env.reset(seed=7)[0], real.reset(seed=7)[0])
    np.testing.assert_array_equal(env.reset()[0], real.reset()[0])
    assert not np.allclose(make(path).reset()[0], make(path).reset()[0])


@pytest.mark.parametrize("source", [*CHECKED, "cartpole-rn", "side by side"], ids=str)
def test_a_pickled_environment_goes_on_as_it_would_have(stored, source):
    lanes = SyntheticVectorEnv(world_of(**SES["bandit"]), 2)
    env = lanes if source == "side by side" else an_env(stored, source)
    env.reset(seed=0)
    copy = pickle.loads(pickle.dumps(env))
    env.action_space.seed(0)
    for _ in range(5):
        action = env.action_space.sample()
        assert_same(copy.step(action), env.step(action), tolerance=0)
        assert_same(copy.reset(), env.reset(), tolerance=0)


@ALONE_AND_MANY
def test_what_is_returned_is_the_callers(num_envs):
    env = env_of(world_of(done="soft", min_steps=9, max_steps=9), num_envs)
    actions = np.zeros(env.action_space.shape, int)
    env.reset(seed=0)[0][:] = np.nan
    env.step(actions)[0][:] = np.nan
    assert np.isfinite(env.step(actions)[0]).all()


@pytest.mark.parametrize(("task", "num_envs", "good", "bad", "space"), [
    ("cartpole", None, 1, [-1, 2, 0.5, None], r"Discrete\(2\)"),
    ("cartpole", 2, [0, 1], [[0, 2], [0, -1], [0], 0, [0.0, 1.0], [[0, 1]]], "MultiDiscrete"),
    ("pendulum", None, [7.0], [0.5], "Box"), ("pendulum", 2, [[0.0], [7.0]], [[0.0, 1.0]], "Box"),
])  # fmt: skip
def test_a_step_needs_an_episode_and_an_action_of_the_space(task, num_envs, good, bad, space):
    env = env_of(world_of(task, outputs={"done": 1.0}), num_envs)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(good)
    env.reset(seed=0)
    for action in bad:
        with pytest.raises(gymnasium.error.InvalidAction, match=f"is none of {space}"):
            env.step(action)
    assert np.all(env.step(good)[2])
    if not num_envs:  # several begin again by themselves
        with pytest.raises(gymnasium.error.ResetNeeded):
            env.step(good)


@ALONE_AND_MANY
def test_continuous_actions_are_clipped_to_the_bounds(num_envs):
    world = world_of("pendulum")
    space = env_of(world, num_envs).action_space
    within, beyond = (world.encode(np.full(space.shape, x), space) for x in (2.0, 7.0))
    np.testing.assert_array_equal(within, beyond)


PROGRAM = """
import sys
from pathlib import Path
import sejax
sejax.pretrained()
assert "gymnasium" not in sys.modules
import sejax.gym
from gymnasium.vector import AsyncVectorEnv

def make():
    import gymnasium
    return gymnasium.make("sejax.gym:sejax/cartpole")

if __name__ == "__main__":
    sejax.gym.make("cartpole-rn").reset(seed=0)
    sejax.gym.make("cliff_walking-rn")
    envs = AsyncVectorEnv([make], context="CONTEXT")
    envs.reset(seed=0)
    loaded = {"stable_baselines3", "torch"} & set(sys.modules)
    from jax._src import xla_bridge
    assert not xla_bridge.backends_are_initialized()
    print(envs.step([0])[0].shape, make().spec.id, sorted(loaded))
    envs.close()
"""


@pytest.mark.parametrize("context", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_it_starts_no_backend_of_jax_and_its_ids_are_known_in_new_processes(context):
    """In a fresh process, as the test's own has what its processes would need to import."""
    program = PROGRAM.replace("CONTEXT", context)
    assert printed(sys.executable, "-c", program) == "(1, 4) sejax/cartpole []\n"


# --- tasks ---------------------------------------------------------------------------------------


def a_start(rng):
    return rng.uniform(1, 2, size=3)


def test_an_unknown_task_must_be_given(stored):
    from gymnax.environments.classic_control import pendulum

    path = stored(jax_se(sejax.Task(name="mine", env=pendulum.Pendulum(), max_steps=7)))
    box = spaces.Box(-2, 2, (1,))
    mine = RealTask(observation_space=spaces.Box(-8, 8, (3,)), action_space=box, max_steps=7)
    assert refused(make, path) == "task"
    assert refused(make, path, mine) == "task.starts"
    mine = dataclasses.replace(mine, starts=a_start)
    env = make(path, mine)
    assert ((env.reset(seed=0)[0] >= 1) & (env.reset()[0] <= 2)).all()
    assert make(path, "Pendulum-v1").action_space == box
    other = dataclasses.replace(mine, action_space=spaces.Box(0, 4, (1,)))
    for given in ("CartPole-v1", other):
        assert refused(make, path, given) == "task"
    images = dataclasses.replace(mine, observation_space=spaces.Box(0, 1, (2, 2)))
    assert refused(make, path, images) == "task"
    assert refused(make, stored(jax_se("cliff_walking")), "FrozenLake-v1") == "task"  # fewer cells


def test_an_se_with_its_own_starts_needs_no_task(stored, monkeypatch):
    task = dataclasses.replace(envs.make("pendulum"), name="mine")
    path = stored(jax_se(task, initial_state="learned", state_units="bounds"))
    env, given = make(path), make(path, "Pendulum-v1")
    assert env.action_space == given.action_space
    assert env.observation_space == spaces.Box(-np.inf, np.inf, (3,))
    assert_same(env.reset(seed=0), given.reset(seed=0), tolerance=0)
    for _ in range(3):
        assert_same(env.step([0.5]), given.step([0.5]), tolerance=0)
    monkeypatch.setattr(gymnasium, "make", None)
    assert make("halfcheetah").action_space == spaces.Box(-1, 1, (6,))


def test_an_se_keeps_its_step_limit_on_another_task_of_its_kind(stored):
    path, task = stored(jax_se()), RealTask.of_env(gymnasium.make("CartPole-v1"))
    assert refused(make, path, task) == "task"
    for given in (None, "CartPole-v1", dataclasses.replace(task, max_steps=200)):
        assert make(path, given).world.max_steps == 200
    assert make(stored(jax_se(horizon=1)), task).world.max_steps == 1  # whatever the task's


# --- what cannot be ------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "field", "value"), [
    ("halfcheetah-rn", "xml_file", "/etc/hostname"), ("cartpole-rn", "render_mode", "human"),
    ("cliff_walking-rn", "goal_reward", "x"),
])  # fmt: skip
def test_a_strangers_file_sets_no_options_that_the_task_does_not_have_here(
    tmp_path, name, field, value
):
    tensors, header = unpack(find(name).read_bytes(), "sejax")
    header["config"]["env"][field] = value
    path = tmp_path / "strangers.safetensors"
    path.write_bytes(pack(tensors, "sejax", header))
    assert refused(make, path) == f"env.{field}"


def test_a_file_that_is_no_single_se_is_refused(tmp_path):
    env, path = jax_se(), tmp_path / "other.safetensors"
    sejax.save(path, env, random_weights(env))
    forge(path, proxy={"name": "mine:LinearSE"})
    assert refused(make, path) == "source"
    sejax.save_set(path, env, [random_weights(env)] * 2, [{}, {}])
    assert refused(make, path) == "source"
    tensors, header = unpack(find("cartpole").read_bytes(), "sejax")
    path.write_bytes(pack({k: x.astype(float) for k, x in tensors.items()}, "sejax", header))
    assert refused(make, path) == "weights"


@pytest.mark.parametrize(("field", "options"), [
    ("num_envs", {"num_envs": 0}), ("num_envs", {"num_envs": 2.5}),
    ("autoreset_mode", {"autoreset_mode": "samestep"}), ("source", {"source": "carpole"}),
    ("task", {"task": gymnasium.make("CartPole-v1")}),
    ("autoreset_mode", {"source": "cartpole-rn", "autoreset_mode": "samestep"}),
])  # fmt: skip
def test_an_option_that_cannot_be_is_one_message(field, options):
    assert refused(make_vec, **{"source": "cartpole"} | options) == field


def test_without_stable_baselines3_one_message_says_what_to_install(monkeypatch):
    for module in ("stable_baselines3", "stable_baselines3.common.vec_env"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ConfigError, match=r"pip install '.\[sb3\]'"):
        sejax.gym.make_sb3("cartpole")


def test_a_proxy_is_found_from_home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "a.safetensors").write_bytes(find("cartpole").read_bytes())
    assert make("~/a.safetensors").observation_space.shape == (4,)
    assert sejax.load("~/a.safetensors")[0].task.name == "cartpole"
