"""Training fresh agents in a world and testing them on the real task.

Source: paper, Algorithm 1 (TrainAgent, EvaluateAgent) and section "Performance of SE-trained
Agents".
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, overload

import jax
import jax.numpy as jnp
from jaxtyping import Array

from sejax.agents.base import Agent
from sejax.envs.base import Task
from sejax.errors import require
from sejax.objectives import Outcome
from sejax.ops.parallel import compiler_options, spread_over_devices
from sejax.proxies.base import world_of
from sejax.rollout import Steps, make_recorder, make_tester
from sejax.training import TrainingConfig, TrainResult, make_trainer


@overload
def make_evaluator(
    agent: Agent, env: Any, task: Any, training: TrainingConfig, record: Literal[False] = False
) -> Callable[..., Outcome]: ...
@overload
def make_evaluator(
    agent: Agent, env: Any, task: Any, training: TrainingConfig, record: Literal[True]
) -> Callable[..., tuple[Outcome, Steps]]: ...
def make_evaluator(
    agent: Agent, env: Any, task: Any, training: TrainingConfig, record: bool = False
) -> Callable[..., Any]:
    """Builds `evaluate(key, env_params, active=True, score_steps=None) -> Outcome`.

    A fresh agent trains in `env`, which may be a proxy or the task itself, and is tested over
    `training.test_episodes` episodes on the task. With `active=False` nothing is computed. If the
    agent's hyperparameters are drawn, they are drawn from the same key first. `score_steps` is the
    length of the test episodes that the objective scores, the task's limit if not given.

    Args:
      agent: from `sejax.make_agent`, or one of your own.
      env: gymnax environment to train in.
      task: the real task.
      training: stopping rule and limits.
      record: whether it returns `(Outcome, Steps)`, with every step of the tests
        (`sejax.rollout.Steps`); the outcome is the same.

    Source: paper, Algorithm 1, TrainAgent and EvaluateAgent.

    Example:
      >>> import sejax
      >>> env, params = sejax.load("cartpole")
      >>> agent = sejax.make_agent(sejax.DDQNConfig(warmup_episodes=1), env.task)
      >>> training = sejax.TrainingConfig(max_steps=2000, max_episodes=2000, stop_rule="never")
      >>> evaluate = make_evaluator(agent, env, env.task, training)
      >>> outcome = jax.eval_shape(evaluate, jax.random.key(0), params)
      >>> outcome.test_returns.shape
      (10,)
    """

    require(
        isinstance(task, Task),
        "task",
        "be a sejax.Task",
        "agents are tested on it",
        type(task).__name__,
        "task=env.task of a proxy, or sejax.envs.make(name)",
    )

    def make_run(agent: Agent) -> Callable[..., Any]:
        test = make_tester(agent, task, training.test_episodes)
        recorded = make_recorder(agent, task, training.test_episodes) if record else None
        train = make_tested_trainer(agent, env, task, training)

        def run(
            key: Array, env_params: Any, active: Array | bool, score_steps: Any, hparams: Any
        ) -> Any:
            key_train, key_test = jax.random.split(key)
            result = train(key_train, env_params, hparams, active)
            tests = test(key_test, result.agent_state, active, score_steps)
            real_steps = tests.num_steps.sum() + result.test_steps
            outcome = Outcome(
                test_returns=tests.returns,
                scored_returns=tests.scored,
                train_steps=result.train_steps,
                train_episodes=result.episodes,
                return_area=return_area(result, tests.returns.mean()),
                nonfinite=result.nonfinite | ~jnp.isfinite(tests.returns).all(),
                real_steps=real_steps + result.train_steps if world_of(env).is_real else real_steps,
            )
            return (outcome, recorded(key_test, result.agent_state)) if recorded else outcome

        return run

    run = agent.fresh(make_run)
    return lambda key, env_params, active=True, score_steps=None: run(
        key, env_params, active, score_steps
    )


def num_parallel_on_cpu(agent: Agent, training: TrainingConfig) -> int | None:
    """Agents in lockstep on a CPU core: 1 where they would wait for the one that trains longest."""
    num_parallel = agent.spec.cpu_num_parallel
    return 1 if num_parallel is not None and not training.is_fixed_length else num_parallel


def make_tested_trainer(
    agent: Agent, env: Any, task: Any, training: TrainingConfig, **options: Any
) -> Callable[..., TrainResult]:
    """A `make_trainer` whose tests between episodes, if `training` asks for any, are on the task.

    Args:
      agent: from `sejax.make_agent`.
      env: gymnax environment to train in.
      task: the real task.
      training: stopping rule and limits.
      **options: of `make_trainer`.

    Source: paper, section "Experiments with Reward Networks" (training and testing alternate).
    """
    test = make_tester(agent, task, max(1, training.num_tests_between))

    def test_between(key: Array, agent_state: Any, active: Array) -> tuple[Array, Array]:
        tests = test(key, agent_state, active)
        return tests.returns.mean(), tests.num_steps.sum()

    return make_trainer(agent, env, training, task.solved_reward, test_fn=test_between, **options)


def tested_throughout(training: TrainingConfig) -> TrainingConfig:
    """The same training with tests between its episodes, which goes on when the task is solved.

    The area under a learning curve that ended there would reward learning late.
    """
    stop_rule = "never" if training.stop_rule == "solved" else training.stop_rule
    tests_between = max(1, training.num_tests_between)
    return dataclasses.replace(training, stop_rule=stop_rule, tests_between=tests_between)


def return_area(result: TrainResult, final_return: Array) -> Array:
    """Sum over training episodes of return times length: the area under the learning curve.

    Args:
      result: of a training. The returns are those of its tests, where it had any.
      final_return: of the test after it, for the steps of an episode that the step limit cut off.

    Source: paper, appendix "Studying the Influence of Different Reward Network Optimization
    Objectives" (AUC); `docs/reference.md` 5.5.
    """
    returns = result.returns if result.test_returns is None else result.test_returns
    lengths = jnp.diff(result.episode_ends, prepend=0)
    finished = jnp.arange(lengths.size) < result.episodes
    rest = result.train_steps - result.episode_ends.max()
    return jnp.sum(jnp.where(finished, returns * lengths, 0.0)) + final_return * rest


def evaluate_agents(
    agent: Agent,
    env: Any,
    env_params: Any,
    task: Any,
    training: TrainingConfig,
    keys: Array,
    num_parallel: int | None = None,
    devices: int | None = None,
    on_done: Callable[[], None] | None = None,
) -> Outcome:
    """Trains and tests one fresh agent for each key, over all devices; leaves `[agent]`.

    `env, env_params` are what `sejax.load` returns, `task` the real one.

    It compiles at every call: in a loop, jit `make_evaluator` yourself. `on_done` is called from
    the program's threads as each agent ends, also for copies that fill up the last lanes. The
    numbers are the same with it, but jax keeps no compiled program that calls back.
    """
    evaluate = make_evaluator(agent, env, task, training)

    def one(key: Array) -> Outcome:
        outcome: Outcome = evaluate(key, env_params)
        if on_done is not None:
            jax.debug.callback(lambda _: on_done(), outcome.test_return)
        return outcome

    program = spread_over_devices(one, devices, num_parallel, num_parallel_on_cpu(agent, training))
    return jax.jit(program, compiler_options=compiler_options())(keys)
