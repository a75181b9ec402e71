"""Builds the agent that a configuration names, for a task."""

from sejax.agents import configs
from sejax.agents.agent import Agent
from sejax.agents.configs import AgentConfig, ExplorationConfig
from sejax.configs import require_fit
from sejax.envs import Task


def make_agent(
    config: AgentConfig,
    task: Task,
    exploration: ExplorationConfig = ExplorationConfig(),  # noqa: B008 (frozen)
) -> Agent:
    """The agent for a task's observations and actions; the same object for the same arguments.

    Raises:
      ConfigError: if the agent does not suit the task's states or actions.
    """
    require_fit(config, exploration, task.name)
    agent = _plain_agent(config, task)
    if isinstance(exploration, configs.ICMConfig):
        from sejax.agents.icm import with_icm

        return with_icm(agent, exploration, task.obs_dim, task.num_actions, task.action_dim)
    if isinstance(exploration, configs.CountBasedConfig):
        from sejax.agents.count_based import with_count_bonus

        return with_count_bonus(
            agent, exploration, _count(task.num_states), _count(task.num_actions)
        )
    return agent


def _plain_agent(config: AgentConfig, task: Task) -> Agent:
    match config:
        case configs.DDQNConfig():
            from sejax.agents.ddqn import make_ddqn

            return make_ddqn(config, task.obs_dim, _count(task.num_actions))
        case configs.DiscreteTD3Config():
            from sejax.agents.td3 import make_td3_discrete

            return make_td3_discrete(config, task.obs_dim, _count(task.num_actions))
        case configs.TD3Config():
            from sejax.agents.td3 import make_td3

            return make_td3(config, task.obs_dim, task.action_dim, task.max_action)
        case configs.PPOConfig():
            from sejax.agents.ppo import make_ppo

            action_dim = task.action_dim if task.num_actions is None else None
            return make_ppo(config, task.obs_dim, task.num_actions, action_dim, task.max_action,
                            task.max_steps)  # fmt: skip
        case configs.SARSAConfig():
            from sejax.agents.tabular import make_sarsa

            return make_sarsa(config, _count(task.num_states), _count(task.num_actions))
        case configs.QLearningConfig():
            from sejax.agents.tabular import make_q_learning

            return make_q_learning(config, _count(task.num_states), _count(task.num_actions))
    raise TypeError(f"no agent for {type(config).__name__}")


def _count(number: int | None) -> int:
    """A count that `require_fit` has made sure is there."""
    assert number is not None
    return number
