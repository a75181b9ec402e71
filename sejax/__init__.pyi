"""The public names of sejax and their modules, which are imported on first use."""

from . import (
    agents as agents,
    envs as envs,
    es as es,
    gym as gym,
    options as options,
    proxies as proxies,
)
from .agents import make_agent as make_agent
from .agents.base import Agent as Agent
from .agents.dqn import (
    DDQNConfig as DDQNConfig,
    DQNConfig as DQNConfig,
    DuelingDDQNConfig as DuelingDDQNConfig,
)
from .agents.exploration import CountBasedConfig as CountBasedConfig, ICMConfig as ICMConfig
from .agents.mixture import Mixture as Mixture, MixtureConfig as MixtureConfig
from .agents.ppo import PPOConfig as PPOConfig
from .agents.sac import SACConfig as SACConfig
from .agents.tabular import QLearningConfig as QLearningConfig, SARSAConfig as SARSAConfig
from .agents.td3 import DiscreteTD3Config as DiscreteTD3Config, TD3Config as TD3Config
from .bilevel import LearnResult as LearnResult, make_learner as make_learner
from .check import check as check
from .envs.base import Task as Task
from .es.base import Strategy as Strategy
from .es.evosax import EvosaxConfig as EvosaxConfig
from .es.nes import NESConfig as NESConfig
from .evaluation import evaluate_agents as evaluate_agents, make_evaluator as make_evaluator
from .objectives import (
    AUC as AUC,
    AUCSum as AUCSum,
    MaxReward as MaxReward,
    Objective as Objective,
    Outcome as Outcome,
    RewardThreshold as RewardThreshold,
)
from .ops.parallel import (
    compiler_options as compiler_options,
    spread_over_devices as spread_over_devices,
)
from .options import ConfigError as ConfigError
from .proxies import ProxyConfig as ProxyConfig
from .proxies.base import ProxyEnv as ProxyEnv, ProxyParams as ProxyParams
from .proxies.io import (
    Proxy as Proxy,
    ProxySet as ProxySet,
    agent_of as agent_of,
    load as load,
    load_proxy as load_proxy,
    load_set as load_set,
    register_gymnax as register_gymnax,
    save as save,
    save_set as save_set,
    training_of as training_of,
)
from .proxies.reward import RewardConfig as RewardConfig
from .proxies.synthetic import SyntheticConfig as SyntheticConfig
from .proxies.zoo import PretrainedProxy as PretrainedProxy, pretrained as pretrained, push as push
from .runs.config import config as config
from .runs.runtime import configure_xla as configure_xla
from .training import (
    TrainingConfig as TrainingConfig,
    TrainResult as TrainResult,
    make_trainer as make_trainer,
)

__version__: str
