"""Training fresh agents in a world and testing them on the real task.

Source: paper, Algorithm 1 (TrainAgent, EvaluateAgent) and section "Performance of SE-trained
Agents".
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from sejax.agents.agent import Agent
from sejax.agents.configs import AgentConfig
from sejax.agents.hparams import VariedAgents
from sejax.configs import TrainingConfig
from sejax.envs import Task
from sejax.objectives import Outcome
from sejax.parallel import spread_over_devices
from sejax.proxies.synthetic import SyntheticEnv
from sejax.trainer import TrainResult, make_tester, make_trainer


def make_evaluator(
    agent: Agent,
    env: Any,
    task: Task,
    training: TrainingConfig,
    stop_reward: float | None = None,
) -> Callable[..., Outcome]:
    """Builds `evaluate(key, env_params, active=True, hparams=...) -> Outcome` for a fresh agent.

    The agent trains in `env`, which may be a proxy or the task itself, and is tested over
    `training.test_episodes` episodes on the task. With `active=False` nothing is computed. What the
    solved rule asks for is `stop_reward`, or the task's threshold.
    """
    synthetic = isinstance(env, SyntheticEnv)
    test = make_tester(agent, task, training.test_episodes)
    train = make_tested_trainer(agent, env, task, training, stop_reward)

    def evaluate(
        key: Array, env_params: Any, active: Array | bool = True, hparams: Any = agent.hparams
    ) -> Outcome:
        key_train, key_test = jax.random.split(key)
        result = train(key_train, env_params, hparams, active)
        returns, steps = test(key_test, result.agent_state, active)
        real_steps = steps.sum() + result.test_steps
        return Outcome(
            test_returns=returns,
            train_steps=result.train_steps,
            train_episodes=result.episodes,
            return_area=return_area(result, returns.mean()),
            nonfinite=result.nonfinite | ~jnp.isfinite(returns).all(),
            real_steps=real_steps if synthetic else real_steps + result.train_steps,
        )

    return evaluate


def make_tested_trainer(
    agent: Agent,
    env: Any,
    task: Task,
    training: TrainingConfig,
    stop_reward: float | None = None,
    tests_between: int = 1,
) -> Callable[..., TrainResult]:
    """Builds a `make_trainer` that tests on the task after each episode if the solved rule asks so.

    Args:
      agent: from `sejax.agents`.
      env: gymnax environment to train in.
      task: the real task.
      training: stopping rule and limits.
      stop_reward: what the solved rule asks for; None for the task's threshold.
      tests_between: greedy test episodes after each training episode, of which the mean counts.

    Source: paper, section "Experiments with Reward Networks" (training and testing alternate).
    """
    test = make_tester(agent, task, tests_between)

    def test_between(key: Array, agent_state: Any, active: Array) -> tuple[Array, Array]:
        returns, steps = test(key, agent_state, active)
        return returns.mean(), steps.sum()

    stop_reward = task.solved_reward if stop_reward is None else stop_reward
    return make_trainer(agent, env, training, stop_reward, test_fn=test_between)


def return_area(result: TrainResult, final_return: Array) -> Array:
    """Sum over training episodes of return times length: the area under the learning curve.

    Args:
      result: of a training.
      final_return: of the test after it, for the steps of an episode that the step limit cut off.

    Source: paper, appendix "Studying the Influence of Different Reward Network Optimization
    Objectives" (AUC); `reference_details.md` 5.5.
    """
    lengths = jnp.diff(result.episode_ends, prepend=0)
    finished = jnp.arange(lengths.size) < result.episodes
    rest = result.train_steps - result.episode_ends.max()
    return jnp.sum(jnp.where(finished, result.returns * lengths, 0.0)) + final_return * rest


def make_varied_evaluator(
    varied: VariedAgents,
    env: Any,
    task: Task,
    training: TrainingConfig,
    stop_reward: float | None = None,
) -> Callable[..., Outcome]:
    """As `make_evaluator`, for an agent whose hyperparameters are drawn first, from the same key.

    Source: paper, section "Performance of SE-trained Agents" (HPs varied).
    """
    evaluate = varied.over_draws(
        lambda agent: make_evaluator(agent, env, task, training, stop_reward)
    )
    return lambda key, env_params, active=True: evaluate(key, env_params, active)


def evaluator_and_lanes(
    agent: Agent | VariedAgents,
    env: Any,
    task: Task,
    training: TrainingConfig,
    stop_reward: float | None = None,
) -> tuple[Callable[..., Outcome], int | None]:
    """The evaluator of an agent, fixed or varied, and the lanes that suit it on a CPU."""
    if isinstance(agent, VariedAgents):
        evaluator = make_varied_evaluator(agent, env, task, training, stop_reward)
        return evaluator, agent.agents[0].cpu_lanes
    return make_evaluator(agent, env, task, training, stop_reward), agent.cpu_lanes


def training_as_learned(proxy: Any, agent: AgentConfig) -> TrainingConfig:
    """How long agents trained while a proxy, or a set of them, was learned.

    A step budget grows by the steps for which this agent waits longer with learning than the one it
    was learned with: ten long initial episodes, or a rollout of PPO, could use it up.

    Args:
      proxy: a `Proxy` or `ProxySet`, whose `config` and `task` are used.
      agent: that is to train.
    """
    training = proxy.config.training
    if training.max_steps is None:
        return training
    before, before_then = (
        each.steps_before_learning(proxy.task.max_steps) for each in (agent, proxy.config.agent)
    )
    max_steps = training.max_steps + max(0, before - before_then)
    return dataclasses.replace(training, max_steps=max_steps)


def evaluate_agents(
    agent: Agent | VariedAgents,
    env: Any,
    env_params: Any,
    task: Task,
    training: TrainingConfig,
    keys: Array,
    lanes: int | None = None,
    devices: int | None = None,
) -> Outcome:
    """Trains and tests one fresh agent for each key, over all devices; leaves `[agent]`."""
    evaluate, cpu_lanes = evaluator_and_lanes(agent, env, task, training)
    program = spread_over_devices(lambda key: evaluate(key, env_params), devices, lanes, cpu_lanes)
    return jax.jit(program)(keys)
