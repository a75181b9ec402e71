"""The agents' hyperparameters. Importing this imports no jax."""

from dataclasses import dataclass
from typing import ClassVar

from sejax.validation import at_least, default, fraction, one_of, positive

ACTIVATIONS = ("tanh", "relu", "leaky_relu", "prelu")


@dataclass(frozen=True, kw_only=True)
class AgentConfig:
    """What all agents share.

    Class attributes say which tasks an agent fits: `states` is "vector" or "discrete", `actions`
    lists "discrete" and "continuous".
    """

    states: ClassVar[str] = "vector"
    actions: ClassVar[tuple[str, ...]] = ("discrete",)

    name: str
    init_episodes: int = 10  # episodes before learning starts and before a stop rule may judge

    def __post_init__(self) -> None:
        cls = type(self)
        one_of("agent.name", self.name, tuple(AGENT_CONFIGS))
        at_least(0, "agent.init_episodes", self.init_episodes, "it counts episodes", 1)
        for name in ("batch_size", "buffer_size", "hidden_size", "num_layers", "action_repeat",
                     "policy_delay", "epochs", "update_episodes", "feature_dim",
                     "stream_hidden_size", "temperature_steps"):  # fmt: skip
            if hasattr(self, name):
                at_least(1, f"agent.{name}", getattr(self, name), "there is nothing to learn from "
                         "or with otherwise", default(cls, name))  # fmt: skip
        for name in ("learning_rate", "clip_ratio", "init_action_std", "temperature"):
            if hasattr(self, name):
                positive(f"agent.{name}", getattr(self, name), "the agent would not move",
                         default(cls, name))  # fmt: skip
        for name in ("target_update_rate", "discount", "epsilon_init", "epsilon_min",
                     "epsilon_decay", "final_temperature"):  # fmt: skip
            if hasattr(self, name):
                fraction(f"agent.{name}", getattr(self, name), default(cls, name))
        for name in ("action_noise_std", "target_noise_std", "target_noise_clip", "value_weight",
                     "entropy_weight", "stream_num_layers"):  # fmt: skip
            if hasattr(self, name):
                at_least(
                    0, f"agent.{name}", getattr(self, name), "it is a size", default(cls, name)
                )
        if hasattr(self, "activation"):
            one_of("agent.activation", self.activation, ACTIVATIONS)

    def steps_before_learning(self, max_episode_steps: int) -> int:
        """Training steps before the agent first learns, where episodes have this length."""
        return self.init_episodes * max_episode_steps


@dataclass(frozen=True, kw_only=True)
class DDQNConfig(AgentConfig):
    """DDQN's hyperparameters; the defaults are the paper's "default agent hyperparameters"."""

    name: str = "ddqn"
    batch_size: int = 128
    buffer_size: int = 100_000
    hidden_size: int = 128
    num_layers: int = 2
    activation: str = "relu"
    learning_rate: float = 1e-3
    target_update_rate: float = 0.01  # tau: weight of the online network in the target's update.
    discount: float = 0.99  # gamma
    epsilon_init: float = 1.0
    epsilon_min: float = 0.01
    epsilon_decay: float = 0.9  # factor for each episode


@dataclass(frozen=True, kw_only=True)
class DuelingDDQNConfig(DDQNConfig):
    """DDQN with a dueling network (paper, appendix, tables of DDQN and Dueling DDQN)."""

    name: str = "dueling_ddqn"
    feature_dim: int = 128  # outputs of the part that both streams share
    stream_num_layers: int = 1  # hidden layers of the value and of the advantage stream
    stream_hidden_size: int = 128


@dataclass(frozen=True, kw_only=True)
class TD3Config(AgentConfig):
    """TD3's hyperparameters (paper, appendix "MountainCarContinuous-v0 and HalfCheetah-v3")."""

    actions: ClassVar[tuple[str, ...]] = ("continuous",)

    name: str = "td3"
    init_episodes: int = 20  # with uniformly random actions
    batch_size: int = 256
    buffer_size: int = 100_000
    hidden_size: int = 128
    num_layers: int = 2
    activation: str = "relu"
    learning_rate: float = 3e-4  # of the actor and the critics
    target_update_rate: float = 0.005
    discount: float = 0.99
    policy_delay: int = 2  # learning steps for each update of the actor and of the targets
    action_repeat: int = 1  # steps of the world for each decision
    action_noise_std: float = 0.1  # exploration, in units of the largest action
    target_noise_std: float = 0.2  # smoothing of the target policy, likewise
    target_noise_clip: float = 0.5
    noisy_tests: bool = False  # exploration noise in tests too, as in the authors' code


@dataclass(frozen=True, kw_only=True)
class DiscreteTD3Config(TD3Config):
    """TD3 for discrete actions: the policy is a Gumbel-Softmax (paper, default agent table)."""

    actions: ClassVar[tuple[str, ...]] = ("discrete",)

    name: str = "td3_discrete"
    init_episodes: int = 10
    batch_size: int = 128
    activation: str = "tanh"
    learning_rate: float = 5e-4
    target_update_rate: float = 0.01
    layer_norm: bool = True  # after each hidden layer but the first, as in the authors' code
    temperature: float = 1.0  # of the Gumbel-Softmax at the start
    final_temperature: float = 0.05  # as a fraction of it, reached linearly ...
    temperature_steps: int = 2000  # ... after so many learning steps
    one_hot_actions: bool = False  # straight-through one-hot actions in place of soft ones


@dataclass(frozen=True, kw_only=True)
class PPOConfig(AgentConfig):
    """PPO (clip) for discrete and continuous actions (paper, appendix, table of PPO)."""

    actions: ClassVar[tuple[str, ...]] = ("discrete", "continuous")

    name: str = "ppo"
    init_episodes: int = 1  # PPO learns from the start; this only holds back the stop rule
    hidden_size: int = 64
    num_layers: int = 2
    activation: str = "relu"
    learning_rate: float = 3e-4
    discount: float = 0.99
    update_episodes: int = 10  # episodes of full length between two learning phases
    epochs: int = 80  # Adam steps on all of the rollout in a learning phase
    clip_ratio: float = 0.2
    value_weight: float = 1.0
    entropy_weight: float = 0.01
    init_action_std: float = 0.5  # of the Gaussian policy; learned
    action_repeat: int = 1

    def rollout_length(self, max_episode_steps: int) -> int:
        """Decisions between two learning phases.

        The authors learn as soon as (decisions x `action_repeat`) / `max_episode_steps` exceeds
        `update_episodes`, also in the middle of an episode; this is the first whole number that
        does.

        Source: `reference_details.md` 4.5.
        """
        return self.update_episodes * max_episode_steps // self.action_repeat + 1

    def steps_before_learning(self, max_episode_steps: int) -> int:
        """As of any agent; PPO learns once a rollout is full."""
        return self.rollout_length(max_episode_steps) * self.action_repeat


@dataclass(frozen=True, kw_only=True)
class QLearningConfig(AgentConfig):
    """Tabular Q-learning (paper, appendix "Cliff Walking")."""

    states: ClassVar[str] = "discrete"

    name: str = "q_learning"
    init_episodes: int = 0
    learning_rate: float = 1.0
    discount: float = 0.8
    epsilon_init: float = 0.1
    epsilon_min: float = 0.1
    epsilon_decay: float = 0.0


@dataclass(frozen=True, kw_only=True)
class SARSAConfig(QLearningConfig):
    """Tabular SARSA; the same hyperparameters."""

    name: str = "sarsa"


AGENT_CONFIGS: dict[str, type[AgentConfig]] = {
    "ddqn": DDQNConfig,
    "dueling_ddqn": DuelingDDQNConfig,
    "td3": TD3Config,
    "td3_discrete": DiscreteTD3Config,
    "ppo": PPOConfig,
    "q_learning": QLearningConfig,
    "sarsa": SARSAConfig,
}


@dataclass(frozen=True, kw_only=True)
class ExplorationConfig:
    """No intrinsic reward."""

    agents: ClassVar[tuple[str, ...]] = tuple(AGENT_CONFIGS)

    name: str = "none"


@dataclass(frozen=True, kw_only=True)
class ICMConfig(ExplorationConfig):
    """Intrinsic curiosity module (paper, appendix, tables of ICM)."""

    agents: ClassVar[tuple[str, ...]] = ("ddqn", "dueling_ddqn", "td3", "td3_discrete", "ppo")

    name: str = "icm"
    learning_rate: float = 1e-5
    forward_weight: float = 0.05  # beta: the forward model's share of the loss
    reward_scale: float = 0.03  # eta: intrinsic reward for each unit of prediction error
    feature_dim: int = 32
    hidden_size: int = 128
    num_layers: int = 2
    num_residual_blocks: int = 4

    def __post_init__(self) -> None:
        positive("exploration.learning_rate", self.learning_rate, "Adam would not move", 1e-5)
        fraction("exploration.forward_weight", self.forward_weight, 0.05)
        at_least(0, "exploration.reward_scale", self.reward_scale, "it scales a bonus", 0.03)
        for name in ("feature_dim", "hidden_size", "num_layers"):
            at_least(1, f"exploration.{name}", getattr(self, name), "the models need units",
                     default(ICMConfig, name))  # fmt: skip
        at_least(0, "exploration.num_residual_blocks", self.num_residual_blocks, "it counts", 4)


@dataclass(frozen=True, kw_only=True)
class CountBasedConfig(ExplorationConfig):
    r"""A bonus :math:`\beta / n(s, a)^p` for rarely taken actions."""

    agents: ClassVar[tuple[str, ...]] = ("q_learning", "sarsa")

    name: str = "count_based"
    reward_scale: float = 0.1  # beta
    count_power: float = 1.0  # p: 1 in the paper's text, 0.5 in the authors' code

    def __post_init__(self) -> None:
        at_least(0, "exploration.reward_scale", self.reward_scale, "it scales a bonus", 0.1)
        positive("exploration.count_power", self.count_power, "the bonus would not fade", 1)


EXPLORATION_CONFIGS: dict[str, type[ExplorationConfig]] = {
    "none": ExplorationConfig,
    "icm": ICMConfig,
    "count_based": CountBasedConfig,
}
