"""Agents that do not learn: a policy in the form that testers and recorders take."""

from collections.abc import Callable
from typing import Any

from jaxtyping import Array

from sejax.agents.base import Agent, AgentSpec, Hparams, sizes_of
from sejax.agents.buffers import no_buffer
from sejax.envs.base import Task


def make_fixed(task: Task, act: Callable[[Array, Any, Array], Array]) -> Agent:
    """A policy as an agent. The agent's state is whatever the policy needs.

    Args:
      task: gives the observations and actions.
      act: `(key, state, obs) -> action`.

    Example:
      >>> import jax, sejax
      >>> from sejax.evaluation import make_tester
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
