"""Agents: bundles of pure functions, a file each with configuration and learning.

What one's own agent is made of is here too: `AgentOptions` for its configuration, `traced` for the
hyperparameters that compiled programs take as arguments, and the memories.
"""

import functools
from typing import Any

from sejax import registry
from sejax.agents.base import Agent, AgentOptions, NoExploration, traced
from sejax.agents.memory import Memory, Rollout, no_memory, replay_memory, rollout_memory
from sejax.agents.replay import Transition
from sejax.envs.spec import TaskSpec
from sejax.errors import require

__all__ = [
    "Agent",
    "AgentOptions",
    "Memory",
    "NoExploration",
    "Rollout",
    "Transition",
    "make_agent",
    "names",
    "no_memory",
    "replay_memory",
    "require_fit",
    "rollout_memory",
    "traced",
]

DEFAULTS = ("ddqn", "td3", "q_learning")  # of which the first that suits a task is its own


def names() -> list[str]:
    """Names of the agents that come with sejax or with installed packages."""
    return registry.names("agent")


def make_agent(
    config: Any,
    task: Any,
    exploration: Any = NoExploration(),  # noqa: B008 (frozen)
    varied: bool = False,
) -> Agent:
    """The agent for a task's observations and actions; the same object for the same arguments.

    Args:
      config: of the agent, such as `DDQNConfig()`; anything with `make(task) -> Agent`.
      task: the real task.
      exploration: intrinsic reward, such as `ICMConfig()`.
      varied: whether hyperparameters are drawn anew for each training (paper, appendix "Varied
        Agent Hyperparameters").

    Raises:
      ConfigError: if the agent does not suit the task's states or actions, or the exploration the
        agent; or if none of a varied agent's options says how it is drawn.

    Example:
      >>> import sejax
      >>> agent = make_agent(sejax.DDQNConfig(hidden_size=64), sejax.envs.make("cartpole"))
      >>> agent.warmup_episodes
      10
    """
    require(
        isinstance(task, TaskSpec),
        "task",
        "be a sejax.Task",
        "an agent is made for its spaces",
        type(task).__name__,
        "task to env.task, or sejax.Task(name=..., env=env)",
    )
    require(
        hasattr(config, "make") and not isinstance(config, type),
        "config",
        "be an agent's configuration",
        "the agent is made by it",
        config,
        "config to such as sejax.DDQNConfig()",
    )
    require_fit(config, exploration, task, task.name)
    return _make_agent(registry.Same(config, exploration), task, varied)


@functools.cache
def _make_agent(key: registry.Same, task: Any, varied: bool) -> Agent:
    config, exploration = key.configs

    def make(config: Any) -> Agent:
        agent = registry.make("agent", config, task)
        return registry.make("exploration", exploration, agent, task)

    if not varied:
        return make(config)
    from sejax.agents.varied import make_varied

    return make_varied(config, make)


def require_fit(agent: Any, exploration: Any, spec: TaskSpec, task_name: str) -> None:
    """Checks that an agent can act in a task, and that it can be made to explore so.

    Args:
      agent: its configuration; one without `states` and `actions` suits every task.
      exploration: that of its intrinsic reward.
      spec: of the task.
      task_name: for messages.

    Raises:
      ConfigError: if it cannot.
    """
    if not _suits(agent, spec):
        fitting = [name for name in names() if _suits(registry.find("agent", name), spec)]
        require(
            False,
            "agent",
            f"be one of {', '.join(fitting)} in {task_name}",
            f"its states are {spec.states} and its actions {spec.actions}",
            registry.name_of("agent", agent),
            f"agent={fitting[0]}",
        )
    for field in ("train_every", "gradient_steps") if _learns_each_step(exploration) else ():
        value = getattr(agent, field, 1)
        require(
            value == 1,
            f"agent.{field}",
            f"be 1 with exploration={registry.name_of('exploration', exploration)}",
            "its module learns once at each step, and so must the agent",
            value,
            f"agent.{field}=1",
        )
    wanted = getattr(exploration, "states", None)
    name = registry.name_of("agent", agent)
    require(
        wanted in (None, getattr(agent, "states", wanted)),
        "exploration",
        f"suit {name}",
        f"{registry.name_of('exploration', exploration)} is made for agents with {wanted} states",
        registry.name_of("exploration", exploration),
        "exploration=none",
    )


def _learns_each_step(exploration: Any) -> bool:
    return getattr(exploration, "learns_each_step", False)


def default_for(spec: TaskSpec) -> str:
    """The agent that is chosen for a task where none is asked for: the first that suits it."""
    fitting = (name for name in DEFAULTS if _suits(registry.find("agent", name), spec))
    return next(fitting, DEFAULTS[0])  # which will be refused, if none does


def _suits(agent: Any, spec: TaskSpec) -> bool:
    states, actions = getattr(agent, "states", None), getattr(agent, "actions", None)
    return states in (None, spec.states) and (actions is None or spec.actions in actions)
