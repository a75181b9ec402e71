"""Bandits that copy a policy: the null baseline of one-step SEs.

A one-step SE is a contextual bandit, and its reward is a policy. The cheapest such bandit is a
table: states, and what some policy does in each. An agent is shown one of the states, acts, and is
paid for acting as the table does. This module makes the policies (written by hand, trained for few
real steps, or searched) and the environment; `experiments.null_baselines` tests agents on it.
"""

import functools
import itertools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

import sejax
from sejax.agents import AgentConfig
from sejax.check import ARS
from sejax.distill.policy_search import (
    Policy,
    PolicySearchConfig,
    first_policy,
    linear_agent,
    make_search,
)
from sejax.envs.base import Task
from sejax.envs.environment import EnvState
from sejax.evaluation import make_fixed, make_recorder, make_tester
from sejax.ops.scores import reaches
from sejax.proxies.base import ProxyEnv, ProxyParams

Controller = Callable[[Array], Array]  # an observation [obs_dim] to an action

# Controllers in a line each, as a textbook has them; gains are first guesses and were not searched.
# MountainCar and Acrobot push along a velocity; Pendulum swings up by energy, and balances at the
# top.
BY_HAND: dict[str, Controller] = {
    "cartpole": lambda s: (0.1 * s[0] + 0.3 * s[1] + s[2] + 0.6 * s[3] > 0).astype(jnp.int32),
    "acrobot": lambda s: jnp.where(s[5] > 0, 2, 0),
    "mountain_car": lambda s: jnp.where(  # Z. Xiao's, of Gym's leaderboard
        (jnp.minimum(0.03 - 0.09 * (s[0] + 0.25) ** 2, 0.3 * (s[0] + 0.9) ** 4 - 0.008) < s[1])
        & (s[1] < 0.07 - 0.07 * (s[0] + 0.38) ** 2),
        2,
        0,
    ),
    "mountain_car_continuous": lambda s: jnp.sign(s[1:2]),
    "pendulum": lambda s: jnp.where(
        s[0] > 0.8, -10 * s[1] - 2 * s[2], s[2] * (15 * (1 - s[0]) - s[2] ** 2 / 2)
    ).clip(-2, 2)[None],
}
BY_HAND["cartpole_v1"] = BY_HAND["cartpole"]


class Copied(NamedTuple):
    """A policy's actions in some states, and what it took to get them.

    Attributes:
      states: `[state, obs_dim]`, in the task's units.
      actions: `[state]` int32, or `[state, action_dim]`.
      real_steps: steps on the real task that making it took, tests included.
      cpu_s: CPU seconds of that, without compilation.
      policy_return: mean return of the policy itself on the real task, over `TEST_EPISODES`.
    """

    states: np.ndarray
    actions: np.ndarray
    real_steps: int
    cpu_s: float
    policy_return: float


TEST_EPISODES = 10


@struct.dataclass
class BanditState(EnvState):
    obs: Array  # [obs_dim]
    action: Array  # what the policy does there
    time: Array | int


class PolicyBandit(ProxyEnv):
    """An environment of one-step episodes that pays for acting as a table does.

    The reward is 1 for the table's action and 0 for others; where actions are continuous, it is
    minus the mean distance to the table's. The weights are `{"states": [state, obs_dim],
    "actions": [state, ...]}`, so that one compiled program serves all tables of a size.
    """

    def __init__(self, task: Task):
        config = sejax.SyntheticConfig(initial_state="noise")
        super().__init__(task, config)

    def init_weights(self, key: Array) -> dict[str, Array]:
        """A table of one state of zeros, where the policy does nothing."""
        shape, dtype = ((1,), int) if self._is_discrete else ((1, self.task.action_dim), float)
        states, actions = jnp.zeros((1, self.task.obs_dim)), jnp.zeros(shape, dtype)
        return {"states": states, "actions": actions}

    @property
    def _is_discrete(self) -> bool:
        return self.task.num_actions is not None

    def reset_env(self, key: Array, params: ProxyParams) -> tuple[Array, BanditState]:
        states, actions = (jnp.asarray(params.weights[name]) for name in ("states", "actions"))
        i = jax.random.randint(key, (), 0, states.shape[0])
        state = BanditState(obs=states[i], action=actions[i], time=jnp.int32(0))
        return state.obs, state

    def step_env(
        self, key: Array, state: BanditState, action: Array, params: ProxyParams
    ) -> tuple[Array, BanditState, Float[Array, ""], Array, dict[Any, Any]]:
        if self._is_discrete:
            reward = jnp.float32(action == state.action)
        else:
            reward = -jnp.abs(action - state.action).mean()
        after = BanditState(obs=state.obs, action=state.action, time=state.time + 1)
        return state.obs, after, reward, jnp.bool_(True), {}

    def is_truncated(self, state: BanditState, params: ProxyParams) -> Array:
        """Never: the only step terminates the episode."""
        return jnp.bool_(False)

    def get_obs(self, state: BanditState, params: Any = None, key: Any = None) -> Array:
        return state.obs


# --- policies ------------------------------------------------------------------------------------


class Teacher(NamedTuple):
    """A policy, and what making it took; the next tests are not in it."""

    agent: sejax.Agent
    state: Any  # of the agent
    key: Array  # of the tests and states of `copy`
    real_steps: int
    cpu_s: float


def by_hand(task: Task, seed: int) -> Teacher:
    """The controller of `BY_HAND`, which takes no step.

    Raises:
      KeyError: where there is none.
    """
    return Teacher(_hand(task), (), jax.random.key(seed), real_steps=0, cpu_s=0.0)


@functools.cache
def _hand(task: Task) -> sejax.Agent:
    policy = BY_HAND[task.name]
    return make_fixed(task, lambda key, state, obs: policy(obs))


@functools.cache
def trained(task: Task, config: AgentConfig, real_steps: int, seed: int) -> Teacher:
    """An agent of this configuration that trains on the real task for a number of steps."""
    agent = sejax.make_agent(config, task)
    key_train, key_copy = jax.random.split(jax.random.key(seed))
    train = _trainer(task, agent, real_steps)
    started = time.process_time()
    result = jax.block_until_ready(train(key_train, task.params))
    cpu_s = time.process_time() - started
    return Teacher(agent, result.agent_state, key_copy, real_steps, cpu_s)


@functools.cache
def _trainer(task: Task, agent: sejax.Agent, real_steps: int) -> Callable[..., Any]:
    """A compiled training on the real task."""
    training = sejax.TrainingConfig(max_steps=real_steps, max_episodes=real_steps)
    train = jax.jit(sejax.make_trainer(agent, task.env, training))
    return train.lower(jax.random.key(0), task.params).compile()


def search_teacher(task: Task, real_steps: int, seed: int) -> Teacher:
    """A linear policy found by augmented random search, on rollouts alone.

    The search ends when the policy solves the task in `TEST_EPISODES` tests, or when `real_steps`
    are spent. Of all generations the one with the best tests is kept.

    Source: `sejax.distill.policy_search`. The stored rows are of a search of the same
    algorithm with the moments of observations from random episodes before it.
    """
    agent, init, generation = _search(task)
    key_search, key_copy = jax.random.split(jax.random.key(seed))
    policy = best = init
    best_return, used, started = -np.inf, 0, time.process_time()
    for i in itertools.count():
        policy, steps_used, tests = generation(jax.random.fold_in(key_search, i), policy)
        used += int(steps_used) + int(tests.num_steps.sum())
        if float(tests.returns.mean()) > best_return:
            best, best_return = policy, float(tests.returns.mean())
        if reaches(best_return, task.solved_reward) or used >= real_steps:
            break
    return Teacher(agent, best, key_copy, used, time.process_time() - started)


@functools.cache
def _search(task: Task) -> tuple[sejax.Agent, Policy, Callable[..., Any]]:
    """The linear policy as an agent, one that does nothing, and a compiled, tested generation."""
    search = make_search(PolicySearchConfig(**ARS), task)
    agent = linear_agent(task)

    def generation(key: Array, policy: Policy) -> tuple[Policy, Array, Any]:
        key_search, key_test = jax.random.split(key)
        policy, _, num_steps = search.generation(key_search, policy, 0)  # its step size stays
        return policy, num_steps, search.test(key_test, policy)

    init = first_policy(task)
    return agent, init, jax.jit(generation).lower(jax.random.key(0), init).compile()


# --- copies --------------------------------------------------------------------------------------


def copy(task: Task, teacher: Teacher, num_states: int, widen: float) -> Copied:
    """What a teacher does in states around those that it visits in its test episodes.

    Args:
      task: the real task.
      teacher: whose greedy actions are copied; its tests are further real steps.
      num_states: of the table; half of them are visited ones.
      widen: standard deviation of the Gaussian around the visited states, in units of theirs; 0 for
        visited states alone; inf for standard normal noise alone, in the units of the task's SEs,
        which is where their episodes begin.
    """
    test, greedy = _programs(task, teacher.agent)
    key_test, key_rows, key_noise = jax.random.split(teacher.key, 3)
    tests, steps = test(key_test, teacher.state)
    visited = steps.obs[np.asarray(steps.valid)]
    rows = jax.random.choice(key_rows, visited, (num_states,))
    noise = jax.random.normal(key_noise, rows.shape)
    is_wide = (jnp.arange(num_states) % 2 == 1)[:, None]
    if np.isinf(widen):
        config: Any = sejax.config([f"env={task.name}"]).proxy
        space: Any = task.observation
        states = config.units(space.low, space.high).decode(noise)
    else:
        states = jnp.where(
            is_wide & (widen > 0), visited.mean(0) + widen * (noise * visited.std(0)), rows
        )
    return Copied(
        states=np.asarray(states),
        actions=np.asarray(greedy(teacher.state, states)),
        real_steps=teacher.real_steps + int(tests.num_steps.sum()),
        cpu_s=teacher.cpu_s,
        policy_return=float(tests.returns.mean()),
    )


@functools.cache
def _programs(task: Task, agent: sejax.Agent) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Compiled tests with the steps of the same episodes, and greedy actions in many states."""
    test = make_tester(agent, task, TEST_EPISODES)
    record = make_recorder(agent, task, TEST_EPISODES)
    act = functools.partial(agent.act, explore=False)
    tested = jax.jit(lambda key, state: (test(key, state), record(key, state)))
    acts = jax.vmap(lambda state, obs: act(jax.random.key(0), state, obs), (None, 0))
    return tested, jax.jit(acts)
