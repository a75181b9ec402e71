"""sejax.gym: the same SEs as in JAX, as Gymnasium environments that need none of it."""

import dataclasses
import pickle
import sys

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import TransformObservation
from support import paper_se, printed, random_like, refused, shapes_of

import sejax
from sejax import envs
from sejax.gym import GYMNASIUM_IDS, RealTask, SyntheticEnv, SyntheticWorld, make
from sejax.gym.networks import shapes_of as shapes_of_networks
from sejax.ops.checksummed import pack, unpack
from sejax.options import registry
from sejax.proxies import MAX_ABS_VALUE
from sejax.proxies.header import find, pretrained_names

KEY = jax.random.key(0)
SMALL = {"hidden_size": 5}
BANDIT = {"initial_state": "learned", "horizon": 1, "done": "threshold"}


def jax_se(task="cartpole", **config):
    return registry.make("proxy", paper_se(**SMALL | config), envs.make(task))


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


def constant(state=0.25, reward=2.0, d=0.0, max_steps=200, **config):
    """A CartPole SE whose outputs are constants, whatever it sees; d is the done output."""
    config = paper_se(**SMALL | {"done": "threshold"} | config)
    shapes = shapes_of_networks(config.networks(obs_dim=4, action_dim=2))
    weights = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
    for head, value in {"state": state, "reward": reward, "done": d}.items():
        if f"{head}/Dense_1/bias" in weights:
            weights[f"{head}/Dense_1/bias"][:] = value
    task = RealTask.of_gymnasium("CartPole-v1", max_steps)
    return SyntheticEnv(SyntheticWorld(weights, config, task))


# --- the same as in JAX --------------------------------------------------------------------------


def assert_close(got, expected):
    """Up to the rounding of sums, whose terms may be as large as the largest of the values."""
    largest = np.abs(np.asarray(expected, np.float64)).max(initial=0.0)
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=max(1e-5, 1e-6 * largest))


def assert_equal_steps(env, jax_env, params, num_steps=40):
    """Compares all that both say of steps from the same states; returns how many episodes ended."""
    step = jax.jit(jax_env.step_env)
    empty = jax.eval_shape(jax_env.reset_env, KEY, params)[1]
    is_horizon = jax_env.config.horizon is not None and jax_env.config.horizon_is_terminal
    env.reset(seed=0)
    env.action_space.seed(0)
    num_ended, time = 0, 0
    for i in range(num_steps):
        state = empty.replace(vector=jnp.asarray(env._vector), time=jnp.int32(time))
        action = env.action_space.sample()
        out = step(jax.random.key(i), state, jnp.asarray(action), params)
        expected_obs, state, expected_reward, expected_terminated, expected_info = out
        obs, reward, terminated, truncated, info = env.step(action)
        assert type(reward) is type(info["discount"]) is float
        assert type(terminated) is type(truncated) is bool
        assert_close(obs, expected_obs)
        assert_close(reward, expected_reward)
        assert_close(info["discount"], expected_info["discount"])
        assert terminated == expected_terminated
        # At a horizon that terminates gymnax's step says that it truncates too.
        assert truncated == (bool(jax_env.is_truncated(state, params)) and not is_horizon)
        time += 1
        if terminated or truncated:
            num_ended, time = num_ended + 1, 0
            env.reset()
    return num_ended


@pytest.mark.parametrize(
    ("task", "config"),
    [
        ("cartpole", {"done": "soft"}),
        ("acrobot", {"done": "threshold", "num_layers": 2, "activation": "prelu"}),
        ("gridworld_2x2", {"done": "threshold", "activation": "relu", "state_units": "bounds"}),
        ("mountain_car", {"done": "threshold", "state_units": "bounds",
                          "initial_state": "learned"}),
        ("cartpole", {"done": "threshold", "state_units": "bounds", "horizon": 2}),
        ("pendulum", {"done": "threshold", "state_units": "bounds", "horizon": 1}),
        ("cartpole", {"done": "threshold", "activation": "fast_tanh", "horizon": 3}),
        ("pendulum", {"done": "bernoulli", "activation": "tanh", "initial_state": "learned"}),
        ("cartpole", {"done": "sigmoid", "horizon": 3}),
        ("mountain_car_continuous", {"done": "threshold", "horizon": 3,
                                     "horizon_is_terminal": False}),
        ("cartpole", BANDIT),
        ("gridworld_2x2", {"done": "soft", "horizon": 1}),
        ("pendulum", {"done": "threshold", "state_units": "bounds", "initial_state": "noise"}),
        ("cartpole", {"done": "soft", "min_steps": 3}),
        ("cartpole", {"done": "sigmoid", "min_steps": 4, "horizon": 6}),
    ],
    ids=str,
)  # fmt: skip
def test_every_step_is_that_of_the_se_in_jax(stored, task, config):
    jax_env = jax_se(task, **config)
    weights = random_weights(jax_env, scale=1.0)
    if config["done"] in ("bernoulli", "sigmoid"):  # far out, where any draw says the same
        last = weights["done"]["Dense_1"]
        last["kernel"], last["bias"] = 1e3 * last["kernel"], 1e3 * last["bias"]
    env = make(stored(jax_env, weights))
    assert assert_equal_steps(env, jax_env, jax_env.params(weights)) > 0


@pytest.mark.parametrize("scale", [0.5, 1e4], ids=["usual", "beyond what is absurd"])
def test_learned_initial_states_are_the_same_function_of_the_noise(stored, scale):
    jax_env = jax_se(**BANDIT)
    weights = random_weights(jax_env, scale=scale)
    env = make(stored(jax_env, weights))
    expected, _ = jax_env.reset_env(KEY, jax_env.params(weights))

    class SameNoise(np.random.Generator):
        def standard_normal(self, *_):
            return np.asarray(jax.random.normal(KEY, (4,)))[None]

    env.np_random = SameNoise(np.random.PCG64(0))
    np.testing.assert_allclose(env.reset()[0], expected, rtol=1e-5, atol=1e-5)
    assert (np.abs(expected).max() == MAX_ABS_VALUE) == (scale > 1)


@pytest.mark.parametrize("initial_state", ["learned", "noise"])
def test_noise_of_initial_states_is_standard_normal(stored, initial_state):
    jax_env = jax_se(**BANDIT | {"initial_state": initial_state})
    env = make(stored(jax_env, random_weights(jax_env, scale=0.0)))  # which adds nothing to it
    env.reset(seed=0)
    noise = np.stack([env.reset()[0] for _ in range(2000)])
    np.testing.assert_allclose(noise.mean(axis=0), 0, atol=5 / 2000**0.5)
    np.testing.assert_allclose(np.cov(noise.T), np.eye(4), atol=5 * (2 / 2000) ** 0.5)


# --- ends ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mode", "d", "probability"),
    [("bernoulli", 0.3, 0.3), ("sigmoid", -1.0, 1 / (1 + np.e)), ("sigmoid", 2.0, 0.8808)],
)
def test_ends_are_drawn_with_their_probability(mode, d, probability):
    env = constant(d=d, done=mode)
    env.reset(seed=0)
    count = 2000
    ended = 0
    for _ in range(count):
        ended += env.step(0)[2]
        env.reset()
    assert abs(ended / count - probability) < 5 * (probability * (1 - probability) / count) ** 0.5


def episode(env):
    """Ends of all steps of an episode."""
    env.reset(seed=0)
    steps = []
    while not steps or not any(steps[-1][:2]):
        _, _, terminated, truncated, info = env.step(1)
        steps.append((terminated, truncated, info["discount"]))
    return steps


def test_an_episode_is_truncated_at_the_tasks_limit():
    assert episode(constant()) == [(False, False, 1.0)] * 199 + [(False, True, 1.0)]


def test_an_episode_that_ends_at_its_limit_is_both_terminated_and_truncated():
    assert episode(constant(d=1.0, max_steps=1)) == [(True, True, 0.0)]  # as with TimeLimit


@pytest.mark.parametrize(
    "outputs",
    [{"state": np.inf}, {"reward": np.nan}, {"d": -np.inf}, {"state": 2e6}, {"reward": -2e6}],
    ids=str,
)
@pytest.mark.parametrize(("mode", "min_steps"), [("soft", 1), ("soft", 2), ("bernoulli", 1)])
def test_an_absurd_or_nonfinite_output_ends_the_episode_where_it_was(mode, min_steps, outputs):
    finite = {name: x if np.isfinite(x) else 0.0 for name, x in outputs.items()}
    env = constant(**finite, done=mode, min_steps=min_steps)
    _, last_bias = env.world._layers[-1]
    last_bias += [*[outputs.get("state", 0.0)] * 4, outputs.get("reward", 0), outputs.get("d", 0)]
    first, _ = env.reset(seed=0)
    obs, reward, terminated, _, info = env.step(0)
    assert (obs == first).all() and reward == 0.0 and terminated is True
    assert info["discount"] == 0.0


def test_an_overflow_within_the_networks_ends_the_episode_without_a_warning():
    env = constant()
    for kernel, _ in env.world._layers:
        kernel[:] = 3e38
    env.reset(seed=0)
    assert env.step(0)[2]


# --- as a Gymnasium environment ------------------------------------------------------------------

CHECKED = [("cartpole", {"done": "threshold"}), ("cartpole", BANDIT),
           ("pendulum", {"done": "bernoulli"}), ("gridworld_2x2", {"done": "sigmoid"})]  # fmt: skip


def an_env(stored, source):
    """Of the name of a shipped proxy, or of an SE's task and configuration."""
    return make(source if isinstance(source, str) else stored(jax_se(source[0], **source[1])))


@pytest.mark.parametrize("source", [*CHECKED, *pretrained_names()], ids=str)
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
    real = gymnasium.make("CartPole-v1")
    path = stored(jax_se())
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


@pytest.mark.parametrize("source", [*CHECKED, "cartpole-rn"], ids=str)
def test_a_pickled_environment_goes_on_as_it_would_have(stored, source):
    env = an_env(stored, source)
    env.reset(seed=0)
    copy = pickle.loads(pickle.dumps(env))
    env.action_space.seed(0)
    for _ in range(5):
        action = env.action_space.sample()
        (obs, *rest), (same_obs, *same_rest) = env.step(action), copy.step(action)
        np.testing.assert_array_equal(obs, same_obs)
        assert rest == same_rest
        np.testing.assert_array_equal(env.reset()[0], copy.reset()[0])


def test_the_spec_makes_it_again_and_adds_no_second_time_limit(stored):
    path = stored(jax_se())
    env = make(path)
    again = gymnasium.make(env.spec)
    assert again.unwrapped.config == env.config
    assert env.spec.id == "sejax/cartpole" and env.spec.max_episode_steps is None
    assert gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))


@pytest.mark.parametrize("name", ["by hand", "a(b)/c", "@"])
def test_a_task_may_be_called_what_gymnasium_would_not(stored, name):
    task = dataclasses.replace(envs.make("cartpole"), name=name, origin=None)
    env = make(stored(registry.make("proxy", paper_se(**SMALL, **BANDIT), task)))
    assert gymnasium.make(env.spec).reset(seed=0)[0].shape == (4,)


def test_a_step_needs_an_episode_and_an_action_of_the_space(stored):
    env = constant(d=1.0)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(0)
    env.reset(seed=0)
    for action in (-1, 2, 0.5, None):
        with pytest.raises(gymnasium.error.InvalidAction, match=r"is none of Discrete\(2\)"):
            env.step(action)
    assert env.step(True)[2]  # and np.int64(1)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(0)
    env = make(stored(jax_se("pendulum")))
    env.reset(seed=0)
    with pytest.raises(gymnasium.error.InvalidAction, match=r"is none of Box"):
        env.step(0.5)


def test_continuous_actions_are_clipped_to_the_bounds(stored):
    env = make(stored(jax_se("pendulum")))
    seen = []
    for action in (2.0, 7.0, -2.0):
        env.reset(seed=0)
        seen.append(env.step([action])[0])
    assert (seen[0] == seen[1]).all() and (seen[0] != seen[2]).any()


def test_what_ships_is_registered_once_and_by_its_name():
    ids = sejax.gym.register()
    names = [f"sejax.gym:sejax/{name}" for name in pretrained_names()]
    assert ids == sejax.gym.register() == names
    env = gymnasium.make("sejax/cartpole")
    assert env.spec.id == "sejax/cartpole" and "TimeLimit" not in str(env)
    assert str(gymnasium.make(env.spec)) == str(gymnasium.make("sejax.gym:sejax/cartpole"))
    np.testing.assert_array_equal(env.reset(seed=1)[0], make("cartpole").reset(seed=1)[0])


def test_it_runs_without_jax_and_in_forked_processes():
    program = """
import sys
import sejax
sejax.pretrained()
assert "gymnasium" not in sys.modules
import sejax.gym
from gymnasium.vector import AsyncVectorEnv
env = sejax.gym.make("cartpole")
env.reset(seed=0)
env.step(1)
sejax.gym.make("cartpole-rn").reset(seed=0)
envs = AsyncVectorEnv([lambda: sejax.gym.make("cartpole")] * 2, context="fork")
envs.reset(seed=0)
loaded = {"jax", "flax", "jaxtyping", "stable_baselines3", "torch"} & set(sys.modules)
print(envs.step([0, 1])[0].shape, sorted(loaded))
envs.close()
"""
    assert printed(sys.executable, "-c", program) == "(2, 4) []\n"


# --- tasks ---------------------------------------------------------------------------------------


# Gymnasium's MuJoCo environments need imageio: see test_mujoco.py.
@pytest.mark.parametrize("name", sorted(x for x in GYMNASIUM_IDS if "-v5" not in GYMNASIUM_IDS[x]))
def test_gymnasiums_tasks_have_the_spaces_of_sejaxs(name):
    task, real = envs.make(name), RealTask.of_gymnasium(GYMNASIUM_IDS[name])
    assert real.observation_space.shape == (task.obs_dim,)
    if task.num_actions is None:
        assert real.action_space.shape == (task.action_dim,)
        assert np.allclose(real.action_space.high, task.max_action)
        assert np.allclose(real.action_space.low, -task.max_action)
    else:
        assert real.action_space == spaces.Discrete(task.num_actions)


@pytest.mark.parametrize(("given", "limit"), [({}, 200), ({"max_steps": 300}, 300)], ids=str)
def test_a_task_of_gymnax_is_gymnasiums_of_that_id(stored, given, limit):
    jax_env = paper_se(**SMALL).make(envs.make("gymnax/MountainCar-v0", **given))
    env = make(stored(jax_env))
    assert env.action_space == spaces.Discrete(3) and env.world.max_steps == limit
    (position, velocity), _ = env.reset(seed=0)
    assert -0.6 <= position <= -0.4 and velocity == 0.0


def a_start(rng):
    return rng.uniform(1, 2, size=3)


def test_an_unknown_task_must_be_given(stored):
    from gymnax.environments.classic_control import pendulum

    task = sejax.Task(name="mine", env=pendulum.Pendulum(), max_steps=7)
    path = stored(registry.make("proxy", paper_se(**SMALL, done="bernoulli"), task))
    box = spaces.Box(-2, 2, (1,))
    mine = RealTask(observation_space=spaces.Box(-8, 8, (3,)), action_space=box, max_steps=7)
    assert refused(make, path) == "task"
    assert refused(make, path, mine) == "task.starts"
    mine = dataclasses.replace(mine, starts=a_start)
    env = make(path, mine)
    assert ((env.reset(seed=0)[0] >= 1) & (env.reset()[0] <= 2)).all()
    assert gymnasium.make(env.spec).reset(seed=1)[0].tolist() == env.reset(seed=1)[0].tolist()
    assert make(path, "Pendulum-v1").action_space == box
    other = dataclasses.replace(mine, action_space=spaces.Box(0, 4, (1,)))
    for given in ("CartPole-v1", other, 8, "Nothing-v1"):
        assert refused(make, path, given) == "task"
    images = dataclasses.replace(mine, observation_space=spaces.Box(0, 1, (2, 2)))
    assert refused(make, path, images) == "task.observation_space"


def test_an_se_with_its_own_starts_needs_no_task(stored, monkeypatch):
    task = dataclasses.replace(envs.make("pendulum"), name="mine", origin=None)
    config = paper_se(**SMALL, initial_state="learned", state_units="bounds")
    path = stored(registry.make("proxy", config, task))
    env, given = make(path), make(path, "Pendulum-v1")
    assert (env.action_space, env.observation_space) == (given.action_space, spaces.Box(
        -np.inf, np.inf, (3,)))  # fmt: skip
    for each in (env, given):
        each.reset(seed=0)
    action = np.array([0.5], np.float32)
    for _ in range(3):
        here, there = env.step(action), given.step(action)
        np.testing.assert_array_equal(here[0], there[0])
        assert here[1:4] == there[1:4]
    monkeypatch.setattr(gymnasium, "make", None)
    assert make("halfcheetah").action_space == spaces.Box(-1, 1, (6,))


def test_what_is_no_single_se_is_one_message(tmp_path, stored):
    env = jax_se()
    other, several = tmp_path / "other.safetensors", tmp_path / "set.safetensors"
    sejax.save(other, env, random_weights(env), config={"proxy": {"name": "mine:LinearSE"}})
    sejax.save_set(several, env, [random_weights(env)] * 2, [{}, {}])
    for source in (other, several, "carpole"):
        assert refused(make, source) == "source"


@pytest.mark.parametrize(
    "name, given",
    [("halfcheetah-rn", {"xml_file": "/etc/hostname"}), ("cartpole-rn", {"render_mode": "human"}),
     ("cartpole-rn", {"sutton_barto_reward": True}), ("cliff_walking-rn", {"goal_reward": "x"}),
     ("cliff_walking-rn", {"bogus": 1})],
)  # fmt: skip
def test_a_strangers_file_sets_no_options_that_the_task_does_not_have_here(tmp_path, name, given):
    tensors, header = unpack(find(name).read_bytes(), "sejax")
    header["config"]["env"] |= given
    path = tmp_path / "strangers.safetensors"
    path.write_bytes(pack(tensors, "sejax", header))
    assert refused(make, path) == f"env.{next(iter(given))}"


def test_weights_that_are_not_the_networks_are_refused_as_in_jax(tmp_path):
    tensors, values = unpack(find("cartpole").read_bytes(), "sejax")
    path = tmp_path / "odd.safetensors"
    path.write_bytes(pack({k: x.astype(float) for k, x in tensors.items()}, "sejax", values))
    assert refused(make, path) == "weights"


def test_an_se_keeps_its_step_limit_on_another_task_of_its_kind(stored):
    env = registry.make("proxy", paper_se(**SMALL), envs.make("cartpole"))
    path = stored(env)
    assert make(path).world.max_steps == make(path, "CartPole-v1").world.max_steps == 200
    task = RealTask.of_gymnasium("CartPole-v1")
    assert refused(make, path, task) == "task"
    assert make(path, dataclasses.replace(task, max_steps=200)).world.max_steps == 200
    bandit = stored(registry.make("proxy", paper_se(**SMALL, horizon=1),
                                 envs.make("cartpole")))  # fmt: skip
    assert make(bandit, task).world.max_steps == 1  # whatever the task's


def test_starts_are_as_the_environments_wrappers_show_them(stored):
    path = stored(registry.make("proxy", paper_se(**SMALL), envs.make("cartpole")))
    real = gymnasium.make("CartPole-v1", max_episode_steps=200)
    wrapped = TransformObservation(real, lambda obs: 10 * obs, real.observation_space)
    se = make(path, RealTask.of_env(wrapped))
    np.testing.assert_array_equal(se.reset(seed=0)[0], wrapped.reset(seed=0)[0])


def test_vector_environments_take_a_render_mode_as_single_ones_do():
    assert gymnasium.make_vec("sejax/cartpole", num_envs=np.int64(2), render_mode="rgb_array")
    assert sejax.gym.make_vec("cartpole", 2.0).num_envs == 2
    assert refused(sejax.gym.make_vec, "cartpole", 2, render_mode="human") == "render_mode"
    envs_of_rn = sejax.gym.make_vec("mountain_car_continuous-rn", 1, render_mode="rgb_array")
    assert envs_of_rn.envs[0].render_mode == "rgb_array"


@pytest.mark.parametrize("context", ["spawn", "forkserver"])
def test_ids_that_name_the_package_are_known_in_new_processes(context):
    """In a fresh process, as the test's own has what its processes would need to import."""
    program = f"""
import gymnasium

def make():
    return gymnasium.make("sejax.gym:sejax/cartpole")

if __name__ == "__main__":
    envs = gymnasium.vector.AsyncVectorEnv([make] * 2, context="{context}")
    print(envs.reset(seed=0)[0].shape, gymnasium.spec("sejax/cartpole").id)
    envs.close()
"""
    assert printed(sys.executable, "-c", program) == "(2, 4) sejax/cartpole\n"


@pytest.mark.parametrize("env", [make("cartpole"), sejax.gym.GridWorld("gridworld_2x2")])
def test_what_has_no_picture_says_so(env):
    with pytest.raises(NotImplementedError):
        env.render()


def test_a_proxy_is_found_from_home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "a.safetensors").write_bytes(find("cartpole").read_bytes())
    assert make("~/a.safetensors").observation_space.shape == (4,)
    assert sejax.load("~/a.safetensors")[0].task.name == "cartpole"
