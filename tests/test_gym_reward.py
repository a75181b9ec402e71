"""Reward networks around Gymnasium's environments: each reward, worked by hand."""

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium import spaces, wrappers
from support import forge, numpy_forward, random_like, refused, shapes_of

import sejax
from sejax import envs
from sejax.gym import GridWorld, RealTask, RewardNetwork, make, make_vec, networks
from sejax.gym.tasks import signature
from sejax.ops import checksummed
from sejax.options import registry
from sejax.proxies import header
from sejax.proxies.reward import VARIANTS, RewardConfig

KEY = jax.random.key(0)
NETWORKS = [variant for variant in VARIANTS if "info" not in variant]


class Walk(gymnasium.Env):
    """A walk along a line that tells its place and speed, and pays and ends as it is told to."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, reward=0.5, length=1000):
        self.reward, self.length = reward, length

    def _see(self):
        return np.array([self.place, np.cos(self.place)])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.num_steps = 0.25, 0
        return self._see(), {"x_position": self.place}

    def step(self, action):
        self.place += float(action[0])
        self.num_steps += 1
        info = {"x_position": self.place, "x_velocity": float(action[0])}
        info |= {"reward_forward": 3.0, "reward_ctrl": -1.0}
        return self._see(), np.float64(self.reward), self.num_steps >= self.length, False, info


ENDLESS = {"low": [None] * 2, "high": [None] * 2}
WALK = {"observation": ENDLESS, "action": {"low": [-1.0], "high": [1.0]}, "max_steps": 1000}


@pytest.fixture
def stored_rn(tmp_path):
    """Writes an RN of random weights by hand; returns its file and the weights."""

    def write(num_inputs, task="walk", interface=WALK, **config):
        config = RewardConfig(hidden_size=5, **config)
        shapes = networks.shapes_of({"potential": [num_inputs, 5, 1]})
        if config.shaping.weighs_info:
            shapes = {"info_weights": (num_inputs,)}
        tensors = random_like({name: np.zeros(shape) for name, shape in shapes.items()}, 2, 0.5)
        config = {"env": {"name": task}, "proxy": {"name": "rn", **vars(config)}}
        options = {"task": task, "interface": interface, "config": config, "discount": 0.9}
        options |= {"format_version": header.FORMAT_VERSION, "is_set": False, "proxies": [{}]}
        path = tmp_path / "rn.safetensors"
        path.write_bytes(checksummed.pack(tensors, header.KIND, options))
        return path, tensors

    return write


def phi(weights, *inputs):
    parts = ("kernel", "bias")
    layers = {x: {k: weights[f"potential/{x}/{k}"] for k in parts} for x in ("Dense_0", "Dense_1")}
    return numpy_forward(layers, np.concatenate(inputs), "prelu", 1)[0]


# --- rewards -------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", NETWORKS)
@pytest.mark.parametrize(("zero_at_terminal", "output_scale", "discount"), [
    (False, 1.0, None), (True, 1.0, 0.99), (False, 0.1, None),  # None: that of the RN's agent
])  # fmt: skip
def test_every_variant_pays_what_its_equation_says(
    stored_rn, variant, zero_at_terminal, output_scale, discount
):
    options = {"zero_at_terminal": zero_at_terminal, "output_scale": output_scale}
    path, weights = stored_rn(2, variant=variant, **options)
    env = RewardNetwork(Walk(length=2), path, discount=discount)
    obs, _ = env.reset(seed=0)
    for action in ([0.5], [-0.25]):
        before = output_scale * phi(weights, obs)
        obs, reward, terminated, truncated, info = env.step(action)
        after = 0.0 if terminated and zero_at_terminal else output_scale * phi(weights, obs)
        additive, _, kind = variant.partition("_")
        shaped = {"potential": (discount or 0.9) * after - before, "non_potential": after}[kind]
        expected = shaped + (0.5 if additive == "additive" else 0.0)
        assert reward == pytest.approx(expected, abs=1e-5)
        assert info["real_reward"] == 0.5 and info["discount"] == 1.0 - terminated
        assert [type(x) for x in (reward, terminated, truncated)] == [float, bool, bool]
    assert terminated


def test_the_step_limit_is_no_terminal_state(stored_rn):
    path, weights = stored_rn(2, variant="exclusive_non_potential", zero_at_terminal=True)
    env = RewardNetwork(wrappers.TimeLimit(Walk(), 1), path)
    env.reset()
    obs, reward, terminated, truncated, _ = env.step([0.5])
    assert truncated and not terminated
    assert reward == pytest.approx(phi(weights, obs), abs=1e-6)


def test_an_augmented_network_sees_info_of_its_own_state(stored_rn):
    """Zeros before the first step, whatever `reset` tells, as in JAX."""
    path, weights = stored_rn(4, "halfcheetah", variant="exclusive_potential", augmented=True)
    env = RewardNetwork(Walk(), path)
    obs, _ = env.reset()
    before = phi(weights, obs, [0, 0])
    for action in (0.5, -0.25):
        obs, reward, _, _, info = env.step([action])
        after = phi(weights, obs, [info["x_position"], action])
        assert reward == pytest.approx(0.9 * after - before, abs=1e-5)
        before = after


@pytest.mark.parametrize("variant", ["additive_weighted_info", "exclusive_weighted_info"])
def test_weighted_info_is_a_product(stored_rn, variant):
    path, weights = stored_rn(4, "halfcheetah", variant=variant)
    env = RewardNetwork(Walk(), path)
    env.reset()
    _, reward, *_ = env.step([0.5])
    expected = weights["info_weights"] @ [0.75, 0.5, 3.0, -1.0]
    expected += 0.5 if variant.startswith("additive") else 0.0
    assert reward == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(("kind", "real", "learned", "expected"), [
    ("additive", np.nan, 1.0, None), ("additive", np.inf, 1.0, None), ("additive", 0.5, 1e9, None),
    ("additive", -2e7, 1.0, -2e7), ("exclusive", -2e7, 1.0, 1.0),
])  # fmt: skip
def test_an_absurd_reward_is_none_and_terminates(stored_rn, kind, real, learned, expected):
    """A real one of money's size passes, and a learned one does not."""
    env = RewardNetwork(Walk(real), stored_rn(2, variant=f"{kind}_non_potential")[0])
    env.reset()
    env.potential = lambda *_: learned
    _, reward, terminated, _, info = env.step([0.5])
    assert reward == (pytest.approx(expected, abs=10) if expected else 0.0)
    assert terminated is (expected is None) and info["discount"] == 1.0 - terminated
    np.testing.assert_equal(info["real_reward"], real)


@pytest.mark.slow
@pytest.mark.parametrize("name", [x.name for x in sejax.pretrained() if x.kind == "rn"])
def test_rewards_are_those_of_the_rn_in_jax(name):
    """The shipped ones, on 5,000 steps of their task, which is held against JAX's elsewhere."""
    env, proxy = make(name), sejax.load_proxy(name)
    env.action_space.seed(0)
    obs, _ = env.reset(seed=0)
    rows = []
    for _ in range(5000):
        before, action = obs, env.action_space.sample()
        obs, reward, terminated, truncated, info = env.step(action)
        rows.append((before, obs, terminated, info["real_reward"], reward))
        if terminated or truncated:
            obs, _ = env.reset()
    *seen, real, rewards = (np.array(column) for column in zip(*rows, strict=True))

    config = proxy.env.config
    potential = jax.jit(jax.vmap(lambda obs: proxy.env.potential(proxy.params, obs)))
    before, after, ends = seen
    expected = np.where(ends & config.zero_at_terminal, 0, potential(after))
    if config.shaping.is_potential_based:
        expected = proxy.params.discount * expected - potential(before)
    expected = expected + (real if config.shaping.is_additive else 0)
    np.testing.assert_allclose(rewards, expected, rtol=1e-5, atol=1e-5)


# --- tasks ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["cliff_walking", "gridworld_2x2"])
def test_a_walk_in_a_grid_world_is_that_in_jax(name):
    task, env = envs.make(name), GridWorld(name)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(0)
    step, rng = jax.jit(task.env.step_env), np.random.default_rng(0)
    for _ in range(5):
        obs, state = task.env.reset_env(KEY, task.params)
        assert env.reset() == (obs, {})
        terminated = False
        while not terminated:
            action = rng.integers(4)
            _, state, reward, *_ = step(KEY, state, action, task.params)
            obs, paid, terminated, truncated, _ = env.step(action)
            assert (obs, np.float32(paid), truncated) == (state.index, reward, False)
            assert terminated == task.env.is_terminated(state, task.params)
    env.reset()
    with pytest.raises(gymnasium.error.InvalidAction, match=r"4 is none of Discrete\(4\)"):
        env.step(4)


def test_the_time_limit_is_the_tasks_and_there_once():
    env = gymnasium.make("sejax/mountain_car_continuous-rn")
    env.reset(seed=0)
    assert [env.step([0.0])[2:4] for _ in range(999)] == [(False, False)] * 998 + [(False, True)]
    assert str(env).count("TimeLimit") == 1
    env = make("cliff_walking-rn")
    env.reset()
    assert [env.step(3)[3] for _ in range(50)] == [False] * 49 + [True]


def test_the_spec_of_a_wrapper_makes_the_wrapper_again():
    env = RewardNetwork(gymnasium.make("CartPole-v1"), "cartpole-rn", discount=0.5)
    again = gymnasium.make(type(env.spec).from_json(env.spec.to_json()))
    assert again.discount == 0.5 and again.spec.max_episode_steps == 500


def test_lanes_of_a_reward_network_are_gymnasiums():
    lanes, single = make_vec("cartpole-rn", 2, autoreset_mode="SameStep"), make("cartpole-rn")
    np.testing.assert_array_equal(lanes.reset(seed=3)[0][1], single.reset(seed=4)[0])
    assert lanes.step([1, 1])[1][1] == single.step(1)[1]
    assert lanes.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP


# --- what cannot be ------------------------------------------------------------------------------


def test_what_does_not_fit_is_one_message():
    cartpole = gymnasium.make("CartPole-v1")
    assert refused(RewardNetwork, cartpole, "cartpole") == "source"  # an SE
    assert refused(RewardNetwork, gymnasium.make("MountainCar-v0"), "cartpole-rn") == "env"
    # In Gymnasium's cliff walking no fall ends an episode.
    assert refused(RewardNetwork, gymnasium.make("CliffWalking-v1"), "cliff_walking-rn") == "env"
    assert signature(spaces.Discrete(4)) != signature(spaces.Discrete(4, start=1))
    assert refused(make, "cartpole-rn", RealTask.of_env(cartpole)) == "task"
    for discount in (float("nan"), 3, "x"):
        assert refused(RewardNetwork, cartpole, "cartpole-rn", discount) == "discount"
    assert make("cartpole-rn", "CartPole-v1").get_wrapper_attr("_max_episode_steps") == 500


def test_the_network_sees_the_tasks_own_observations():
    cartpole = gymnasium.make("CartPole-v1")
    normalized = wrappers.TransformReward(wrappers.NormalizeObservation(cartpole), float)
    rewards = (wrappers.NormalizeReward(cartpole), wrappers.ClipReward(cartpole, 0))
    for env in (normalized, *rewards, wrappers.MaxAndSkipObservation(cartpole)):
        assert refused(RewardNetwork, env, "cartpole-rn") == "env"
    assert wrappers.NormalizeObservation(RewardNetwork(cartpole, "cartpole-rn")).reset(seed=0)
    pendulum = gymnasium.make("InvertedPendulum-v5")  # 4 numbers too, and other actions
    assert refused(RewardNetwork, pendulum, "cartpole-rn") == "env"
    car = gymnasium.make("MountainCarContinuous-v0")
    wide = wrappers.RescaleAction(wrappers.FlattenObservation(car), np.float32(-2), np.float32(2))
    for env in (wrappers.DtypeObservation(car, np.float32), wide):
        rewards = RewardNetwork(env, "mountain_car_continuous-rn")
        rewards.reset(seed=0)
        assert np.isfinite(rewards.step(np.array([0.5], np.float32))[1])


def test_the_info_of_an_unknown_task_is_not_known(stored_rn):
    options = {"interface": envs.make("cartpole").interface, "variant": "exclusive_weighted_info"}
    path, _ = stored_rn(4, "mine", **options)
    assert refused(RewardNetwork, gymnasium.make("CartPole-v1"), path) == "source"


def test_a_task_that_gymnasium_has_not_must_be_given(tmp_path):
    for task in ({"name": "gymnax/Pendulum-v1"}, {"name": "halfcheetah", "backend": "spring"}):
        rn = registry.make("proxy", RewardConfig(hidden_size=2), envs.make("pendulum"))
        path = tmp_path / "rn.safetensors"
        sejax.save(path, rn, random_like(shapes_of(rn.init_weights, KEY)), discount=0.9)
        forge(path, env=task)
        assert refused(make, path) == "task"
        assert make(path, "Pendulum-v1").reset(seed=0)[0].shape == (3,)
