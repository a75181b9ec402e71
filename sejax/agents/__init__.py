"""Agents: bundles of pure functions. An algorithm and its variants share a file with their options.

Here are also the parts for an agent of your own: `AgentOptions` for its configuration, `traced` for
the hyperparameters that compiled programs take as arguments, and the buffers.
"""

import dataclasses

from sejax.agents.base import Agent as Agent
from sejax.agents.base import AgentConfig as AgentConfig
from sejax.agents.base import AgentOptions as AgentOptions
from sejax.agents.base import AgentSpec as AgentSpec
from sejax.agents.base import ExplorationConfig as ExplorationConfig
from sejax.agents.base import Hparams as Hparams
from sejax.agents.base import NoExploration as NoExploration
from sejax.agents.base import traced as traced
from sejax.agents.buffers import Buffer as Buffer
from sejax.agents.buffers import Rollout as Rollout
from sejax.agents.buffers import Transition as Transition
from sejax.agents.buffers import no_buffer as no_buffer
from sejax.agents.buffers import replay_buffer as replay_buffer
from sejax.agents.buffers import rollout_buffer as rollout_buffer
from sejax.agents.varied import make_varied
from sejax.envs.base import Task
from sejax.envs.spec import TaskSpec, sizes_of
from sejax.options import ConfigError, registry
from sejax.options.registry import require_part

# The usual agents by actions: first a task's default, last the one that often learns fastest.
USUAL = {"discrete": ("ddqn", "ppo"), "continuous": ("td3", "sac")}


def names() -> list[str]:
    """Names of the agents that come with sejax or with installed packages."""
    return registry.names("agent")


def make_agent(
    config: AgentConfig,
    task: Task,
    exploration: ExplorationConfig = NoExploration(),
    varied: bool = False,
) -> Agent:
    """The agent for a task's observations and actions; one object for equal arguments with hashes.

    Args:
      config: configuration of the agent, such as `DDQNConfig()`.
      task: the real task, a `sejax.Task`.
      exploration: configuration of an intrinsic reward, such as `ICMConfig()`.
      varied: whether hyperparameters are drawn anew for each training (paper, appendix "Varied
        Agent Hyperparameters").

    Raises:
      ConfigError: if the agent does not fit the task's observations or actions, if the exploration
        does not fit the agent, or if a varied agent has no option with `varied` set.

    Example:
      >>> import sejax
      >>> agent = make_agent(sejax.DDQNConfig(hidden_size=64), sejax.envs.make("cartpole"))
      >>> agent.spec.stops_from
      1
    """
    require_part("agent", AgentConfig, config, "Write make_agent(DDQNConfig(), task), for example.")
    require_part("task", TaskSpec, task, "Set task to env.task, or sejax.Task(name=..., env=env).")
    require_part("exploration", ExplorationConfig, exploration, "Pass one, such as ICMConfig().")
    require_fit(config, exploration, task, task.name)
    return registry.make("agent", _WholeAgent(varied), config, exploration, task)


@dataclasses.dataclass(frozen=True)
class _WholeAgent:
    """Makes an agent of all its parts: equal parts give one agent."""

    varied: bool

    def make(self, config: AgentConfig, exploration: ExplorationConfig, task: Task) -> Agent:
        if self.varied:
            return make_varied(config, lambda x: make_agent(x, task, exploration))
        agent = registry.make("agent", config, task)
        agent = registry.make("exploration", exploration, agent, task)
        sizes = sizes_of(task.observation, task.action)
        return dataclasses.replace(agent, spec=dataclasses.replace(agent.spec, sizes=sizes))


def require_fit(
    agent: AgentConfig,
    exploration: ExplorationConfig,
    spec: TaskSpec,
    task_name: str,
    field: str = "agent",
) -> None:
    """Checks that an agent fits a task, and that an exploration fits the agent.

    Args:
      agent: configuration of the agent.
      exploration: configuration of its intrinsic reward.
      spec: spaces of the task.
      task_name: for messages.
      field: field of the agent, for messages.

    Raises:
      ConfigError: if one of them does not fit.
    """
    if not _fits(agent, spec):
        known = fitting(spec) or ["MODULE:NAME"]
        rule = f"must be one of {', '.join(known)} in {task_name}"
        raise ConfigError(field, rule, got=registry.name_of("agent", agent), use=known[0])
    if exploration.states is not None and agent.states not in (None, exploration.states):
        got = registry.name_of("exploration", exploration)
        raise ConfigError("exploration", f"must be for {agent.states} states", got=got, use="none")


def default_for(spec: TaskSpec) -> str:
    """The default agent of a task: DDQN or TD3; Q-learning where the states are indices."""
    usual = USUAL[spec.actions][0]
    return usual if _fits(registry.find("agent", usual), spec) else "q_learning"


def fitting(spec: TaskSpec) -> list[str]:
    """Names of the agents that can act in a task."""
    return [name for name in names() if _fits(registry.find("agent", name), spec)]


def _fits(agent: AgentConfig | type[AgentConfig], spec: TaskSpec) -> bool:
    return agent.states in (None, spec.states) and spec.actions in agent.actions
