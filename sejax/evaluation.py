"""Greedy episodes on the real task, and fresh agents that are trained and then tested there.

Source: paper, Algorithm 1 (TrainAgent, EvaluateAgent) and section "Performance of SE-trained
Agents".
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PyTree

from sejax.agents.base import Agent, AgentSpec, AgentState, Hparams, require_agent
from sejax.agents.buffers import no_buffer
from sejax.agents.varied import for_keys
from sejax.envs.base import Task, require_own_steps
from sejax.envs.environment import Environment, spaces_of
from sejax.envs.spec import sizes_of
from sejax.envs.wrappers import repeat_actions
from sejax.objectives import Outcome
from sejax.ops.keys import step_keys
from sejax.ops.loops import while_any_active
from sejax.ops.parallel import compiler_options, in_batches_on_cpu, spread_over_devices
from sejax.options import LARGEST, require
from sejax.options.registry import require_part
from sejax.proxies.base import ProxyEnv, steps_are_real
from sejax.training import TrainingConfig, TrainResult, cpu_num_parallel_of, make_trainer

# --- greedy episodes ------------------------------------------------------------------------------


class Steps(NamedTuple):
    """Steps of greedy episodes, leaves `[step, ...]`; rows after an episode's end are not valid."""

    obs: Array
    action: Array
    next_obs: Array
    reward: Float[Array, " step"]
    terminated: Bool[Array, " step"]
    valid: Bool[Array, " step"]


class Tests(NamedTuple):
    """Results of greedy episodes.

    Attributes:
      returns: return of each episode within the task's step limit.
      num_steps: steps of each.
      scored: sum of `info["scored_reward"]`, or of the reward in steps without that entry.
    """

    returns: Float[Array, " episode"]
    num_steps: Int[Array, " episode"]
    scored: Float[Array, " episode"]


class _Episode(struct.PyTreeNode):
    """Carry of an episode."""

    active: Array
    num_steps: Array  # of the task
    total: Array
    scored: Array
    obs: Array
    env_state: PyTree


def _begun(env: Environment, key: Array, active: Array | bool, params: PyTree) -> _Episode:
    """A greedy episode before its first step."""
    obs, env_state = env.reset_env(key, params)
    return _Episode(
        active=jnp.asarray(active),
        num_steps=jnp.int32(0),
        total=jnp.float32(0),
        scored=jnp.float32(0),
        obs=obs,
        env_state=env_state,
    )


def _stepped(
    agent: Agent,
    env: Environment,
    key: Array,
    agent_state: AgentState,
    before: _Episode,
    params: PyTree,
) -> tuple[_Episode, Steps]:
    """A greedy episode after one more step, and that step; `key` is that of the whole episode."""
    key_act, key_env = step_keys(key, before.num_steps, 2)
    action = agent.env_action(agent.act(key_act, agent_state, before.obs, explore=False))
    obs, env_state, reward, terminated, info = env.step_env(
        key_env, before.env_state, action, params
    )
    after = _Episode(
        active=~(terminated | env.is_truncated(env_state, params)),
        num_steps=before.num_steps + info.get("sejax_num_steps", 1),
        total=before.total + reward,
        scored=before.scored + info.get("scored_reward", reward),
        obs=obs,
        env_state=env_state,
    )
    return after, Steps(before.obs, action, obs, jnp.float32(reward), terminated, before.active)


def make_tester(
    agent: Agent,
    task: Task,
    num_episodes: int,
    test_env: Callable[[Environment], Environment] = lambda env: env,
) -> Callable[..., Tests]:
    """Builds `test(key, agent_state, active=True, params=None) -> Tests`.

    It plays episodes on the real task without exploration, each from a fresh initial state. With
    `active=False` it plays nothing and all results are 0.

    Args:
      agent: chooses the actions.
      task: the real task; its params are the default of `params`.
      num_episodes: episodes of each test.
      test_env: maps the task's environment, with the agent's action repeat, to the environment of
        the episodes; by default the same one.
    """
    env = test_env(repeat_actions(task.env, agent.spec.action_repeat))

    def step(
        nothing: Array, state: _Episode, consts: PyTree, masked: bool
    ) -> tuple[Array, _Episode]:
        key, agent_state, params = consts
        # Resolved here too: as a part of `consts` the task's would be no constants to XLA.
        params = task.params if params is None else params
        return nothing, _stepped(agent, env, key, agent_state, state, params)[0]

    def episode(key: Array, agent_state: AgentState, active: Array | bool, params: PyTree) -> Tests:
        key_reset, key_steps = jax.random.split(key)
        state = _begun(env, key_reset, active, task.params if params is None else params)
        _, state = while_any_active(step, jnp.zeros(0), state, (key_steps, agent_state, params))
        return Tests(state.total, state.num_steps, state.scored)

    def test(
        key: Array, agent_state: AgentState, active: Array | bool = True, params: PyTree = None
    ) -> Tests:
        keys = jax.random.split(key, num_episodes)
        return jax.vmap(episode, in_axes=(0, None, None, None))(keys, agent_state, active, params)

    return test


def make_recorder(
    agent: Agent, task: Task, num_episodes: int
) -> Callable[[Array, AgentState], Steps]:
    """Builds `record(key, agent_state) -> Steps`, leaves `[num_episodes * decisions, ...]`.

    The episodes are those of `make_tester` with the same key. A decision is one step here, even if
    the agent repeats its action: an episode has `max_steps / action_repeat` of them, rounded up.
    """
    env = repeat_actions(task.env, agent.spec.action_repeat)

    def episode(key: Array, agent_state: AgentState) -> Steps:
        key_reset, key_steps = jax.random.split(key)

        def step(state: _Episode, _: None) -> tuple[_Episode, Steps]:
            after, steps = _stepped(agent, env, key_steps, agent_state, state, task.params)
            return after.replace(active=state.active & after.active), steps

        start = _begun(env, key_reset, True, task.params)
        return jax.lax.scan(step, start, length=-(-task.max_steps // agent.spec.action_repeat))[1]

    def record(key: Array, agent_state: AgentState) -> Steps:
        keys = jax.random.split(key, num_episodes)
        steps = jax.vmap(episode, in_axes=(0, None))(keys, agent_state)
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), steps)

    return record


def make_fixed(task: Task, act: Callable[[Array, Any, Array], Array]) -> Agent:
    """A policy as an agent, for `make_tester` and `make_recorder`; it learns nothing.

    Args:
      task: gives the observations and actions.
      act: `(key, state, obs) -> action`; the agent's state is whatever the policy needs.

    Example:
      >>> import sejax
      >>> task = sejax.envs.make("cartpole")
      >>> agent = make_fixed(task, lambda key, gain, obs: (obs[2] + gain * obs[3] > 0).astype(int))
      >>> make_tester(agent, task, 3)(jax.random.key(0), 0.5).returns.tolist()
      [200.0, 200.0, 200.0]
    """
    return Agent(
        init=lambda key, hparams: (),
        act=lambda key, state, obs, /, explore: act(key, state, obs),
        update=lambda key, state, batch: state,
        buffer=no_buffer(),
        hparams=Hparams(),
        spec=AgentSpec(sizes=sizes_of(task.observation, task.action)),
    )


# --- one fresh agent ------------------------------------------------------------------------------


def make_evaluator(
    agent: Agent,
    env: Environment,
    task: Task,
    training: TrainingConfig,
    test_env: Callable[[Environment], Environment] = lambda env: env,
    in_batches: bool = True,
) -> Callable[..., Outcome]:
    """Builds `evaluate(key, env_params, active=True, test_params=None) -> Outcome`.

    A fresh agent trains in `env`, which may be a proxy or the task itself, and is tested over
    `training.test_episodes` episodes on the task. With `active=False` no step is taken. Varied
    hyperparameters of the agent are drawn first, from the same key. `test_params` are the params of
    the test episodes; default: the task's.

    Args:
      agent: from `sejax.make_agent`, or one of your own.
      env: gymnax environment to train in.
      task: the real task.
      training: stopping rule and limits.
      test_env: maps the task's environment to that of the test after the training. A test's
        `scored_returns` add up its `info["scored_reward"]`.
      in_batches: as in `make_trainer`.

    Raises:
      ConfigError: for arguments of the wrong kind, or if a test episode may be far longer than the
        training.

    Source: paper, Algorithm 1, TrainAgent and EvaluateAgent.

    Example:
      >>> import sejax
      >>> env, params = sejax.load("cartpole")
      >>> agent, training = sejax.agent_of(env), sejax.training_of(env)
      >>> evaluate = make_evaluator(agent, env, env.task, training)
      >>> outcome = jax.eval_shape(evaluate, jax.random.key(0), params)
      >>> outcome.test_returns.shape
      (10,)
    """
    require_part("task", Task, task, "Set task=env.task of a proxy, or sejax.envs.make(name).")
    require_own_steps(env)
    is_same = sizes_of(*spaces_of(env)) == sizes_of(task.observation, task.action)
    require(is_same, "env", f"must have the spaces of {task.name}", fix="Set task=env.task.")
    require_agent(agent, task.observation, task.action)
    require_part("training", TrainingConfig, training)
    # A test of an agent that has not learned may last to the task's limit.
    most = 1000 * max(training.max_steps or LARGEST, 1000)
    rule = f"must be at most {most:,}"
    require(task.max_steps <= most, "env.max_steps", rule, got=f"{task.max_steps:,}", use=1000)

    def make_run(agent: Agent) -> Callable[..., Outcome]:
        test = make_tester(agent, task, training.test_episodes, test_env)
        train = make_tested_trainer(agent, env, task, training, in_batches=False)

        def run(
            key: Array, env_params: PyTree, active: Array, test_params: PyTree, hparams: Hparams
        ) -> Outcome:
            key_train, key_test = jax.random.split(key)
            result = train(key_train, env_params, hparams, active)
            tests = test(key_test, result.agent_state, active, test_params)
            real_steps = tests.num_steps.sum() + result.test_steps
            return Outcome(
                test_returns=tests.returns,
                scored_returns=tests.scored,
                train_steps=result.train_steps,
                train_episodes=result.episodes,
                auc=area_under_curve(result, tests.returns.mean()),
                nonfinite=result.nonfinite | ~jnp.isfinite(tests.returns).all(),
                real_steps=real_steps + result.train_steps if steps_are_real(env) else real_steps,
            )

        return run

    run = agent.with_hparams(make_run)
    if in_batches:
        run = in_batches_on_cpu(run, cpu_num_parallel_of(agent, training))
    return lambda key, env_params, active=True, test_params=None: run(
        key, env_params, jnp.asarray(active), test_params
    )


def make_tested_trainer(
    agent: Agent, env: Environment, task: Task, training: TrainingConfig, **options: Any
) -> Callable[..., TrainResult]:
    """As `make_trainer`; tests between episodes, if `training` asks for any, are on the task.

    If it asks for none, `make_trainer` leaves the tester out. On a task without a solved reward
    `stop_rule=solved` ends no training, so that it counts as `never`.

    Args:
      agent: from `sejax.make_agent`.
      env: gymnax environment to train in.
      task: the real task.
      training: stopping rule and limits.
      **options: further arguments of `make_trainer`.

    Source: paper, section "Experiments with Reward Networks" (training and testing alternate).
    """
    if training.stop_rule == "solved" and not task.is_solvable:  # tests would end no training
        training = dataclasses.replace(training, stop_rule="never")
    test = make_tester(agent, task, training.tests_after_each)

    def test_between(key: Array, agent_state: AgentState, active: Array) -> tuple[Array, Array]:
        tests = test(key, agent_state, active)
        return tests.returns.mean(), tests.num_steps.sum()

    return make_trainer(agent, env, training, task.solved_reward, test_fn=test_between, **options)


def tested_throughout(training: TrainingConfig) -> TrainingConfig:
    """The same training with tests between its episodes, and no stop when the task is solved.

    If the learning curve ended there, the area under it would reward late learning.
    """
    stop_rule = "never" if training.stop_rule == "solved" else training.stop_rule
    tests_between = max(1, training.tests_after_each)
    return dataclasses.replace(training, stop_rule=stop_rule, tests_between=tests_between)


def area_under_curve(result: TrainResult, final_return: Array) -> Array:
    """Sum over training episodes of return times length: the area under the learning curve.

    Args:
      result: result of a training. If it has test returns, they replace the training returns.
      final_return: return of the test after the training; counts for the steps of an episode that
        the step limit cut off.

    Source: paper, appendix "Studying the Influence of Different Reward Network Optimization
    Objectives" (AUC); `docs/reference.md` 5.5.
    """
    returns = result.returns if result.test_returns is None else result.test_returns
    lengths = jnp.diff(result.episode_ends, prepend=0)
    finished = jnp.arange(lengths.size) < result.episodes
    rest = result.train_steps - result.episode_ends.max()
    return jnp.sum(jnp.where(finished, returns * lengths, 0.0)) + final_return * rest


# --- many fresh agents ----------------------------------------------------------------------------


def evaluate_agents(
    agent: Agent,
    env: Environment,
    env_params: PyTree,
    task: Task,
    training: TrainingConfig,
    keys: Array,
    *,
    devices: int | None = None,
    num_parallel: int | None = None,
) -> Outcome:
    """Trains and tests one fresh agent for each key, over all devices; leaves `[agent]`.

    `sejax.load` returns `env, env_params`; `task` is the real task. Calls with equal arguments
    share a compiled program; `env_params` and values of `keys` may differ, but that keys of varied
    agents must draw networks of the same sizes. Results equal those of
    `jax.vmap(make_evaluator(...))` up to rounding: programs of another width add in another order,
    and a training amplifies a difference in the last bit.

    Not for code inside `jit` or `vmap`, which `make_evaluator` serves.

    Args:
      agent: from `sejax.make_agent`, or one of your own.
      env: environment to train in, a proxy or the task's.
      env_params: its params.
      task: the real task.
      training: stopping rule and limits.
      keys: `[agent]`, as `jax.random.split(key, n)` makes them.
      devices: the first ones are used; None for all.
      num_parallel: agents side by side on a device; None for what suits agent and device.

    Raises:
      ConfigError: as `make_evaluator`, or for a single key.
    """
    shape = jax.random.key_data(keys).shape if hasattr(keys, "dtype") else ()
    require(len(shape) == 2, "keys", "must be several", use="jax.random.split(key, 20)")
    env = env.bare if isinstance(env, ProxyEnv) else env
    program = _evaluation_program(for_keys(agent, keys), env, task, training, devices, num_parallel)
    return program(keys, env_params)


@functools.lru_cache(maxsize=64, typed=True)  # `devices=True` is not 1: it must raise
def _evaluation_program(
    agent: Agent,
    env: Environment,
    task: Task,
    training: TrainingConfig,
    devices: int | None,
    num_parallel: int | None,
) -> Callable[[Array, PyTree], Outcome]:
    """The compiled program of `evaluate_agents`: `(keys, env_params) -> Outcome`."""
    evaluate = make_evaluator(agent, env, task, training, in_batches=False)

    def program(keys: Array, env_params: PyTree) -> PyTree:
        width = cpu_num_parallel_of(agent, training, keys.shape[0])
        train = functools.partial(evaluate, env_params=env_params)
        spread = spread_over_devices(
            train, num_devices=devices, num_parallel=num_parallel, cpu_num_parallel=width
        )
        return spread(keys)

    return jax.jit(program, compiler_options=compiler_options())
