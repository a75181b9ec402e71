"""HalfCheetah on brax, and what only its reward networks can see."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
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
ACTIONS = np.random.default_rng(0).uniform(-1, 1, (5, 6)).astype(np.float32)
KEY = jax.random.key(3)


def walk_of(env, params):
    """`walk(key)`: the first observation and `[step]` of what five steps return; jitted."""

    def step(state, action):
        obs, state, reward, terminated, info = env.step_env(None, state, action, params)
        return state, (obs, reward, terminated, env.is_truncated(state, params), info)

    def walk(key):
        obs, state = env.reset_env(key, params)
        return obs, *jax.lax.scan(step, state, jnp.asarray(ACTIONS))[1]

    compiled = jax.jit(walk)
    return lambda key: jax.device_get(compiled(key))


@functools.cache
def on_brax():
    """The task and a walk there, of which both take long to compile."""
    pytest.importorskip("brax")
    task = envs.make("halfcheetah", backend="mjx")
    return task, walk_of(task.env, task.params)


class Replay(Wrapper):
    """HalfCheetah as it went from `KEY`, without its physics: RNs add none."""

    def __init__(self, env, walk):
        super().__init__(env)
        self.first, self.obs, self.reward, self.terminated, _, self.info = walk(KEY)

    def reset_env(self, key, params):
        return jnp.asarray(self.first), EnvState(time=jnp.int32(0))

    def step_env(self, key, state, action, params):
        made = (self.obs, self.reward, self.terminated, self.info)
        obs, *rest = jax.tree.map(lambda x: jnp.asarray(x)[state.time], made)
        return obs, EnvState(time=state.time + 1), *rest


def replayed():
    task, walk = on_brax()
    return dataclasses.replace(task, env=Replay(task.env, walk))


@pytest.mark.slow
def test_steps_are_braxs():
    from brax.envs.half_cheetah import Halfcheetah

    task, walk = on_brax()
    brax_env = Halfcheetah(backend=task.env.backend)

    def walk_in_brax(actions):
        def step(state, action):
            state = brax_env.step(state, action)
            return state, (state.obs, state.reward, state.metrics["x_position"])

        return jax.lax.scan(step, brax_env.reset(KEY), actions)[1]

    _, obs, reward, terminated, truncated, info = walk(KEY)
    expected = jax.jit(walk_in_brax)(ACTIONS)
    for mine, brax in zip((obs, reward, info["x_position"]), expected, strict=True):
        np.testing.assert_allclose(mine, brax, rtol=1e-4, atol=1e-5)
    assert not terminated.any() and not truncated.any()


def test_it_is_paid_for_running_and_pays_for_its_torques():
    _, _, reward, _, _, info = on_brax()[1](KEY)
    np.testing.assert_allclose(info["reward_ctrl"], -0.1 * np.sum(ACTIONS**2, axis=1), rtol=1e-5)
    np.testing.assert_allclose(reward, info["reward_run"] + info["reward_ctrl"], rtol=1e-5)
    moved = np.diff(info["x_position"]) / 0.05
    np.testing.assert_allclose(info["x_velocity"][1:], moved, rtol=1e-2, atol=1e-3)
    np.testing.assert_allclose(info["reward_run"], info["x_velocity"])
    assert (info["discount"] == 1.0).all()


def test_each_reset_draws_another_state_and_the_limit_truncates():
    task, walk = on_brax()
    assert np.abs(walk(KEY)[0] - walk(jax.random.key(0))[0]).max() > 1e-3
    late = EnvState(time=jnp.array([999, 1000]))
    assert list(task.env.is_truncated(late, task.params)) == [False, True]


def test_augmented_potentials_see_position_and_velocity_of_either_state():
    config = RewardConfig(variant="exclusive_potential", augmented=True, hidden_size=4)
    env = config.make(replayed())
    weights = env.init_weights(jax.random.key(1))
    first, obs, reward, _, _, info = walk_of(env, env.params(weights, GAMMA))(KEY)
    np.testing.assert_array_equal(first, env.task.env.first)
    v = np.stack([info["x_position"], info["x_velocity"]], axis=1)
    inputs = np.concatenate([obs, v], axis=1)
    start = np.concatenate([first, np.zeros(2)])  # no step has told position and velocity yet
    potentials = [numpy_forward(weights["potential"], x, "prelu", 1)[0] for x in (start, *inputs)]
    expected = GAMMA * np.array(potentials[1:]) - np.array(potentials[:-1])
    np.testing.assert_allclose(reward, expected, rtol=1e-3, atol=1e-4)


def test_weighted_info_is_a_linear_reward():
    env = RewardConfig(variant="additive_weighted_info").make(replayed())
    weights = env.init_weights(jax.random.key(2))
    assert weights["info_weights"].shape == (4,) and np.abs(weights["info_weights"]).max() <= 0.5
    _, _, reward, _, _, info = walk_of(env, env.params(weights))(KEY)
    keys = ("x_position", "x_velocity", "reward_run", "reward_ctrl")
    bonus = sum(w * info[key] for w, key in zip(weights["info_weights"], keys, strict=True))
    np.testing.assert_allclose(reward, info["real_reward"] + bonus, rtol=1e-5, atol=1e-6)


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
