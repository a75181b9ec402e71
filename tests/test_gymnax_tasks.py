"""Any environment of gymnax as a task: vectors in, vectors out, limits kept, faults told."""

import copy
import math
from pathlib import Path
from typing import NamedTuple

import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments import spaces
from gymnax.environments.classic_control import cartpole
from gymnax.registration import registered_envs
from gymnax.wrappers.purerl import StickyActionWrapper
from support import assert_equal, paper_se, refusal, refused

import sejax
from sejax import envs
from sejax.envs.base import Task
from sejax.envs.gymnax import PREFIX, SOLVED_REWARD, GymnaxTask
from sejax.envs.spec import Box
from sejax.envs.wrappers import AsVectors
from sejax.options import registry

DOWNLOADS = {"MNISTBandit-bsuite"}  # what it plays with
# Not those that a test beside this one may have registered (`sejax.register_gymnax`).
IDS = [x for x in registered_envs if "/" not in x and x not in DOWNLOADS]
KEY = jax.random.key(0)
# One that is flattened, one whose observations are integers in spite of its space, one of indices.
TAKEN = ["Catch-bsuite", "FourRooms-misc", "FrozenLake-misc"]


def task_of(gymnax_id, **options):
    return envs.make(PREFIX + gymnax_id, **options)


@pytest.mark.parametrize("limit", [1, 10])
def test_an_environment_with_one_done_is_the_same_but_for_the_ends_of_its_step(limit):
    task = envs.make("cartpole")
    env, params = envs.with_one_done(task.env), task.params.replace(max_steps_in_episode=limit)
    _, state = env.reset(KEY, params)
    *same, terminated, truncated, info = task.env.step(KEY, state, 1, params)
    assert_equal(jax.jit(env.step)(KEY, state, 1, params), (*same, terminated | truncated, info))
    assert truncated == (limit == 1) and env.num_actions == 2


@pytest.mark.parametrize("gymnax_id", IDS)
def test_every_environment_of_gymnax_is_a_task(gymnax_id):
    """By its types; nothing is computed."""
    task = task_of(gymnax_id)
    env, params = task.env, task.params
    obs, state = jax.eval_shape(env.reset, KEY, params)
    action = jax.eval_shape(env.action_space(params).sample, KEY)
    after, next_state, reward, terminated, _ = jax.eval_shape(
        env.step_env, KEY, state, action, params
    )
    if task.num_states is None:
        assert obs.shape == (task.obs_dim,) and obs.dtype == jnp.float32
    else:
        assert obs.shape == () and jnp.issubdtype(obs.dtype, jnp.integer)
    type_of = lambda x: (x.shape, x.dtype)  # noqa: E731
    assert jax.tree.map(type_of, (after, next_state)) == jax.tree.map(type_of, (obs, state))
    assert reward.shape == terminated.shape == () and terminated.dtype == bool
    if task.num_actions is None:
        assert action.shape == (task.action_dim,)
        space = env.action_space(params)
        np.testing.assert_array_equal(space.high, task.max_action)
        np.testing.assert_array_equal(space.low, -task.max_action)
    assert task.max_steps == params.max_steps_in_episode >= 1
    assert task.origin["name"] == task.name == PREFIX + gymnax_id and task is task_of(gymnax_id)


@pytest.mark.parametrize("gymnax_id", TAKEN)
def test_steps_are_those_of_gymnax_as_vectors(gymnax_id):
    task = task_of(gymnax_id)
    raw, params = gymnax.make(gymnax_id)

    def walk(env, key):
        obs, state = env.reset_env(key, params)
        return obs, *env.step_env(key, state, jnp.int32(1), params)

    both = jax.jit(lambda key: (walk(raw, key), walk(task.env, key)))
    (obs, next_obs, *expected), got = both(KEY)
    if not task.num_states:
        obs, next_obs = (np.float32(np.ravel(x)) for x in (obs, next_obs))
    expected[1] = np.float32(expected[1])  # the reward
    assert_equal(got, (obs, next_obs, *expected))
    assert all(x.dtype == y.dtype for x, y in zip(got[:2], (obs, next_obs), strict=True))


def test_limit_and_threshold_are_those_asked_for_or_known():
    assert task_of("CartPole-v1").max_steps == 500
    task = task_of("CartPole-v1", max_steps=7, solved_reward=100)
    assert task.max_steps == task.params.max_steps_in_episode == 7 and task.solved_reward == 100
    proxy = registry.make("proxy", paper_se(hidden_size=2), task)
    assert proxy.default_params.max_steps_in_episode == 7
    for limit in (0, 2**31):
        assert refused(task_of, "CartPole-v1", max_steps=limit) == "env.max_steps"
    assert {x: task_of(x).solved_reward for x in SOLVED_REWARD} == SOLVED_REWARD
    assert not task_of("MountainCar-v0", max_steps=100).is_solvable  # -100 is its worst return
    unknown = task_of("Catch-bsuite")
    assert unknown.solved_reward == math.inf and not unknown.is_solvable
    assert refused(sejax.RewardThreshold().make, unknown) == "objective"


def test_an_id_that_is_unknown_or_cannot_be_made_is_one_message(monkeypatch):
    assert "env must be one of gymnax/CartPole-v1, " in str(refusal(task_of, "CartPole-v7"))

    def make(_):
        raise OSError("no network\nat all")

    monkeypatch.setattr(gymnax, "make", make)
    error = refusal(GymnaxTask(name=f"{PREFIX}MNISTBandit-bsuite").make)
    assert error.field == "env" and "OSError: no network at all" in str(error)


def test_one_that_another_package_registers_is_a_task():
    if "sejax_tests/Mine-v0" not in registered_envs:
        gymnax.register("sejax_tests/Mine-v0", cartpole.CartPole)
    assert task_of("sejax_tests/Mine-v0").obs_dim == 4


# --- spaces that gymnax allows -------------------------------------------------------------------


class Plain:
    """An environment that has all that sejax uses, and is not derived from gymnax's."""

    default_params = gymnax.EnvParams(max_steps_in_episode=3)
    is_truncated = gymnax.environments.environment.Environment.is_truncated
    actions, observations = spaces.Discrete(2), spaces.Box(-1.0, 1.0, (2,))
    obs, reward, terminated = np.zeros(2), 0.0, np.bool_(False)

    def reset_env(self, key, params):
        return jnp.array(self.obs), gymnax.EnvState(time=jnp.int32(0))

    def step_env(self, key, state, action, params):
        after = state.replace(time=state.time + 1)
        return jnp.array(self.obs), after, self.reward, jnp.array(self.terminated), {}

    def action_space(self, params):
        return self.actions

    def observation_space(self, params):
        return self.observations


def changed(**attributes):
    """The plain environment but for these attributes."""
    return type("Changed", (Plain,), attributes)()


def echo(self, key, state, action, params):
    """The observation is what the action came to."""
    after = state.replace(time=state.time + 1)
    return jnp.resize(jnp.float32(action), self.obs.shape), after, 0.0, jnp.bool_(False), {}


def odd_task(actions, observations=Plain.observations):
    obs = np.zeros(getattr(observations, "shape", 2))
    env = changed(actions=actions, observations=observations, obs=obs, step_env=echo)
    return Task(name="odd", env=env)


def test_actions_of_an_asymmetric_box_are_scaled_to_its_bounds():
    low, high = jnp.array([[-1.0], [0.0]]), jnp.array([[3.0], [10.0]])
    box = spaces.Box(low, high, (2, 1))
    task = odd_task(box, box)
    assert isinstance(task.env, AsVectors)
    assert (task.action_dim, task.max_action, task.num_actions) == (2, 1.0, None)
    assert (task.observation.low, task.observation.high) == ((-1, 0), (3, 10))
    for action, expected in [
        ([-1.0, -1.0], [-1.0, 0.0]),  # the lower bounds
        ([1.0, 1.0], [3.0, 10.0]),  # the upper ones
        ([0.0, 0.0], [1.0, 5.0]),  # their middle
        ([-0.5, 0.5], [0.0, 7.5]),
        ([-2.0, 2.0], [-1.0, 10.0]),  # no further
    ]:
        obs, *_ = task.env.step_env(KEY, gymnax.EnvState(time=0), jnp.array(action), task.params)
        np.testing.assert_allclose(obs, expected, rtol=1e-6)


@pytest.mark.parametrize(("is_wrapped", "spaces_of_env"), [
    (False, (spaces.Discrete(2),)), (False, (spaces.Box(-2.0, 2.0, (1,)),)),
    (True, (spaces.Box(-2.0, 2.0, ()),)), (True, (spaces.Box(-2.0, 1.0, (1,)),)),
    (True, (spaces.Box(jnp.array([-1.0, -2.0]), jnp.array([1.0, 2.0]), (2,)),)),
    (True, (spaces.Discrete(2), spaces.Box(0, 1, (2, 2)))),
])  # fmt: skip
def test_environments_that_agents_can_take_as_they_are_are_left_alone(is_wrapped, spaces_of_env):
    assert isinstance(odd_task(*spaces_of_env).env, AsVectors) == is_wrapped


def test_uneven_actions_of_an_environment_of_sejax_are_scaled_too():
    env = copy.copy(envs.make("pendulum").env)
    env.spaces = env.spaces[0], Box((0.0,), (10.0,))
    task = Task(name="uneven", env=env)
    assert isinstance(task.env, AsVectors) and task.action == Box((-1.0,), (1.0,))


DICT, TUPLE = spaces.Dict({"x": spaces.Discrete(2)}), spaces.Tuple([spaces.Discrete(2)])


@pytest.mark.parametrize("spaces_of_env", [
    (DICT,), (TUPLE,), (spaces.Discrete(2), DICT), (spaces.Box(-jnp.inf, 1.0, (1,)),),
    (spaces.Box(-1.0, jnp.inf, (1,)),), (spaces.Box(1.0, 1.0, (1,)),),
])  # fmt: skip
def test_spaces_that_no_agent_could_use_are_refused(spaces_of_env):
    assert refused(odd_task, *spaces_of_env) == "env"


# --- environments with a fault -------------------------------------------------------------------


def drifts(self, key, state, action, params):
    return jnp.zeros(2), state.replace(time=jnp.float32(1)), 0.0, jnp.bool_(False), {}


class Limit(NamedTuple):
    max_steps_in_episode: int = 3


@pytest.mark.parametrize(("env", "options", "field"), [
    (changed(is_truncated=None), {}, "env"),
    (changed(action_space=lambda self, params: {}["actions"]), {}, "env"),
    (changed(step_env=lambda *args: (jnp.zeros(2), args[2], 0.0, False)), {}, "env"),
    (changed(obs=np.zeros(3)), {}, "env"),
    (changed(step_env=drifts), {}, "env"),
    (changed(step_env=lambda *args: (jnp.zeros(2), args[2], 0.0, jnp.bool_(False), {})), {}, "env"),
    (changed(terminated=np.float32(0)), {}, "env"),
    (changed(reward=np.zeros(2)), {}, "env"),
    (gymnax.make("CartPole-v1"), {}, "env"),  # a pair
    (Plain(), {"params": Limit(), "max_steps": 5}, "env"),
    (changed(action_space=lambda self, params: spaces.Discrete(params.max_steps_in_episode)),
     {"params": gymnax.EnvParams(max_steps_in_episode=5)}, "env"),
    (Plain(), {"params": gymnax.EnvState(time=0)}, "env"),
    (StickyActionWrapper(cartpole.CartPole(), 1.0), {}, "env"),  # whose step is never called
    (Plain(), {"solved_reward": "high"}, "env.solved_reward"),
    (Plain(), {"solved_reward": math.nan}, "env.solved_reward"),
    (Plain(), {"max_steps": 0}, "env.max_steps"),
])  # fmt: skip
def test_a_fault_is_told_before_an_agent_trains(env, options, field):
    assert Task(name="mine", env=Plain()).max_steps == 3
    assert refused(Task, name="mine", env=env, **options) == field


def reads(self, key, state, action, params):
    return jnp.zeros(2), state, float(action), jnp.bool_(False), {}


def test_a_fault_in_code_of_ones_own_is_told_with_its_place():
    error = refusal(Task, name="mine", env=changed(step_env=reads))
    said, line = str(error), reads.__code__.co_firstlineno + 1
    source = Path(__file__).read_text().splitlines()[line - 1].strip()
    assert error.field == "env" and "use jnp.where" in said
    assert f"test_gymnax_tasks.py:{line}: {source[:60]}" in said


def test_a_wrapper_that_hands_on_what_it_does_not_change_is_taken():
    class Half:
        def __init__(self, env):
            self.env = env

        def __getattr__(self, name):
            return getattr(self.env, name)

        def step_env(self, key, state, action, params):
            obs, state, reward, *rest = self.env.step_env(key, state, action, params)
            return obs, state, 2 * reward, *rest

    half = Task(name="half", env=Half(cartpole.CartPole()))
    _, state = half.env.reset_env(KEY, half.params)
    assert half.env.step_env(KEY, state, 0, half.params)[2] == 2
