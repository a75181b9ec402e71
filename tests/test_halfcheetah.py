"""HalfCheetah on brax, and what only its reward networks can see."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import numpy_forward

import sejax
from sejax import envs
from sejax.envs.halfcheetah import HalfCheetah
from sejax.errors import ConfigError
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
    return envs.make("halfcheetah")


@pytest.fixture(scope="module")
def walk(task):
    """`walk(env, params)`: the first steps of an episode with fixed actions, leaves `[step]`."""
    actions = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (NUM_STEPS, 6)), jnp.float32)

    def walk(env, params):
        def step(state, action):
            obs, state, reward, terminated, info = env.step_env(None, state, action, params)
            truncated = env.is_truncated(state, params)
            return state, (obs, reward, terminated, truncated, info)

        obs, state = env.reset_env(jax.random.key(3), params)
        return obs, *jax.lax.scan(step, state, actions)[1]

    compiled = jax.jit(walk, static_argnums=0)
    return lambda env, params: (actions, *jax.device_get(compiled(env, params)))


@pytest.fixture(scope="module")
def real(task, walk):
    return walk(task.env, task.params)


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


def test_limits_and_sizes_are_the_papers(task):
    assert (task.max_steps, task.solved_reward) == (1000, 3000.0)
    assert (task.obs_dim, task.action_dim, task.max_action) == (17, 6, 1.0)
    assert task.num_states is None and task.num_actions is None
    assert task.facts == HalfCheetah.facts  # what is said of it before brax is imported


def test_each_reset_draws_another_state_and_the_limit_truncates(task):
    keys = jax.random.split(jax.random.key(0), 2)
    obs, state = jax.jit(jax.vmap(task.env.reset_env, (0, None)))(keys, task.params)
    assert np.abs(obs[0] - obs[1]).max() > 1e-3
    late = state.replace(time=jnp.array([999, 1000]))
    assert list(task.env.is_truncated(late, task.params)) == [False, True]


def test_augmented_potentials_see_position_and_velocity_of_either_state(task, walk, real):
    config = RewardConfig(variant="exclusive_potential", augmented=True, hidden_size=4)
    env = config.make(task)
    weights = env.init_weights(jax.random.key(1))
    _, first, *_ = real
    _, rn_first, obs, reward, _, _, info = walk(env, env.params(weights, GAMMA))
    np.testing.assert_array_equal(rn_first, first)
    v = np.stack([info["x_position"], info["x_velocity"]], axis=1)
    inputs = np.concatenate([obs, v], axis=1)
    start = np.concatenate([first, np.zeros(2)])  # no step has told position and velocity yet
    potentials = [numpy_forward(weights["potential"], x, "prelu", 1)[0] for x in (start, *inputs)]
    expected = GAMMA * np.array(potentials[1:]) - np.array(potentials[:-1])
    np.testing.assert_allclose(reward, expected, rtol=1e-3, atol=1e-4)


def test_weighted_info_is_a_linear_reward(task, walk):
    env = RewardConfig(variant="additive_weighted_info").make(task)
    weights = env.init_weights(jax.random.key(2))
    assert weights["info_weights"].shape == (4,) and np.abs(weights["info_weights"]).max() <= 0.5
    _, _, _, reward, _, _, info = walk(env, env.params(weights))
    keys = ("x_position", "x_velocity", "reward_run", "reward_ctrl")
    bonus = sum(w * info[key] for w, key in zip(weights["info_weights"], keys, strict=True))
    np.testing.assert_allclose(reward, info["real_reward"] + bonus, rtol=1e-5, atol=1e-6)


def test_the_papers_settings_are_its_own():
    config = sejax.config(["env=halfcheetah", "proxy=rn", "proxy.augmented=true"])
    agent = config.agent
    assert (config.name("agent"), agent.init_episodes, agent.discount, agent.activation) == (
        "td3", 20, 0.98, "relu",
    )  # fmt: skip
    assert (config.proxy.hidden_size, config.proxy.activation) == (128, "prelu")
    assert config.name("objective") == "reward_threshold" and config.generations == 50


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["env=halfcheetah", "proxy=rn", "env.backend=sprung"], "spring"),
        (["env=cartpole", "+env.backend=mjx"], r"env\.backend must be a field of CartPole"),
        (["env=halfcheetah", "preset=paper"], "preset=paper for halfcheetah with proxy=se"),
        (["env=cartpole", "proxy=rn", "proxy.augmented=true"], "proxy.augmented=false"),
        (["env=cartpole", "proxy=rn", "proxy.variant=additive_weighted_info"], "potential"),
        (["env=halfcheetah", "proxy=rn", "proxy.variant=exclusive_weighted_info",
          "proxy.augmented=true"], "has no network"),
        (["env=halfcheetah", "proxy=rn", "proxy.variant=exclusive_weighted_info",
          "proxy.zero_at_terminal=true"], "has no network"),
        (["env=halfcheetah", "proxy=rn", "agent=ddqn"], "td3"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused(overrides, said):
    with pytest.raises(ConfigError, match=said):
        sejax.config(overrides)
