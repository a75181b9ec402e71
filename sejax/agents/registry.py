"""Builds the agent that a configuration names, for a task."""

from sejax.agents.agent import Agent
from sejax.agents.ddqn import make_ddqn
from sejax.configs import DDQNConfig
from sejax.envs import Task


def make_agent(config: DDQNConfig, task: Task) -> Agent:
    """The agent for a task's observations and actions; the same object for the same arguments."""
    return make_ddqn(config, task.obs_dim, task.num_actions)
