"""sejax.envs.wrappers: decisions that last, against stepping by hand, and worlds as vectors."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scripted import MAX_EPISODES, MAX_STEPS, ScriptedEnv, script, scripted_agent
from support import paper_training

from sejax import envs
from sejax.envs.wrappers import repeat_actions
from sejax.training import make_trainer

KEY = jax.random.key(0)


@pytest.mark.parametrize("start", [0, 6, 8])
def test_a_decision_is_three_steps_or_as_many_as_the_episode_has_left(start):
    task = envs.make("cartpole")
    params = task.params.replace(max_steps_in_episode=10)
    env = repeat_actions(task.env, 3)
    obs, state = task.env.reset_env(KEY, params)
    state = state.replace(time=start)
    _, repeated, reward, terminated, info = jax.jit(env.step_env)(KEY, state, 1, params)
    total, num_steps = 0.0, 0
    while num_steps < 3 and state.time < 10:
        obs, state, step_reward, _, _ = task.env.step_env(KEY, state, 1, params)
        total, num_steps = total + step_reward, num_steps + 1
    assert info["num_steps"] == num_steps == min(3, 10 - start)
    assert reward == total and not terminated
    assert env.is_truncated(repeated, params) == (start + num_steps >= 10)
    np.testing.assert_allclose(env.get_obs(repeated), obs, rtol=1e-6)


def test_nothing_happens_after_an_episode_has_terminated():
    task = envs.make("mountain_car_continuous")
    env = repeat_actions(task.env, 4)
    _, state = task.env.reset_env(KEY, task.params)
    state = state.replace(position=jnp.float32(0.449), velocity=jnp.float32(0.05))
    _, end, reward, terminated, info = env.step_env(KEY, state, jnp.ones(1), task.params)
    assert terminated and info["num_steps"] == 1 and reward == pytest.approx(100 - 0.1)
    assert end.position == pytest.approx(0.449 + 0.05, abs=3e-3)  # one step further, not four


def test_a_trainer_counts_steps_of_the_world():
    agent = scripted_agent()
    agent = dataclasses.replace(agent, spec=dataclasses.replace(agent.spec, action_repeat=3))
    training = paper_training(max_episodes=MAX_EPISODES, stop_rule="never")
    train = jax.jit(make_trainer(agent, ScriptedEnv(), training))
    result = train(KEY, script([1.0] * MAX_EPISODES, [99] * MAX_EPISODES))
    assert result.train_steps == MAX_EPISODES * MAX_STEPS  # 3 + 1 steps in each episode
    assert result.episodes == MAX_EPISODES
    np.testing.assert_array_equal(result.returns, 1.0)
