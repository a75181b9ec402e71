"""HalfCheetah on brax, and what only its reward networks can see."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from support import numpy_forward

import sejax
from sejax import envs
from sejax.envs.environment import EnvState
from sejax.envs.wrappers import Wrapper
from sejax.options import ConfigError
from sejax.proxies.configs import RewardConfig

# brax calls parts of MuJoCo XLA that have been given other names.
pytestmark = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore:Brax System:UserWarning"
)

GAMMA = 0.98
NUM_STEPS = 5


@pytest.fixture(scope="module")
def task():
    pytest.importorskip("brax")
    return envs.make("halfcheetah", backend="mjx")


@pytest.fixture(scope="module")
def walk():
    """`walk(env)(key)`: the first steps of an episode with fixed actions, leaves `[step]`."""
    actions = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (NUM_STEPS, 6)), jnp.float32)

    def walk(env, params):
        def step(state, action):
            obs, state, reward, terminated, info = env.step_env(None, state, action, params)
            truncated = env.is_truncated(state, params)
            return state, (obs, reward, terminated, truncated, info)

        def walk(key):
            obs, state = env.reset_env(key, params)
            return obs, *jax.lax.scan(step, state, actions)[1]

        compiled = jax.jit(walk)
        return lambda key: (actions, *jax.device_get(compiled(key)))

    return walk


@pytest.fixture(scope="module")
def real_walk(task, walk):
    return walk(task.env, task.params)


@pytest.fixture(scope="module")
def real(real_walk):
    return real_walk(jax.random.key(3))


class Replay(Wrapper):
    """HalfCheetah as it went in `real`: its physics take long to compile, and RNs add none."""

    def __init__(self, env, real):
        super().__init__(env)
        _, self.first, self.obs, self.reward, self.terminated, _, self.info = real

    def reset_env(self, key, params):
        return jnp.asarray(self.first), CheetahTime(time=jnp.int32(0))

    def step_env(self, key, state, action, params):
        made = (self.obs, self.reward, self.terminated, self.info)
        obs, *rest = jax.tree.map(lambda x: jnp.asarray(x)[state.time], made)
        return obs, CheetahTime(time=state.time + 1), *rest


@struct.dataclass
class CheetahTime(EnvState):
    pass


@pytest.fixture(scope="module")
def replayed(task, real):
    return dataclasses.replace(task, env=Replay(task.env, real))


@pytest.mark.slow
def test_steps_are_braxs(task, real):
    from brax.envs.half_cheetah import Halfcheetah

    brax_env = Halfcheetah(backend=task.env.backend)

    def walk(actions):
        def step(state, action):
            state = brax_env.step(state, action)
            return state, (state.obs, state.reward, state.metrics["x_position"])

        return jax.lax.scan(step, brax_env.reset(jax.random.key(3)), actions)[1]

    actions, _, obs, reward, terminated, truncated, info = real
    expected = jax.jit(walk)(actions)
    for mine, brax in zip((obs, reward, info["x_position"]), expected, strict=True):
        np.testing.assert_allclose(mine, brax, rtol=1e-4, atol=1e-5)
    assert not terminated.any() and not truncated.any()


def test_it_is_paid_for_running_and_pays_for_its_torques(real):
    actions, _, _, reward, _, _, info = real
    np.testing.assert_allclose(info["reward_ctrl"], -0.1 * np.sum(actions**2, axis=1), rtol=1e-5)
    np.testing.assert_allclose(reward, info["reward_run"] + info["reward_ctrl"], rtol=1e-5)
    moved = np.diff(info["x_position"]) / 0.05
    np.testing.assert_allclose(info["x_velocity"][1:], moved, rtol=1e-2, atol=1e-3)
    np.testing.assert_allclose(info["reward_run"], info["x_velocity"])
    assert (info["discount"] == 1.0).all()


def test_each_reset_draws_another_state_and_the_limit_truncates(task, real_walk):
    obs = [real_walk(key)[1] for key in jax.random.split(jax.random.key(0), 2)]
    assert np.abs(obs[0] - obs[1]).max() > 1e-3
    late = CheetahTime(time=jnp.array([999, 1000]))
    assert list(task.env.is_truncated(late, task.params)) == [False, True]


def test_augmented_potentials_see_position_and_velocity_of_either_state(replayed, walk, real):
    config = RewardConfig(variant="exclusive_potential", augmented=True, hidden_size=4)
    env = config.make(replayed)
    weights = env.init_weights(jax.random.key(1))
    _, first, *_ = real
    rn_walk = walk(env, env.params(weights, GAMMA))
    _, rn_first, obs, reward, _, _, info = rn_walk(jax.random.key(3))
    np.testing.assert_array_equal(rn_first, first)
    v = np.stack([info["x_position"], info["x_velocity"]], axis=1)
    inputs = np.concatenate([obs, v], axis=1)
    start = np.concatenate([first, np.zeros(2)])  # no step has told position and velocity yet
    potentials = [numpy_forward(weights["potential"], x, "prelu", 1)[0] for x in (start, *inputs)]
    expected = GAMMA * np.array(potentials[1:]) - np.array(potentials[:-1])
    np.testing.assert_allclose(reward, expected, rtol=1e-3, atol=1e-4)


def test_weighted_info_is_a_linear_reward(replayed, walk):
    env = RewardConfig(variant="additive_weighted_info").make(replayed)
    weights = env.init_weights(jax.random.key(2))
    assert weights["info_weights"].shape == (4,) and np.abs(weights["info_weights"]).max() <= 0.5
    _, _, _, reward, _, _, info = walk(env, env.params(weights))(jax.random.key(3))
    keys = ("x_position", "x_velocity", "reward_run", "reward_ctrl")
    bonus = sum(w * info[key] for w, key in zip(weights["info_weights"], keys, strict=True))
    np.testing.assert_allclose(reward, info["real_reward"] + bonus, rtol=1e-5, atol=1e-6)


def test_the_papers_settings_are_its_own():
    config = sejax.config(["env=halfcheetah", "proxy=rn", "preset=paper", "proxy.augmented=true"])
    agent = config.agent
    assert config.name("agent") == "td3" and config.name("objective") == "reward_threshold"
    assert (agent.warmup_episodes, agent.discount, agent.activation) == (20, 0.98, "relu")
    assert (config.proxy.hidden_size, config.proxy.activation) == (128, "prelu")
    assert config.generations == 50


ENV, RN = "env=halfcheetah", "proxy=rn"
WEIGHTED = "proxy.variant=exclusive_weighted_info"


@pytest.mark.parametrize(
    ("overrides", "field"),
    [
        ([ENV, RN, "env.backend=sprung"], "env.backend"),
        (["env=cartpole", "env.backend=mjx"], "env.backend"),
        ([ENV, "preset=paper"], "preset"),
        (["env=cartpole", RN, "proxy.augmented=true"], "proxy.augmented"),
        (["env=reacher", RN, "proxy.augmented=true"], "proxy.augmented"),  # has no v
        (["env=cartpole", RN, "proxy.variant=additive_weighted_info"], "proxy.variant"),
        ([ENV, RN, WEIGHTED, "proxy.augmented=true"], "proxy.augmented"),
        ([ENV, RN, WEIGHTED, "proxy.zero_at_terminal=true"], "proxy.zero_at_terminal"),
        ([ENV, RN, "agent=ddqn"], "agent"),
        (["env=hopper", "env.reset_noise_scale=-1"], "env.reset_noise_scale"),
        (["env=ant", "env.ctrl_cost_weight=1e31"], "env.ctrl_cost_weight"),
    ],
)
def test_what_makes_no_sense_is_refused(overrides, field):
    with pytest.raises(ConfigError) as error:
        sejax.config(overrides)
    assert error.value.field == field
