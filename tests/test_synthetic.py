"""sejax.proxies.synthetic: the SE's equations, how episodes begin and end, plain gymnax usage."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import assert_close, bits, numpy_forward, paper_se, refused

import sejax
from sejax import envs
from sejax.envs.wrappers import Wrapper
from sejax.options import registry
from sejax.proxies import MAX_ABS_VALUE
from sejax.proxies.base import steps_are_real
from sejax.proxies.synthetic import SyntheticConfig, SyntheticState

CONFIG = paper_se(hidden_size=5, num_layers=2, activation="leaky_relu")
OBS = jnp.array([0.1, -0.2, 0.3, -0.4])


def make_env(task="cartpole", **changes):
    config = SyntheticConfig(**{**vars(CONFIG), **changes})
    return registry.make("proxy", config, envs.make(task))


DONE_MODES = ("soft", "threshold", "bernoulli")


@pytest.fixture(scope="module")
def step():
    """Jitted `step_env` from OBS at time 0 with action 1, by done mode: `(weights)`."""

    def build(done):
        env = make_env(done=done)
        state = SyntheticState(vector=OBS, time=jnp.int32(0))
        return jax.jit(lambda w: env.step_env(jax.random.key(1), state, 1, env.params(w)))

    return {done: build(done) for done in DONE_MODES}


def constant_heads(env, **values):
    """Weights of an SE with which the networks named have constant outputs, and others 0."""
    shapes = jax.eval_shape(env.init_weights, jax.random.key(0))
    weights = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)
    for head, value in values.items():
        *_, last = sorted(weights[head])
        weights[head][last]["bias"][:] = value
    return weights


def networks_of(env, weights, inputs, *names):
    """What the networks make of inputs `[in]`, unit by unit."""
    return [numpy_forward(weights[name], inputs, CONFIG.activation, CONFIG.num_layers)
            for name in names]  # fmt: skip


@pytest.mark.parametrize("config", [{}, {"horizon": 1, "initial_state": "learned"}])
def test_continuous_actions_are_clipped_to_the_tasks_bounds(config):
    env = make_env("pendulum", **config)
    params = env.params(env.init_weights(jax.random.key(2)))
    _, state = env.reset_env(jax.random.key(0), params)
    step = jax.jit(lambda action: env.step_env(jax.random.key(1), state, action, params)[:3])
    far, high, inner, low, least = (bits(step(jnp.float32([x]))) for x in (50, 2, 1.9, -3, -2))
    assert far == high != inner and low == least


# --- equations -----------------------------------------------------------------------------------


@pytest.mark.parametrize("task", ["cartpole", "acrobot"])
def test_predict_equals_three_separate_mlps_fed_the_one_hot_action_first(task):
    env = make_env(task)
    num_actions, obs_dim = env.task.num_actions, env.task.obs_dim
    weights = env.init_weights(jax.random.key(3))
    predict = jax.jit(env.predict)
    for action in range(num_actions):
        obs = np.random.default_rng(action).normal(size=obs_dim)
        inputs = np.concatenate([np.eye(num_actions)[action], obs])  # action first
        state, reward, done = networks_of(env, weights, inputs, "state", "reward", "done")
        outputs = predict(weights, jnp.float32(obs), jnp.int32(action))
        assert_close(outputs, (state, reward[0], done[0]), rtol=1e-5, atol=1e-6)


def test_the_papers_se_for_cartpole_has_2247_parameters():
    # (6 * 83 + 83) * 3 for the hidden layers, (83 + 1) * (4 + 1 + 1) for the heads:
    # 1743 + 504 = 2247, as the authors' networks have.
    env = make_env(hidden_size=83, num_layers=1)
    weights = jax.eval_shape(env.init_weights, jax.random.key(0))
    assert sum(x.size for x in jax.tree.leaves(weights)) == 2247


@pytest.mark.parametrize("mode", ["soft", "threshold"])
def test_an_episode_terminates_where_the_done_output_exceeds_one_half(step, mode):
    for done in (-3.0, 0.0, 0.5, 0.501, 7.0):
        weights = constant_heads(make_env(), state=1.0, reward=2.0, done=done)
        obs, state, reward, terminated, info = step[mode](weights)
        # The predicted state itself; the reward of the last step counts.
        assert (obs == 1.0).all() and (state.vector == 1.0).all() and reward == 2.0
        assert terminated == (done > 0.5) and not info["nonfinite"]
        # soft: 1 - d, not confined to [0, 1]; threshold: 1 - [d > 0.5].
        expected = 1.0 - done if mode == "soft" else 1.0 - (done > 0.5)
        np.testing.assert_allclose(info["discount"], expected, rtol=1e-6)


# --- outputs that no world has -------------------------------------------------------------------


ABSURD = [
    *({"state": np.nan}, {"state": np.inf}, {"reward": np.nan}, {"reward": -np.inf}),
    *({"done": np.nan}, {"done": -np.inf}, {"state": 2 * MAX_ABS_VALUE}),
    *({"reward": -2 * MAX_ABS_VALUE}, {"done": -2 * MAX_ABS_VALUE}),
]


@pytest.mark.parametrize("mode", DONE_MODES)
def test_an_absurd_or_nonfinite_output_ends_the_episode_where_it_was(step, mode):
    for outputs in ABSURD:
        weights = constant_heads(
            make_env(), **{"state": 1.0, "reward": 2.0, "done": 0.0, **outputs}
        )
        obs, state, reward, terminated, info = step[mode](weights)
        np.testing.assert_array_equal([obs, state.vector], [OBS, OBS])
        assert terminated and reward == 0.0 and info["discount"] == 0.0
        (value,) = outputs.values()
        assert info["nonfinite"] == (not np.isfinite(value))


def test_outputs_just_below_absurd_are_a_world(step):
    large = np.float32(0.99 * MAX_ABS_VALUE)
    weights = constant_heads(make_env(), state=large, reward=large)
    obs, _, reward, terminated, info = step["soft"](weights)
    assert (obs == large).all() and reward == large
    assert not terminated and not info["nonfinite"]


# --- ends by chance ------------------------------------------------------------------------------

D = np.array([-np.inf, -0.5, 0.0, 0.1, 0.5, 0.9, 1.0, 7.0, np.inf])


def test_a_drawn_end_comes_as_often_as_the_done_output_says():
    num_keys = 10_000
    ends = jax.vmap(jax.vmap(make_env(done="bernoulli").ends, (0, None)), (None, 0))
    keys = jax.random.split(jax.random.key(0), num_keys)
    shares = np.asarray(jax.jit(ends)(keys, jnp.float32(D)).mean(axis=1))
    for share, probability in zip(shares, np.clip(D, 0, 1), strict=True):
        # The limits are exact, what lies between them is within 5 standard errors.
        error = np.sqrt(probability * (1 - probability) / num_keys)
        assert share == probability if error == 0 else abs(share - probability) < 5 * error


# --- learned beginnings --------------------------------------------------------------------------


@pytest.mark.parametrize(("task", "horizon"), [("cartpole", None), ("cliff_walking", 1)])
def test_learned_starts_are_normal_noise_moved_by_a_network(task, horizon):
    env = make_env(task, initial_state="learned", horizon=horizon)
    params = env.params(env.init_weights(jax.random.key(2)))
    keys = jax.random.split(jax.random.key(0), 4)
    obs, state = jax.jit(jax.vmap(env.reset_env, (0, None)))(keys, params)
    for key, seen, start in zip(keys, obs, state.vector, strict=True):
        noise = jax.random.normal(key, (env.task.obs_dim,))
        expected = noise + numpy_forward(params.weights["start"], noise, CONFIG.activation, 1)
        np.testing.assert_allclose(start, expected, rtol=1e-5, atol=1e-6)
        # Where states are discrete the agent sees the index of the largest entry.
        np.testing.assert_array_equal(seen, np.argmax(start) if task == "cliff_walking" else start)
    np.testing.assert_array_equal(state.time, 0)
    assert len(np.unique(np.asarray(state.vector), axis=0)) == 4


def test_starts_of_noise_are_that_in_the_units_of_the_networks():
    env = make_env("pendulum", initial_state="noise", state_units="bounds", horizon=1)
    weights = env.init_weights(jax.random.key(2))
    assert set(weights) == {"reward"}
    obs, state = env.reset_env(jax.random.key(0), env.params(weights))
    # Bounds of 1, 1 and 8: half of the way there is 1.
    expected = np.array([0.5, 0.5, 4.0]) * jax.random.normal(jax.random.key(0), (3,))
    np.testing.assert_allclose(state.vector, expected, rtol=1e-6)
    np.testing.assert_array_equal(obs, state.vector)


def test_units_of_bounds_are_from_the_middle_with_half_of_the_way_as_one():
    """MountainCar: positions in [-1.2, 0.6], velocities in [-0.07, 0.07]."""
    env = make_env("mountain_car", state_units="bounds", done="threshold")
    assert env.config.units([2.0], [2.0]).scale == 1.0  # a number that is constant
    middle, one = np.array([-0.3, 0.0]), np.array([0.45, 0.035])
    obs, weights = np.array([0.2, -0.05]), env.init_weights(jax.random.key(3))
    seen = np.concatenate([[0, 1, 0], (obs - middle) / one])
    state, reward, _ = env.predict(weights, jnp.float32(obs), jnp.int32(1))
    change, paid = networks_of(env, weights, seen, "state", "reward")
    assert_close((state, reward), (middle + one * change, paid[0]), rtol=1e-5, atol=1e-6)


def test_no_two_networks_begin_with_the_same_numbers():
    weights = make_env(initial_state="learned").init_weights(jax.random.key(0))
    assert set(weights) == {"state", "reward", "done", "start"}
    kernels = [np.asarray(net["Dense_0"]["kernel"]) for net in weights.values()]
    drawn = [x.ravel()[:16] * np.sqrt(x.shape[1]) for x in kernels]  # from U(-1, 1)
    for a, b in itertools.combinations(drawn, 2):
        assert not np.isclose(a, b, rtol=1e-3).any()


def test_a_discrete_task_goes_on_from_the_vector_and_not_from_what_is_seen():
    env = make_env("cliff_walking", initial_state="learned")
    params = env.params(env.init_weights(jax.random.key(2)))
    _, state = env.reset_env(jax.random.key(0), params)
    obs, after, *_ = env.step_env(jax.random.key(1), state, 3, params)
    inputs = np.concatenate([[0.0, 0.0, 0.0, 1.0], state.vector])
    (expected,) = networks_of(env, params.weights, inputs, "state")
    np.testing.assert_allclose(after.vector, expected, rtol=1e-4, atol=1e-6)
    assert obs == np.argmax(after.vector) and env.observation_space().contains(obs)


@pytest.mark.parametrize("start", [2 * MAX_ABS_VALUE, -np.inf, np.nan])
def test_an_absurd_start_is_an_episode_of_one_step_that_pays_nothing(start):
    env = make_env(initial_state="learned", horizon=1)
    params = env.params(constant_heads(env, start=start, reward=1.0))
    obs, state = env.reset_env(jax.random.key(0), params)
    np.testing.assert_array_equal(obs, np.clip(start, -MAX_ABS_VALUE, MAX_ABS_VALUE) + np.zeros(4))
    _, _, reward, terminated, info = env.step_env(jax.random.key(1), state, 0, params)
    assert terminated and reward == 0.0 and info["discount"] == 0.0
    assert info["nonfinite"] == np.isnan(start)


# --- horizons ------------------------------------------------------------------------------------


def walk(env, weights, num_steps=3):
    """`(terminated, truncated, discount)` of the first steps of an episode, `[step]` each."""
    params = env.params(weights)

    def step(state, key):
        _, state, _, terminated, info = env.step_env(key, state, 1, params)
        return state, (terminated, env.is_truncated(state, params), info["discount"])

    _, state = env.reset_env(jax.random.key(0), params)
    return jax.lax.scan(step, state, jax.random.split(jax.random.key(1), num_steps))[1]


THRESHOLD, LATE = {"done": "threshold"}, {"min_steps": 3}
ENDING = {"horizon": 3}
NO, LAST = [False] * 3, [False, False, True]


@pytest.mark.parametrize(
    ("config", "outputs", "terminated", "truncated", "discounts"),
    [
        # d = 0.25 ends nothing. Soft: targets bootstrap with 0.75, at a terminal horizon with 0.
        (ENDING, {"done": 0.25}, LAST, NO, [0.75, 0.75, 0]),
        (ENDING | THRESHOLD, {"done": 0.25}, LAST, NO, [1, 1, 0]),
        (ENDING | THRESHOLD, {"done": 0.6}, [True], [False], [0]),  # before the horizon
        # Steps 1 and 2 end nothing, whatever d says; step 3 is as it would be without min_steps=3.
        (LATE | THRESHOLD, {"done": 1.0}, LAST, NO, [1, 1, 0]),
        (LATE | THRESHOLD, {"done": 0.0}, NO, NO, [1, 1, 1]),
        (LATE | {"done": "bernoulli"}, {"done": 1.0}, LAST, NO, [1, 1, 0]),
        (LATE, {"done": 0.25}, NO, NO, [1, 1, 0.75]),
        (LATE, {"done": 1.5}, LAST, NO, [1, 1, -0.5]),
        (LATE, {"reward": np.nan}, [True], [False], [0]),  # absurd
    ],
    ids=str,
)
def test_horizons_and_least_numbers_of_steps(config, outputs, terminated, truncated, discounts):
    env = make_env(**config)
    walked = walk(env, constant_heads(env, **outputs), num_steps=len(terminated))
    np.testing.assert_array_equal(walked[0], terminated)
    np.testing.assert_array_equal(walked[1], truncated)  # as in sejax.gym
    np.testing.assert_allclose(walked[2], discounts)
    limit = config.get("horizon", 200)
    assert not steps_are_real(env) and env.max_steps == limit
    assert env.default_params.max_steps_in_episode == limit


def test_a_bandit_has_a_reward_and_nothing_else():
    env = make_env(horizon=1)
    weights = env.init_weights(jax.random.key(4))
    assert set(weights) == {"reward"} and env.max_steps == 1
    params = env.params(weights)
    start, state = env.reset_env(jax.random.key(0), params)
    real, _ = env.task.env.reset_env(jax.random.key(0), env.task.params)
    (expected,) = networks_of(env, weights, np.concatenate([[0.0, 1.0], start]), "reward")
    for done in DONE_MODES:
        step = make_env(horizon=1, done=done).step_env
        obs, _, reward, terminated, info = step(jax.random.key(1), state, 1, params)
        np.testing.assert_array_equal([obs, start], [real, real])
        np.testing.assert_allclose(reward, expected[0], rtol=1e-5)
        assert terminated and info["discount"] == 0.0 and not info["nonfinite"]


@pytest.mark.parametrize("fields", [
    {"done": "maybe"}, {"initial_state": "any"}, {"horizon": 0}, {"min_steps": 0},
    {"min_steps": 4, "horizon": 3},
])  # fmt: skip
def test_what_no_episode_can_be_is_refused(fields):
    assert refused(paper_se, **fields) == f"proxy.{next(iter(fields))}"


# --- as a gymnax environment ---------------------------------------------------------------------


def test_plain_gymnax_usage_counts_time_truncates_at_the_limit_and_resets():
    env = make_env()
    # d = 0.25 never terminates: the episode runs to the real task's limit.
    params = env.params(constant_heads(env, state=0.7, reward=1.5, done=0.25))
    assert params.max_steps_in_episode == 200
    obs, state = env.reset(jax.random.key(0), params)
    for t in range(1, 4):
        obs, state, reward, terminated, truncated, info = env.step(
            jax.random.key(t), state, env.action_space(params).sample(jax.random.key(t)), params
        )
        assert state.time == t
        assert not terminated and not truncated and reward == 1.5
    state = state.replace(time=jnp.int32(199))
    obs, state, reward, terminated, truncated, info = env.step(jax.random.key(9), state, 0, params)
    assert truncated and not terminated and reward == 1.5
    assert info["discount"] == 0.75  # a learned discount: the limit itself does not cut it
    np.testing.assert_allclose(info["final_observation"], 0.7)
    assert state.time == 0 and np.abs(obs).max() <= 0.05  # the next episode has begun


def test_spaces_and_names_are_those_of_the_task():
    env = make_env("acrobot")
    assert env.num_actions == 3 and env.observation_space().shape == (6,)
    assert env.name == "Synthetic-acrobot" and not steps_are_real(env) and env.max_steps == 500
    assert not steps_are_real(Wrapper(env)) and steps_are_real(Wrapper(env.task.env))
    assert make_env("acrobot") is env  # one instance for each configuration


# --- a reward of a known form --------------------------------------------------------------------

DISTANCE = SyntheticConfig(
    hidden_size=8, horizon=1, initial_state="noise", state_units="bounds", reward_form="distance",
)  # fmt: skip
STATE = jnp.array([0.6, 0.8, -2.0])


def distance_se():
    env = DISTANCE.make(envs.make("pendulum"))
    return env, env.init_weights(jax.random.key(3))


def step_reward(env, weights, obs, action):
    """As an agent would meet it."""
    params = env.params(weights)
    _, state = env.reset_env(jax.random.key(0), params)
    state = state.replace(vector=jnp.asarray(obs))
    return float(env.step_env(jax.random.key(0), state, jnp.asarray(action), params)[2])


def test_the_reward_of_a_distance_is_what_the_form_says():
    env, weights = distance_se()
    # The network by hand: leaky ReLUs of the state in units of half the way to the bounds.
    seen = np.asarray(STATE) / np.array([0.5, 0.5, 4.0])
    output = numpy_forward(weights["reward"], seen, "leaky_relu", 1)
    best = 2.0 * np.clip(output, -1, 1)
    for action in (-2.0, 0.3, 5.0):  # the last is clipped to 2
        wanted = -abs(min(action, 2.0) - best[0])
        assert step_reward(env, weights, STATE, [action]) == pytest.approx(wanted, rel=1e-4)


@pytest.mark.parametrize("words", [
    ["proxy.reward_form=distance", "env=cartpole", "proxy.horizon=1"],
    ["proxy.reward_form=distance", "env=pendulum", "proxy.horizon=null"],
])  # fmt: skip
def test_a_form_of_the_reward_that_cannot_be_is_refused(words):
    assert refused(sejax.config, words) == words[0].partition("=")[0]
