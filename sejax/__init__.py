"""Synthetic environments and reward networks for reinforcement learning, in JAX.

Learn a small network that stands in for a task (`make_learner`), load one that was learned
(`load`), and train agents on it (`make_trainer`; `make_evaluator` tests them on the real task too).
Everything takes objects: tasks (`Task`, `sejax.envs.make`), agents (`make_agent`), proxies,
objectives and strategies of your own serve as well as those that come with sejax.

Names are imported on first use: importing `sejax` costs nothing, sets no environment variable and
touches no flag.
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "1.0.0"

_EXPORTS = {
    "AUC": "sejax.objectives",
    "AUCSum": "sejax.objectives",
    "Agent": "sejax.agents.base",
    "ConfigError": "sejax.options",
    "CountBasedConfig": "sejax.agents.exploration",
    "DDQNConfig": "sejax.agents.dqn",
    "DQNConfig": "sejax.agents.dqn",
    "DiscreteTD3Config": "sejax.agents.td3",
    "DuelingDDQNConfig": "sejax.agents.dqn",
    "Evaluations": "sejax.es.base",
    "EvosaxConfig": "sejax.es.evosax",
    "ICMConfig": "sejax.agents.exploration",
    "LearnResult": "sejax.bilevel",
    "MaxReward": "sejax.objectives",
    "Mixture": "sejax.agents.mixture",
    "MixtureConfig": "sejax.agents.mixture",
    "NESConfig": "sejax.es.nes",
    "Objective": "sejax.objectives",
    "Outcome": "sejax.objectives",
    "PPOConfig": "sejax.agents.ppo",
    "PretrainedProxy": "sejax.proxies.zoo",
    "Proxy": "sejax.proxies.io",
    "ProxyConfig": "sejax.proxies",
    "ProxyEnv": "sejax.proxies.base",
    "ProxyParams": "sejax.proxies.base",
    "ProxySet": "sejax.proxies.io",
    "QLearningConfig": "sejax.agents.tabular",
    "RewardConfig": "sejax.proxies.configs",
    "RewardThreshold": "sejax.objectives",
    "SACConfig": "sejax.agents.sac",
    "SARSAConfig": "sejax.agents.tabular",
    "Strategy": "sejax.es.base",
    "SyntheticConfig": "sejax.proxies.configs",
    "TD3Config": "sejax.agents.td3",
    "Task": "sejax.envs.base",
    "TrainResult": "sejax.training",
    "TrainingConfig": "sejax.training",
    "agent_of": "sejax.proxies.io",
    "config": "sejax.runs.config",
    "configure_xla": "sejax.runs.runtime",
    "evaluate_agents": "sejax.evaluation",
    "load": "sejax.proxies.io",
    "load_proxy": "sejax.proxies.io",
    "load_set": "sejax.proxies.io",
    "make_agent": "sejax.agents",
    "make_evaluator": "sejax.evaluation",
    "make_learner": "sejax.bilevel",
    "make_trainer": "sejax.training",
    "pretrained": "sejax.proxies.zoo",
    "push": "sejax.proxies.zoo",
    "register_gymnax": "sejax.proxies.io",
    "save": "sejax.proxies.io",
    "save_set": "sejax.proxies.io",
    "spread_over_devices": "sejax.ops.parallel",
    "training_of": "sejax.proxies.io",
}
_MODULES = ("agents", "envs", "es", "gym", "options", "proxies")

if TYPE_CHECKING:  # what a type checker and an editor see
    from sejax import agents, envs, es, gym, options, proxies
    from sejax.agents import make_agent
    from sejax.agents.base import Agent
    from sejax.agents.dqn import DDQNConfig, DQNConfig, DuelingDDQNConfig
    from sejax.agents.exploration import CountBasedConfig, ICMConfig
    from sejax.agents.mixture import Mixture, MixtureConfig
    from sejax.agents.ppo import PPOConfig
    from sejax.agents.sac import SACConfig
    from sejax.agents.tabular import QLearningConfig, SARSAConfig
    from sejax.agents.td3 import DiscreteTD3Config, TD3Config
    from sejax.bilevel import LearnResult, make_learner
    from sejax.envs.base import Task
    from sejax.es.base import Evaluations, Strategy
    from sejax.es.evosax import EvosaxConfig
    from sejax.es.nes import NESConfig
    from sejax.evaluation import evaluate_agents, make_evaluator
    from sejax.objectives import AUC, AUCSum, MaxReward, Objective, Outcome, RewardThreshold
    from sejax.ops.parallel import spread_over_devices
    from sejax.options import ConfigError
    from sejax.proxies import ProxyConfig
    from sejax.proxies.base import ProxyEnv, ProxyParams
    from sejax.proxies.configs import RewardConfig, SyntheticConfig
    from sejax.proxies.io import (
        Proxy,
        ProxySet,
        agent_of,
        load,
        load_proxy,
        load_set,
        register_gymnax,
        save,
        save_set,
        training_of,
    )
    from sejax.proxies.zoo import PretrainedProxy, pretrained, push
    from sejax.runs.config import config
    from sejax.runs.runtime import configure_xla
    from sejax.training import TrainingConfig, TrainResult, make_trainer

__all__ = [
    "AUC",
    "AUCSum",
    "Agent",
    "ConfigError",
    "CountBasedConfig",
    "DDQNConfig",
    "DQNConfig",
    "DiscreteTD3Config",
    "DuelingDDQNConfig",
    "Evaluations",
    "EvosaxConfig",
    "ICMConfig",
    "LearnResult",
    "MaxReward",
    "Mixture",
    "MixtureConfig",
    "NESConfig",
    "Objective",
    "Outcome",
    "PPOConfig",
    "PretrainedProxy",
    "Proxy",
    "ProxyConfig",
    "ProxyEnv",
    "ProxyParams",
    "ProxySet",
    "QLearningConfig",
    "RewardConfig",
    "RewardThreshold",
    "SACConfig",
    "SARSAConfig",
    "Strategy",
    "SyntheticConfig",
    "TD3Config",
    "Task",
    "TrainResult",
    "TrainingConfig",
    "agent_of",
    "agents",
    "config",
    "configure_xla",
    "envs",
    "es",
    "evaluate_agents",
    "gym",
    "load",
    "load_proxy",
    "load_set",
    "make_agent",
    "make_evaluator",
    "make_learner",
    "make_trainer",
    "options",
    "pretrained",
    "proxies",
    "push",
    "register_gymnax",
    "save",
    "save_set",
    "spread_over_devices",
    "training_of",
]


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        return getattr(importlib.import_module(_EXPORTS[name]), name)
    if name in _MODULES:
        return importlib.import_module(f"sejax.{name}")
    raise AttributeError(f"module 'sejax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
