"""HalfCheetah on brax, and what only its reward networks can see."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import has_compiler, numpy_forward, refused

import sejax
from sejax import envs
from sejax.envs.environment import EnvState
from sejax.proxies.reward import RewardConfig

# brax calls parts of MuJoCo XLA that have been given other names.
pytestmark = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore:Brax System:UserWarning"
)

GAMMA = 0.98
ACTIONS = np.random.default_rng(0).uniform(-1, 1, (5, 6)).astype(np.float32)
KEY = jax.random.key(3)
needs_compiler = pytest.mark.skipif(not has_compiler(), reason="no C++ compiler")


def walk_of(env, params):
    """The first observation and `[step]` of what five steps return."""

    def step(state, action):
        obs, state, reward, terminated, info = env.step_env(None, state, action, params)
        return state, (obs, reward, terminated, info)

    def walk(key):
        obs, state = env.reset_env(key, params)
        return obs, *jax.lax.scan(step, state, jnp.asarray(ACTIONS))[1]

    return jax.device_get(jax.jit(walk)(KEY))


@pytest.mark.slow
def test_steps_are_braxs():
    brax_env = pytest.importorskip("brax.envs.half_cheetah").Halfcheetah(backend="mjx")
    task = envs.make("halfcheetah", backend="mjx")

    def walk_in_brax(actions):
        def step(state, action):
            state = brax_env.step(state, action)
            return state, (state.obs, state.reward, state.metrics)

        return jax.lax.scan(step, brax_env.reset(KEY), actions)[1]

    _, obs, reward, terminated, info = walk_of(task.env, task.params)
    expected = jax.jit(walk_in_brax)(ACTIONS)
    metrics = {name: info[name] for name in expected[2]}
    chex.assert_trees_all_close((obs, reward, metrics), expected, rtol=1e-4, atol=1e-5)
    assert not terminated.any() and (info["discount"] == 1.0).all()
    late = EnvState(time=jnp.array([999, 1000]))
    assert list(task.env.is_truncated(late, task.params)) == [False, True]


@needs_compiler
def test_augmented_potentials_see_position_and_velocity_of_either_state():
    config = RewardConfig(variant="exclusive_potential", augmented=True, hidden_size=4)
    env = config.make(envs.make("halfcheetah"))
    weights = env.init_weights(jax.random.key(1))
    first, obs, reward, _, info = walk_of(env, env.params(weights, GAMMA))
    v = np.stack([info["x_position"], info["x_velocity"]], axis=1)
    inputs = np.concatenate([obs, v], axis=1)
    start = np.concatenate([first, np.zeros(2)])  # no step has told position and velocity yet
    potentials = [numpy_forward(weights["potential"], x, "prelu", 1)[0] for x in (start, *inputs)]
    expected = GAMMA * np.array(potentials[1:]) - np.array(potentials[:-1])
    np.testing.assert_allclose(reward, expected, rtol=1e-3, atol=1e-4)


@needs_compiler
def test_weighted_info_is_a_linear_reward():
    env = RewardConfig(variant="additive_weighted_info").make(envs.make("halfcheetah"))
    weights = env.init_weights(jax.random.key(2))
    assert weights["info_weights"].shape == (4,) and np.abs(weights["info_weights"]).max() <= 0.5
    _, _, reward, _, info = walk_of(env, env.params(weights))
    keys = ("x_position", "x_velocity", "reward_run", "reward_ctrl")
    bonus = sum(w * info[key] for w, key in zip(weights["info_weights"], keys, strict=True))
    np.testing.assert_allclose(reward, info["real_reward"] + bonus, rtol=1e-5, atol=1e-6)


ENV, RN = "env=halfcheetah", "proxy=rn"
WEIGHTED = "proxy.variant=exclusive_weighted_info"


@pytest.mark.parametrize(("overrides", "field"), [
    ([ENV, RN, "env.backend=sprung"], "env.backend"),
    ([ENV, "preset=paper"], "preset"),
    (["env=reacher", RN, "proxy.augmented=true"], "proxy.augmented"),  # has no v
    (["env=cartpole", RN, "proxy.variant=additive_weighted_info"], "proxy.variant"),
    ([ENV, RN, WEIGHTED, "proxy.augmented=true"], "proxy.augmented"),
    ([ENV, RN, WEIGHTED, "proxy.zero_at_terminal=true"], "proxy.zero_at_terminal"),
    ([ENV, RN, "agent=ddqn"], "agent"),
    (["env=hopper", "env.reset_noise_scale=-1"], "env.reset_noise_scale"),
    (["env=ant", "env.ctrl_cost_weight=1e31"], "env.ctrl_cost_weight"),
])  # fmt: skip
def test_what_makes_no_sense_is_refused(overrides, field):
    assert refused(sejax.config, overrides) == field
