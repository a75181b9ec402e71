"""sejax.proxies.reward: the four rewards, what they leave unchanged, and RNs as proxies."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments.classic_control import cartpole
from support import numpy_forward, refused

import sejax
from sejax import bilevel, envs, generation
from sejax.agents import Agent, make_agent
from sejax.agents.tabular import QLearningConfig
from sejax.envs.wrappers import Wrapper
from sejax.evaluation import area_under_curve, make_evaluator
from sejax.options import registry
from sejax.proxies.base import proxy_in, steps_are_real
from sejax.proxies.reward import RewardConfig, RewardEnv
from sejax.training import TrainingConfig, TrainResult, make_trainer

GAMMA = 0.9
KEY = jax.random.key(0)
VARIANTS = {  # table "Overview of Reward Network variants"
    "additive_potential": lambda r, before, after: r + GAMMA * after - before,
    "exclusive_potential": lambda r, before, after: GAMMA * after - before,
    "additive_non_potential": lambda r, before, after: r + after,
    "exclusive_non_potential": lambda r, before, after: after,
}


def make_env(task, variant="additive_potential", **changes):
    config = RewardConfig(variant=variant, hidden_size=5, **changes)
    return registry.make("proxy", config, envs.make(task))


def phi(env, weights, obs):
    """The potential in NumPy; a discrete state is one-hot."""
    one_hot = env.task.num_states is not None
    x = np.eye(env.task.num_states)[int(obs)] if one_hot else np.asarray(obs, np.float64)
    return numpy_forward(weights["potential"], x, "prelu", 1)[0]


def trajectory(env, weights, actions, seed=0):
    """Transitions `(s, r shaped, s', real reward)` with the given actions."""
    params = env.params(weights, GAMMA)
    step = jax.jit(env.step_env)
    obs, state = env.reset_env(jax.random.key(seed), params)
    rows = []
    for action in actions:
        before = obs
        obs, state, reward, _, info = step(jax.random.key(1), state, jnp.int32(action), params)
        rows.append((before, float(reward), obs, float(info["real_reward"])))
    return rows


def on_bias(env, value):
    """Params of an RN whose potential is this number everywhere, and its first state."""
    weights = jax.tree.map(jnp.zeros_like, env.init_weights(KEY))
    weights["potential"]["Dense_1"]["bias"] = jnp.full(1, value)
    return env.params(weights), env.reset_env(KEY, env.params(weights))[1]


# --- the rewards ---------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("task", ["cartpole", "cliff_walking"])
def test_rewards_are_those_of_the_table(task, variant):
    """Phi is the network's output times its scale."""
    scale = 0.1 if task == "cliff_walking" else 1.0
    env = make_env(task, variant, output_scale=scale)
    weights = env.init_weights(jax.random.key(1))
    rows = trajectory(env, weights, [1, 0, 1, 0] if task == "cartpole" else [3, 0, 1, 2])
    for obs, reward, next_obs, real in rows:
        before, after = (scale * phi(env, weights, x) for x in (obs, next_obs))
        expected = VARIANTS[variant](real, before, after)
        np.testing.assert_allclose(reward, expected, rtol=1e-5, atol=1e-6)


def test_everything_but_the_reward_is_the_real_tasks():
    env = make_env("cartpole")
    task, params = env.task, env.default_params
    key = jax.random.key(4)
    obs, state = env.reset_env(key, params)
    real_obs, real_state = task.env.reset_env(key, task.params)
    terminated = False
    while not terminated:  # pushed to one side the pole falls
        np.testing.assert_array_equal([obs, env.get_obs(state)], [real_obs, real_obs])
        obs, state, _, terminated, info = env.step_env(key, state, 1, params)
        real_obs, real_state, reward, real_terminated, real_info = task.env.step_env(
            key, real_state, 1, task.params
        )
        assert terminated == real_terminated
        assert info["discount"] == real_info["discount"] and info["real_reward"] == reward
    assert state.time < 12
    late = state.replace(time=task.max_steps)
    assert env.is_truncated(late, params) and not env.is_truncated(state, params)


def test_zero_at_terminal_drops_the_potential_there_and_nowhere_else():
    # From S, RIGHT falls off the cliff and terminates; UP does not.
    env = make_env("cliff_walking", zero_at_terminal=True)
    weights = env.init_weights(jax.random.key(5))
    start = phi(env, weights, 36)
    fall, up = (trajectory(env, weights, [action])[0] for action in (0, 3))
    np.testing.assert_allclose(fall[1], -100 - start, rtol=1e-5)
    np.testing.assert_allclose(up[1], -1 + GAMMA * phi(env, weights, 24) - start, rtol=1e-5)


@pytest.mark.parametrize("limit_is_terminal", [True, False])
def test_zero_at_terminal_counts_the_step_limit_if_agents_do(limit_is_terminal):
    env = make_env("cartpole", "exclusive_potential", zero_at_terminal=True)
    weights = env.init_weights(jax.random.key(7))
    params = env.prepare(env.params(weights), GAMMA, limit_is_terminal)
    obs, state = env.reset_env(jax.random.key(8), params)
    for time, ends in ((198, False), (199, True)):  # the next step is the 199th or the 200th
        after, _, reward, terminated, _ = env.step_env(
            jax.random.key(9), state.replace(time=jnp.int32(time)), 0, params
        )
        assert not terminated
        kept = 0.0 if ends and limit_is_terminal else GAMMA * phi(env, weights, after)
        np.testing.assert_allclose(reward, kept - phi(env, weights, obs), rtol=1e-5)


@pytest.mark.parametrize("limit_is_terminal", [True, False])
def test_a_training_says_whether_the_limit_is_terminal(limit_is_terminal, monkeypatch):
    seen = []
    monkeypatch.setattr(
        RewardEnv, "prepare", lambda self, params, discount, limit: seen.append(limit) or params
    )
    env = make_env("cliff_walking", zero_at_terminal=True)
    training = TrainingConfig(
        max_episodes=1, max_steps=1, stop_rule="never", time_limit_is_terminal=limit_is_terminal
    )
    train = make_trainer(make_agent(QLearningConfig(), env.task), env, training)
    train(jax.random.key(0), env.params(env.init_weights(jax.random.key(0))))
    assert seen == [limit_is_terminal]


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_an_absurd_reward_ends_the_episode_instead_of_poisoning_the_agent(value):
    env = make_env("cartpole", "additive_non_potential")
    params, state = on_bias(env, value)
    _, _, reward, terminated, info = env.step_env(jax.random.key(1), state, 0, params)
    assert reward == 0 and terminated and info["nonfinite"] == (not np.isfinite(value))
    assert info["discount"] == 0  # nothing is learned from what would come after


@pytest.mark.parametrize("real", [1e7, np.inf])
def test_real_rewards_of_money_size_pass_and_infinite_ones_do_not(real):
    class Rich(cartpole.CartPole):
        def step_env(self, key, state, action, params):
            obs, state, _, *rest = super().step_env(key, state, action, params)
            return obs, state, jnp.float32(real), *rest

    env = RewardConfig(hidden_size=5).make(sejax.Task(name="rich", env=Rich(), max_steps=9))
    params, state = on_bias(env, 0.0)
    _, _, reward, terminated, info = env.step_env(jax.random.key(1), state, 0, params)
    is_paid = np.isfinite(real)
    assert bool(terminated) != is_paid and info["nonfinite"] != is_paid
    assert reward == (real if is_paid else 0.0)


# --- agents on it --------------------------------------------------------------------------------


def test_the_discount_is_the_agents():
    """The table of a Q-learning agent with alpha 1 after one step is the shaped reward itself."""
    env = make_env("cliff_walking")
    weights = env.init_weights(jax.random.key(1))
    training = TrainingConfig(max_episodes=1, max_steps=1, stop_rule="never")
    agent = make_agent(QLearningConfig(discount=GAMMA), env.task)
    result = make_trainer(agent, env, training)(jax.random.key(0), env.params(weights, 0.123))
    table = np.asarray(result.agent_state.q_values)
    ((state, action),) = np.argwhere(table != 0)
    (row,) = trajectory(env, weights, [action])
    assert state == 36
    np.testing.assert_allclose(table[state, action], row[1], rtol=1e-5)


def test_an_agent_without_a_discount_is_told_where_one_is_needed():
    agent = Agent(init=None, act=None, update=None, buffer=None, hparams={"rate": 0.1})
    env = make_env("cliff_walking")
    assert refused(env.prepare, env.default_params, agent.discount(agent.hparams)) == "agent"
    env = make_env("cliff_walking", "exclusive_non_potential")
    assert env.prepare(env.default_params, agent.discount(agent.hparams)).discount == 1


def test_prepared_params_look_up_what_the_network_says():
    env = make_env("cliff_walking", "exclusive_potential")
    params = env.params(env.init_weights(jax.random.key(1)))
    prepared = env.prepare(params, GAMMA)
    assert params.potentials is None and prepared.potentials.shape == (48,)
    for state in (0, 36, 47):
        expected = phi(env, params.weights, state)
        for one in (params, prepared):
            np.testing.assert_allclose(env.potential(one, jnp.int32(state)), expected, rtol=1e-5)
    assert prepared.discount == np.float32(GAMMA)
    assert steps_are_real(env) and env.max_steps == 50 and proxy_in(Wrapper(env)) is env
    assert steps_are_real(env.task.env)
    assert make_env("cartpole").prepare(params, GAMMA).potentials is None


def test_an_augmented_network_sees_a_discrete_state_and_its_info():
    """Also if its params are prepared for a training."""

    class Lit(Wrapper):
        def step_env(self, key, state, action, params):
            *stepped, info = self.env.step_env(key, state, action, params)
            return *stepped, info | {"light": jnp.float32(stepped[0] % 3)}

    keys, walk = ("light",), envs.make("cliff_walking")
    lit = {"env": Lit(walk.env), "info_keys": keys, "augmented_keys": keys}
    task = dataclasses.replace(walk, **lit)
    env = RewardConfig(variant="exclusive_potential", augmented=True, hidden_size=5).make(task)
    params = env.prepare(env.params(env.init_weights(KEY)), GAMMA)
    obs, state = env.reset_env(KEY, params)
    seen = [np.append(np.eye(48)[obs], 0)]  # no step has told the light yet
    for action in (0, 1, 1):
        obs, state, reward, *_ = env.step_env(KEY, state, jnp.int32(action), params)
        seen.append(np.append(np.eye(48)[obs], obs % 3))
        net = params.weights["potential"]
        before, after = (numpy_forward(net, x, "prelu", 1)[0] for x in seen[-2:])
        np.testing.assert_allclose(reward, GAMMA * after - before, rtol=1e-4, atol=1e-6)


LEARN = ["env=cliff_walking", "proxy=rn", "generations=1", "es.population_size=2",
         "training.max_episodes=12"]  # fmt: skip


def test_training_on_a_reward_network_stops_when_tests_on_the_real_task_solve_it():
    config = sejax.config(LEARN)
    env = make_env("cliff_walking")
    agent = make_agent(config.agent, env.task, config.exploration)
    params = env.params(env.init_weights(jax.random.key(1)))

    @functools.partial(jax.jit, static_argnums=0)
    def ended(solved_reward):
        task = dataclasses.replace(env.task, solved_reward=solved_reward)
        return make_evaluator(agent, env, task, config.training)(jax.random.key(0), params)

    assert ended(-1000.0).train_episodes == agent.spec.stops_from + 1
    last, untested = ended(0.0), ended(np.inf)  # which no test would end
    assert last.train_episodes == config.training.max_episodes == 12
    assert untested.train_steps == last.train_steps and untested.real_steps < last.real_steps


@pytest.mark.parametrize("objective", ["auc", "auc_sum"])
def test_the_area_under_the_curve_is_of_trainings_that_go_on_when_solved(objective, monkeypatch):
    """One that ended there would reward learning late."""
    config = sejax.config([*LEARN, f"objective={objective}"])
    assert config.training.stop_rule == "solved"
    changes = {"stop_rule": "never", "tests_between": 1}
    monkeypatch.setattr(
        generation, "make_evaluator", lambda *parts, **_: trainings.append(parts[3])
    )
    trainings = []
    bilevel.make_bilevel(**config.parts())
    assert trainings == [dataclasses.replace(config.training, **changes)]


def test_the_area_counts_an_episode_that_the_budget_cut_off_with_the_test_after_it():
    result = TrainResult(
        agent_state=None, train_steps=jnp.int32(17), episodes=jnp.int32(2),
        returns=jnp.array([-5.0, -3.0, jnp.nan]), test_returns=None,
        episode_ends=jnp.array([4, 10, 0]), nonfinite=jnp.bool_(False),
        test_steps=jnp.int32(0),
    )  # fmt: skip
    assert area_under_curve(result, jnp.float32(-2.0)) == -5 * 4 - 3 * 6 - 2 * 7
    tested = result.replace(test_returns=jnp.array([-1.0, -4.0, jnp.nan]))  # where there are some
    assert area_under_curve(tested, jnp.float32(-2.0)) == -1 * 4 - 4 * 6 - 2 * 7
    nothing = result.replace(episodes=jnp.int32(0), episode_ends=jnp.zeros(3, jnp.int32))
    assert area_under_curve(nothing, jnp.float32(-2.0)) == -2 * 17


def test_an_episode_ends_where_the_tasks_own_does():
    class Early(cartpole.CartPole):
        def is_truncated(self, state, params):
            return (state.time >= params.max_steps_in_episode) | (state.time >= 3)

    config = RewardConfig(variant="exclusive_potential", hidden_size=5, zero_at_terminal=True)
    env = config.make(sejax.Task(name="early", env=Early()))
    params = env.prepare(env.params(env.init_weights(KEY)), GAMMA, limit_is_terminal=True)
    obs, state = env.reset_env(KEY, params)
    for cut in (False, False, True):
        before = env.potential(params, obs)
        obs, state, reward, terminated, _ = env.step_env(KEY, state, 0, params)
        assert bool(env.is_truncated(state, params)) == cut and not terminated
        after = 0.0 if cut else GAMMA * env.potential(params, obs)
        np.testing.assert_allclose(reward, after - before, rtol=1e-5)


@pytest.mark.parametrize("task", ["cartpole", "cliff_walking"])
def test_proxies_step_in_double_precision_too(task):
    for config in (RewardConfig(), sejax.SyntheticConfig(horizon=None, initial_state="real")):
        env = config.make(envs.make(task))
        with jax.enable_x64(True):
            params = env.params(env.init_weights(KEY))
            out = jax.eval_shape(env.step, KEY, env.reset(KEY, params)[1], jnp.int32(0), params)
        assert out[2].shape == ()
