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
from sejax.agents.registry import make_agent
from sejax.agents.trainer import make_tester, make_trainer
from sejax.configs import AgentConfig, TrainingConfig
from sejax.envs import Task
from sejax.objectives import Outcome
from sejax.parallel import spread_over_devices
from sejax.proxies.synthetic import SyntheticEnv


def make_evaluator(
    agent: Agent, env: Any, task: Task, training: TrainingConfig
) -> Callable[..., Outcome]:
    """Builds `evaluate(key, env_params, active=True) -> Outcome` for one fresh agent.

    The agent trains in `env`, which may be a proxy or the task itself, and is tested over
    `training.test_episodes` episodes on the task. With `active=False` nothing is computed.

    `training.time_limit_is_terminal` speaks of real time limits and is ignored in an SE: there the
    last step of an episode bootstraps with what the done network says, as in the authors' code.
    """
    synthetic = isinstance(env, SyntheticEnv)
    if synthetic:
        training = dataclasses.replace(training, time_limit_is_terminal=False)
    test_once = make_tester(agent, task, num_episodes=1)
    test = make_tester(agent, task, training.test_episodes)

    def test_between(key: Array, agent_state: Any, active: Array) -> tuple[Array, Array]:
        returns, steps = test_once(key, agent_state, active)
        return returns[0], steps[0]

    train = make_trainer(agent, env, training, task.solved_reward, test_fn=test_between)

    def evaluate(key: Array, env_params: Any, active: Array | bool = True) -> Outcome:
        key_train, key_test = jax.random.split(key)
        result = train(key_train, env_params, agent.hparams, active)
        returns, steps = test(key_test, result.agent_state, active)
        test_return = returns.mean()
        real_steps = steps.sum() + result.test_steps
        return Outcome(
            test_return=test_return,
            train_steps=result.train_steps,
            train_episodes=result.episodes,
            nonfinite=result.nonfinite | ~jnp.isfinite(test_return),
            real_steps=real_steps if synthetic else real_steps + result.train_steps,
        )

    return evaluate


def evaluate_agents(
    agent_config: AgentConfig,
    env: Any,
    env_params: Any,
    task: Task,
    training: TrainingConfig,
    keys: Array,
    lanes: int | None = None,
    devices: int | None = None,
) -> Outcome:
    """Trains and tests one fresh agent for each key, over all devices; leaves `[agent]`."""
    evaluate = make_evaluator(make_agent(agent_config, task), env, task, training)
    program = spread_over_devices(lambda key: evaluate(key, env_params), devices, lanes)
    return jax.jit(program)(keys)
