"""All shipped proxies in NumPy and as `sejax.load` has them: 10,000 random steps are the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnax.environments.classic_control import cartpole

import sejax
from sejax.envs.dynamics import gridworld, mountain_car_continuous
from sejax.gym import make, make_vec
from sejax.proxies.reward import RewardState

pytestmark = pytest.mark.slow
NUM_STEPS = 10_000
KINDS = {kind: [proxy.name for proxy in sejax.pretrained() if proxy.kind == kind]
         for kind in ("se", "rn")}  # fmt: skip
# What a world is in, by what is seen of it; HalfCheetah's states hold more, and its steps are held
# against Gymnasium's in test_mujoco.py.
WORLDS = {
    "cartpole": lambda obs, time: cartpole.EnvState(
        x=obs[0], x_dot=obs[1], theta=obs[2], theta_dot=obs[3], time=time),
    "mountain_car_continuous": lambda obs, time: mountain_car_continuous.EnvState(
        position=obs[0], velocity=obs[1], time=time),
    "cliff_walking": lambda obs, time: gridworld.GridState(index=obs, time=time),
}  # fmt: skip


def close(got, expected):
    """Up to the rounding of sums, whose terms may be as large as the largest of the values."""
    largest = np.abs(np.asarray(expected, np.float64)).max(initial=0.0)
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=max(1e-5, 1e-6 * largest))


@pytest.mark.parametrize("name", KINDS["se"])
def test_steps_of_an_se(name):
    jax_env, params = sejax.load(name)
    env = make(name)
    env.action_space.seed(0)
    env.reset(seed=0)
    rows = []
    for _ in range(NUM_STEPS):
        vector, time, action = env._vector, env._time, env.action_space.sample()
        obs, reward, terminated, truncated, info = env.step(action)
        rows.append((vector, time, action, obs, reward, terminated, truncated, info["discount"]))
        if terminated or truncated:
            env.reset()
    vectors, times, actions, *got = (np.array(column) for column in zip(*rows, strict=True))

    @jax.jit
    @jax.vmap
    def step(vector, time, action):
        state = jax.eval_shape(jax_env.reset_env, jax.random.key(0), params)[1]
        state = state.replace(vector=vector, time=time)
        obs, _, reward, terminated, info = jax_env.step_env(None, state, action, params)
        return obs, reward, terminated, info["discount"]

    obs, reward, terminated, discount = step(vectors, times, actions)
    close(got[0], obs), close(got[1], reward), close(got[4], discount)
    np.testing.assert_array_equal(got[2], terminated)
    assert got[2].all() and not got[3].any()  # every shipped one has one-step episodes


@pytest.mark.parametrize("name", KINDS["se"])
def test_starts_of_an_se_and_steps_of_a_batch(name):
    jax_env, params = sejax.load(name)
    num_envs = 100
    envs = make_vec(name, num_envs, autoreset_mode=AutoresetMode.DISABLED)
    keys = jax.random.split(jax.random.key(0), num_envs)
    noise = np.asarray(jax.vmap(lambda key: jax.random.normal(key, (envs.world.obs_dim,)))(keys))
    starts, states = jax.jit(jax.vmap(jax_env.reset_env, (0, None)))(keys, params)
    close(envs.world.first(noise), starts)
    envs.reset(seed=0)
    envs.action_space.seed(0)
    step = jax.jit(jax.vmap(jax_env.step_env, (None, 0, 0, None)))
    for _ in range(NUM_STEPS // num_envs):
        states, actions = states.replace(vector=envs._vectors.copy()), envs.action_space.sample()
        obs, _, reward, terminated, info = step(None, states, actions, params)
        got = envs.step(actions)
        close(got[0], obs), close(got[1], reward), close(got[4]["discount"], info["discount"])
        np.testing.assert_array_equal(got[2], terminated)
        envs.reset(options={"reset_mask": got[2] | got[3]})


@pytest.mark.parametrize("name", KINDS["rn"])
def test_steps_of_an_rn(name):
    proxy = sejax.load_proxy(name)
    rn, task = proxy.env, proxy.task
    env = make(name)
    env.action_space.seed(0)
    obs, _ = env.reset(seed=0)
    rows, time = [], 0
    for i in range(NUM_STEPS):
        action = env.action_space.sample()
        if task.name == "mountain_car_continuous" and i % 3:  # up the hill now and then
            action = np.float32([1.0 if obs[1] >= 0 else -1.0])
        before, (obs, reward, terminated, truncated, info) = obs, env.step(action)
        rows.append((before, time, action, obs, reward, terminated, truncated,
                     info["real_reward"]))  # fmt: skip
        time += 1
        if terminated or truncated:
            (obs, _), time = env.reset(), 0
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    before, time, action, after, reward, terminated, truncated, real = (
        x.astype(np.float32) if x.dtype == np.float64 else x for x in columns
    )

    @jax.jit
    @jax.vmap
    def bonus(before, after, terminated):
        states = [RewardState(world=None, obs=x, augmentation=jnp.zeros(0), time=0)
                  for x in (before, after)]  # fmt: skip
        return rn.bonus(proxy.params, *states, {}, terminated)

    expected = bonus(before, after, terminated) + (real if rn.config.shaping.is_additive else 0)
    close(reward, expected)
    assert truncated.any() or terminated.any()
    if task.name not in WORLDS:
        return

    @jax.jit
    @jax.vmap
    def step(obs, time, action):
        world = WORLDS[task.name](obs, time)
        state = RewardState(world=world, obs=obs, augmentation=jnp.zeros(0), time=time)
        obs, state, reward, terminated, info = rn.step_env(None, state, action, proxy.params)
        return obs, reward, terminated, rn.is_truncated(state, proxy.params), info["real_reward"]

    out = step(before, time, action)
    close(after, out[0]), close(reward, out[1]), close(real, out[4])
    np.testing.assert_array_equal(terminated, out[2])
    np.testing.assert_array_equal(truncated, out[3])
    assert terminated.any()
